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

from dataclasses import replace
import math
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import GRAVITY, measured, number
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.noise import noise, noise_of
from dlo_calibration.observation.table import HANGING, lowest_level, resting_band

SHORTEST, LONGEST = 0.009, 16.5  # m; 1 cm to 15 m, measured with noise; half a metre in inches is 20
UNITS = {'millimetres': 1e-3, 'centimetres': 1e-2, 'inches': 0.0254}
BELOW = 0.01  # m; a table may be measured with such an error, and trackers see the table through a thin DLO
LONGEST_STEP = 0.025  # of the time in which a DLO swings; beyond, released ones end elsewhere
SIGMAS = 5.0  # standard deviations that noise never exceeds
STEEPEST = math.radians(15.0)  # of the plane in which a DLO lies; table poses are more exact
BESIDE = math.radians(60.0)  # of a centre of mass from straight below the hands that hold a DLO
IN_THE_AIR = 0.05  # m above the table; a lower hand may press a DLO on it
FELT = 0.05  # N; smaller mean forces are noise
LEVER = 0.1  # of the length; the direction of a shorter lever is uncertain
NOISY = 0.005  # of the length; trackers and photographs are twice as good
SUNK = 0.002  # m; a middle line is not further below the top of the table
LIGHTEST = 200.0  # kg/m^3; cork, and the lightest hoses
MOST_TRIALS = 3  # with warnings in full; a wrong frame makes all trials wrong
SOON = 0.5  # s; between two chains with a shorter gap, no DLO turns end for end


def implausible_trials(trials: Sequence[Trial], table_height: float | None,
                       scene: bool = False) -> tuple[str, ...]:
    """Return the warnings of `implausible` about the trials of a session; of many trials, the first ones."""
    warned, before = [], None
    for trial in trials:
        if warnings := implausible(trial, table_height, scene, before):
            warned.append(warnings)
        before = in_order(trial, before)
    more = len(warned) - MOST_TRIALS
    return (*(text for warnings in warned[:MOST_TRIALS] for text in warnings),
            *[f'{more} more trial(s) are implausible'] * (more > 0))


def observation_warnings(trials: Sequence[Trial], table_height: float | None, mass: float = 0.0,
                         time_step: float = 0.0) -> tuple[str, ...]:
    """
    Return warnings about how trials were observed: repeated ones, noise, a short DLO, the table's height.

    :param table_height: [m]; None: there is no table.
    :param mass: of the whole DLO [kg]; 0: unknown.
    :param time_step: of the simulation [s].
    """
    warnings = list(repeated_trials(trials))
    length = float(np.mean([trial.initial.length for trial in trials]))
    swing = math.sqrt(length / GRAVITY)
    if time_step > LONGEST_STEP * swing:
        warnings.append(str(InputError(
            'the simulation',
            f'a time step of {number(1e3 * time_step)} ms for a DLO of {measured(length, "m")}',
            f'at most {number(float(f"{1e3 * LONGEST_STEP * swing:.2g}"))} ms, as short DLOs move fast',
            f'set time_step to {number(float(f"{0.4 * LONGEST_STEP * swing:.1g}"))}')))
    sigma = float(np.nan_to_num(noise(trials)))
    if sigma > NOISY * length:
        warnings.append(str(InputError(
            'the chains', f'a noise of {measured(sigma, "m")} in each coordinate', f'at most '
            f'{measured(NOISY * length, "m")}, {100 * NOISY:g} % of the length',
            'average several views, light the DLO better, or bring the camera nearer')))
    flat = max(resting_band(length), 6 * sigma)
    levels = [float(np.median(trial.initial.points[:, 2])) for trial in trials
              if trial.velocity is None and np.ptp(trial.initial.points[:, 2]) <= flat]
    if not levels or table_height is None:
        return tuple(warnings)
    above, margin = float(np.median(levels)) - table_height, 3 * sigma
    radius = above - margin
    if above < -SUNK - margin:
        warnings.append(str(InputError(
            'the table', f'a DLO whose middle line lies {measured(-above, "m")} below its top', 'a DLO on it',
            f'set table_height to about {number(float(np.median(levels)))}, less the radius of the DLO')))
    elif radius > 0 and 0 < mass < LIGHTEST * math.pi * radius**2 * length:
        warnings.append(str(InputError(
            'the table', f'a DLO whose middle line lies {measured(above, "m")} above its top, so that it '
            f'would be {measured(2 * above, "m")} thick and lighter than foam', 'its radius',
            'set table_height to the height of the middle line less the radius of the DLO, or correct mass')))
    return tuple(warnings)


