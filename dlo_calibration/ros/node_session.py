# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""NodeSession: what the sessions of the three nodes have in common, and what they need from their node."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Callable, Generic, Mapping, Protocol, Sequence, TypeVar

from dlo_calibration.calibration.options import DeclaredOptions
from dlo_calibration.errors import DEFECT, DloCalibrationError, InputError, safe_line
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.messages.refusals import Refusals

FAILED = 'failed'  # a state of each node
NO_TEXTS = ['']  # an empty list of texts as a parameter: ROS cannot distinguish it from other empty lists
Chosen_co = TypeVar('Chosen_co', bound=DeclaredOptions, covariant=True)


class NodeInterface(Protocol[Chosen_co]):
    """What a session needs from its node, whose options are of some class."""

    def options(self) -> Chosen_co:
        """Return the options in force."""

    def stamp(self) -> int:
        """Return the time for the header of a message [ns]."""

    def topic(self, name: str) -> str:
        """Return the full name of one of the node's topics."""

    def decode(self, kind: str, octets: bytes) -> Any:
        """Return the message that came on an input topic; damaged bytes may raise any exception."""

    def encode(self, name: str, message: Any) -> bytes:
        """Return the CDR bytes of a message for an output topic."""

    def publish(self, name: str, octets: bytes) -> None:
        """Publish bytes on an output topic."""

    def hear_waiting(self) -> None:
        """Pass messages that wait to the session, for a moment only."""

    def info(self, text: str) -> None:
        """Log a text."""

    def warn(self, text: str) -> None:
        """Log a warning."""

    def error(self, text: str) -> None:
        """Log an error."""


@dataclass
class NodeState:
    """
    What the status says of either node.

    :param name: of the state, e.g. FAILED.
    :param detail: about it, e.g. why the node failed.
    :param counted: the refusals, by their reason.
    """

    name: str
    detail: str = ''
    last_refusal: str = ''
    counted: Refusals = field(default_factory=Refusals)


class NodeSession(Generic[Chosen_co]):
    """
    The session of a node, which reports every error in the log and in ``~/status``, and goes on working.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param inputs: name of each input topic -> its type.
    :param clock: a monotonic clock [s].
    :ivar requests: name of each service -> what it does; it returns the answer.
    """

    status_period = 1.0  # s between two messages about no more than what changes with each message

    def __init__(self, graph: NodeInterface[Chosen_co], types: MessageTypes, inputs: Mapping[str, str],
                 state: NodeState, clock: Callable[[], float]) -> None:
        self._graph, self._types, self._inputs, self._clock = graph, types, inputs, clock
        self._state = state
        self.requests: Mapping[str, Callable[[], str]] = {}
        self._status: dict[str, Any] = {}  # content of the last message
        self._status_sent = float('-inf')  # [s]

    def hear(self, kind: str, octets: bytes) -> None:
        """Take a message that came on an input topic."""
        raise NotImplementedError

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second."""
        raise NotImplementedError

    def refuse(self, text: str) -> None:
        """Report a refusal in the log and in ``~/status``; a repeated reason only now and then."""
        self._state.last_refusal = self._state.counted.add(safe_line(text))
        self._report_refusals()

    def request(self, name: str) -> tuple[bool, str]:
        """Serve one of the `requests`; return whether that succeeded, and the answer."""
        try:
            answer = self.requests[name]()
        except Exception as error:
            answer = str(error) if isinstance(error, DloCalibrationError) else f'{error!r}; {DEFECT}'
            self.refuse(answer)
            return False, answer
        self._report()
        return True, answer

    def fail(self, text: str, *log: str) -> None:
        """Report a failure in ``~/status`` and in the log; `log` has the lines of the log if they differ."""
        self._state.name, self._state.detail = FAILED, safe_line(text)
        for line in log or (text,):
            self._graph.error(line)
        self._report()

    def close(self) -> None:
        """End the session."""
        raise NotImplementedError

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        raise NotImplementedError

    def _status_is_due(self, content: dict[str, Any], *passing: str) -> bool:
        """Return whether to send this status now; if only `passing` contents changed, once a second."""
        changed = {name for name, value in content.items() if value != self._status.get(name, content)}
        now = self._clock()
        if not changed or changed <= {*passing} and now - self._status_sent < self.status_period:
            return False
        self._status, self._status_sent = content, now
        return True

    def _report_refusals(self) -> None:
        self._warn(self._state.counted.due(self._clock()))

    def _warn(self, texts: Sequence[str]) -> None:
        for text in texts:
            self._graph.warn(text)
        if texts:
            self._report()

    def _decoded(self, kind: str, octets: bytes) -> Any:
        """
        Return the message that came on an input topic.

        :raises InputError: if its bytes are damaged.
        """
        try:
            return self._graph.decode(kind, octets)
        except Exception as error:  # whatever the decoder meets in damaged bytes
            raise InputError(kind, f'bytes that do not decode ({error!r})', f'a {self._inputs[kind]}',
                             'check what publishes it') from error


def refusal_text(error: Exception, kind: str) -> str:
    """Return the text that refuses a message of a kind because of an error."""
    return str(error) if isinstance(error, InputError) else f'{kind}: could not be used ({error!r}); {DEFECT}'
