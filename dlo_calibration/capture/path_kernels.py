# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels of the way along a ridge; `path` declares them, and says what their arguments are."""

from __future__ import annotations

import math

import numpy as np

from dlo_calibration.capture import path
from dlo_calibration.simulation.compilation import entry, part
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

#: moves (x, y) to the pixels around and a knight's move away, in the order of their angles
MOVES = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
                  (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)])
LENGTHS = np.sqrt((MOVES * MOVES).sum(axis=1))  # px
_X, _Y = -MOVES[:, 1] / LENGTHS, MOVES[:, 0] / LENGTHS  # unit vectors across
ACROSS = np.column_stack([_X * _X, 2 * _X * _Y, _Y * _Y])  # weights of the three second derivatives
OFF = 25.0  # cost of a pixel of way off the ridge, where one on it costs 1
STRONG = 0.55  # share of the ridge measure at the clicks that costs the least
BEND = 0.6  # cost of a change of direction by a sixteenth of a turn; that by two is four times as much
ASIDE = 1.0  # cost of each pixel between a click and the way
CROSSED = 40.0  # cost by which another arrival at a click may be worse than the best


@entry(path.add_scores)
def add_scores(scores: Matrix32, drift: float, totals: Matrix, came: ByteRows) -> None:
    """Find the largest sum of scores to each column of each row."""
    rows, columns = scores.shape
    total, next_total = totals[0], totals[1]
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


@entry(path.follow_back)
def follow_back(came: ByteRows, index: Indices) -> None:
    """Write the columns that lead to the last one, which is given."""
    for row in range(len(index) - 1, 0, -1):
        index[row - 1] = index[row] + came[row, index[row]]


@entry(path.look_beside)
def look_beside(place: Vector, reach: float, height: int, width: int, states: Indices,
                costs: Vector32) -> int:
    """Find the states around a click, in all directions, and what each costs."""
    span = int(reach) + 1
    count = 0
    u, v = int(round(place[0])), int(round(place[1]))
    for y in range(max(0, v - span), min(height, v + span + 1)):
        for x in range(max(0, u - span), min(width, u + span + 1)):
            aside = math.hypot(x - place[0], y - place[1])
            if aside <= reach:
                for d in range(16):
                    states[count], costs[count] = (y * width + x) * 16 + d, aside * ASIDE
                    count += 1
    return count


@part
def _push(heap: Indices, keys: Vector32, count: int, state: int, key: float) -> None:
    """Add a state to `count` others."""
    at = count
    while at:
        above = (at - 1) >> 1
        if keys[above] <= key:
            break
        heap[at], keys[at] = heap[above], keys[above]
        at = above
    heap[at], keys[at] = state, key


@part
def _pop(heap: Indices, keys: Vector32, count: int) -> None:
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


@entry(path.find_ways)
def find_ways(hessian: Cube32, floor: float, goal: Vector, reach: float, left: Indices, begins: Indices,
              begin_costs: Vector32, cost: Vector32, before: Bytes, heap: Indices, keys: Vector32,
              touched: Indices, ends: Indices, end_costs: Vector32) -> int:
    """Find the ways from one click to the next."""
    height, width = hessian.shape[0], hessian.shape[1]
    held, reached = 0, 0
    for k in range(len(begins)):
        begin = begins[k]
        if begin_costs[k] < cost[begin]:
            if cost[begin] == np.inf:
                touched[reached] = begin
                reached += 1
            cost[begin], before[begin] = begin_costs[k], -1
            _push(heap, keys, held, begin, begin_costs[k])
            held += 1
    arrived, nearest = 0, np.inf
    while held and left[0] > 0:
        left[0] -= 1
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
        if aside <= reach and arrived < len(ends):
            ends[arrived], end_costs[arrived] = state, key + aside * ASIDE
            arrived += 1
            nearest = min(nearest, key + aside * ASIDE)
        for turn in range(-2, 3):
            d = (direction + turn) % 16
            i, j = x + MOVES[d, 0], y + MOVES[d, 1]
            if not (0 <= i < width and 0 <= j < height):
                continue
            strength = 0.0
            half_y, half_x = (y + j) // 2, (x + i) // 2
            for k in range(3):
                strength += 0.5 * ACROSS[d, k] * (hessian[j, i, k] + hessian[half_y, half_x, k])
            off = 1 - min(1.0, max(0.0, (strength - floor * 0.5) / (STRONG - floor * 0.5)))
            new = key + LENGTHS[d] * (1 + (OFF - 1) * off * off) + BEND * turn * turn
            after = (j * width + i) * 16 + d
            if new < cost[after]:
                if cost[after] == np.inf:
                    touched[reached] = after
                    reached += 1
                cost[after], before[after] = new, direction
                _push(heap, keys, held, after, new)
                held += 1
    for k in range(reached):
        cost[touched[k]] = np.inf
    kept = 0
    for k in range(arrived):
        if end_costs[k] <= nearest + CROSSED:
            ends[kept], end_costs[kept] = ends[k], end_costs[k]
            kept += 1
    return kept


@entry(path.list_ways)
def list_ways(ends: Indices, begins: Indices, before: Bytes, width: int, pixels: Indices, bounds: Indices,
              links: Indices) -> int:
    """List the pixels of the ways back, one after the other, as far as there is room."""
    count = 0
    for k in range(len(ends)):
        state, bounds[k] = ends[k], count
        while before[state] >= 0:
            if count < len(pixels):
                pixels[count] = state // 16
            count += 1
            d = state % 16
            pixel = state // 16 - MOVES[d, 1] * width - MOVES[d, 0]
            state = pixel * 16 + before[state]
        for begin in range(len(begins)):
            if begins[begin] == state:
                links[k] = begin
                break
    bounds[len(ends)] = count
    return count
