# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Plausibility: warnings about trials that physics rules out, from their chains alone.

A calibration would fit them all the same, and find wrong parameters: chains in a wrong frame or at a wrong
table height, whose z is not up, in millimetres, or with points that run from the other end. A DLO at rest
that nothing holds lies on the table, in a level plane; if it is held at points, its centre of mass is
straight below them (statics of a pivoted body).
"""

from __future__ import annotations

import math
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import measured, number
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.observation.noise import noise_of
from dlo_calibration.observation.table import HANGING, lowest_level, RESTING_BAND

SHORTEST, LONGEST = 0.02, 15.0  # m; hands manipulate no DLO beyond; half a metre in inches is 20
UNITS = {'millimetres': 1e-3, 'centimetres': 1e-2, 'inches': 0.0254}
BELOW = 0.01  # m; a table may be measured with such an error, and trackers see the table through a thin DLO
SIGMAS = 5.0  # standard deviations of the noise that are never exceeded
STEEPEST = math.radians(15.0)  # of the plane in which a DLO lies; the pose of a table is known better
BESIDE = math.radians(60.0)  # of a centre of mass from straight below the hands that hold a DLO
LEVER = 0.1  # of the length; the direction of a shorter lever is uncertain
MOST_TRIALS = 3  # with warnings in full; a wrong frame makes all trials wrong
SOON = 0.5  # s; between two chains with a shorter gap, no DLO turns end for end


def implausible_trials(trials: Sequence[Trial], table_height: float | None,
                       scene: bool = False) -> tuple[str, ...]:
    """Return the warnings of `implausible` about the trials of a session; of many trials, the first ones."""
    warned = [warnings for trial, before in zip(trials, [None, *trials], strict=False)
              if (warnings := implausible(trial, table_height, scene, before))]
    more = len(warned) - MOST_TRIALS
    return (*(text for warnings in warned[:MOST_TRIALS] for text in warnings),
            *[f'{more} more trial(s) are implausible'] * (more > 0))


def implausible(trial: Trial, table_height: float | None, scene: bool = False,
                before: Trial | None = None) -> tuple[str, ...]:
    """
    Return warnings about a trial: what came, what was expected, and the remedy.

    :param table_height: [m]; None: there is no table.
    :param scene: whether there are other obstacles; a DLO may then lie on them.
    :param before: the trial before this one in the session.
    """
    length = trial.initial.length
    if not SHORTEST <= length <= LONGEST:
        return _wrong_unit(trial, length),
    warnings = list(_swapped(trial, before))
    seen = [trial.initial.points, *(trial.goals[k].chain.points for k in shown_goals(len(trial.goals)))]
    sigma = noise_of([np.stack(seen)])
    margin = SIGMAS * (0.002 if math.isnan(sigma) else sigma)
    for description, chain, hands in _at_rest(trial):
        problem = _wrong_place(chain, hands, table_height, scene, margin)
        if problem is not None:
            warnings.append(str(InputError(trial.name, f'{description} {problem[0]}', *problem[1:])))
            break  # the warnings about the others would be the same
    return tuple(warnings)


def _at_rest(trial: Trial) -> list[tuple[str, Chain, Sequence[Hand]]]:
    """
    Return a description of each chain at rest, the chain, and the hands that may hold it.

    Those that no hand holds are first, as most is known about them.
    """
    shown = [trial.goals[k] for k in shown_goals(len(trial.goals))]
    chains: list[tuple[str, Chain, Sequence[Hand]]] = [
        (f'a DLO at rest at {number(goal.time)} s', goal.chain, trial.holding(goal))
        for goal in shown if goal.stable]
    if trial.velocity is None:
        # Whether a hand that closes at the start has held the DLO before is not known.
        chains.append(('a DLO that begins at rest', trial.initial,
                       [hand for hand in trial.hands if hand.times[0] <= 0]))
    return sorted(chains, key=lambda rest: len(rest[2]))


def _wrong_unit(trial: Trial, length: float) -> str:
    units = [f'{name} ({length * size:.3g} m then)' for name, size in UNITS.items()
             if 0.1 <= length * size <= 5.0]
    guess = f'if they are {" or ".join(units)}, convert them' if units else 'check their unit'
    return str(InputError(trial.name, f'a DLO that is {length:.4g} m long',
                          f'{SHORTEST:g} to {LONGEST:g} m', f'send the coordinates in metres: {guess}'))


def _wrong_place(chain: Chain, hands: Sequence[Hand], table_height: float | None, scene: bool,
                 margin: float) -> tuple[str, str, str] | None:
    """Return why a chain cannot rest where it does, what was expected and the remedy; None if it can."""
    z = chain.points[:, 2]
    level = lowest_level(chain)
    level = float(np.quantile(z, 0.1)) if math.isinf(level) else level
    if table_height is not None and level < table_height - max(BELOW, margin):
        tilt = _tilt(chain, margin)
        if tilt > STEEPEST and not hands:
            return _steep(tilt)
        return (f'{measured(table_height - level, "m")} below the table at {number(table_height)} m',
                'it on the table', _height_remedy(level))
    if scene:
        return None
    if not hands:
        if table_height is None:
            return ('that nothing holds', 'a table below it, or a hand that holds it',
                    f'set table to true and table_height to {number(level)}, or tell which hands hold it')
        tilt = _tilt(chain, margin)
        if tilt > STEEPEST:
            return _steep(tilt)
        if level >= table_height + HANGING + margin:
            return _in_the_air(level, table_height)
        return None
    if table_height is not None and z.min() < table_height + HANGING + margin:
        return None  # the table holds it, too
    if table_height is not None and _lies_flat(chain, hands, margin):
        return _in_the_air(level, table_height)
    aside = _beside(chain, hands)
    if aside <= BESIDE:
        return None
    if table_height is not None and np.ptp(z) <= max(RESTING_BAND, 2 * margin):
        return _in_the_air(level, table_height)
    return (f'whose centre of mass is {math.degrees(aside):.0f} degrees from straight below the hands',
            'it below them', 'set frame_pose so that z is up, number all points that a hand grips in the '
            'field hand, or correct table_height')


def _in_the_air(level: float, table_height: float) -> tuple[str, str, str]:
    return (f'{measured(level - table_height, "m")} above the table at {number(table_height)} m, where '
            'nothing holds it', 'it on the table', _height_remedy(level) + ', or no table if there is none')


def _steep(tilt: float) -> tuple[str, str, str]:
    return (f'in a plane that is {math.degrees(tilt):.0f} degrees from level, where nothing holds it',
            'a level plane, as z is up', 'set frame_pose to the pose of the frame of the chains in that of '
            'the table, or send them in a frame whose z is up')


def _height_remedy(level: float) -> str:
    return f'set table_height to about {number(level)}, or frame_pose if the chains are in another frame'


def _tilt(chain: Chain, margin: float) -> float:
    """Return the angle from level of the plane or line in which a chain lies [rad]; 0: it lies in neither."""
    centred = chain.points - chain.points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    sizes = sizes / math.sqrt(len(centred))
    wide = sizes > max(margin, 0.03 * chain.length)
    if not wide[0] or wide[2]:
        return 0.0
    if not wide[1]:
        return math.asin(min(1.0, abs(float(axes[0, 2]))))
    return math.acos(min(1.0, abs(float(axes[2, 2])))) if sizes[2] < 0.2 * sizes[1] else 0.0


def _lies_flat(chain: Chain, hands: Sequence[Hand], margin: float) -> bool:
    """Return whether a chain lies: level and bent, with a single hand, so that its other end would sag."""
    points = chain.points
    if len(hands) > 1 or np.ptp(points[:, 2]) > max(RESTING_BAND, 2 * margin):
        return False
    return bool(np.linalg.norm(points[-1] - points[0]) < 0.98 * chain.length)


def _beside(chain: Chain, hands: Sequence[Hand]) -> float:
    """
    Return the angle of the centre of mass from straight below the points that hold a chain in the air [rad].

    The weight must have no moment about a pin, and none about the line through two pins: there is no friction
    that could balance it. 0 where a clamp or a third hand could.
    """
    grips = [chain.gripped(hand.grips, hand.offset)[0] for hand in hands if len(hand.grips) == 1]
    if len(grips) < len(hands) or len(grips) > 2:
        return 0.0
    points = chain.points
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    centre = steps @ (points[:-1] + points[1:]) / (2 * steps.sum())
    down, lever = np.array([0.0, 0.0, -1.0]), centre - grips[0]
    if len(grips) == 2:
        axis = grips[1] - grips[0]
        axis /= np.linalg.norm(axis)
        down, lever = down - (down @ axis) * axis, lever - (lever @ axis) * axis
        if np.linalg.norm(down) < 0.5:  # an axis near the vertical leaves the direction open
            return 0.0
    size = float(np.linalg.norm(lever))
    if size < LEVER * chain.length:
        return 0.0
    return math.acos(float(np.clip(lever @ down / size / np.linalg.norm(down), -1.0, 1.0)))


def _swapped(trial: Trial, before: Trial | None) -> Iterator[str]:
    """Yield warnings about chains whose points run from the other end than in the chain before."""
    length, initial = trial.initial.length, trial.initial.points
    remedy = 'number the points from the same end of the DLO in all chains'
    if before is not None and len(before.initial) == len(initial) and before.goals[-1].stable:
        last = before.goals[-1].chain.points
        if _reversed_fits(last, initial, length) and _apart(last[::-1], initial) < 0.03 * length:
            yield str(InputError(trial.name, f'an initial chain that is the last one of {before.name} from '
                                 'the other end', 'the same end first', remedy))
    chains, times = [initial], [-math.inf]
    for goal in trial.goals:
        points = goal.chain.points
        soon = goal.time - times[-1] < SOON and _reversed_fits(chains[-1], points, length)
        if soon or goal.stable and _held_at_other_end(trial, goal.time, points, length):
            yield str(InputError(trial.name, f'a goal chain at {number(goal.time)} s whose points run from '
                                 'the other end of the DLO', 'the end that was first before', remedy))
            return
        chains.append(points)
        times.append(goal.time)


def _apart(points: Floats, other: Floats) -> float:
    return float(np.linalg.norm(points - other, axis=1).mean())


def _reversed_fits(points: Floats, other: Floats, length: float) -> bool:
    """Return whether a chain is far from another, but near to it in the reversed order of points."""
    apart = _apart(points, other)
    return apart > 0.1 * length and _apart(points[::-1], other) < 0.2 * apart


def _held_at_other_end(trial: Trial, time: float, points: Floats, length: float) -> bool:
    """Return whether the point that the last hand gripped is far from where that ended, its mirror near."""
    finished = [hand for hand in trial.hands if hand.end <= time]
    if not finished:
        return False
    last = max(finished, key=lambda hand: hand.end)
    grip, mirror = last.grips[0], len(points) - 1 - last.grips[0]
    offset = last.positions[0] - trial.initial.points[grip] if last.times[0] <= 0 else np.zeros(3)
    place = last.positions[-1] - offset
    here, there = (float(np.linalg.norm(points[k] - place)) for k in (grip, mirror))
    return here > 0.2 * length and there < 0.05 * length \
        and _apart(points[::-1], trial.initial.points) < _apart(points, trial.initial.points)
