# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The way along a ridge, from click to click.

Dijkstra's algorithm over states of pixel and direction.  A move costs more where the ridge is weak, and more
where the direction changes, so that the way goes straight on at crossings; at a click the next part goes on
in the directions in which the parts before it arrive.
"""

from __future__ import annotations

import math
from typing import Any, Callable, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.capture.ridge import Ridge
from dlo_calibration.model.chain import Floats

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

#: moves (x, y) to the pixels around and a knight's move away, in the order of their angles
MOVES = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
                  (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)])
OFF = 25.0  # cost of a pixel of way off the ridge, where one on it costs 1
STRONG = 0.55  # share of the ridge measure at the clicks that costs the least
BEND = 0.6  # cost of a change of direction by a sixteenth of a turn; that by two is four times as much
ASIDE = 1.0  # cost of each pixel between a click and the way
MOST = 2_500_000  # states that are looked at, about a second: along a DLO these are 20 to 400 thousand
CROSSED = 40.0  # cost by which another arrival at a click may be worse than the best


def _compiled(*types: str) -> Callable[[Kernel], Kernel]:
    """Compile a kernel at import, or load it from the cache."""
    njit: Any = numba.njit
    return njit(*types, cache=True, nogil=True, error_model='numpy')  # type: ignore[no-any-return]


def way(ridge: Ridge, clicks: Floats, reach: float) -> Floats:
    """
    Return the way (n, 2) [px of the photograph] along a ridge.

    :param clicks: (k, 2) [px of the photograph], in order.
    :param reach: how far beside the DLO a click may be [px of the photograph].
    """
    height, width = ridge.hessian.shape[:2]
    places = (np.asarray(clicks) + 0.5) / ridge.factor - 0.5
    places = np.clip(places, 0, (width - 1, height - 1))
    states = _way(ridge.hessian, ridge.floor, places, max(1.5, reach / ridge.factor), MOVES, MOST)
    found: Floats = np.column_stack([states % width, states // width]).astype(float)
    return (found + 0.5) * ridge.factor - 0.5


@_compiled('Tuple((int64[::1], float64))(float32[:, ::1], float64)')
def steady(scores: NDArray[np.float32], drift: float) -> tuple[NDArray[np.int64], float]:
    """
    Return the column of each row with the largest sum of scores, and the mean of that sum over the rows.

    :param scores: (n, m).
    :param drift: cost of a change by one column from row to row; that by two is four times as much.
    """
    rows, columns = scores.shape
    total, next_total = scores[0].astype(np.float64), np.empty(columns)
    came = np.zeros((rows, columns), dtype=np.int8)
    for row in range(1, rows):
        for column in range(columns):
            best, step = total[column], 0
            for change in (-1, 1, -2, 2):
                other = column + change
                if 0 <= other < columns and total[other] - drift * change * change > best:
                    best, step = total[other] - drift * change * change, change
            next_total[column] = best + scores[row, column]
            came[row, column] = step
        total, next_total = next_total, total
    index = np.empty(rows, dtype=np.int64)
    index[-1] = np.argmax(total)
    for row in range(rows - 1, 0, -1):
        index[row - 1] = index[row] + came[row, index[row]]
    return index, total[index[-1]] / rows


@_compiled()
def _push(heap: NDArray[np.int64], keys: NDArray[np.float32], count: int, state: int, key: float) -> None:
    at = count
    while at:
        above = (at - 1) >> 1
        if keys[above] <= key:
            break
        heap[at], keys[at] = heap[above], keys[above]
        at = above
    heap[at], keys[at] = state, key


@_compiled()
def _pop(heap: NDArray[np.int64], keys: NDArray[np.float32], count: int) -> None:
    """Remove the first of `count` states."""
    count -= 1
    state, key = heap[count], keys[count]
    at = 0
    while True:
        below = 2 * at + 1
        if below >= count:
            break
        if below + 1 < count and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        heap[at], keys[at] = heap[below], keys[below]
        at = below
    heap[at], keys[at] = state, key


@_compiled()
def _with(states: NDArray[np.int64], count: int, state: int) -> NDArray[np.int64]:
    """Return an array of `count` states, or one with more room, to which a state is added."""
    if count == len(states):
        states = np.concatenate((states, states))
    states[count] = state
    return states


@_compiled()
def _beside(place: Floats, reach: float, height: int, width: int
            ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the states around a click, in all directions, and what each costs."""
    span = int(reach) + 1
    size = (2 * span + 1) ** 2 * 16
    states, costs = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.float32)
    count = 0
    u, v = int(round(place[0])), int(round(place[1]))
    for y in range(max(0, v - span), min(height, v + span + 1)):
        for x in range(max(0, u - span), min(width, u + span + 1)):
            aside = math.hypot(x - place[0], y - place[1])
            if aside <= reach:
                for d in range(16):
                    states[count], costs[count] = (y * width + x) * 16 + d, aside * ASIDE
                    count += 1
    return states[:count], costs[:count]


