# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""plan(): the actions that bring a calibrated DLO from one configuration to another."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from contextlib import closing
from dataclasses import dataclass, replace
import time
from typing import Callable, Iterator, Mapping

import numpy as np

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import obstacles_of, SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.model.parameters import GRAVITY, natural_curvature
from dlo_calibration.observation.table import HANGING, lying_level, resting_band
from dlo_calibration.planning.action_loads import loads_of_actions
from dlo_calibration.planning.beam import BeamSearch, JudgedSequence, Objective
from dlo_calibration.planning.dlo import CalibratedDlo, intervals, Posterior
from dlo_calibration.planning.limits import crossings, HANDS
from dlo_calibration.planning.moves import HANDS_APART
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.rehearsal import ActionStep, RehearsalJob, Rehearser
from dlo_calibration.planning.surroundings import passed_wrongly, Surroundings

START, GOAL = 'start chain', 'goal chain'  # in errors
OTHER_LENGTH = 0.10  # share of the length; with a larger difference, the unit or the DLO is another one
ELSEWHERE = 0.02  # share of the length; points of start and goal match up to this difference along it
DRAWS = 3  # largest number of draws from the posterior that are laid on the goal


def checked(dlo: CalibratedDlo, start: Chain, goal: Chain, simulation: Options,
            options: PlanOptions) -> tuple[Chain, Chain]:
    """
    Return the start and the goal that a plan is made for.

    The goal is resampled at the points of the start, as fractions of the length, if it has other points.  It
    is moved to the height of the start, because both lie on the same table, unless one of them lies on a
    body of a scene.

    :raises InputError: if the result lacks values; if the start or the goal has another length than the DLO,
        or is in the air; if the goal is in a no-go box, or has more crossings than the start although
        no action may put the DLO over itself.
    """
    _check_dlo(dlo)
    _check_length(START, start, dlo.length, 'the calibrated DLO')
    _check_length(GOAL, goal, start.length, 'the start')
    if simulation.table and not simulation.scene:
        rise = _level(START, start, simulation.table_height) - _level(GOAL, goal, simulation.table_height)
    elif simulation.scene:
        rise = _rise_on_table(start, goal, simulation)
    else:
        raise InputError('parameter table', 'false, and no scene', 'something that the DLO lies on',
                         'leave table at true, or name a scene')
    goal = _matched(goal, start, rise)
    if box := options.limits.box(goal.points[None]):
        raise InputError(GOAL, f'a part in the no-go box {box}', 'a goal outside of all no-go boxes',
                         'move the goal, or correct no_go')
    more = crossings(goal.points) - crossings(start.points)
    if more > 0 and not options.crossings:
        raise InputError(GOAL, f'{more} crossing(s) of the DLO with itself more than in the start',
                         'no more than there', 'allow them with crossings, or choose another goal')
    return start, goal


def goal_warnings(rehearse: Rehearser, posterior: Posterior, start: Chain, goal: Chain,
                  options: PlanOptions) -> tuple[str, ...]:
    """
    Return why a goal cannot be reached exactly, and how near the DLO gets.

    :param rehearse: simulates at most 3 + DRAWS actions.
    :param start: and `goal`: from `checked`.
    :raises CancelledError: as `rehearse` does.
    """
    return (*_warnings_of_length(start, goal, options.tolerance / 100),
            *_warnings_of_limits(start, goal, options),
            *_warnings_of_loads(rehearse, posterior, start, goal, options),
            *_warnings_of_rest(rehearse, posterior, goal, options))


def _check_dlo(dlo: CalibratedDlo) -> None:
    unusable = [name for name, estimate in dlo.parameters.items()
                if not np.isfinite([estimate.value, estimate.lower, estimate.upper]).all()]
    if unusable or not 0 < dlo.length < np.inf or not np.isfinite(dlo.errors.rms):
        raise InputError('result', f'no number for {", ".join(unusable) or "length or errors"}',
                         'finite values, intervals and errors', 'calibrate again')


def _check_length(thing: str, chain: Chain, length: float, whose: str) -> None:
    if not abs(chain.length / length - 1) <= OTHER_LENGTH:
        raise InputError(thing, f'a length of {_mm(chain.length)}',
                         f'that of {whose}, {_mm(length)}, within {100 * OTHER_LENGTH:.0f} %',
                         'send metres, and the whole of the same DLO')


