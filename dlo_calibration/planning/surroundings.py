# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Surroundings: the bodies that stand around a DLO, as hands go around them, and as the DLO passes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Iterator, Self, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation import core
from dlo_calibration.simulation.scene import core_body, extremes, Obstacle

CORNERS = 12  # of the polygon that stands for a body, seen from above
SPARE = 1e-3  # m that corners of ways are further away than the clearance
STRIDE = 5e-4  # m; shortest step along a way whose clearance is checked
SAME = 1e-6  # m; places that are nearer to each other are one
UPRIGHT = 0.7  # least vertical part of the direction in which a body is left by what lies on it
SUNK = 2e-3  # m that a point of the DLO may be lower, or inside a body: noise


def outline(obstacle: Obstacle, corners: int, margin: float = 0.0) -> Floats:
    """
    Return the outline of an obstacle seen from above: corners of a convex polygon around it, (c, 2) [m].

    :param margin: by which the polygon is wider on all sides [m].
    """
    points, radius = extremes(obstacle)
    angles = 2 * np.pi * np.arange(corners) / corners
    outwards = np.column_stack([np.cos(angles), np.sin(angles)])
    support = (points[:, :2] @ outwards.T).max(axis=0) + radius + margin
    # Neighbouring sides, u . x = a and v . x = b, meet at (a v' - b u') / (u x v), where ' turns by -90 deg.
    after, sine = np.roll(outwards, -1, axis=0), np.sin(2 * np.pi / corners)
    turned, turned_after = (np.column_stack([side[:, 1], -side[:, 0]]) for side in (outwards, after))
    return np.asarray((support[:, None] * turned_after - np.roll(support, -1)[:, None] * turned) / sine)


@dataclass(frozen=True)
class Standing:
    """
    A body that stands around the DLO.

    :param body: that the core knows the distances from.
    :param lower: (3,) [m] lowest coordinates of the box around it; `upper` (3,) highest ones.
    :param clearance: that hands keep from it [m].
    :param corners: (c, 2) [m] of a polygon around it and its clearance, seen from above.
    """

    body: core.Body
    lower: Floats
    upper: Floats
    clearance: float
    corners: Floats

    @classmethod
    def of(cls, obstacle: Obstacle, clearance: float, points: Floats) -> Self:
        """
        Return an obstacle; a mesh that is not closed counts as the box around it.

        From one on which the DLO lies, hands keep only as far as the DLO itself.

        :param points: (m, 3) [m] where the DLO lies.
        """
        corners, radius = extremes(obstacle)
        lower, upper = corners.min(axis=0) - radius, corners.max(axis=0) + radius
        try:
            body = core_body(obstacle)
        except InputError:
            body = core.Body('box', (upper - lower) / 2, (upper + lower) / 2, np.eye(3).ravel(), 1.0)
        step = np.array([0.0, 0.0, STRIDE])
        on_it = [distance for place in points if (distance := body.distance(place)) < clearance
                 and body.distance(place + step) - body.distance(place - step) > 2 * UPRIGHT * STRIDE]
        clearance = max(min([clearance, *(distance - SUNK for distance in on_it)]), 0.0)
        return cls(body, lower, upper, clearance, outline(obstacle, CORNERS, clearance + SPARE))

    @property
    def middle(self) -> Floats:
        """Its middle, seen from above, (2,) [m]."""
        return np.asarray((self.lower + self.upper)[:2] / 2)

    def clear(self, begin: Floats, end: Floats) -> bool:
        """
        Tell whether a straight way keeps the clearance.

        At each place, the way is clear as far as the body is further away than that.

        :param begin: (3,) [m]; `end` (3,) [m].
        """
        length, along = float(np.linalg.norm(end - begin)), 0.0
        direction = (end - begin) / max(length, SAME)
        while True:
            spare = self.body.distance(begin + along * direction) - self.clearance
            if spare < -SAME:
                return False
            if along >= length:
                return True
            along = min(along + max(spare, STRIDE), length)


