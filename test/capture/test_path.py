# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The way along a ridge: where it goes, and what it needs."""

from itertools import product
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

from dlo_calibration.capture import path
from dlo_calibration.capture.ridge import Ridge

CLICKS = np.array([(6.0, 20.0), (54.0, 21.0), (31.0, 36.0)])


@pytest.fixture
def ridge():
    """Return a horizontal line and a vertical one that cross each other."""
    hessian = np.zeros((40, 60, 3), dtype=np.float32)
    hessian[20, 5:55, 2] = hessian[3:37, 30, 0] = 1.0
    return Ridge(1.0, hessian, 0.0, 3.0)


def test_the_way_goes_straight_on_at_a_crossing(ridge):
    found = path.way(ridge, CLICKS[:2], 3.0)
    assert np.abs(found[:, 1] - 20).max() == 0
    assert (np.diff(found[:, 0]) > 0).all() and np.ptp(found[:, 0]) > 40


def test_ways_for_which_there_is_no_room_at_first_are_the_same(ridge, monkeypatch):
    before = path.way(ridge, CLICKS, 3.0)
    monkeypatch.setattr(path, 'ROOM', 3)
    np.testing.assert_array_equal(path.way(ridge, CLICKS, 3.0), before)


def test_beyond_the_limit_there_is_no_way(ridge, monkeypatch):
    monkeypatch.setattr(path, 'MOST', 200)
    assert path.way(ridge, CLICKS, 3.0).shape == (0, 2)


def test_the_columns_have_the_largest_sum_of_all():
    scores = np.random.default_rng(2).normal(size=(6, 5)).astype(np.float32)
    found, mean = path.steady(scores, 0.15)
    sums = {columns: scores[range(6), columns].sum(dtype=float) - 0.15 * (np.diff(columns) ** 2).sum()
            for columns in product(range(5), repeat=6) if np.abs(np.diff(columns)).max() <= 2}
    best = max(sums, key=sums.get)
    assert tuple(found) == best
    assert mean == pytest.approx(sums[best] / 6)


def test_a_process_that_traces_needs_no_numba():
    program = """
import sys
import numpy as np
from dlo_calibration.capture.path import steady, way
from dlo_calibration.capture.ridge import Ridge
ridge = Ridge(1.0, np.ones((20, 30, 3), dtype=np.float32), 0.0, 3.0)
assert len(way(ridge, np.array([(2.0, 3.0), (27.0, 16.0)]), 3.0)) > 10
steady(np.zeros((3, 4), dtype=np.float32), 0.1)
assert 'numba' not in sys.modules
"""
    path.steady(np.zeros((1, 1), dtype=np.float32), 0.1)  # else it might have to be compiled
    subprocess.run([sys.executable, '-c', program], cwd=Path(__file__).parents[2], check=True)
