# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Move: an action that a plan may contain, by its grips and its displacements."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import Sequence

import numpy as np

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.planning.limits import HANDS
from dlo_calibration.planning.options import KINDS
from dlo_calibration.planning.rehearsal import ActionStep
from dlo_calibration.planning.surroundings import passed_wrongly, Surroundings
from dlo_calibration.planning.ways import way_around

LIFTING = KINDS[0]  # grasp_and_place; the other kind stays on the table
MOST_GRIPS = 11  # places along the DLO where one hand may grip; neighbours do nearly the same
MOST_PAIRED_GRIPS = 6  # places along the DLO where two hands may grip, in pairs
MOST_PIVOTS = 7  # places along the DLO from which on a part is led
HANDS_APART = 0.04  # m between two hands, as grippers have a size
SHORTEST_LEG = 1e-6  # m; a shorter part of a path has no duration
OVER = 4  # points of the goal from one corner of a way over it to the next
HIGHEST = 0.25  # of the length; over higher posts, no DLO is carried
NOTHING = Surroundings()
STRAIGHT = frozen_array(np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class Move:
    """
    An action of one or two hands, each of which grips one point.

    :param name: `grasp_and_place` or `drag`.
    :param grips: indices of the gripped points.
    :param hands: names of the hands, one for each grip.
    :param shifts: (h, 2) [m] horizontal displacement of each hand.
    :param corners: (c, 2) [m] places that the way of one hand passes; two hands move straight.
    :param over: height of what a lift has to carry the DLO over [m].
    """

    name: str
    grips: tuple[int, ...]
    hands: tuple[str, ...]
    shifts: Floats
    corners: Floats = field(default_factory=lambda: STRAIGHT)
    over: float = -np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, 'shifts', frozen_array(np.reshape(self.shifts, (len(self.grips), 2))))

    def step(self, points: Floats, levels: Floats, height: float, speed: float,
             surroundings: Surroundings = NOTHING) -> ActionStep:
        """
        Return the paths of the hands, which have waypoints at the same times, and open at the end.

        :param points: (n, 3) [m] the DLO before the action.
        :param levels: (n,) heights [m] at which the points are put down.
        :param height: of a lift above the highest place [m]; it is higher where hands pass over a body.
        :param speed: of the faster hand [m/s].
        """
        begin, level = points[list(self.grips)], levels[list(self.grips)]
        end = np.column_stack([begin[:, :2] + self.shifts, level])
        corners = [np.column_stack([np.tile(corner, (len(begin), 1)), level]) for corner in self.corners]
        way = [begin, *corners, end]
        if self.name == LIFTING:
            top = max(begin[:, 2].max(), level.max(), self.over) + height
            for passed in np.stack(way, axis=1):
                top = surroundings.above(passed[:, :2], top)
            lifted = [np.column_stack([place[:, :2], np.full(len(place), top)]) for place in way]
            way = [begin, *lifted, end]
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


def carrying(points: Floats, goal: Floats, kinds: Sequence[str], hands: int,
             surroundings: Surroundings = NOTHING) -> list[tuple[Move, ...]]:
    """
    Return the moves that carry gripped points to their places in the goal.

    Each entry has the same grips and displacements with every choice of hands, the usual one first.  One hand
    goes around bodies; two go straight.

    :param points: (n, 3) [m] the DLO now.
    :param goal: (n, 3) [m].
    :param kinds: names of the permitted actions.
    :param hands: number of hands, 1 or 2.
    """
    pairs = list(combinations(grips(len(points), MOST_PAIRED_GRIPS), 2)) if hands > 1 else []
    moves = []
    for kind in kinds:
        for grip in grips(len(points), MOST_GRIPS):
            to = goal[[grip], :2]
            moves += _ways(kind, grip, points, to, to, hands, surroundings)
        for pair in pairs:
            shifts = (goal - points)[list(pair), :2]
            moves.append(tuple(Move(kind, pair, names, shifts) for names in (HANDS, HANDS[::-1])))
    return moves


def leading(points: Floats, goal: Floats, kinds: Sequence[str], hands: int, surroundings: Surroundings,
            posts: Floats) -> list[tuple[Move, ...]]:
    """
    Return the moves that lead a part of the DLO around posts that it passes at another side than the goal.

    A hand takes the DLO near an end, goes back along it as far as a pivot, and from there along the goal:
    what follows the hand then passes all posts as the goal does.  The way is as short as the posts permit.
    Or a hand carries any part to its place in the goal, so high that the DLO passes over the posts.

    :param posts: (p, 2) [m]; the other arguments are those of `carrying`.
    """
    wrong, last = passed_wrongly(points, goal, posts), len(points) - 1
    if not wrong:
        return []
    top = surroundings.top(posts)
    length = float(np.linalg.norm(np.diff(goal, axis=0), axis=1).sum())
    low = LIFTING in kinds and top - goal[:, 2].min() < HIGHEST * length
    moves = [tuple(Move(LIFTING, (grip,), (name,), goal[grip, :2] - points[grip, :2], over=top)
                   for name in HANDS[:hands]) for grip in grips(last + 1, MOST_GRIPS * low)]
    for order in (np.arange(last + 1), np.arange(last, -1, -1)):
        now, then = points[order], goal[order]
        for pivot in grips(last + 1, MOST_PIVOTS)[:-1]:
            if passed_wrongly(now[:pivot + 1], then[:pivot + 1], posts) >= wrong:
                continue
            for grip in grips(last + 1, MOST_GRIPS)[-2:]:
                way = np.concatenate([now[pivot:grip][::-1], then[pivot:grip + 1]])[:, :2]
                over = np.concatenate([now[[pivot]], then[pivot:grip:OVER], then[[grip]]])[:, :2]
                for kind in kinds:
                    moves += _ways(kind, int(order[grip]), points, way, over, hands, surroundings)
    return list({(each.name, each.grips, each.over, each.corners.tobytes(), each.shifts.tobytes()): choices
                 for choices in moves for each in choices[:1]}.values())


def _ways(kind: str, grip: int, points: Floats, way: Floats, over: Floats, hands: int,
          surroundings: Surroundings) -> list[tuple[Move, ...]]:
    """
    Return the moves in which a hand takes a grip along a way around bodies; lifted, also over them.

    :param way: (w, 2) [m] places that the hand passes; `over` (v, 2) those that it passes above bodies.
    """
    begin, ways = points[grip], [way]
    if surroundings.bodies:
        around = way_around(surroundings, np.vstack([begin[:2], way]), float(begin[2]))
        ways = [] if around is None else [around[1:]]
        if kind == LIFTING and (around is None or len(around) > 2):
            ways.append(over)
    return [tuple(Move(kind, (grip,), (name,), each[-1] - begin[:2], frozen_array(each[:-1]))
                  for name in HANDS[:hands]) for each in ways]
