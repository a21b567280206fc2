# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
What calibration is worth: plans with fitted, default and true parameters, executed in reality.

Reality is a finer simulation with the true properties.  In the open loop, a plan from the exact start is
executed blindly.  Replanned, only the first action of each plan is executed; then a camera sees the DLO,
and the next plan starts from there, until what it sees is within the tolerance.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass, replace
import functools
import time
from typing import Any, Callable, Mapping, Protocol

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.experiment.knowledge import Knowledge
from dlo_calibration.experiment.known_dlos import KnownDlo
from dlo_calibration.experiment.pairs import Pair, random_pair, seen
from dlo_calibration.experiment.reality import Reality
from dlo_calibration.experiment.study import digest
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.score import difference_score
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan
from dlo_calibration.simulation.protocol import Simulator

NOISE = 1e-3  # m, standard deviation of each coordinate that the camera sees
REPLANNED_ACTIONS = 6  # most actions of a replanned course
FOCAL_POINT = 0  # of the difference score, whose features are both ends, as no hand holds the DLO
OPEN_LOOP, REPLANNED = 'open_loop', 'replanned'


_Timed = tuple[Plan, float]  # a plan, and the time that it took [s]


class Planner(Protocol):
    """What `plan` is called with here."""

    def __call__(self, found: Knowledge, start: Chain, goal: Chain, options: PlanOptions, *,
                 simulation: Options, should_stop: Callable[[], bool]) -> Plan:
        """Return a plan."""


@dataclass(frozen=True)
class PlanTask:
    """
    Plans from one start to one goal with one set of parameters.

    :param index: of the `random_pair`, which has the seed `seed`.
    :param options: of the planner.
    :param engine: name of its simulator.
    """

    dlo: KnownDlo
    knowledge: Knowledge
    index: int
    seed: int
    options: PlanOptions
    engine: str

    @property
    def about(self) -> dict[str, Any]:
        """Plain values that tell a reader of the journal which plans they are."""
        return {'object': self.dlo.name, 'parameters': self.knowledge.kind, 'pair': self.index + 1,
                'seed': self.seed, 'engine': self.engine}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""
        return digest(self.dlo, self.knowledge, self.index, self.seed, self.options, self.engine)


@dataclass(frozen=True)
class Course:
    """
    What the actions of a course did to the DLO in reality.

    :param errors: mean distance of the points from the goal, before and after each action [% of the length].
    :param scores: difference score likewise [cm].
    :param missed: number of actions in which a hand closed on nothing.
    :param predicted: error that the first plan expected at its end [% of the length].
    :param plans: number of plans; `rollouts` of them all.
    :param seconds: that all plans took, on one thread.
    """

    errors: tuple[float, ...]
    scores: tuple[float, ...]
    missed: int
    predicted: float
    plans: int
    rollouts: int
    seconds: float

    @property
    def actions(self) -> int:
        """Number of actions."""
        return len(self.errors) - 1


@dataclass(frozen=True)
class PlanOutcome:
    """
    What the plans of a task led to.

    :param failure: why a plan, or reality, failed; empty if none did.  A course ends there; None: no plan
        was found at all.
    """

    open_loop: Course | None
    replanned: Course | None
    failure: str = ''

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> PlanOutcome:
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        courses = {name: None if entry[name] is None else Course(**{
            **entry[name], 'errors': tuple(entry[name]['errors']), 'scores': tuple(entry[name]['scores'])})
            for name in (OPEN_LOOP, REPLANNED)}
        return cls(**{**entry, **courses})


