# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Plan executions: plans with fitted, default and true parameters, executed in reality.

Reality is a finer simulation with the true properties.  In the open loop, a plan from the exact start is
executed blindly.  Replanned, only the first action of each plan is executed; then a camera sees the DLO,
and the next plan starts from there, until what it sees is within the tolerance.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass, replace
import functools
from pathlib import Path
import time
from typing import Any, Callable, Mapping, Protocol

import numpy as np
from reality import KnownDlo, Pair, random_pair, Reality, seen

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options, recordable
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.experiment.study import Observed, task_digest
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import BY_NAME, PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.score import difference_score, PointErrors
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan
from dlo_calibration.simulation.protocol import Simulator

FITTED, DEFAULT, TRUE = 'fitted', 'default', 'true'
NOISE = 1e-3  # m, standard deviation of each coordinate that the camera sees
REPLANNED_ACTIONS = 6  # at most, of a replanned execution
FOCAL_POINT = 0  # of the difference score, whose features are both ends, as no hand holds the DLO
OPEN_LOOP, REPLANNED = 'open_loop', 'replanned'
#: With the package's own code, this determines the outcome of an execution.
CODE = tuple(Path(__file__).with_name(name).read_bytes() for name in ('plan_executions.py', 'reality.py'))


@dataclass(frozen=True)
class Belief:
    """
    The parameters of a DLO in the belief of a planner: a `CalibratedDlo` of plain values.

    :param kind: FITTED, DEFAULT or TRUE.
    :param mass: [kg]; `length` [m].
    :param intervals: value of each parameter with the ends of its 90 % interval, on the 0..100 scale; of a
        certain parameter, all three are equal.
    :param fixed: values of other parameters on the same scale.
    :param errors: point errors of the fit.
    """

    kind: str
    mass: float
    length: float
    intervals: Mapping[str, tuple[float, float, float]]
    fixed: Mapping[str, float]
    errors: PointErrors
    correlations: Mapping[str, Mapping[str, float]] | None = None

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Belief:
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        intervals = {name: tuple(map(float, ends)) for name, ends in entry['intervals'].items()}
        return cls(**{**entry, 'intervals': intervals, 'errors': PointErrors(**entry['errors'])})

    @classmethod
    def certain(cls, kind: str, dlo: KnownDlo) -> Belief:
        """Return the TRUE or the DEFAULT parameters of a DLO whose mass and length are known."""
        values = dlo.values if kind == TRUE else {name: BY_NAME[name].default for name in PAPER_PARAMETERS}
        return cls(kind, dlo.mass, dlo.length, {name: (value,) * 3 for name, value in values.items()}, {},
                   PointErrors(0.0, 0.0, 0.0, 0.0))

    @property
    def space(self) -> ParameterSpace:
        """The believed parameters, and the values of the others."""
        return ParameterSpace(tuple(self.intervals), self.fixed, self.mass)

    @property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """The believed parameters by name."""
        return {name: self._estimate(name, *interval) for name, interval in self.intervals.items()}

    def _estimate(self, name: str, value: float, lower: float, upper: float) -> ParameterEstimate:
        (physical, unit), *ends = (self.space.reported(name, x) for x in (value, lower, upper))
        low, high = sorted(end for end, _ in ends)
        return ParameterEstimate(name, value, 0.0, lower, upper, physical, low, high, unit, True)


@dataclass(frozen=True)
class CalibrationTask:
    """
    A calibration of a known DLO, which gives a FITTED belief.

    :param engine: name of the simulator that will be used.
    """

    dlo: KnownDlo
    observed: Observed
    engine: str

    @property
    def about(self) -> dict[str, Any]:
        """Plain values that identify the calibration for a reader of the journal."""
        return {'object': self.dlo.name, 'engine': self.engine}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""
        return task_digest(CODE, self.engine, self.observed.trials, recordable(self.observed.options.flat()))


def learn(task: CalibrationTask, make_simulator: SimulatorFactory,
          should_stop: Callable[[], bool] = lambda: False) -> Belief:
    """
    Calibrate once, on one thread.

    :raises SimulationError: if no evaluation could be simulated.
    :raises CancelledError: if stopped.
    """
    options = task.observed.options
    with closing(make_simulator(options)) as simulator:
        result = fitted(Setting(task.observed.trials, options, simulator, should_stop=should_stop))
    if should_stop():
        raise CancelledError
    return Belief(
        FITTED, result.space.mass, result.length,
        {name: (estimate.value, estimate.lower, estimate.upper)
         for name, estimate in result.parameters.items()},
        result.space.fixed, result.errors, result.correlations)


