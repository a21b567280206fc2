# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Wrenches: what force sensors of hands measured, and the forces of trials that follow from it.

A message has the name of a hand as its frame_id, and a force in the axes of that hand, as its orientation in
the action says: the force that the DLO, and the gripper's own weight, exert on the sensor.  What a hand
measures while it holds nothing, before it closes, is subtracted from what it measures later.  As the weight
of the gripper turns with the axes, only goals count in which the hand is as far from the vertical as then.
The forces depend only on the set of messages, not on the order of arrival.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import NANOSECONDS, WrenchMessage
from dlo_calibration.model.action import Hand, rotation_matrix
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Force, Goal, Trial

BIN = NANOSECONDS // 100  # messages within this time [ns] are one mean: sensors may send 1000 a second
MOST_BINS = 500_000  # of all hands, which take 100 MB: 40 minutes of two hands
RESOLUTION = 1e-9  # N; sums of whole numbers do not depend on the order
EMPTY = -1.0, -0.2  # s from when a hand closes: the time in which it holds nothing and rests
AT_REST = -0.5, 0.05  # s from a goal at rest
IN_MOTION = -0.025, 0.025  # s from a goal in motion
LEAST_TURN = math.radians(0.5)  # turns a gripper of 1 kg, whose weight is then off by 0.09 N


class Wrenches:
    """The forces that hands measured, as means over short times."""

    def __init__(self) -> None:
        self._bins: dict[str, dict[int, tuple[int, int, int, int]]] = {}  # by hand and time: sums, and count
        self._count = 0

    def __bool__(self) -> bool:
        """Return whether any came."""
        return bool(self._bins)

    @property
    def names(self) -> tuple[str, ...]:
        """The frame_ids, in the order in which they came."""
        return tuple(self._bins)

    def add(self, message: WrenchMessage) -> None:
        """
        Add a message.

        :raises InputError: if there are too many.
        """
        bins, time = self._bins.setdefault(message.frame_id, {}), message.stamp // BIN
        if time not in bins:
            if self._count >= MOST_BINS:
                raise InputError(str(message), f'it came after {MOST_BINS} others that are 10 ms apart',
                                 f'at most {MOST_BINS}', 'calibrate with these, or reset to begin anew')
            self._count += 1
        x, y, z = (round(value / RESOLUTION) for value in message.force.tolist())
        a, b, c, count = bins.get(time, (0, 0, 0, 0))
        bins[time] = a + x, b + y, c + z, count + 1

    def mean(self, name: str, begin: int, end: int) -> Floats | None:
        """Return the mean force (3,) [N] on a hand from one stamp to another [ns]; None: there is none."""
        bins = self._bins.get(name, {})
        sums = [bins[time] for time in range(-(-begin // BIN), end // BIN + 1) if time in bins]
        if not sums:
            return None
        *total, count = np.sum(np.array(sums, dtype=float), axis=0).tolist()
        return np.asarray(np.array(total) * (RESOLUTION / count))

    def forces(self, trial: Trial, zero: int, tares: dict[str, Floats]) -> tuple[tuple[Force, ...], ...]:
        """
        Return the forces in each goal of a trial.

        :param zero: stamp of the trial's time 0 [ns].
        :param tares: what each hand measured when it last held nothing, (3,) [N]; this trial adds its own.
        """
        first = {hand.name: hand for hand in reversed(trial.hands)}
        for name, hand in first.items():
            empty = self._around(name, zero, hand.start, EMPTY)
            if empty is not None:
                tares[name] = empty
        each = ([self._force(goal, hand, first[hand.name], zero, tares) for hand in trial.holding(goal)]
                for goal in trial.goals)
        return tuple(tuple(force for force in forces if force is not None) for forces in each)

    def _force(self, goal: Goal, hand: Hand, first: Hand, zero: int, tares: dict[str, Floats]
               ) -> Force | None:
        """Return the force on a hand that holds the DLO in a goal; `first` is its path when it closed."""
        begin, end = AT_REST if goal.stable else IN_MOTION
        begin = max(begin, hand.end - goal.time) if goal.stable else begin
        measured, tare = self._around(hand.name, zero, goal.time, (begin, end)), tares.get(hand.name)
        if measured is None:
            return None
        closed, now = axes(first, first.start), axes(hand, goal.time)
        # The vertical in the axes of the hand; without a tare, all axes.
        same = closed[2] @ now[2] if tare is not None else (np.trace(closed.T @ now) - 1) / 2
        if same < math.cos(LEAST_TURN):
            return None
        return Force(hand.name, now @ (measured if tare is None else measured - tare), tare is not None)

    def _around(self, name: str, zero: int, time: float, within: tuple[float, float]) -> Floats | None:
        begin, end = (zero + round((time + seconds) * NANOSECONDS) for seconds in within)
        return self.mean(name, begin, end)


def axes(hand: Hand, time: float) -> Floats:
    """Return the rotation (3, 3) from the axes of a hand to those of the trial at a time [s]."""
    return np.asarray(hand.poses(time)[1][0] @ rotation_matrix(hand.orientations[0]))


def with_forces(trial: Trial, forces: Sequence[tuple[Force, ...]]) -> Trial:
    """Return a trial with forces in its goals."""
    return replace(trial, goals=tuple(replace(goal, forces=each)
                                      for goal, each in zip(trial.goals, forces, strict=True)))


def same_forces(forces: Sequence[tuple[Force, ...]], others: Sequence[tuple[Force, ...]]) -> bool:
    """Return whether the forces of two versions of a trial are equal."""
    def plain(rows: Sequence[tuple[Force, ...]]) -> list[list[tuple[str, bool, bytes]]]:
        return [[(force.hand, force.tared, force.vector.tobytes()) for force in row] for row in rows]

    return plain(forces) == plain(others)


def force_problems(wrenches: Wrenches, trials: Sequence[Trial]) -> tuple[InputError, ...]:
    """Return why wrenches of trials are not used, if some are not."""
    if not wrenches or not trials:
        return ()
    hands = tuple(dict.fromkeys(hand.name for trial in trials for hand in trial.hands))
    problems = [InputError(f'wrench of {name!r}', 'no hand of this name in any action',
                           f'one of {", ".join(hands)}', 'let frame_id name the hand, as in joint_names')
                for name in wrenches.names if name not in hands]
    for trial in trials:
        measured = {hand.name for hand in trial.hands} & set(wrenches.names)
        if measured and not trial.forces and any(trial.holding(goal) for goal in trial.goals):
            problems.append(InputError(
                trial.name, f'no wrench of {" or ".join(sorted(measured))} that can be used',
                'some in the half second before a goal in which the hand holds the DLO, and has not turned '
                'since it closed', 'publish ~/wrench all the time, with the clock of the chains'))
    return tuple(problems)
