# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The path along a ridge, from click to click.

Dijkstra's algorithm over states of pixel and direction.  (SciPy's needs the graph of all states; this search
visits few.)  A move costs more where the ridge is weak and where the direction changes, so that the path goes
straight on at crossings.  At a click, the next part continues in the directions in which those before arrive.

Every move costs at least 1, so all states of the frontier that cost less than 1 more than its cheapest are
settled at once: they form a bucket as wide as the least cost (Dial, Algorithm 360: shortest-path forest with
topological ordering, 1969), and none of them is reached more cheaply through another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.ridge import Ridge, Singles

Indices = NDArray[np.int64]

#: moves (x, y) to the pixels around and a knight's move away, in the order of their angles
MOVES = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
                  (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)])
LENGTHS = np.sqrt((MOVES * MOVES).sum(axis=1))  # px
_X, _Y = -MOVES[:, 1] / LENGTHS, MOVES[:, 0] / LENGTHS  # unit vectors across
ACROSS = np.column_stack([_X * _X, 2 * _X * _Y, _Y * _Y])  # weights of the three second derivatives
OFF = 25.0  # cost of a pixel off the ridge, where one on it costs 1
STRONG = 0.55  # share of the ridge measure at the clicks from which on a move costs the least
BEND = 0.6  # cost of a change of direction by a sixteenth of a turn; two sixteenths cost four times as much
TURNS = np.arange(-2, 3)  # sixteenths of a turn, from one move to the next
ASIDE = 2.0  # cost of each pixel between a click and the path: more than along a ridge, less than off it
CROSSED = 40.0  # cost by which another arrival at a click may be worse than the best
MAXIMUM_STATES = 2_500_000  # to settle, about two seconds; along a DLO these are 2 to 50 thousand
EDGE = 2  # px around the ridge that no path enters, as wide as the longest move


def ridge_path(ridge: Ridge, clicks: Floats, reach: ArrayLike) -> Floats:
    """
    Return the path (n, 2) [px of the photograph] along a ridge; empty: there is none.

    :param clicks: (k, 2) [px of the photograph], in order.
    :param reach: how far beside the DLO all clicks, or (k,) each of them, may be [px of the photograph].
    """
    height, width = ridge.hessian.shape[:2]
    places = (np.asarray(clicks) + 0.5) / ridge.factor - 0.5
    reaches = np.broadcast_to(np.maximum(1.5, np.asarray(reach) / ridge.factor), len(places))
    pixels = _Search(ridge).along(np.clip(places, 0, (width - 1, height - 1)), reaches)
    return (pixels + 0.5) * ridge.factor - 0.5