class Planner(Protocol):
    """The arguments with which `plan` is called here."""

    def __call__(self, dlo: Belief, start: Chain, goal: Chain, options: PlanOptions, *,
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
    belief: Belief
    index: int
    seed: int
    options: PlanOptions
    engine: str

    @property
    def about(self) -> dict[str, Any]:
        """Plain values that identify the plans for a reader of the journal."""
        return {'object': self.dlo.name, 'parameters': self.belief.kind, 'pair': self.index + 1,
                'seed': self.seed, 'engine': self.engine}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""
        return task_digest(CODE, self.dlo, self.belief, self.index, self.seed, self.options, self.engine)


@dataclass(frozen=True)
class Execution:
    """
    The outcome of the actions of one or more plans in reality.

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
    The executions of the plans of a task; None if there was no plan at all.

    :param failure: why a plan, or reality, failed; empty if none did.  An execution ends there.
    """

    open_loop: Execution | None
    replanned: Execution | None
    failure: str = ''

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> PlanOutcome:
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        courses = {name: None if entry[name] is None else Execution(**{
            **entry[name], 'errors': tuple(entry[name]['errors']), 'scores': tuple(entry[name]['scores'])})
            for name in (OPEN_LOOP, REPLANNED)}
        return cls(**{**entry, **courses})


class _PlanExecution:
    """
    An execution under way.

    :ivar plans: all plans so far, each with the time that it took [s].
    """

    def __init__(self, dlo: KnownDlo, pair: Pair, simulator: Simulator, first: tuple[Plan, float]) -> None:
        self.plans = [first]
        self._dlo = dlo
        self._goal = seen(pair.goal.points)
        self._reality = Reality(dlo, pair.start, simulator)
        self._missed = 0
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

    def act(self, action: Action) -> None:
        """Execute an action."""
        self._missed += not self._reality.act(action)
        self._errors.append(self.error(self.seen))
        self._scores.append(self._score())

    def outcome(self) -> Execution:
        """Return what the actions did."""
        plans, seconds = zip(*self.plans, strict=True)
        return Execution(tuple(self._errors), tuple(self._scores), self._missed,
                         100 * plans[0].error_after / self._dlo.length, len(plans),
                         sum(plan.rollouts for plan in plans), sum(seconds))

    def _score(self) -> float:
        return difference_score(self._goal, self.seen, FOCAL_POINT, [0, len(self._goal) - 1])


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
        goal = Chain(seen(pair.goal.points))

        def timed_plan(start: Floats, actions: int) -> tuple[Plan, float]:
            """Return a plan from (n, 3) points [m] with at most `actions` actions, and its duration [s]."""
            begun = time.monotonic()
            plan = planner(task.belief, Chain(start), goal, replace(task.options, actions=actions),
                           simulation=simulation, should_stop=should_stop)
            if should_stop():
                raise CancelledError
            return plan, time.monotonic() - begun

        try:
            first = timed_plan(seen(pair.start.points), task.options.actions)
        except DloCalibrationError as error:
            return PlanOutcome(None, None, str(error))
        open_loop, replanned = (_PlanExecution(task.dlo, pair, finer, first) for _ in range(2))
        failure = ''
        try:
            for planned in first[0].actions:
                open_loop.act(planned.action)
            _replan(replanned, timed_plan, task)
        except DloCalibrationError as error:
            failure = str(error)
    return PlanOutcome(open_loop.outcome(), replanned.outcome(), failure)


def _replan(execution: _PlanExecution, timed_plan: Callable[[Floats, int], tuple[Plan, float]],
            task: PlanTask) -> None:
    """Execute the first action of each plan, until what the camera sees is within the tolerance."""
    camera = np.random.default_rng([task.seed, task.index, 1])
    while actions := execution.plans[-1][0].actions:
        execution.act(actions[0].action)
        points = execution.seen + camera.normal(0.0, NOISE, execution.seen.shape)
        remaining = REPLANNED_ACTIONS - execution.actions
        if not remaining or execution.error(points) <= task.options.tolerance:
            return
        execution.plans.append(timed_plan(points, min(remaining, task.options.actions)))
