# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The way along a ridge, from click to click.

Dijkstra's algorithm over states of pixel and direction.  A move costs more where the ridge is weak, and more
where the direction changes, so that the way goes straight on at crossings; at a click the next part goes on
in the directions in which the parts before it arrive.

The kernels are in `path_kernels`.  A state of a ridge of H x W pixels is (v W + u) 16 + the index, in
`path_kernels.MOVES`, of the move that leads to the pixel u, v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.capture.ridge import Ridge
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.kernel_cache import TRACER
from dlo_calibration.simulation.machine_code import defined_in
from dlo_calibration.simulation.states import (
    ByteRows,
    Bytes,
    Cube32,
    Indices,
    Matrix,
    Matrix32,
    Vector,
    Vector32,
)

MOST = 2_500_000  # states that are looked at, about a second: along a DLO these are 20 to 400 thousand
ROOM = 1 << 16  # pixels of all ways to a click for which there is room at first


@defined_in(TRACER)
def add_scores(scores: Matrix32, drift: float, totals: Matrix, came: ByteRows) -> int:
    """
    Find the largest sum of scores to each column of each row.

    :param scores: (n, m).
    :param drift: see `steady`.
    :param totals: (2, m) sums up to the last row with an even index, the first row's being given, and up to
        the last one with an odd index.
    :param came: (n, m) from how many columns further on the sum to each comes is written here, but to row 0.
    """
    raise NotImplementedError


@defined_in(TRACER)
def follow_back(came: ByteRows, index: Indices) -> int:
    """Write the (n,) columns that lead to the last one, which is given; `came` (n, m) is of `add_scores`."""
    raise NotImplementedError


@defined_in(TRACER)
def look_beside(place: Vector, reach: float, height: int, width: int, states: Indices,
                costs: Vector32) -> int:
    """
    Find the states around a click, in all directions, and what each costs.

    :param place: (2,) the click [px of the ridge].
    :param reach: how far it may be from the way [px of the ridge].
    :param states: room for 16 (2 int(reach) + 3)^2 of them, and `costs` likewise.
    :returns: how many there are.
    """
    raise NotImplementedError


@defined_in(TRACER)
def find_ways(hessian: Cube32, floor: float, goal: Vector, reach: float, left: Indices, begins: Indices,
              begin_costs: Vector32, cost: Vector32, before: Bytes, heap: Indices, keys: Vector32,
              touched: Indices, ends: Indices, end_costs: Vector32) -> int:
    """
    Find the ways from one click to the next.

    :param hessian: (H, W, 3), and `floor`: see `Ridge`.
    :param goal: (2,) the next click [px of the ridge].
    :param reach: how far it may be from the way [px of the ridge].
    :param left: (1,) how many states may still be looked at.
    :param begins: (s,) states at the first click; `begin_costs`: their costs.
    :param cost: (16 H W,) workspace, all inf: cost of the best way to each state.
    :param before: (16 H W,) the direction in which the way came to the state before is written here for each
        state that was found, -1 at a begin.
    :param heap: (s + 4 left,) workspace: states to look at, the cheapest first; `keys`: their costs.
    :param touched: (16 H W,) workspace: states whose cost is known.
    :param ends: (e,) room for the states near `goal` at which ways end; `end_costs`: for their costs.
    :returns: how many there are; 0: none was found within `left`.
    """
    raise NotImplementedError


@defined_in(TRACER)
def list_ways(ends: Indices, begins: Indices, before: Bytes, width: int, pixels: Indices, bounds: Indices,
              links: Indices) -> int:
    """
    List the pixels of the ways back from `ends` (e,), one after the other, as far as there is room.

    :param begins: (s,) states at which the ways begin.
    :param before: (16 H W,) of `find_ways`.
    :param width: W.
    :param pixels: (p,) room for the pixels, v W + u.
    :param bounds: (e + 1,) where each way begins among them, and where the last one ends.
    :param links: (e,) the index in `begins` of each way's begin.
    :returns: how many pixels there are, more than p if there was not room for all.
    """
    raise NotImplementedError


