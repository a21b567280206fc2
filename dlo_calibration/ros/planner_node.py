# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node `planner`: subscriptions, publishers, services and a timer around a `PlannerSession`.

It publishes a description that comes from a file, and else listens for one.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, Sequence

from std_srvs.srv import Trigger

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import Description, read_description, WHAT
from dlo_calibration.files.xml import read_octets
from dlo_calibration.ros.graph_node import GraphNode
from dlo_calibration.ros.planner_session import (
    ACTION,
    CHAIN,
    DESCRIPTION,
    GOAL,
    INPUT_TYPES,
    OUTPUT_TYPES,
    PlannerOptions,
    PlannerSession,
    PUBLISH,
)


class PlannerNode(GraphNode[PlannerOptions]):
    """
    The node `planner`; it is the `NodeInterface` of its session.

    :param make_simulator: builds the engine, in the planning thread.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value, or a description that cannot be
        used.
    """

    latched = (DESCRIPTION,)

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, **arguments: Any) -> None:
        super().__init__('planner', PlannerOptions, INPUT_TYPES, **arguments)
        self.session: PlannerSession | None = None  # in the mode publish there is none
        self._next: tuple[Path, bytes, Description] | None = None  # replaces the description at the next tick
        try:
            options = self.options()
            self._next = _read(options.description) if options.description else None
            if options.mode != PUBLISH:
                self._begin(make_simulator)
            self._serve_description()
            self.serve_parameters()
        except BaseException:
            self.close()
            raise

    def _begin(self, make_simulator: SimulatorFactory) -> None:
        for name, kind in OUTPUT_TYPES.items():
            # Nobody has a use for old progress, and a robot that comes late must not execute an old action.
            self.offer(name, kind, latched=name not in ('progress', ACTION))
        self.session = PlannerSession(self, self.types, make_simulator)
        self.subscribe(CHAIN, GOAL, *([] if self._next else [DESCRIPTION]))
        for name in self.session.requests:
            self.create_service(Trigger, f'~/{name}', functools.partial(self.serve, name))
        self.info('call ~/plan to plan from the newest ~/chain to the newest ~/goal_chain')

    def act(self) -> None:
        """Do what is due now."""
        self._serve_description()
        if self.session is not None:
            self.session.tick()

    def changed(self, names: Sequence[str], options: PlannerOptions) -> None:
        """
        Use another description from the next tick on.

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
            self._next = _read(options.description)
        if self.session is not None and self.session.planning:
            self.info(f'{", ".join(names)}: takes effect at the next plan')

    # The description

    def _serve_description(self) -> None:
        """Publish a description newly read from a file, and stop listening for one."""
        if self._next is None:
            return
        (path, octets, description), self._next = self._next, None
        if DESCRIPTION not in self.outputs:
            if DESCRIPTION in self.inputs:
                self.destroy_subscription(self.inputs.pop(DESCRIPTION))
            self.offer(DESCRIPTION, INPUT_TYPES[DESCRIPTION])
        message = self.types.build(INPUT_TYPES[DESCRIPTION], data=octets.decode('utf-8'))
        self.publish(DESCRIPTION, self.encode(DESCRIPTION, message))
        if self.session is not None:
            self.session.describe(description, str(path))
        else:
            self.info(f'{path} is published on {self.topic(DESCRIPTION)}')



def _read(name: str) -> tuple[Path, bytes, Description]:
    """
    Return a description in a file, with its path, and its document as the file has it.

    :raises InputError: where it cannot be read, or is not a valid result.
    """
    path = Path(name).expanduser()
    octets = read_octets(path, WHAT, 'a result.xml')
    return path, octets, read_description(octets, f'{WHAT} {path}', path.parent)
