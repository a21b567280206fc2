# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Ways of a hand over the table, around the bodies that stand there."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.planning.surroundings import raised, SAME, SPARE, STRIDE, Surroundings

PUSHES = 20  # at most, of a place out of bodies
MOST_CORNERS = 300  # that a search for a way looks from, at most
MOST_BODIES = 40  # that a way goes around, at most: the nearest ones


def way_around(surroundings: Surroundings, places: Floats, height: float) -> Floats | None:
    """
    Return a short way that keeps the clearance, and passes bodies at the same side as the given one.

    :param places: (w, 2) [m] that the given way passes; all but the first are moved out of bodies.
    :param height: of the way [m].
    :returns: (v, 2) [m], from the first place to the last one; None if there is none.
    """
    pushed = [_pushed(surroundings, place, height) for place in places[1:]]
    if pushed[-1] is None:
        return None
    way = [places[0]]
    for place in pushed:
        if place is not None:
            part = _around(surroundings, way[-1], place, height)
            if part is None:
                return None
            way += part
    return _shortened(surroundings, np.array(way), height)


def _pushed(surroundings: Surroundings, place: Floats, height: float) -> Floats | None:
    """Return the place, (2,) [m], moved out of the clearance of bodies; None if that does not succeed."""
    place = np.array(place, float)
    for _ in range(PUSHES):
        lack = SPARE - surroundings.spare(np.append(place, height))
        if lack <= SPARE / 2:
            return place
        uphill = np.array([surroundings.spare(np.append(place + step, height))
                           - surroundings.spare(np.append(place - step, height))
                           for step in np.eye(2) * STRIDE]) / (2 * STRIDE)
        slope = float(np.linalg.norm(uphill))
        if slope < 0.1:  # as above the middle of a body
            return None
        place = place + lack * uphill / slope
    return None


def _around(surroundings: Surroundings, begin: Floats, end: Floats, height: float) -> list[Floats] | None:
    """Return the places that the shortest way from begin to end, both (2,) [m], passes after begin."""
    if surroundings.clear(raised(begin[None], height), raised(end[None], height))[0]:
        return [end]
    low, high = surroundings.margins[..., 2]
    around = [surroundings.bodies[k] for k in np.flatnonzero((low < height) & (height < high))]
    around.sort(key=lambda body: float(np.linalg.norm(2 * body.middle - begin - end)))
    corners = np.concatenate([[end], *(body.corners for body in around[:MOST_BODIES])])
    # A* (Hart, Nilsson and Raphael 1968) on the visibility graph of the corners, whose edges are checked
    # only where the search comes.
    far = np.linalg.norm(corners - end, axis=1)
    over_table, costs = raised(corners, height), np.full(len(corners), np.inf)
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
        origin = np.repeat(raised(here[None], height), len(tried), axis=0)
        for k in tried[surroundings.clear(origin, over_table[tried])]:
            costs[k], before[k] = reached[k], at
            heapq.heappush(queue, (float(reached[k] + far[k]), int(k)))
    return None


def _shortened(surroundings: Surroundings, way: Floats, height: float) -> Floats:
    """Return a way without places where no body stands between it and the shortcut."""
    middles = np.array([body.middle for body in surroundings.bodies]).reshape(-1, 2)
    places, k = list(way), 1
    while k < len(places) - 1:
        corner = np.array(places[k - 1:k + 2])
        line = raised(corner[[0, 2]], height)
        if not _inside(middles, corner).any() and surroundings.clear(line[:1], line[1:])[0]:
            del places[k]
            k = max(k - 1, 1)
        else:
            k += 1
    return np.array(places)


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