def _level(thing: str, chain: Chain, table_height: float) -> float:
    """Return the height [m] at which a chain lies on the table; raise the InputError if it does not."""
    level, z = lying_level(chain, table_height), chain.points[:, 2]
    # A strand that lies on another one is higher by the diameter.
    if level is None or z.max() - level > HANGING + 2 * max(level - table_height, 0.0):
        raise InputError(
            thing, f'points {1e3 * (z.min() - table_height):.0f} to {1e3 * (z.max() - table_height):.0f} mm '
            'above the table', 'a DLO that lies on the table, as hands open after each action',
            'lay it down, or correct table_height')
    return level


def _rise_on_table(start: Chain, goal: Chain, simulation: Options) -> float:
    """Return how much higher the start lies on the table than the goal [m]; 0 if one lies on a body."""
    here, there = (lying_level(chain, simulation.table_height) for chain in (start, goal))
    if not simulation.table or here is None or there is None:
        return 0.0
    return here - there if abs(here - there) <= resting_band(start.length) else 0.0


def _levels(start: Chain, goal: Chain, simulation: Options) -> Floats:
    """Return the heights (n,) [m] at which points are put down: on the table, but for those on a body."""
    level = lying_level(start, simulation.table_height) if simulation.table else None
    z = goal.points[:, 2]
    if level is None:
        return z
    return np.where((np.abs(z - level) < resting_band(start.length)) | (not simulation.scene), level, z)


def _check_bodies(goal: Chain, surroundings: Surroundings) -> None:
    """Raise the InputError if the middle line of a goal is inside a body."""
    inside = sum(map(surroundings.cover, goal.points))
    if inside:
        raise InputError(GOAL, f'{inside} of {len(goal)} points inside a body of the scene',
                         'a goal beside or on all bodies', 'move the goal, or correct the scene')


def _matched(goal: Chain, start: Chain, rise: float) -> Chain:
    """Return a goal with the points of the start, higher by `rise` [m]; itself if nothing changes."""
    fractions = start.arc_lengths() / start.length
    same = len(goal) == len(start) and np.abs(
        goal.arc_lengths() / goal.length - fractions).max() <= ELSEWHERE
    if same and rise == 0:
        return goal
    up = np.array([0.0, 0.0, rise])
    return replace(goal, points=goal.points + up) if same else Chain(
        goal.resample(fractions * goal.length) + up)


def _warnings_of_length(start: Chain, goal: Chain, tolerance: float) -> Iterator[str]:
    """Warn of another length: if both middles coincide, a point at s = 0..1 is off by |s - 1/2| of it."""
    longer = goal.length - start.length
    if abs(longer) > tolerance * start.length:
        yield (f'the goal is {_percent(longer, start)} {"longer" if longer > 0 else "shorter"} than '
               f'the DLO, {_mm(goal.length)} instead of {_mm(start.length)}, so its points stay about '
               f'{_mm(abs(longer) / 4)} away from the goal on average')


def _warnings_of_limits(start: Chain, goal: Chain, options: PlanOptions) -> Iterator[str]:
    """Warn of points that no hand can reach, and of a start in a no-go box."""
    limits, hands = options.limits, HANDS[:options.hands]
    whose = ' and '.join(hands)
    start_within, goal_within = (np.any(
        [limits.reach[name].contains(chain.points, chain.points) for name in hands], axis=0)
        for chain in (start, goal))
    if options.hands > 1 and start.length < HANDS_APART:
        yield (f'hands stay {_mm(HANDS_APART)} apart, as grippers have a size, so two of them cannot grip a '
               f'DLO of {_mm(start.length)} together, and each action is that of one hand')
    if not start_within.any():
        yield f'no point of the DLO is within the reach of {whose}, so nothing can move it'
    if not goal_within.all():
        yield (f'{(~goal_within).sum()} of the {len(goal)} points of the goal are outside the reach of '
               f'{whose}, so they can only be moved by other parts of the DLO')
    if box := limits.box(start.points[None]):
        yield f'the DLO is in the no-go box {box} at the start'


