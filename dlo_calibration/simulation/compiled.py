# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""CompiledSimulator: rollouts in the core; Engine: what it shares with the engine in PyBullet."""

from __future__ import annotations

import copy
from dataclasses import dataclass
import threading
from typing import Any, Mapping, Self, Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.table import resting_level
from dlo_calibration.simulation import core
from dlo_calibration.simulation.loads import Loads
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import (
    DEFAULT_NODES,
    DEFAULT_TIME_STEP,
    Job,
    Rollout,
    TogetherSimulator,
)
from dlo_calibration.simulation.scene import core_scene, Obstacle
from dlo_calibration.simulation.script import Script, Settling

if TYPE_CHECKING:
    from dlo_calibration.simulation.core._core import Outcome

CACHE_SIZE = 1000  # prepared trials; a plan simulates each of its trials only once
MOST_POSITIONS = 200_000  # of hands in the cached scripts: 100 MB if each hand holds four nodes
NO_TABLE = -1e6  # m; level of nodes on a table so low that no node touches it


@dataclass(frozen=True)
class Prepared:
    """
    The parts of a trial that do not depend on the parameters.

    :param level: height [m] of nodes on the table; None if it is unknown, or if there is no table.
    :param start: of the nodes; if the level is unknown, at their observed heights.
    """

    trial: Trial
    layout: NodeLayout
    level: float | None
    start: core.Start
    script: Script


class Engine:
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
        self._begin()

    def _begin(self) -> None:
        self._prepared: dict[int, Prepared] = {}  # cache, by the ids of the trials
        self._lock = threading.Lock()  # guards it

    def _prepare(self, trial: Trial,
                 physical: Mapping[str, float]) -> tuple[Prepared, core.Start, float | None]:
        """
        Return a prepared trial, the start of its nodes, and their height [m] on the table, or None.

        :raises SimulationError: if a hand moves for too long.
        :raises InputError: if the trial grips more points than there are nodes.
        """
        with self._lock:
            prepared = self._prepared.get(id(trial))
            if prepared is None or prepared.trial is not trial:
                level = None if self._table_height is None else resting_level(trial, self._table_height)
                layout = NodeLayout.of(trial, self._nodes)
                script = Script.of(trial, layout, self._time_step, self._settling)
                prepared = Prepared(trial, layout, level, layout.start(level), script)
                self._cache(prepared)
        if self._table_height is None or prepared.level is not None:
            return prepared, prepared.start, prepared.level
        level = self._table_height + physical['self_collision']
        return prepared, prepared.layout.start(level), level

    def _cache(self, prepared: Prepared) -> None:
        """Cache a prepared trial, unless it is too large; drop the oldest ones if they are too many."""
        trials, positions = self._prepared, prepared.script.positions
        trials.pop(id(prepared.trial), None)
        if positions > MOST_POSITIONS:
            return
        while len(trials) >= CACHE_SIZE or (
                positions + sum(trial.script.positions for trial in trials.values()) > MOST_POSITIONS):
            del trials[next(iter(trials))]
        trials[id(prepared.trial)] = prepared

    def _rollout(self, prepared: Prepared, outcome: Outcome | None) -> Rollout:
        """
        Return a rollout for an outcome of the core.

        :raises SimulationError: if it diverged.
        """
        if outcome is None:
            raise SimulationError('the rollout diverged: the chain is no longer finite')
        nodes, settled, steps, measured, holding = outcome
        loads = Loads.measured(measured, prepared.layout.places) if measured is not None else None
        forces = [-holding[k, list(prepared.layout.nodes(hand))].sum(axis=0)
                  for k, hand, _ in prepared.trial.forces]
        return Rollout(prepared.layout.observe @ nodes, settled, steps * self._time_step, steps, loads,
                       np.reshape(forces, (-1, 3)))

    def refined(self) -> Self:
        """Return an engine with twice the segments and half the time step."""
        finer = copy.copy(self)
        finer._nodes, finer._time_step = 2 * self._nodes - 1, self._time_step / 2
        return finer

    def close(self) -> None:
        """Drop the prepared trials."""
        self._prepared.clear()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the cache, which belongs to this engine alone, and its lock."""
        return {name: value for name, value in self.__dict__.items() if name not in ('_prepared', '_lock')}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()


class CompiledSimulator(Engine, TogetherSimulator):
    """
    Simulates trials on a table, in the air or among obstacles.

    It is about 60 times as fast as `bullet.BulletSimulator`.

    Threads may share it.

    A trial that grips more points than there are nodes is refused with an InputError.

    :param obstacles: that the DLO touches.
    :param settings: see `Engine`.
    :raises InputError: if a mesh is not closed.
    """

    name = 'compiled'
    at_a_time = 48  # twelve for each lane, so that lanes are empty only towards the end

    def __init__(self, *, obstacles: Sequence[Obstacle] = (), **settings: Any) -> None:
        super().__init__(**settings)
        self._obstacles = tuple(obstacles)
        self._scene = core_scene(obstacles)

    def simulate_together(self, jobs: Sequence[Job], stop: core.Stop) -> list[Rollout | SimulationError]:
        """Simulate each job, four at a time; see `TogetherSimulator`."""
        rollouts: list[Rollout | SimulationError] = []
        prepared: list[Prepared | SimulationError] = []
        packed = []
        for trial, physical in jobs:
            try:
                job, start, level = self._prepare(trial, physical)
            except SimulationError as error:
                prepared.append(error)
            else:
                prepared.append(job)
                packed.append((job.script.events, start, physical, NO_TABLE if level is None else level))
        outcomes = iter(core.roll_out(packed, self._time_step, stop, scene=self._scene))
        for item in prepared:
            try:
                if isinstance(item, SimulationError):
                    raise item
                rollouts.append(self._rollout(item, next(outcomes)))
            except SimulationError as error:
                rollouts.append(error)
        return rollouts

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the scene of the core, too, which is made again from the obstacles."""
        return {name: value for name, value in super().__getstate__().items() if name != '_scene'}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        super().__setstate__(state)
        self._scene = core_scene(self._obstacles)