@_compiled()
def _part(hessian: NDArray[np.float32], floor: float, moves: NDArray[np.int64], goal: Floats, reach: float,
          most: int, begins: NDArray[np.int64], begin_costs: NDArray[np.float32], cost: NDArray[np.float32],
          before: NDArray[np.int8]
          ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64], int]:
    """
    Find the ways from one click to the next.

    :param begins: (s,) states at the first click, and their costs.
    :param cost: (height * width * 16,) of the best way to each state, all inf; those found are filled in.
    :param before: likewise, the direction in which the way came to the state before; -1 at a begin.
    :returns: (a,) states near `goal` and their costs; the states whose `cost` was filled in; and how many
        were looked at, which are at most `most`.
    """
    height, width = hessian.shape[0], hessian.shape[1]
    lengths = np.sqrt((moves * moves).sum(axis=1).astype(np.float64))
    across = np.empty((16, 3))  # weights of the three second derivatives, across each direction
    for d in range(16):
        x, y = -moves[d, 1] / lengths[d], moves[d, 0] / lengths[d]
        across[d, 0], across[d, 1], across[d, 2] = x * x, 2 * x * y, y * y
    heap, keys = np.empty(1 << 16, dtype=np.int64), np.empty(1 << 16, dtype=np.float32)
    touched = np.empty(1 << 16, dtype=np.int64)
    held, reached, looked = 0, 0, 0
    for k in range(len(begins)):
        if begin_costs[k] < cost[begins[k]]:
            touched = _with(touched, reached, begins[k])
            reached += 1
            cost[begins[k]], before[begins[k]] = begin_costs[k], -1
            if held == len(heap):
                heap, keys = np.concatenate((heap, heap)), np.concatenate((keys, keys))
            _push(heap, keys, held, begins[k], begin_costs[k])
            held += 1
    size = (2 * (int(reach) + 1) + 1) ** 2 * 16
    arrivals, arrival_costs = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.float32)
    arrived, nearest = 0, np.inf
    while held and looked < most:
        looked += 1
        state, key = heap[0], keys[0]
        _pop(heap, keys, held)
        held -= 1
        if key > cost[state]:
            continue
        if key > nearest + CROSSED:
            break
        pixel, direction = state // 16, state % 16
        x, y = pixel % width, pixel // width
        aside = math.hypot(x - goal[0], y - goal[1])
        if aside <= reach and arrived < size:
            arrivals[arrived], arrival_costs[arrived] = state, key + aside * ASIDE
            arrived += 1
            nearest = min(nearest, key + aside * ASIDE)
        for turn in range(-2, 3):
            d = (direction + turn) % 16
            i, j = x + moves[d, 0], y + moves[d, 1]
            if not (0 <= i < width and 0 <= j < height):
                continue
            strength = 0.0
            half_y, half_x = (y + j) // 2, (x + i) // 2
            for k in range(3):
                strength += 0.5 * across[d, k] * (hessian[j, i, k] + hessian[half_y, half_x, k])
            off = 1 - min(1.0, max(0.0, (strength - floor * 0.5) / (STRONG - floor * 0.5)))
            new = key + lengths[d] * (1 + (OFF - 1) * off * off) + BEND * turn * turn
            after = (j * width + i) * 16 + d
            if new < cost[after]:
                if cost[after] == np.inf:
                    touched = _with(touched, reached, after)
                    reached += 1
                cost[after], before[after] = new, direction
                if held == len(heap):
                    heap, keys = np.concatenate((heap, heap)), np.concatenate((keys, keys))
                _push(heap, keys, held, after, new)
                held += 1
    kept = np.flatnonzero(arrival_costs[:arrived] <= nearest + CROSSED)
    return arrivals[kept], arrival_costs[kept], touched[:reached], looked


@_compiled()
def _back(ends: NDArray[np.int64], begins: NDArray[np.int64], before: NDArray[np.int8], width: int,
          moves: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """
    Return the pixels of the ways back from `ends`, one after the other.

    :returns: the pixels; (e + 1,) where each way begins among them; (e,) index of its begin in `begins`.
    """
    pixels, bounds = np.empty(1 << 12, dtype=np.int64), np.empty(len(ends) + 1, dtype=np.int64)
    links = np.full(len(ends), -1, dtype=np.int64)
    length = 0
    for k in range(len(ends)):
        state, bounds[k] = ends[k], length
        while before[state] >= 0:
            pixels = _with(pixels, length, state // 16)
            length += 1
            d = state % 16
            pixel = state // 16 - moves[d, 1] * width - moves[d, 0]
            state = pixel * 16 + before[state]
        for begin in range(len(begins)):
            if begins[begin] == state:
                links[k] = begin
                break
    bounds[-1] = length
    return pixels[:length].copy(), bounds, links


@_compiled('int64[::1](float32[:, :, ::1], float64, float64[:, ::1], float64, int64[:, ::1], int64)')
def _way(hessian: NDArray[np.float32], floor: float, places: Floats, reach: float,
         moves: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """
    Return the pixels (n,) of the way, v * width + u; `places` and `reach` are in pixels of `hessian`.

    It is empty if there is none within `most` states.
    """
    height, width = hessian.shape[0], hessian.shape[1]
    cost = np.full(height * width * 16, np.inf, dtype=np.float32)
    before = np.zeros(height * width * 16, dtype=np.int8)
    begins, costs = _beside(places[0], reach, height, width)
    parts = len(places) - 1
    # The ways of all parts are kept, and the last click chooses one; [:0] tells the compiler the types.
    nothing = np.empty(0, dtype=np.int64)
    chains, bounds, links = [nothing][:0], [nothing][:0], [nothing][:0]
    looked = 0
    for part in range(parts):
        ends, costs, touched, seen = _part(hessian, floor, moves, places[part + 1], reach, most - looked,
                                           begins, costs, cost, before)
        looked += seen
        if not len(ends):
            return nothing
        chain, bound, link = _back(ends, begins, before, width, moves)
        chains.append(chain)
        bounds.append(bound)
        links.append(link)
        cost[touched] = np.inf
        begins = ends
    found, best = nothing, np.argmin(costs)
    for part in range(parts - 1, -1, -1):
        found = np.concatenate((found, chains[part][bounds[part][best]:bounds[part][best + 1]]))
        best = links[part][best]
    return found[::-1].copy()