def _warnings_of_loads(rehearse: Rehearser, posterior: Posterior, start: Chain, goal: Chain,
                       options: PlanOptions) -> Iterator[str]:
    """Touch the DLO where it lies and on the goal, and warn if it bears more there than permitted."""
    if not options.limits.of_loads:
        return
    at_start, at_goal = rehearse([RehearsalJob(chain, (_touch(chain),), posterior.best, loads=True)
                                  for chain in (start, goal)])
    if overload := options.limits.overload(at_start.loads):
        yield f'at the start already, {overload}, so no action is permitted'
    if overload := options.limits.overload(at_goal.loads):
        yield f'exactly on the goal, {overload}'


def _touch(chain: Chain) -> ActionStep:
    """Return an action in which a hand closes at the middle of a chain, and opens again."""
    middle = len(chain) // 2
    return ActionStep(Action((Hand(HANDS[0], (middle,), np.zeros(1), chain.points[[middle]]),)))


def _warnings_of_rest(rehearse: Rehearser, posterior: Posterior, goal: Chain,
                     options: PlanOptions) -> Iterator[str]:
    """Lay the DLO exactly on the goal, let it go, and warn if it moves far."""
    touch = _touch(goal)
    drawn = posterior.draws(min(DRAWS, options.draws), options.seed)
    rehearsals = rehearse([RehearsalJob(goal, (touch,), physical) for physical in (posterior.best, *drawn)])
    failures = [rehearsal.failure for rehearsal in rehearsals if rehearsal.failure]
    if failures:
        yield f'whether the DLO stays on the goal is unknown: {failures[0]}'
        return
    away = np.stack([np.linalg.norm(rehearsal.chains[-1] - goal.points, axis=1) for rehearsal in rehearsals])
    each, at = away.mean(axis=1), goal.arc_lengths() / goal.length
    if each.mean() > options.tolerance / 100 * goal.length / 2:
        worst = int(away.mean(axis=0).argmax())
        curved = natural_curvature(posterior.best, at).any()
        yield (f'laid exactly on the goal and let go, the DLO springs back by {_mm(each.mean())} on average '
               f'({_percent(each.mean(), goal)} of the length; {_mm(each.min())} to {_mm(each.max())} within '
               f'the uncertainty of its parameters), and by {_mm(away[:, worst].mean())} at {at[worst]:.2f} '
               f'of the length: friction holds only bends {"beyond its rest shape " * bool(curved)}with a '
               'radius above about '
               f'{_mm(sharpest_bend(posterior.best, goal.length))}, and none at the ends')


def sharpest_bend(physical: Mapping[str, float], length: float) -> float:
    """
    Return approximately the smallest radius of a bend [m] that friction on the table holds.

    The lateral force of a bent rod without tension is EI kappa'' per length, which is at most mu m g / L in
    equilibrium.  A bend of the radius R begins and ends within about R, so kappa'' is about 1 / R^3.

    :param physical: parameters by name (SI units).
    :param length: of the DLO [m].
    """
    held = physical['friction'] * physical['mass'] * GRAVITY / length
    return float(np.cbrt(physical['flexibility'] / held))


def _percent(length: float, chain: Chain) -> str:
    return f'{100 * abs(length) / chain.length:.1f} %'


def _mm(length: float) -> str:
    return f'{1e3 * length:.1f} mm' if length < 0.01 else f'{1e3 * length:.0f} mm'


@dataclass(frozen=True)
class PlanProgress:
    """
    The progress of a plan.

    :param actions: number of actions of the sequences that are tried now.
    :param rollouts: number of actions simulated so far.
    :param expected: estimate of their number if all permitted actions are needed.
    :param best_error: mean distance of the points from the goal after the best sequence so far [m].
    :param seconds_left: until the expected number is simulated [s].
    """

    actions: int
    rollouts: int
    expected: int
    best_error: float
    seconds_left: float


