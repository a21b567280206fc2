# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""plan(): the actions that bring a calibrated DLO from one configuration to another."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from contextlib import ExitStack
from dataclasses import dataclass
import time
from typing import Callable

import numpy as np

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.processes import ProcessExecutor
from dlo_calibration.model.chain import Chain, frozen_array
from dlo_calibration.planning.beam import BeamSearch, Judged
from dlo_calibration.planning.dlo import CalibratedDlo, Posterior
from dlo_calibration.planning.limits import Limits
from dlo_calibration.planning.objective import Objective
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.prediction import intervals
from dlo_calibration.planning.rehearsal import Rehearser

RESTING_SHARE = 15.0  # % of the points of a DLO that are at most as high as those on the table


@dataclass(frozen=True)
class PlanProgress:
    """
    How far a plan is.

    :param actions: number of actions of the sequences that are tried now.
    :param rollouts: number of actions simulated so far.
    :param expected: estimate of their number in the end.
    :param best_error: mean distance of the points from the goal after the best sequence so far [m].
    :param seconds_left: estimate.
    """

    actions: int
    rollouts: int
    expected: int
    best_error: float
    seconds_left: float


def plan(found: CalibratedDlo, start: Chain, goal: Chain, options: PlanOptions | None = None, *,
         simulation: Options | None = None,
         on_progress: Callable[[PlanProgress], None] = lambda progress: None,
         should_stop: Callable[[], bool] = lambda: False,
         make_simulator: SimulatorFactory = make_chosen_simulator, executor: Executor | None = None,
         clock: Callable[[], float] = time.monotonic) -> Plan:
    """
    Find the fewest actions that bring a DLO within the tolerance of a goal, or those that get nearest.

    :param found: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param start: the DLO now, at rest.
    :param options: None: the defaults.
    :param simulation: options of the simulation; None: the defaults.
    :param should_stop: once it is True, the best plan so far is returned.
    :param executor: simulates; None: as many processes as the options say, for this plan only.
    :raises InputError: if start, goal and DLO do not belong together.
    """
    options, simulation, begin = options or PlanOptions(), simulation or Options(), clock()
    posterior = Posterior.of(found)
    objective = Objective(start, goal, options.objective, options.tolerance / 100 * found.length)
    search = BeamSearch(start, objective, options, Limits.of(options), resting_height(start), posterior.best,
                        posterior.draws(options.draws, options.seed))
    with ExitStack() as stack:
        simulator = make_simulator(simulation)
        stack.callback(simulator.close)
        if executor is None and options.workers != 1:
            executor = ProcessExecutor(options.workers, answer_limit=simulation.answer_limit)
            stack.callback(executor.close)
        rehearse = Rehearser(simulator, executor, should_stop)
        try:
            while jobs := search.ask():
                search.tell(rehearse(jobs))
                seconds = clock() - begin
                expected = max(search.expected, rehearse.count)
                on_progress(PlanProgress(search.depth, rehearse.count, expected,
                                         objective.error(search.best.end),
                                         seconds * (expected - rehearse.count) / max(rehearse.count, 1)))
        except CancelledError:
            search.stop()
            finish = Rehearser(simulator, executor)
            while jobs := search.ask():
                search.tell(finish(jobs))
        rollouts = rehearse.count
    actions = planned_actions(search.judged, found.errors.rms) if search.judged else ()
    ends = [one.chains[-1] for one in search.judged.drawn or (search.judged.best,)] \
        if search.judged and actions else [start.points]
    error = float(np.mean([objective.error(end) for end in ends]))
    cost = float(np.mean([objective.cost(end) for end in ends]))
    return Plan(
        start=start, goal=goal, actions=actions, error_before=objective.error(start.points),
        error_after=error, score_after=float(np.mean([objective.score(end) for end in ends])),
        reached=cost <= objective.enough, tolerance=options.tolerance / 100 * found.length, rollouts=rollouts,
        seconds=clock() - begin, seed=options.seed, stop_reason=search.stop_reason)


def planned_actions(judged: Judged, error: float) -> tuple[PlannedAction, ...]:
    """
    Return the actions of a judged sequence, with the intervals of its predictions.

    :param error: root mean square point distance that the calibration left [m].
    """
    lower, upper = intervals(judged.best.chains, [one.chains for one in judged.drawn], error / np.sqrt(3))
    return tuple(
        PlannedAction(move.name, step.starting(0.0).action, frozen_array(judged.best.chains[k]),
                      frozen_array(lower[k]), frozen_array(upper[k]))
        for k, (move, step) in enumerate(zip(judged.course.moves, judged.steps, strict=True)))


def resting_height(chain: Chain) -> float:
    """Return the height [m] of the points of a DLO that lie on the table."""
    z = chain.points[:, 2]
    return float(np.median(z[z <= np.percentile(z, RESTING_SHARE)]))
