# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Engine: the common part of both simulators; each adds its own rope."""

from __future__ import annotations

import copy
from dataclasses import dataclass
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

MOST_KNOWN = 1000  # trials that are kept; a plan simulates each of its trials only once
MOST_POSITIONS = 200_000  # of hands in the scripts that are kept: 100 MB if each hand holds four nodes

AnyRope = TypeVar('AnyRope', bound=Stepper, covariant=True)


@dataclass(frozen=True)
class _Known:
    """
    What of a trial does not depend on the parameters.

    :param level: height [m] of nodes on the table; None if it is unknown, or if there is no table.
    :param points: (N, 3) [m] where nodes start.
    """

    trial: Trial
    layout: NodeLayout
    level: float | None
    points: Floats
    script: Script


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
        self._kept: dict[int, _Known] = {}  # by the identities of the trials

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
        known = self._known(trial)
        level, points = known.level, known.points
        if self._table_height is not None and level is None:
            level = self._table_height + physical['self_collision']
            points = rest_on(points, level)
        return known.script, self._rope(known.layout, points, physical, level)

    def _known(self, trial: Trial) -> _Known:
        known = self._kept.get(id(trial))
        if known is None or known.trial is not trial:
            level = None if self._table_height is None else resting_level(trial, self._table_height)
            layout = NodeLayout.of(trial, self._nodes)
            points = layout.points if level is None else rest_on(layout.points, level)
            script = write_script(trial, layout, self._time_step, self._settling)
            known = _Known(trial, layout, level, points, script)
            self._keep(known)
        return known

    def _keep(self, known: _Known) -> None:
        """Keep what is known of a trial, and drop what has been known longest if that is too much."""
        kept, positions = self._kept, known.script.positions
        kept.pop(id(known.trial), None)
        if positions > MOST_POSITIONS:
            return
        while len(kept) >= MOST_KNOWN or (
                positions + sum(one.script.positions for one in kept.values()) > MOST_POSITIONS):
            del kept[next(iter(kept))]
        kept[id(known.trial)] = known

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
        self._kept.clear()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to this process."""
        return {**self.__dict__, '_kept': {}}
