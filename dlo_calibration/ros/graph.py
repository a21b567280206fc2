# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Graph: what a session needs from its node."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

from dlo_calibration.calibration.declaration import DeclaredOptions
from dlo_calibration.errors import DEFECT, InputError

Chosen_co = TypeVar('Chosen_co', bound=DeclaredOptions, covariant=True)


class Graph(Protocol[Chosen_co]):
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


def decoded(graph: Graph[Any], kind: str, type_name: str, octets: bytes) -> Any:
    """
    Return the message that came on an input topic.

    :raises InputError: if its bytes are damaged.
    """
    try:
        return graph.decode(kind, octets)
    except Exception as error:  # whatever the decoder meets in damaged bytes
        raise InputError(kind, f'bytes that do not decode ({error!r})', f'a {type_name}',
                         'check what publishes it') from error


def why(error: Exception, kind: str) -> str:
    """Return why a message of a kind is refused."""
    return str(error) if isinstance(error, InputError) else f'{kind}: could not be used ({error!r}); {DEFECT}'
