# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Move: an action that a plan may contain, by its grips and its displacements."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Sequence

import numpy as np

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.planning.limits import HANDS
from dlo_calibration.planning.options import KINDS
from dlo_calibration.planning.rehearsal import ActionStep

LIFTING = KINDS[0]  # grasp_and_place; the other kind stays on the table
MOST_GRIPS = 11  # places along the DLO where one hand may grip; neighbours do nearly the same
MOST_PAIRED_GRIPS = 6  # places along the DLO where two hands may grip, in pairs
HANDS_APART = 0.04  # m between two hands, as grippers have a size
SHORTEST_LEG = 1e-6  # m; a shorter part of a path has no duration


@dataclass(frozen=True, eq=False)
class Move:
    """
    An action of one or two hands, each of which grips one point.

    :param name: `grasp_and_place` or `drag`.
    :param grips: indices of the gripped points.
    :param hands: names of the hands, one for each grip.
    :param shifts: (h, 2) [m] horizontal displacement of each hand.
    """

    name: str
    grips: tuple[int, ...]
    hands: tuple[str, ...]
    shifts: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, 'shifts', frozen_array(np.reshape(self.shifts, (len(self.grips), 2))))

    def step(self, points: Floats, levels: Floats, height: float, speed: float) -> ActionStep:
        """
        Return the paths of the hands, which have waypoints at the same times, and open at the end.

        :param points: (n, 3) [m] the DLO before the action.
        :param levels: (n,) heights [m] at which the points are put down.
        :param height: of a lift above the highest place [m].
        :param speed: of the faster hand [m/s].
        """
        begin, level = points[list(self.grips)], levels[list(self.grips)]
        end = np.column_stack([begin[:, :2] + self.shifts, level])
        way = [begin, end]
        if self.name == LIFTING:
            top = np.full((len(begin), 1), max(begin[:, 2].max(), level.max()) + height)
            way = [begin, np.hstack([begin[:, :2], top]), np.hstack([end[:, :2], top]), end]
        places, times = [way[0]], [0.0]
        for place in way[1:]:
            leg = float(np.linalg.norm(place - places[-1], axis=1).max())
            if leg > SHORTEST_LEG:
                places.append(place)
                times.append(times[-1] + leg / speed)
        path = np.array(places)
        return ActionStep(Action(tuple(Hand(name, (grip,), np.array(times), path[:, k])
                                 for k, (name, grip) in enumerate(zip(self.hands, self.grips, strict=True)))))


def clash(action: Action) -> str:
    """
    Return why the hands of a move collide; empty if they do not.

    :param action: its hands have waypoints at the same times, and move straight from one to the next.
    """
    for hand, other in combinations(action.hands, 2):
        between = other.positions - hand.positions
        leg = np.diff(between, axis=0)
        share = -np.sum(between[:-1] * leg, axis=1) / np.maximum(np.sum(leg**2, axis=1), SHORTEST_LEG**2)
        nearest = np.vstack([between, between[:-1] + np.clip(share, 0, 1)[:, None] * leg])
        if np.linalg.norm(nearest, axis=1).min() < HANDS_APART:
            return f'{hand.name} and {other.name} come nearer to each other than {1e3 * HANDS_APART:.0f} mm'
    return ''


def grips(count: int, most: int) -> tuple[int, ...]:
    """Return the indices of at most `most` of `count` points, evenly spread, with both ends."""
    return tuple(sorted({int(k) for k in np.linspace(0, count - 1, min(count, most)).round()}))


def carrying(points: Floats, goal: Floats, kinds: Sequence[str], hands: int) -> list[tuple[Move, ...]]:
    """
    Return the moves that carry gripped points to their places in the goal.

    Each entry has the same grips and displacements with every choice of hands, the usual one first.

    :param points: (n, 3) [m] the DLO now.
    :param goal: (n, 3) [m].
    :param kinds: names of the permitted actions.
    :param hands: number of hands, 1 or 2.
    """
    single = [(grip,) for grip in grips(len(points), MOST_GRIPS)]
    pairs = list(combinations(grips(len(points), MOST_PAIRED_GRIPS), 2)) if hands > 1 else []
    moves = []
    for kind in kinds:
        for gripped in [*single, *pairs]:
            shifts = (goal - points)[list(gripped), :2]
            choices = [HANDS, HANDS[::-1]] if len(gripped) > 1 else [(name,) for name in HANDS[:hands]]
            moves.append(tuple(Move(kind, gripped, names, shifts) for names in choices))
    return moves
