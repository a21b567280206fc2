# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Surroundings: the bodies that stand around a DLO, as hands go around them, and as the DLO passes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import heapq
from typing import Iterator, Self, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation import core
from dlo_calibration.simulation.scene import core_body, Obstacle

CORNERS = 12  # of the polygon that stands for a body, seen from above
SPARE = 1e-3  # m that corners of ways are further away than the clearance
STRIDE = 5e-4  # m; shortest step along a way whose clearance is checked
SAME = 1e-6  # m; places that are nearer to each other are one
PUSHES = 20  # at most, of a place out of bodies
MOST_CORNERS = 300  # that a search for a way looks from, at most
MOST_BODIES = 40  # that a way goes around, at most: the nearest ones
UPRIGHT = 0.7  # least vertical part of the direction in which a body is left by what lies on it
SUNK = 2e-3  # m that a point of the DLO may be lower, or inside a body: noise
OPEN = 4  # corners of the rims of a cylinder for each of CORNERS


def outline(obstacle: Obstacle, corners: int = OPEN * CORNERS, margin: float = 0.0) -> Floats:
    """
    Return the outline of an obstacle seen from above: corners of a convex polygon around it, (c, 2) [m].

    :param margin: by which the polygon is wider on all sides [m].
    """
    points, radius = _extremes(obstacle)
    angles = 2 * np.pi * np.arange(corners) / corners
    outwards = np.column_stack([np.cos(angles), np.sin(angles)])
    support = (points[:, :2] @ outwards.T).max(axis=0) + radius + margin
    # Neighbouring sides, u . x = a and v . x = b, meet at (a v' - b u') / (u x v), where ' turns by -90 deg.
    after, sine = np.roll(outwards, -1, axis=0), np.sin(2 * np.pi / corners)
    turned, turned_after = (np.column_stack([side[:, 1], -side[:, 0]]) for side in (outwards, after))
    return np.asarray((support[:, None] * turned_after - np.roll(support, -1)[:, None] * turned) / sine)


