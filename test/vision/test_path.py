# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The path along a ridge: where it goes, and that no other costs less."""

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from dlo_calibration.vision import path
from dlo_calibration.vision.ridge import Ridge

CLICKS = np.array([(6.0, 20.0), (54.0, 21.0), (31.0, 36.0)])


@pytest.fixture
def ridge():
    """Return a horizontal line and a vertical one that cross each other."""
    hessian = np.zeros((40, 60, 3), dtype=np.float32)
    hessian[20, 5:55, 2] = hessian[3:37, 30, 0] = 1.0
    return Ridge(1.0, hessian, 0.0, 3.0)


def test_the_path_goes_straight_on_at_a_crossing(ridge):
    pixels = path.ridge_path(ridge, CLICKS[:2], 3.0)
    assert np.abs(pixels[:, 1] - 20).max() == 0
    assert (np.diff(pixels[:, 0]) > 0).all() and np.ptp(pixels[:, 0]) > 40


def test_the_path_passes_all_clicks_in_their_order(ridge):
    distances = np.linalg.norm(path.ridge_path(ridge, CLICKS, 3.0)[:, None] - CLICKS, axis=2)
    assert (distances.min(axis=0) <= (4, 3, 3)).all()  # it begins one pixel after the first click's pixel
    assert (np.diff(distances.argmin(axis=0)) > 0).all()


def move_cost(ridge, before, after):
    """Return the cost of a move between two pixels (x, y), without that of its direction."""
    x, y = np.subtract(after, before)
    halfway = (before[0] + after[0]) // 2, (before[1] + after[1]) // 2
    xx, xy, yy = (ridge.hessian[after[::-1]].astype(float) + ridge.hessian[halfway[::-1]]) / 2
    strength = (xx * y * y - 2 * xy * x * y + yy * x * x) / (x * x + y * y)
    off = 1 - np.clip((strength - ridge.floor / 2) / (path.STRONG - ridge.floor / 2), 0, 1)
    return np.hypot(x, y) * (1 + (path.OFF - 1) * off ** 2)


def bend_cost(before, after):
    """Return the cost of a bend between two moves, given their directions; inf: it is too sharp."""
    turn = abs((after - before + 8) % 16 - 8)
    return path.BEND * turn ** 2 if turn <= 2 else np.inf


@pytest.mark.parametrize('seed', range(4))
def test_no_other_path_costs_less(seed):
    random = np.random.default_rng(seed)
    width, height, reach = 14, 11, 1.5
    ridge = Ridge(1.0, random.normal(scale=0.5, size=(height, width, 3)).astype(np.float32), 0.1, 3.0)
    first, last = np.array([1.2, random.uniform(0, 10)]), np.array([12.1, random.uniform(0, 10)])
    moves = [tuple(move) for move in path.MOVES.tolist()]
    links = []  # of states of pixel and direction
    for x, y, d in product(range(width), range(height), range(16)):
        for after in ((d + turn) % 16 for turn in range(-2, 3)):
            i, j = x + moves[after][0], y + moves[after][1]
            if 0 <= i < width and 0 <= j < height:
                cost = move_cost(ridge, (x, y), (i, j)) + bend_cost(d, after)
                links.append(((y * width + x) * 16 + d, (j * width + i) * 16 + after, cost))
    y, x = (np.repeat(axis.ravel(), 16) for axis in np.mgrid[:height, :width])
    aside = [np.hypot(x - click[0], y - click[1]) for click in (first, last)]
    begins, ends = (np.where(each <= reach, each * path.ASIDE, np.inf) for each in aside)
    source = 16 * width * height  # which leads to all states near the first click
    links += [(source, k, begins[k]) for k in np.nonzero(np.isfinite(begins))[0]]
    rows, columns, costs = zip(*links, strict=True)
    graph = coo_matrix((costs, (rows, columns)), shape=(source + 1, source + 1)).tocsr()
    least = (dijkstra(graph, indices=source)[:-1] + ends).min()

    pixels = path.ridge_path(ridge, np.array([first, last]), reach).astype(int)
    pixels = [tuple(pixel) for pixel in pixels.tolist()]
    totals = []
    for begin in zip(*(axis[np.isfinite(begins)].tolist() for axis in (x, y)), strict=True):
        line = [begin, *pixels]
        if all(tuple(np.subtract(b, a).tolist()) in moves for a, b in pairwise(line)):
            directions = [moves.index(tuple(np.subtract(b, a).tolist())) for a, b in pairwise(line)]
            totals.append(path.ASIDE * np.hypot(*np.subtract(begin, first))
                          + path.ASIDE * np.hypot(*np.subtract(pixels[-1], last))
                          + sum(move_cost(ridge, a, b) for a, b in pairwise(line))
                          + sum(bend_cost(a, b) for a, b in pairwise(directions)))
    assert min(totals) == pytest.approx(least, rel=1e-6)


def test_beyond_the_limit_of_states_there_is_no_path(ridge, monkeypatch):
    monkeypatch.setattr(path, 'MAXIMUM_STATES', 200)
    assert path.ridge_path(ridge, CLICKS, 3.0).shape == (0, 2)
