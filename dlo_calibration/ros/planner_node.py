# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node `planner`: subscriptions, publishers, services and a timer around a `PlannerSession`.

It publishes a description that comes from a file, and else listens for one.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import Description, read_description, WHAT
from dlo_calibration.files.xml import read_octets
from dlo_calibration.ros import graph_node
from dlo_calibration.ros.graph_node import GraphNode, waiting
from dlo_calibration.ros.planner_options import PlannerOptions, PUBLISH
from dlo_calibration.ros.planner_session import (
    ACTION,
    CHAIN,
    DESCRIPTION,
    GOAL,
    INPUT_TYPES,
    OUTPUT_TYPES,
    PlannerSession,
)

SLICE = 0.02  # s for the messages that wait in a queue
QUEUE = 10  # messages that wait on a topic; only the newest are of use


def spin(args: Sequence[str], should_stop: Callable[[], bool],
         make_simulator: SimulatorFactory = make_chosen_simulator) -> int:
    """
    Run the node until `should_stop` returns true; the caller handles the signals.

    :param args: command line without the program's name.
    :returns: exit code: 0; 2, with one line on stderr, if an argument or a parameter cannot be used.
    """
    return graph_node.spin('planner', lambda: PlannerNode(make_simulator), args, should_stop)


class PlannerNode(GraphNode[PlannerOptions]):
    """
    The node `planner`; it is the `Graph` of its session.

    :param make_simulator: builds the engine, in the planning thread.
    :param session: further arguments of `PlannerSession`.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value, or a description that cannot be
        used.
    """

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, *,
                 session: Mapping[str, Any] | None = None, **arguments: Any) -> None:
        super().__init__('planner', PlannerOptions, INPUT_TYPES, **arguments)
        self.session: PlannerSession | None = None  # in the mode publish there is none
        self._file: _File | None = None  # of the description in use; None: it comes as a message
        self._next: _File | None = None  # replaces it at the next tick
        try:
            options = self.options()
            self._next = _File.read(options.description) if options.description else None
            if options.mode != PUBLISH:
                self._begin(make_simulator, session or {})
            self._serve_description()
            self.serve_parameters()
        except BaseException:
            self.close()
            raise

    def _begin(self, make_simulator: SimulatorFactory, session: Mapping[str, Any]) -> None:
        for name, kind in OUTPUT_TYPES.items():
            # Nobody has a use for old progress, and a robot that comes late must not execute an old action.
            self.offer(name, kind, latched=name not in ('progress', ACTION))
        self.session = PlannerSession(self, self.types, make_simulator, **session)
        self.subscribe(CHAIN, GOAL, *([] if self._next else [DESCRIPTION]))
        for name in ('plan', 'stop'):
            self.create_service(Trigger, f'~/{name}', functools.partial(self._serve, name))
        self.info('call ~/plan to plan from the newest ~/chain to the newest ~/goal_chain')

    def end(self) -> None:
        """End the session."""
        if self.session is not None:
            self.session.close()

    def act(self) -> None:
        """Do what is due now."""
        self._serve_description()
        if self.session is not None:
            self.session.tick()

    def changed(self, names: Sequence[str], options: PlannerOptions) -> None:
        """
        Take note of another description.

        :raises InputError: if it cannot be used, or the mode changes.
        """
        now = self.options()
        if options.mode != now.mode:
            raise InputError('parameter mode', f'a change to {options.mode!r}', 'none while the node runs',
                             'start the node again')
        if options.description != now.description:
            if not options.description:
                raise InputError('parameter description', 'a change to an empty text', 'another path',
                                 'start the node again without a description to listen for one')
            self._next = _File.read(options.description)
        if self.session is not None and self.session.planning:
            self.info(f'{", ".join(names)}: takes effect at the next plan')

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``."""
        if self.session is None:
            self.warn(text)
        else:
            self.session.refuse(text)

    def fail(self, text: str) -> None:
        """Report a failure in ``~/status`` and in the log."""
        if self.session is None:
            self.error(text)
        else:
            self.session.fail(text)

    # The description

    def _serve_description(self) -> None:
        """Publish the description that a file newly gave, instead of listening for one."""
        if self._next is None:
            return
        if self._file is None:
            if DESCRIPTION in self.inputs:
                self.destroy_subscription(self.inputs.pop(DESCRIPTION))
            self.offer(DESCRIPTION, INPUT_TYPES[DESCRIPTION])
        self._file, self._next = self._next, None
        message = self.types.build(INPUT_TYPES[DESCRIPTION], data=self._file.octets.decode('utf-8'))
        self.publish(DESCRIPTION, self.encode(DESCRIPTION, message))
        if self.session is not None:
            self.session.describe(self._file.found, str(self._file.path))
        else:
            self.info(f'{self._file.path} is published on {self.topic(DESCRIPTION)}')

    # Subscriptions and services

    def subscription(self, kind: str, reliability: ReliabilityPolicy) -> Any:
        """Subscribe to an input topic."""
        latched = DurabilityPolicy.TRANSIENT_LOCAL if kind == DESCRIPTION else DurabilityPolicy.VOLATILE
        return self.create_subscription(
            self.classes[kind], f'~/{kind}', functools.partial(self._hear, kind),
            QoSProfile(depth=QUEUE, reliability=reliability, durability=latched), raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=functools.partial(self.on_incompatible_qos, kind)))

    def _hear(self, kind: str, octets: bytes) -> None:
        if self.session is not None:
            self.session.hear(kind, octets)

    def drain(self, kind: str, subscription: Any) -> None:
        """Give the messages in a subscription's queue to the session."""
        for octets, _ in waiting(subscription, SLICE):
            self._hear(kind, octets)

    def hear_waiting(self) -> None:
        """Give the messages that wait to the session."""
        for kind, subscription in self.inputs.items():
            self.drain(kind, subscription)

    def _serve(self, name: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        assert self.session is not None
        response.success, response.message = self.session.request(name)
        return response


class _File:
    """
    A description in a file.

    :param octets: its document, as the file has it.
    """

    def __init__(self, path: Path, octets: bytes, found: Description) -> None:
        self.path, self.octets, self.found = path, octets, found

    @classmethod
    def read(cls, name: str) -> _File:
        """
        Read a file.

        :raises InputError: where it cannot be read, or is not a valid result.
        """
        path = Path(name).expanduser()
        octets = read_octets(path, WHAT, 'a result.xml')
        return cls(path, octets, read_description(octets, f'{WHAT} {path}', path.parent))