class _Course:
    """A course in the making, which begins with a plan and the time that it took [s]; see `Course`."""

    def __init__(self, dlo: KnownDlo, pair: Pair, simulator: Simulator, first: _Timed) -> None:
        self.plan = first[0]  # the last one
        self._dlo = dlo
        self._goal = seen(pair.goal.points)
        self._reality = Reality(dlo, pair.start, simulator)
        self._missed = 0
        self._plans = [first]
        self._errors, self._scores = [self.error(self.seen)], [self._score()]

    @property
    def actions(self) -> int:
        """Number of actions so far."""
        return len(self._errors) - 1

    @property
    def seen(self) -> Floats:
        """The points that a camera without noise sees, (n, 3) [m]."""
        return seen(self._reality.points)

    def error(self, points: Floats) -> float:
        """Return the mean distance of seen points, (n, 3) [m], from the goal [% of the length]."""
        return 100 * float(np.linalg.norm(points - self._goal, axis=1).mean()) / self._dlo.length

    def replan(self, found: _Timed) -> None:
        """Take a new plan."""
        self.plan = found[0]
        self._plans.append(found)

    def act(self, action: Action) -> None:
        """Execute an action."""
        self._missed += not self._reality.act(action)
        self._errors.append(self.error(self.seen))
        self._scores.append(self._score())

    def done(self) -> Course:
        """Return what was done."""
        plans, seconds = zip(*self._plans, strict=True)
        return Course(tuple(self._errors), tuple(self._scores), self._missed,
                      100 * plans[0].error_after / self._dlo.length, len(plans),
                      sum(plan.rollouts for plan in plans), sum(seconds))

    def _score(self) -> float:
        return difference_score(self._goal, self.seen, FOCAL_POINT, [0, len(self._goal) - 1])


class _Desk:
    """Where the plans of a task are made; `should_stop` as in `execute`."""

    def __init__(self, task: PlanTask, goal: Chain, simulation: Options, planner: Planner,
                 should_stop: Callable[[], bool]) -> None:
        self._task = task
        self._goal = goal
        self._simulation = simulation
        self._planner = planner
        self._should_stop = should_stop

    def plan(self, start: Floats, actions: int) -> _Timed:
        """Return a plan from (n, 3) [m] points, with at most so many actions, and the time it took [s]."""
        begun = time.monotonic()
        found = self._planner(self._task.knowledge, Chain(start), self._goal,
                              replace(self._task.options, actions=actions), simulation=self._simulation,
                              should_stop=self._should_stop)
        if self._should_stop():
            raise CancelledError
        return found, time.monotonic() - begun


def execute(task: PlanTask, make_simulator: SimulatorFactory, planner: Planner,
            should_stop: Callable[[], bool] = lambda: False) -> PlanOutcome:
    """
    Plan and execute in the open loop and replanned; both begin with the same plan.

    :raises CancelledError: if stopped.
    """
    simulation = Options.of({'mass': task.dlo.mass, 'workers': 1})
    with closing(make_simulator(simulation)) as coarse:
        finer = coarse.refined() or coarse
        pair = random_pair(task.dlo, task.index, task.seed, finer)
        desk = _Desk(task, Chain(seen(pair.goal.points)), simulation, planner, should_stop)
        try:
            first = desk.plan(seen(pair.start.points), task.options.actions)
        except DloCalibrationError as error:
            return PlanOutcome(None, None, str(error))
        opened, replanned = (_Course(task.dlo, pair, finer, first) for _ in range(2))
        failure = ''
        try:
            for planned in first[0].actions:
                opened.act(planned.action)
            _follow(replanned, desk, task)
        except DloCalibrationError as error:
            failure = str(error)
    return PlanOutcome(opened.done(), replanned.done(), failure)


def _follow(course: _Course, desk: _Desk, task: PlanTask) -> None:
    """Execute the first action of each plan, until what the camera sees is within the tolerance."""
    camera = np.random.default_rng([task.seed, task.index, 1])
    while course.plan.actions:
        course.act(course.plan.actions[0].action)
        points = course.seen + camera.normal(0.0, NOISE, course.seen.shape)
        left = REPLANNED_ACTIONS - course.actions
        if not left or course.error(points) <= task.options.tolerance:
            return
        course.replan(desk.plan(points, min(left, task.options.actions)))
