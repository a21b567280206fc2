# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Engine: the common part of both simulators; each adds its own rope."""

from __future__ import annotations

import copy
from typing import Any, Generic, Mapping, Self, TypeVar

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.table import rest_on, resting_level
from dlo_calibration.simulation.kernel_cache import compile_kernels, SIMULATION
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import DEFAULT_NODES, DEFAULT_TIME_STEP, Rollout
from dlo_calibration.simulation.rollout import roll_out, Stepper
from dlo_calibration.simulation.script import Script, Settling
from dlo_calibration.simulation.script_writer import write_script

MOST_KNOWN = 1000  # trials whose nodes are kept; a plan simulates each of its trials only once
MOST_ROWS = 200_000  # of all scripts that are kept: 100 MB if hands hold four nodes

AnyRope = TypeVar('AnyRope', bound=Stepper, covariant=True)


class Engine(Generic[AnyRope]):
    """
    Simulates trials on a table or in the air.

    The table is placed so that the rope rests on it at the measured height for every
    evaluated radius: no radius throws the rope up or lets it fall.

    :param table: whether there is a table.
    :param table_height: height of the table [m].
    :param nodes: number of nodes of the rope.
    :param time_step: [s].
    :param stable_distance: see `Settling` [m].
    :param stable_time: see `Settling` [s].
    :param settle_limit: see `Settling` [s].
    """

    name: str

    def __init__(self, table: bool = True, table_height: float = 0.0, nodes: int = DEFAULT_NODES,
                 time_step: float = DEFAULT_TIME_STEP, stable_distance: float = Settling.distance,
                 stable_time: float = Settling.time, settle_limit: float = Settling.limit) -> None:
        self._table_height = table_height if table else None
        self._nodes = nodes
        self._time_step = time_step
        self._settling = Settling(stable_distance, stable_time, settle_limit)
        self._known: dict[int, tuple[Trial, NodeLayout, float | None, Floats]] = {}
        self._scripts: dict[int, tuple[Trial, Script]] = {}

    def prepare(self) -> None:
        """See to it that the kernels are compiled."""
        compile_kernels(SIMULATION)

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: if the rollout diverges.
        :raises InputError: if the trial grips more points than there are nodes.
        """
        return roll_out(*self._start(trial, physical))

    def _start(self, trial: Trial, physical: Mapping[str, float]) -> tuple[Script, AnyRope]:
        """Return the script of a trial, and a rope at the start of it."""
        layout, level, points = self._layout(trial)
        if self._table_height is not None and level is None:
            level = self._table_height + physical['self_collision']
            points = rest_on(points, level)
        return self._script(trial, layout), self._rope(layout, points, physical, level)

    def _script(self, trial: Trial, layout: NodeLayout) -> Script:
        if id(trial) not in self._scripts or self._scripts[id(trial)][0] is not trial:
            script = write_script(trial, layout, self._time_step, self._settling)
            self._scripts.pop(id(trial), None)
            left = MOST_ROWS - script.rows
            while self._scripts and sum(one.rows for _, one in self._scripts.values()) > left:
                self._scripts.pop(next(iter(self._scripts)))
            if left < 0:
                return script
            self._scripts[id(trial)] = trial, script
        return self._scripts[id(trial)][1]

    def _layout(self, trial: Trial) -> tuple[NodeLayout, float | None, Floats]:
        """
        Return the nodes of a trial, the height [m] of nodes on the table, and (N, 3) [m] where nodes start.

        The height is None if it is unknown, or if there is no table.
        """
        if id(trial) not in self._known or self._known[id(trial)][0] is not trial:
            while len(self._known) >= MOST_KNOWN:
                self._known.pop(next(iter(self._known)))
            level = None if self._table_height is None else resting_level(trial, self._table_height)
            layout = NodeLayout.of(trial, self._nodes)
            points = layout.points if level is None else rest_on(layout.points, level)
            self._known[id(trial)] = trial, layout, level, points
        return self._known[id(trial)][1:]

    def _rope(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              level: float | None) -> AnyRope:
        """
        Return a rope at the start of a trial.

        :param points: (N, 3) [m] positions of its nodes.
        :param level: height [m] of nodes that touch the table; None: no table.
        """
        raise NotImplementedError

    def refined(self) -> Self:
        """Return an engine with twice the segments and half the time step."""
        finer = copy.copy(self)
        finer._nodes, finer._time_step = 2 * self._nodes - 1, self._time_step / 2
        return finer

    def close(self) -> None:
        """Drop what is known of the trials."""
        self._known.clear()
        self._scripts.clear()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to this process."""
        return {**self.__dict__, '_known': {}, '_scripts': {}}