def way(ridge: Ridge, clicks: Floats, reach: float) -> Floats:
    """
    Return the way (n, 2) [px of the photograph] along a ridge; it is empty if there is none.

    :param clicks: (k, 2) [px of the photograph], in order.
    :param reach: how far beside the DLO a click may be [px of the photograph].
    """
    height, width = ridge.hessian.shape[:2]
    places = (np.asarray(clicks) + 0.5) / ridge.factor - 0.5
    places = np.ascontiguousarray(np.clip(places, 0, (width - 1, height - 1)))
    pixels = _Search(ridge, max(1.5, reach / ridge.factor)).along(places)
    found: Floats = np.column_stack([pixels % width, pixels // width]).astype(float)
    return (found + 0.5) * ridge.factor - 0.5


def steady(scores: NDArray[np.float32], drift: float) -> tuple[NDArray[np.int64], float]:
    """
    Return the column of each row with the largest sum of scores, and the mean of that sum over the rows.

    :param scores: (n, m).
    :param drift: cost of a change by one column from row to row; that by two is four times as much.
    """
    rows, columns = scores.shape
    totals, came = np.empty((2, columns)), np.empty((rows, columns), dtype=np.int8)
    totals[0] = scores[0]
    add_scores(scores, drift, totals, came)
    total = totals[(rows - 1) % 2]
    index = np.empty(rows, dtype=np.int64)
    index[-1] = np.argmax(total)
    follow_back(came, index)
    return index, float(total[index[-1]]) / rows


class _Search:
    """
    The search for the way along a ridge.

    :param reach: how far a click may be from it [px of the ridge].
    """

    def __init__(self, ridge: Ridge, reach: float) -> None:
        self._ridge, self._reach = ridge, reach
        self._height, self._width = ridge.hessian.shape[:2]
        self._near = 16 * (2 * int(reach) + 3) ** 2  # states around a click, at most
        states = 16 * self._height * self._width
        self._before: Bytes = np.zeros(states, dtype=np.int8)
        # Each state that is looked at leaves the heap, and at most five enter it.  What is not written to
        # takes no memory.
        room = self._near + 4 * MOST
        self._workspace = (np.full(states, np.inf, dtype=np.float32), self._before,
                           np.empty(room, dtype=np.int64), np.empty(room, dtype=np.float32),
                           np.empty(states, dtype=np.int64))

    def along(self, places: Floats) -> Indices:
        """Return the pixels (n,), v W + u, of the way along (k, 2) clicks [px of the ridge]."""
        begins, costs = self._some()
        count = look_beside(places[0], self._reach, self._height, self._width, begins, costs)
        begins, costs = begins[:count], costs[:count]
        left = np.array([MOST])
        parts = []
        for goal in places[1:]:
            ends, end_costs = self._some()
            count = find_ways(self._ridge.hessian, self._ridge.floor, goal, self._reach, left, begins, costs,
                              *self._workspace, ends, end_costs)
            if not count:
                return np.empty(0, dtype=np.int64)
            ends, costs = ends[:count], end_costs[:count]
            parts.append(self._ways(ends, begins))
            begins = ends
        # The ways of all parts are kept, and the last click chooses one.
        found, best = [np.empty(0, dtype=np.int64)], int(np.argmin(costs))
        for pixels, bounds, links in reversed(parts):
            found.append(pixels[bounds[best]:bounds[best + 1]])
            best = links[best]
        return np.concatenate(found)[::-1]

    def _some(self) -> tuple[Indices, Vector32]:
        """Return room for the states around a click, and their costs."""
        return np.empty(self._near, dtype=np.int64), np.empty(self._near, dtype=np.float32)

    def _ways(self, ends: Indices, begins: Indices) -> tuple[Indices, Indices, Indices]:
        """Return the pixels of the ways back, their bounds and their links; see `list_ways`."""
        bounds, links = np.empty(len(ends) + 1, dtype=np.int64), np.full(len(ends), -1, dtype=np.int64)
        pixels = np.empty(ROOM, dtype=np.int64)
        count = list_ways(ends, begins, self._before, self._width, pixels, bounds, links)
        if count > len(pixels):
            pixels = np.empty(count, dtype=np.int64)
            list_ways(ends, begins, self._before, self._width, pixels, bounds, links)
        return pixels[:count], bounds, links