class _Search:
    """
    The search for the path along a ridge.

    A ridge of H x W pixels gets an edge, so that it has P = (H + 4) (W + 4).  A state is d P + the pixel to
    which the move with the index d leads.
    """

    def __init__(self, ridge: Ridge) -> None:
        self._size = ridge.hessian.shape[1::-1]
        self._moves = _move_costs(ridge).ravel()  # of the move that leads to each state
        self._cost = np.full_like(self._moves, np.inf)  # of the best path to each state
        self._before = np.empty(len(self._moves), dtype=np.int8)  # direction before; -1: the path begins here
        self._width = self._size[0] + 2 * EDGE
        self._pixels = len(self._moves) // len(MOVES)
        self._steps = MOVES @ (1, self._width)
        turned = (np.arange(len(MOVES))[:, None] + TURNS) % len(MOVES)
        self._after = turned * self._pixels + self._steps[turned]  # (16, 5) states minus the pixel before
        self._budget = MAXIMUM_STATES

    def along(self, places: Floats, reaches: Floats) -> Floats:
        """
        Return the pixels (n, 2) of the path along (k, 2) clicks [px of the ridge].

        :param reaches: (k,) how far each click may be from the path [px of the ridge].
        """
        (states, costs), *goals = map(self._around, places, reaches)
        parts = []
        for near, aside in goals:
            reached = self._settle(states, costs, near, aside)
            parts.append((reached, self._before[reached]))
            costs = self._cost[near] + aside
            self._cost[reached] = np.inf
            arrived = np.isfinite(costs) & (costs <= costs.min() + CROSSED)
            if not arrived.any():
                return np.empty((0, 2))
            states, costs = near[arrived], costs[arrived]
        # Every part has several paths; the last click decides which counts.
        visited, state = [], int(states[np.argmin(costs)])
        for reached, before in reversed(parts):
            while (direction := int(before[np.searchsorted(reached, state)])) >= 0:
                last, pixel = divmod(state, self._pixels)
                visited.append(pixel)
                state = direction * self._pixels + pixel - int(self._steps[last])
        v, u = np.divmod(visited[::-1], self._width)
        return np.column_stack([u, v]) - float(EDGE)

    def _around(self, place: Floats, reach: float) -> tuple[Indices, Singles]:
        """Return the states around a click, in all directions, and their costs."""
        span = np.arange(-int(reach) - 1, int(reach) + 2)
        x, y = np.meshgrid(*(np.round(place).astype(int)[:, None] + span))
        aside = np.hypot(x - place[0], y - place[1])
        width, height = self._size
        near = (aside <= reach) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixels = (y[near] + EDGE) * self._width + x[near] + EDGE
        states = np.arange(len(MOVES))[:, None] * self._pixels + pixels
        return states.ravel(), np.tile((aside[near] * ASIDE).astype(np.float32), len(MOVES))

    def _settle(self, begins: Indices, costs: Singles, near: Indices, aside: Singles) -> Indices:
        """
        Find the paths from one click to the next.

        :param begins: (s,) states at the first click.
        :param costs: (s,) of those.
        :param near: (e,) states at the next click.
        :param aside: (e,) costs of ending there.
        :returns: all reached states, sorted.
        """
        cost, before = self._cost, self._before
        cost[begins], before[begins] = costs, -1
        frontier, reached = begins, [begins]
        while len(frontier) and self._budget > 0:
            keys = cost[frontier]
            least = keys.min()
            if least > (cost[near] + aside).min() + CROSSED:
                break
            cheap = keys < least + 1
            # The cheapest comes last: among paths of the same cost, the last one written stays.
            bucket = frontier[cheap][np.argsort(keys[cheap])[::-1]]
            self._budget -= len(bucket)
            direction, pixel = np.divmod(bucket, self._pixels)
            after = pixel[:, None] + self._after[direction]
            new = cost[bucket].astype(float)[:, None] + self._moves[after] + BEND * TURNS * TURNS
            better = new < cost[after]
            row, turn = np.nonzero(better)
            after, new = after[row, turn], new[row, turn].astype(np.float32)
            fresh = np.unique(after[np.isinf(cost[after])])
            np.minimum.at(cost, after, new)
            best = new == cost[after]
            before[after[best]] = direction[row[best]]
            frontier = np.concatenate([frontier[~cheap], fresh])
            reached.append(fresh)
        return np.sort(np.concatenate(reached))


def _move_costs(ridge: Ridge) -> Singles:
    """Return the costs (16, H + 4, W + 4) of a move in each direction to each pixel; inf: to the edge."""
    height, width = ridge.hessian.shape[:2]
    costs = np.full((len(MOVES), height + 2 * EDGE, width + 2 * EDGE), np.inf, dtype=np.float32)
    floor = ridge.floor * 0.5
    for d, (x, y) in enumerate(MOVES):
        across = ridge.hessian @ ACROSS[d]
        # The ridge counts at the end of the move and half-way.
        strength = 0.5 * (across + np.roll(across, (y - y // 2, x - x // 2), axis=(0, 1)))
        off = 1 - np.clip((strength - floor) / (STRONG - floor), 0, 1)
        costs[d, EDGE:-EDGE, EDGE:-EDGE] = LENGTHS[d] * (1 + (OFF - 1) * off * off)
    return costs