def plan(dlo: CalibratedDlo, start: Chain, goal: Chain, options: PlanOptions | None = None, *,
         simulation: Options | None = None,
         on_progress: Callable[[PlanProgress], None] = lambda progress: None,
         should_stop: Callable[[], bool] = lambda: False,
         make_simulator: SimulatorFactory = make_chosen_simulator, executor: Executor | None = None,
         clock: Callable[[], float] = time.monotonic) -> Plan:
    """
    Find the fewest actions that bring a DLO within the tolerance of a goal, or those that get nearest.

    :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param start: the present chain of the DLO, at rest.
    :param options: None: the defaults.
    :param simulation: options of the simulation; None: the defaults.
    :param should_stop: once it is True, the best plan so far is returned.
    :param executor: its workers simulate, e.g. a `ClusterExecutor`; None: as many threads as options say.
    :raises InputError: if start, goal and DLO do not belong together, see `checked`; if a body of the scene
        covers the goal.
    """
    options, simulation, begin = options or PlanOptions(), simulation or Options(), clock()
    start, goal = checked(dlo, start, goal, simulation, options)
    options = options.of_length(start.length)
    surroundings = Surroundings.of(obstacles_of(simulation), options.clearance, start.points,
                                   goal.points)
    _check_bodies(goal, surroundings)
    posterior = Posterior.of(dlo).lying(start, simulation)
    tolerance = options.tolerance / 100 * start.length
    objective = Objective(start, goal, options.objective, surroundings)
    search = BeamSearch(start, objective, tolerance, options, _levels(start, goal, simulation),
                        posterior.best, posterior.draws(options.draws, options.seed), surroundings)

    def report(rollouts: int) -> None:
        expected = max(search.expected, rollouts)
        remaining = (clock() - begin) * (expected - rollouts) / rollouts
        on_progress(PlanProgress(search.actions, rollouts, expected, objective.error(search.best.end),
                                 remaining))

    with closing(make_simulator(simulation)) as simulator, closing(Threads(options.workers)) as threads:
        rehearse = Rehearser(Pool(simulator, executor or threads, should_stop))
        last = Rehearser(Pool(simulator, executor or threads))
        try:
            while jobs := search.ask():
                search.tell(rehearse(jobs))
                report(rehearse.count)
        except CancelledError:  # the best plan so far still needs some rehearsals
            search.stop()
            while jobs := search.ask():
                search.tell(last(jobs))
        warnings = () if search.reached else (*goal_warnings(last, posterior, start, goal, options),
                                              *_warnings_of_sides(objective, search),
                                              *_warnings_of_refusals(search.refusals))
    ends = [start.points] if search.judged is None else [
        rehearsal.chains[-1] for rehearsal in search.judged.drawn or [search.judged.best]]
    return Plan(
        start, goal, () if search.judged is None else planned_actions(search.judged, dlo.errors.rms),
        error_before=objective.error(start.points),
        error_after=float(np.mean([objective.error(end) for end in ends])),
        score_after=float(np.mean([objective.score(end) for end in ends])), reached=search.reached,
        tolerance=tolerance, rollouts=rehearse.count + last.count, seconds=clock() - begin,
        seed=options.seed, stop_reason=search.stop_reason, warnings=warnings)


def planned_actions(judged: JudgedSequence, error: float) -> tuple[PlannedAction, ...]:
    """
    Return the actions of a judged sequence, with the intervals of its predictions.

    :param error: root mean square point distance that the calibration left [m].
    """
    lower, upper = intervals(judged.best.chains, [drawn.chains for drawn in judged.drawn], error / np.sqrt(3))
    loads = loads_of_actions(judged.best, judged.drawn)
    return tuple(
        PlannedAction(move.name, step.starting(0.0).action, frozen_array(judged.best.chains[k]),
                      frozen_array(lower[k]), frozen_array(upper[k]), loads[k])
        for k, (move, step) in enumerate(zip(judged.sequence.moves, judged.steps, strict=True)))


def _warnings_of_sides(objective: Objective, search: BeamSearch) -> Iterator[str]:
    """Warn of bodies that the DLO passes at another side at the end of a plan than in the goal."""
    if search.judged is None:
        return
    ends = [rehearsal.chains[-1] for rehearsal in (search.judged.best, *search.judged.drawn)]
    wrong = [passed_wrongly(end, objective.goal, objective.posts) for end in ends]
    if any(wrong):
        yield (f'at the end, the DLO still passes {max(wrong)} bod{"y" if max(wrong) == 1 else "ies"} at '
               f'another side than in the goal, in {np.count_nonzero(wrong)} of {len(wrong)} simulations')


def _warnings_of_refusals(refusals: Mapping[str, int]) -> Iterator[str]:
    """Warn of moves that were not permitted, with the most frequent reason."""
    if refusals:
        most = max(refusals, key=lambda why: refusals[why])
        yield f'{sum(refusals.values())} moves that were tried are not permitted, mostly because {most}'
