# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Excitation: which parameters a trial can show, found without simulation."""

from __future__ import annotations

from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Chain, Floats, frozen_array, grip_place
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, owner, ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.noise import noise

BETWEEN = 9  # interpolated chains from one observed chain to the next
NEAR = 0.25  # s; a motion is seen from one chain to another that is no later
STILL = 0.005  # m/s; a slower hand or DLO rests
TURNING = 0.05  # rad/s; a hand that turns more slowly rests


def motions(trials: Sequence[Trial]) -> tuple[bool, bool]:
    """
    Return whether timed goals show a motion, and one between clamps; hands and DLO that wait show none.

    A motion is between clamps if two hands or more clamp the DLO meanwhile.
    """
    moving: list[tuple[Trial, Goal]] = []
    for trial in trials:
        goals = [goal for goal in trial.goals if not goal.stable]
        shown = [(trial, goal) for goal, moves in zip(goals, _moves(trial, goals), strict=True) if moves]
        if any(map(_clamped, shown)):
            return True, True
        moving += shown
    moving = moving or _swinging(trials)
    return bool(moving), any(map(_clamped, moving))


def _clamped(seen: tuple[Trial, Goal]) -> bool:
    """Return whether two hands or more clamp the DLO of a trial in a goal."""
    trial, goal = seen
    return sum(len(hand.grips) > 1 for hand in trial.holding(goal)) > 1


def _moves(trial: Trial, goals: Sequence[Goal]) -> NDArray[np.bool_]:
    """
    Return which timed goals certainly show a motion, (g,).

    They do if a hand moves, if the DLO was moving when the trial began, and if no hand is under way: such a
    goal is timed because the DLO was seen in motion.
    """
    times = np.array([goal.time for goal in goals])
    moving = np.full(len(goals), trial.velocity is not None)
    waiting = np.zeros(len(goals), np.bool_)
    for hand in trial.hands if len(goals) else ():
        (place, turn), (place_after, turn_after) = (hand.poses(times + k * NEAR / 2) for k in (-1, 1))
        ways = np.linalg.norm(place_after - place, axis=1)
        # The Frobenius distance of two rotations is 2 sqrt(2) sin(angle / 2).
        angles = np.linalg.norm(turn_after - turn, axis=(1, 2)) / np.sqrt(2)
        under_way = (hand.start <= times) & (times <= hand.end)
        moving |= under_way & ((ways > STILL * NEAR) | (angles > TURNING * NEAR))
        waiting |= under_way
    return moving | ~waiting


def _swinging(trials: Sequence[Trial]) -> list[tuple[Trial, Goal]]:
    """Return the timed goals that differ from the next goal, shortly after, by more than noise explains."""
    pairs = [(trial, goal, later) for trial in trials
             for goal, later in zip(trial.goals[:-1], trial.goals[1:], strict=True)
             if not goal.stable and 0 < later.time - goal.time <= NEAR]
    if not pairs:
        return []
    sigma = np.nan_to_num(noise(trials))
    return [(trial, goal) for trial, goal, later in pairs
            if _apart(goal.chain, later.chain) > 4 * sigma + STILL * (later.time - goal.time)]


def _apart(chain: Chain, other: Chain) -> float:
    """Return the root mean square of how far the coordinates that both chains show moved [m]."""
    both = chain.seen & other.seen
    return float(np.sqrt(np.mean((other.points - chain.points)[both]**2))) if both.any() else 0.0


def excites(trials: Sequence[Trial], space: ParameterSpace, table_height: float | None
            ) -> NDArray[np.bool_]:
    """
    Return which free parameters each trial can show, (T, d); False only if it certainly cannot.

    :param table_height: [m]; None where there is no table.
    """
    sigma = noise(trials)
    rows = []
    for trial in trials:
        touches = _may_touch_itself(trial)
        shown = {
            'friction': touches or _may_touch_table(trial, table_height), 'self_collision': touches,
            'elasticity': _may_stretch(trial, space, sigma),
            'damping': any(not goal.stable for goal in trial.goals),
            'internal_damping': any(not goal.stable for goal in trial.goals),
            'mass': bool(trial.forces) or not all(
                p.per_weight <= (p.name in space.free) for p in BY_NAME.values())}
        rows.append([shown.get(owner(name)[0], True) and space.holds_in(name, trial.session)
                     for name in space.free])
    return frozen_array(np.reshape(rows, (len(trials), space.dimension)), bool)


def _chains(trial: Trial) -> list[Floats]:
    return [trial.initial.points, *(goal.chain.points for goal in trial.goals)]


def _may_touch_table(trial: Trial, table_height: float | None) -> bool:
    """Return whether the DLO may touch the table: it hangs low, or hands move it far."""
    if table_height is None:
        return False
    lowest = min(float(points[:, 2].min()) for points in _chains(trial))
    travel = max(float(np.linalg.norm(np.diff(hand.positions, axis=0), axis=1).sum()) for hand in trial.hands)
    swing = 0.0 if trial.velocity is None else trial.initial.length
    return lowest < table_height + 0.1 + travel + swing  # 0.1 m to spare


def _may_touch_itself(trial: Trial) -> bool:
    """
    Return whether parts that are not neighbours may have touched.

    It checks the observed chains, chains interpolated between them, and the path of each hand past them.
    """
    reach = 1.5 * 2 * BY_NAME['self_collision'].at_hundred  # 1.5 of the largest diameter
    places = trial.initial.arc_lengths()
    along = np.abs(places[:, None] - places[None, :])
    spacing = float(np.diff(places).max())
    chains = _chains(trial)
    steps = np.linspace(0, 1, BETWEEN)[:, None, None]
    between = np.concatenate([a + steps * (b - a) for a, b in zip(chains[:-1], chains[1:], strict=True)])

    def near(distance: Floats, along: Floats) -> bool:
        # A pair that is further apart than 0.8 of its arc length is not folded back to touch.
        return bool(((distance < reach + spacing) & (distance < 0.8 * along)).any())

    for points in between:
        if near(np.linalg.norm(points[:, None] - points[None, :], axis=2), along):
            return True
    for hand in trial.hands:
        path = hand.positions_at(np.linspace(hand.start, hand.end, 4 * BETWEEN))
        for points in chains:
            offset = np.linalg.norm(path[:, None] - points[None, :], axis=2)
            if near(offset, along[list(hand.grips)].min(axis=0)):
                return True
    return False


def _may_stretch(trial: Trial, space: ParameterSpace, sigma: float) -> bool:
    """Return whether the hands may have stretched a DLO of the greatest elasticity measurably."""
    hands, length = trial.hands, trial.initial.length
    places = trial.initial.arc_lengths()
    for k, hand in enumerate(hands):
        for other in hands[k + 1:]:
            times = np.linspace(min(hand.start, other.start), max(hand.end, other.end), 4 * BETWEEN)
            distance = np.linalg.norm(hand.positions_at(times) - other.positions_at(times), axis=1).max()
            grips = [grip_place(places, grip, each.offset) for each in (hand, other) for grip in each.grips]
            if distance > 0.9 * np.ptp(grips):  # else the DLO between is slack
                return True
    if np.isnan(sigma) or 'mass' in space.free or any(not goal.stable for goal in trial.goals):
        return True
    weight = space.physical({}, length)['mass'] * GRAVITY
    # A hand that drags and swings the DLO pulls with at most 4 weights; 0.2 of the noise is not seen.
    return bool(4 * weight / BY_NAME['elasticity'].at_hundred * length > 0.2 * sigma)