def implausible(trial: Trial, table_height: float | None, scene: bool = False,
                before: Trial | None = None) -> tuple[str, ...]:
    """
    Return warnings about a trial: what came, what was expected, and the remedy.

    :param table_height: [m]; None: there is no table.
    :param scene: whether there are other obstacles; a DLO may then lie on them.
    :param before: the trial before this one in the session, see `in_order`.
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
    return (*warnings, *_upwards(trial, table_height, scene))


def _upwards(trial: Trial, table_height: float | None, scene: bool) -> tuple[str, ...]:
    """Return a warning about forces that push up hands from which a DLO hangs."""
    lowest = -math.inf if table_height is None else table_height + IN_THE_AIR
    up = [float(force.vector[2]) for k, hand, force in trial.forces if force.tared and trial.goals[k].stable
          and hand.positions[-1, 2] > lowest]
    if scene or not up or np.mean(up) < FELT:
        return ()
    return str(InputError(
        trial.name, f'forces that push the hands up by {measured(float(np.mean(up)), "N")}, though '
        'a DLO hangs from them', 'the force that the DLO exerts on a hand, which points down there',
        'reverse the sign of the forces, or tell how the hands are turned')),


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
        # A hand that closes at the start may have held the DLO before.
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
    if table_height is not None and np.ptp(z) <= max(resting_band(chain.length), 2 * margin):
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
    if len(hands) > 1 or np.ptp(points[:, 2]) > max(resting_band(chain.length), 2 * margin):
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


def in_order(trial: Trial, before: Trial | None = None) -> Trial:
    """
    Return the trial with a last chain whose points run from the same end as in the trial before.

    If the initial chain is turned, and the first goal too late to tell whether the goals are, too, the last
    one is not stable: the next trial is not compared with it.

    :param before: itself the outcome of this function; None: it is the first trial.
    """
    turned, last = _begins_at_other_end(trial, before), trial.goals[-1]
    if turned and trial.goals[0].time >= max(0.0, trial.hands[0].start) + SOON:
        return replace(trial, goals=(*trial.goals[:-1], replace(last, stable=False)))
    if turned == (_first_turned(trial) is not None):
        return trial
    other = Chain(last.chain.points[::-1])
    return replace(trial, goals=(*trial.goals[:-1], replace(last, chain=other)))


def reversed_trials(trials: Sequence[Trial]) -> tuple[bool, ...]:
    """Return of each trial whether points of a chain run from the other end than in the chain before."""
    turned, before = [], None
    for trial in trials:
        turned.append(_begins_at_other_end(trial, before) or _first_turned(trial) is not None)
        before = in_order(trial, before)
    return tuple(turned)


def repeated(trial: Trial, others: Sequence[Trial]) -> tuple[str, ...]:
    """
    Return a warning if a trial repeats one of the others bit for bit, as no measurement does.

    The means of chains at rest are not compared: a stream may still add to them.
    """
    for other in others:
        if _repeats(trial, other):
            return str(InputError(
                trial.name, f'the initial chain, hands and goal chains of {other.name}, bit for bit',
                'measurements of its own', 'leave one of them out: together they count twice, and all '
                'intervals become too narrow')),
    return ()


def repeated_trials(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the warnings of `repeated` about the trials of a session; of many trials, the first ones."""
    warnings = [text for k, trial in enumerate(trials) for text in repeated(trial, trials[:k])]
    more = len(warnings) - MOST_TRIALS
    return (*warnings[:MOST_TRIALS], *[f'{more} more trial(s) are repeated'] * (more > 0))


def _repeats(trial: Trial, other: Trial) -> bool:
    pairs = [(trial.initial.observed, other.initial.observed)]
    if len(trial.hands) != len(other.hands):
        return False
    for hand, its in zip(trial.hands, other.hands, strict=True):
        pairs += [(hand.times, its.times), (hand.positions, its.positions)]
    goals, its_goals = ([goal for goal in each.goals if goal.count == 1] for each in (trial, other))
    if not goals or not its_goals:
        goals, its_goals = list(trial.goals), list(other.goals)
    pairs += [(goal.chain.observed, its.chain.observed)
              for goal, its in zip(goals, its_goals, strict=False)]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _swapped(trial: Trial, before: Trial | None) -> Iterator[str]:
    """Yield a warning if the points of a chain run from the other end than in the chain before."""
    remedy = 'number the points from the same end of the DLO in all chains'
    if before is not None and _begins_at_other_end(trial, before):
        yield str(InputError(trial.name, f'an initial chain that is the last one of {before.name} from '
                             'the other end', 'the same end first', remedy))
    elif (goal := _first_turned(trial)) is not None:
        yield str(InputError(trial.name, f'a goal chain at {number(goal.time)} s whose points run from '
                             'the other end of the DLO', 'the end that was first before', remedy))


def _begins_at_other_end(trial: Trial, before: Trial | None) -> bool:
    """Return whether the initial chain is the last one of the trial before from the other end."""
    if before is None or len(before.initial) != len(trial.initial) or not before.goals[-1].stable:
        return False
    last, initial, length = before.goals[-1].chain.points, trial.initial.points, trial.initial.length
    return _reversed_fits(last, initial, length) and _apart(last[::-1], initial) < 0.03 * length


def _first_turned(trial: Trial) -> Goal | None:
    """Return the first goal whose points run from the other end than in the chain before, if there is one."""
    length = trial.initial.length
    chains = np.stack([trial.initial.points, *(goal.chain.points for goal in trial.goals)])
    # A DLO at rest stays there until a hand closes.
    begin = 0.0 if trial.velocity is not None else max(0.0, trial.hands[0].start)
    soon = np.diff([begin, *(goal.time for goal in trial.goals)]) < SOON
    jumps = soon & (np.linalg.norm(np.diff(chains, axis=0), axis=2).mean(axis=1) > 0.1 * length)
    for goal, jump, before in zip(trial.goals, jumps, chains, strict=False):
        points = goal.chain.points
        if jump and _reversed_fits(before, points, length) \
                or goal.stable and _held_at_other_end(trial, goal.time, points, length):
            return goal
    return None


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
