# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""plan(): the actions that bring a calibrated DLO from one configuration to another."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from contextlib import closing
from dataclasses import dataclass
import time
from typing import Callable, Iterator, Mapping

import numpy as np

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.model.chain import Chain, frozen_array
from dlo_calibration.observation.table import lying_level
from dlo_calibration.planning.beam import BeamSearch, Judged
from dlo_calibration.planning.checks import checked, remarks
from dlo_calibration.planning.dlo import CalibratedDlo, Posterior
from dlo_calibration.planning.limits import Limits
from dlo_calibration.planning.objective import Objective
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.prediction import intervals
from dlo_calibration.planning.rehearsal import Rehearser


@dataclass(frozen=True)
class PlanProgress:
    """
    How far a plan has come.

    :param actions: number of actions of the sequences that are tried now.
    :param rollouts: number of actions simulated so far.
    :param expected: estimate of their number if all permitted actions are needed.
    :param best_error: mean distance of the points from the goal after the best sequence so far [m].
    :param seconds_left: until then.
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
    :param executor: its workers simulate, e.g. a `ClusterExecutor`; None: as many threads as options say.
    :raises InputError: if start, goal and DLO do not belong together; see `checked`.
    """
    options, simulation, begin = options or PlanOptions(), simulation or Options(), clock()
    start, goal = checked(found, start, goal, simulation, options)
    posterior = Posterior.of(found).lying(start, simulation)
    tolerance = options.tolerance / 100 * start.length
    objective = Objective(start, goal, options.objective)
    level = None if simulation.scene else lying_level(start, simulation.table_height)
    search = BeamSearch(start, objective, tolerance, options, Limits.of(options),
                        goal.points[:, 2] if level is None else np.full(len(start), level), posterior.best,
                        posterior.draws(options.draws, options.seed))

    def tell(rollouts: int) -> None:
        expected = max(search.expected, rollouts)
        left = (clock() - begin) * (expected - rollouts) / rollouts
        on_progress(PlanProgress(search.actions, rollouts, expected, objective.error(search.best.end), left))

    with closing(make_simulator(simulation)) as simulator, closing(Threads(options.workers)) as threads:
        rehearse = Rehearser(Pool(simulator, executor or threads, should_stop))
        last = Rehearser(Pool(simulator, executor or threads))
        _finish(search, rehearse, last, tell)
        said = () if search.reached else (*remarks(last, posterior, start, goal, options),
                                          *_remarks_on_refusals(search.refusals))
    ends = [start.points] if search.judged is None else [
        one.chains[-1] for one in search.judged.drawn or [search.judged.best]]
    return Plan(
        start, goal, () if search.judged is None else planned_actions(search.judged, found.errors.rms),
        error_before=objective.error(start.points),
        error_after=float(np.mean([objective.error(end) for end in ends])),
        score_after=float(np.mean([objective.score(end) for end in ends])), reached=search.reached,
        tolerance=tolerance, rollouts=rehearse.count + last.count, seconds=clock() - begin,
        seed=options.seed, stop_reason=search.stop_reason, remarks=said)


def _finish(search: BeamSearch, rehearse: Rehearser, last: Rehearser, tell: Callable[[int], None]) -> None:
    """Search to the end; once `rehearse` is stopped, `last` rehearses what the best plan so far needs."""
    try:
        while jobs := search.ask():
            search.tell(rehearse(jobs))
            tell(rehearse.count)
    except CancelledError:
        search.stop()
        while jobs := search.ask():
            search.tell(last(jobs))


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


def _remarks_on_refusals(refusals: Mapping[str, int]) -> Iterator[str]:
    """Tell what prevented most of the moves that were not permitted."""
    if refusals:
        most = max(refusals, key=lambda why: refusals[why])
        yield f'{sum(refusals.values())} moves that were tried are not permitted, mostly because {most}'