def _extremes(obstacle: Obstacle) -> tuple[Floats, float]:
    """Return points, (m, 3) [m], and a radius [m]; the hull of balls around these points is the obstacle."""
    from scipy.spatial.transform import Rotation  # slow to load

    sizes, radius = obstacle.sizes, 0.0
    if obstacle.shape == 'box':
        local = np.stack(np.meshgrid(*([-0.5, 0.5],) * 3), axis=-1).reshape(-1, 3) * sizes
    elif obstacle.shape == 'sphere':
        local, radius = np.zeros((1, 3)), float(sizes[0])
    elif obstacle.shape == 'capsule':
        local, radius = np.array([[0, 0, -0.5], [0, 0, 0.5]]) * sizes[0], float(sizes[1])
    elif obstacle.shape == 'cylinder':
        angles = 2 * np.pi * np.arange(OPEN * CORNERS) / (OPEN * CORNERS)
        circle = np.column_stack([np.cos(angles), np.sin(angles)]) * sizes[1]
        local = np.vstack([np.column_stack([circle, np.full(len(circle), z)])
                           for z in (-sizes[0] / 2, sizes[0] / 2)])
    else:
        local = obstacle.triangles.reshape(-1, 3) * sizes
    return Rotation.from_quat(obstacle.turn).apply(local) + obstacle.position, radius


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
        extremes, radius = _extremes(obstacle)
        lower, upper = extremes.min(axis=0) - radius, extremes.max(axis=0) + radius
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
    def _margins(self) -> Floats:
        """Lowest and highest corners of the boxes that enclose bodies and their clearance, (2, b, 3) [m]."""
        return np.array([[body.lower - body.clearance for body in self.bodies],
                         [body.upper + body.clearance for body in self.bodies]]).reshape(2, -1, 3)

    def _near(self, begin: Floats, end: Floats) -> Iterator[tuple[int, Standing]]:
        """Yield the number of a straight way, and a body to which it comes nearer than the clearance."""
        lower, upper = self._margins
        # Boxes around way and body that do not overlap are far from each other.
        overlap = ((np.minimum(begin, end)[:, None] <= upper) & (np.maximum(begin, end)[:, None] >= lower))
        for way, body in np.argwhere(overlap.all(axis=2)):
            if not self.bodies[body].clear(begin[way], end[way]):
                yield int(way), self.bodies[body]

    def spare(self, place: Floats) -> float:
        """Return by how much a place, (3,) [m], keeps more than the clearance of all bodies [m]."""
        lower, upper = self._margins
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
            places = _raised(way, height)
            tops = [float(body.upper[2]) + body.clearance for _, body in self._near(places[:-1], places[1:])]
            if not tops:
                return height
            height = max(tops) + SPARE

    def way(self, places: Floats, height: float) -> Floats | None:
        """
        Return a short way that keeps the clearance, and passes bodies at the same side as the given one.

        :param places: (w, 2) [m] that the given way passes; all but the first are moved out of bodies.
        :param height: of the way [m].
        :returns: (v, 2) [m], from the first place to the last one; None if there is none.
        """
        pushed = [self._pushed(place, height) for place in places[1:]]
        if pushed[-1] is None:
            return None
        way = [places[0]]
        for place in pushed:
            if place is not None:
                part = self._around(way[-1], place, height)
                if part is None:
                    return None
                way += part
        return self._shortened(np.array(way), height)

    def _pushed(self, place: Floats, height: float) -> Floats | None:
        """Return the place, (2,) [m], moved out of the clearance of bodies; None if that does not succeed."""
        place = np.array(place, float)
        for _ in range(PUSHES):
            lack = SPARE - self.spare(np.append(place, height))
            if lack <= SPARE / 2:
                return place
            uphill = np.array([self.spare(np.append(place + step, height))
                               - self.spare(np.append(place - step, height))
                               for step in np.eye(2) * STRIDE]) / (2 * STRIDE)
            slope = float(np.linalg.norm(uphill))
            if slope < 0.1:  # as above the middle of a body
                return None
            place = place + lack * uphill / slope
        return None

    def _around(self, begin: Floats, end: Floats, height: float) -> list[Floats] | None:
        """Return the places that the shortest way from begin to end, both (2,) [m], passes after begin."""
        if self.clear(_raised(begin[None], height), _raised(end[None], height))[0]:
            return [end]
        low, high = self._margins[..., 2]
        around = [self.bodies[k] for k in np.flatnonzero((low < height) & (height < high))]
        around.sort(key=lambda body: float(np.linalg.norm(2 * body.middle - begin - end)))
        corners = np.concatenate([[end], *(body.corners for body in around[:MOST_BODIES])])
        # A* (Hart, Nilsson and Raphael 1968) on the visibility graph of the corners, whose edges are checked
        # only where the search comes.
        far = np.linalg.norm(corners - end, axis=1)
        raised, costs = _raised(corners, height), np.full(len(corners), np.inf)
        before, done = np.full(len(corners), -1), np.zeros(len(corners), bool)
        queue: list[tuple[float, int]] = [(0.0, -1)]
        for _ in range(MOST_CORNERS):
            if not queue:
                return None
            at = heapq.heappop(queue)[1]
            if at == 0:
                return _traced(corners, before)
            if at > 0 and done[at]:
                continue
            here, spent = (begin, 0.0) if at < 0 else (corners[at], costs[at])
            if at >= 0:
                done[at] = True
            reached = spent + np.linalg.norm(corners - here, axis=1)
            tried = np.flatnonzero(~done & (reached < costs - SAME))
            origin = np.repeat(_raised(here[None], height), len(tried), axis=0)
            for k in tried[self.clear(origin, raised[tried])]:
                costs[k], before[k] = reached[k], at
                heapq.heappush(queue, (float(reached[k] + far[k]), int(k)))
        return None

    def _shortened(self, way: Floats, height: float) -> Floats:
        """Return a way without places where no body stands between it and the shortcut."""
        middles = np.array([body.middle for body in self.bodies]).reshape(-1, 2)
        places, k = list(way), 1
        while k < len(places) - 1:
            corner = np.array(places[k - 1:k + 2])
            line = _raised(corner[[0, 2]], height)
            if not _inside(middles, corner).any() and self.clear(line[:1], line[1:])[0]:
                del places[k]
                k = max(k - 1, 1)
            else:
                k += 1
        return np.array(places)

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


def _raised(places: Floats, height: float) -> Floats:
    return np.column_stack([places, np.full(len(places), height)])


def _traced(corners: Floats, before: NDArray[np.int64]) -> list[Floats]:
    """Return the places from the first after the begin to the end, which is corner 0."""
    at, places = 0, []
    while at >= 0:
        places.append(corners[at])
        at = int(before[at])
    return places[::-1]


def _inside(places: Floats, triangle: Floats) -> NDArray[np.bool_]:
    """Tell which places, (p, 2) [m], lie inside a triangle with (3, 2) [m] corners."""
    sides = np.roll(triangle, -1, axis=0) - triangle
    away = places[:, None] - triangle
    cross = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
    return np.asarray((cross > 0).all(axis=1) | (cross < 0).all(axis=1))