@dataclass(frozen=True)
class Surroundings:
    """
    All bodies around a DLO.

    :param bodies: in the order of the scene.
    """

    bodies: tuple[Standing, ...] = ()

    @classmethod
    def of(cls, obstacles: Sequence[Obstacle], clearance: float, *chains: Floats) -> Self:
        """
        Return the surroundings of the obstacles of a scene.

        :param clearance: that hands keep from them [m].
        :param chains: (n, 3) [m] where the DLO lies.
        """
        points = np.concatenate([np.zeros((0, 3)), *chains])
        return cls(tuple(Standing.of(obstacle, clearance, points) for obstacle in obstacles))

    @cached_property
    def margins(self) -> Floats:
        """Lowest and highest corners of the boxes that enclose bodies and their clearance, (2, b, 3) [m]."""
        return np.array([[body.lower - body.clearance for body in self.bodies],
                         [body.upper + body.clearance for body in self.bodies]]).reshape(2, -1, 3)

    def _near(self, begin: Floats, end: Floats) -> Iterator[tuple[int, Standing]]:
        """Yield the number of a straight way, and a body to which it comes nearer than the clearance."""
        lower, upper = self.margins
        # Boxes around way and body that do not overlap are far from each other.
        overlap = ((np.minimum(begin, end)[:, None] <= upper) & (np.maximum(begin, end)[:, None] >= lower))
        for way, body in np.argwhere(overlap.all(axis=2)):
            if not self.bodies[body].clear(begin[way], end[way]):
                yield int(way), self.bodies[body]

    def spare(self, place: Floats) -> float:
        """Return by how much a place, (3,) [m], keeps more than the clearance of all bodies [m]."""
        lower, upper = self.margins
        least = np.linalg.norm(np.maximum(np.maximum(lower - place, place - upper), 0.0), axis=1)
        spare = np.inf
        for k in np.argsort(least, kind='stable'):
            if least[k] >= spare:
                break
            spare = min(spare, self.bodies[k].body.distance(place) - self.bodies[k].clearance)
        return float(spare)

    def cover(self, place: Floats) -> bool:
        """Tell whether a place, (3,) [m], is inside a body."""
        return any(body.body.distance(place) < -SUNK for body in self.bodies)

    def refusal(self, action: Action) -> str:
        """Return which hand comes too near to a body: a phrase, empty if none does."""
        for hand in action.hands if self.bodies else ():
            way = hand.positions if len(hand.positions) > 1 else hand.positions[[0, 0]]
            for _, body in self._near(way[:-1], way[1:]):
                return f'{hand.name} comes nearer to a body than {1e3 * body.clearance:.3g} mm'
        return ''

    def clear(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """
        Tell which straight ways keep the clearance.

        :param begin: (m, 3) [m]; `end` (m, 3) [m].
        :returns: (m,)
        """
        clear = np.ones(len(begin), bool)
        for way, _ in self._near(begin, end):
            clear[way] = False
        return clear

    def above(self, way: Floats, height: float) -> float:
        """
        Return a height [m] in which a way over the table keeps the clearance: at least the given one.

        :param way: (w, 2) [m] places that it passes straight.
        """
        while True:
            places = raised(way, height)
            tops = [float(body.upper[2]) + body.clearance for _, body in self._near(places[:-1], places[1:])]
            if not tops:
                return height
            height = max(tops) + SPARE

    def top(self, posts: Floats) -> float:
        """Return the height of the highest of `posts` [m]."""
        return max(float(body.upper[2]) for body in self.bodies if (body.middle == posts).all(axis=1).any())

    def posts(self, *chains: Floats) -> Floats:
        """
        Return the middles of the bodies that chains, (n, 3) [m], lie beside, not on: (p, 2) [m].

        They reach down to the lowest point of the chains, and up to it.
        """
        points = np.concatenate(chains)
        lowest = points[:, 2].min()
        return np.array([body.middle for body in self.bodies
                         if body.lower[2] <= lowest <= body.upper[2]
                         and not any(body.body.distance([x, y, lowest]) < 0 for x, y, _ in points)]
                        ).reshape(-1, 2)


def passed_wrongly(points: Floats, goal: Floats, posts: Floats) -> int:
    """
    Return how often a DLO passes posts at another side than in its goal.

    Where it does, the post stands in the area between both: the closed curve along the DLO, and back along
    the goal, winds around it.

    :param points: (n, 3) [m]; `goal` (n, 3) [m].
    :param posts: (p, 2) [m].
    """
    curve = np.concatenate([points[:, :2], goal[::-1, :2], points[:1, :2]])
    away = curve[None] - posts[:, None]
    angles = np.diff(np.arctan2(away[..., 1], away[..., 0]), axis=1)
    turns = ((angles + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)
    return int(np.abs(turns.round()).sum())


def raised(places: Floats, height: float) -> Floats:
    """Return places, (m, 2) [m], at a height [m]: (m, 3)."""
    return np.column_stack([places, np.full(len(places), height)])
