# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Checks of what a plan begins with: what cannot be planned, and why a goal cannot be reached exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Iterator, Mapping

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.bending import natural_curvature
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.observation.table import HANGING, lying_level
from dlo_calibration.planning.crossings import crossings
from dlo_calibration.planning.dlo import CalibratedDlo, Posterior
from dlo_calibration.planning.limits import Limits
from dlo_calibration.planning.options import HANDS, PlanOptions
from dlo_calibration.planning.rehearsal import Job, Rehearser, Step

START, GOAL = 'start chain', 'goal chain'  # in errors
OTHER_LENGTH = 0.10  # share of the length; with a larger difference, the unit or the DLO is another one
ELSEWHERE = 0.02  # share of the length; points of start and goal that are so far apart along it do not match
DRAWS = 3  # from the posterior, at most, that are laid on the goal


def checked(found: CalibratedDlo, start: Chain, goal: Chain, simulation: Options,
            options: PlanOptions) -> tuple[Chain, Chain]:
    """
    Return the start and the goal that a plan is made for.

    The goal gets its points at the same fractions of the length as the start, unless they are there
    already, and the height at which the start lies: both lie on the same table.

    :raises InputError: for a result without usable values; for a start or goal with another length than
        the DLO, or in the air; for a goal in a no-go box, or with more crossings than the start, if an
        action may not put the DLO over itself.
    """
    _check_dlo(found)
    _check_length(START, start, found.length, 'the calibrated DLO')
    _check_length(GOAL, goal, start.length, 'the start')
    if simulation.table and not simulation.scene:
        rise = _level(START, start, simulation.table_height) - _level(GOAL, goal, simulation.table_height)
    elif simulation.scene:  # where it lies on obstacles, nothing is known about its height
        rise = 0.0
    else:
        raise InputError('parameter table', 'false, and no scene', 'something that the DLO lies on',
                         'leave table at true, or name a scene')
    goal = _matched(goal, start, rise)
    if box := Limits.of(options).box(goal.points[None]):
        raise InputError(GOAL, f'a part in the no-go box {box}', 'a goal outside of all no-go boxes',
                         'move the goal, or correct no_go')
    more = crossings(goal.points) - crossings(start.points)
    if more > 0 and not options.crossings:
        raise InputError(GOAL, f'{more} crossing(s) of the DLO with itself more than in the start',
                         'no more than there', 'allow them with crossings, or choose another goal')
    return start, goal


def remarks(rehearse: Rehearser, posterior: Posterior, start: Chain, goal: Chain,
            options: PlanOptions) -> tuple[str, ...]:
    """
    Return sentences about why a goal cannot be reached exactly, and how near the DLO gets.

    :param rehearse: simulates at most 1 + DRAWS actions.
    :param start: as `checked` returns it, and `goal` likewise.
    :raises CancelledError: as `rehearse` does.
    """
    return (*_remarks_on_length(start, goal, options.tolerance / 100),
            *_remarks_on_limits(start, goal, options),
            *_remarks_on_rest(rehearse, posterior, goal, options))


def _check_dlo(found: CalibratedDlo) -> None:
    unusable = [name for name, one in found.parameters.items()
                if not np.isfinite([one.value, one.lower, one.upper]).all()]
    if unusable or not 0 < found.length < np.inf or not np.isfinite(found.errors.rms):
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


def _matched(goal: Chain, start: Chain, rise: float) -> Chain:
    """Return a goal with the points of the start, higher by `rise` [m]; it is itself if nothing changes."""
    fractions = start.arc_lengths() / start.length
    same = len(goal) == len(start) and np.abs(
        goal.arc_lengths() / goal.length - fractions).max() <= ELSEWHERE
    if same and rise == 0:
        return goal
    up = np.array([0.0, 0.0, rise])
    return replace(goal, points=goal.points + up) if same else Chain(
        goal.resample(fractions * goal.length) + up)


def _remarks_on_length(start: Chain, goal: Chain, tolerance: float) -> Iterator[str]:
    """Compare the lengths: if both middles coincide, a point is |s - 1/2| of the difference off, s = 0..1."""
    longer = goal.length - start.length
    if abs(longer) > tolerance * start.length:
        yield (f'the goal is {_percent(longer, start)} {"longer" if longer > 0 else "shorter"} than '
               f'the DLO, {_mm(goal.length)} instead of {_mm(start.length)}, so its points stay about '
               f'{_mm(abs(longer) / 4)} away from the goal on average')


def _remarks_on_limits(start: Chain, goal: Chain, options: PlanOptions) -> Iterator[str]:
    """Tell what is out of the reach of all hands, and that the start is in a no-go box."""
    limits, hands = Limits.of(options), HANDS[:options.hands]
    whose = ' and '.join(hands)
    start_within, goal_within = (np.any(
        [limits.reach[name].contains(chain.points, chain.points) for name in hands], axis=0)
        for chain in (start, goal))
    if not start_within.any():
        yield f'no point of the DLO is within the reach of {whose}, so nothing can move it'
    if not goal_within.all():
        yield (f'{(~goal_within).sum()} of the {len(goal)} points of the goal are outside the reach of '
               f'{whose}, so they can only be moved by other parts of the DLO')
    if box := limits.box(start.points[None]):
        yield f'the DLO is in the no-go box {box} at the start'


def _remarks_on_rest(rehearse: Rehearser, posterior: Posterior, goal: Chain,
                     options: PlanOptions) -> Iterator[str]:
    """Lay the DLO exactly on the goal, let it go, and tell how far it moves."""
    middle = len(goal) // 2
    touch = Step(Action((Hand(HANDS[0], (middle,), np.zeros(1), goal.points[[middle]]),)))
    drawn = posterior.draws(min(DRAWS, options.draws), options.seed)
    found = rehearse([Job(goal, (touch,), physical) for physical in (posterior.best, *drawn)])
    failures = [one.failure for one in found if one.failure]
    if failures:
        yield f'whether the DLO stays on the goal cannot be told: {failures[0]}'
        return
    away = np.stack([np.linalg.norm(one.chains[-1] - goal.points, axis=1) for one in found])
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
    Return about the smallest radius of a bend [m] that friction on the table holds.

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
