# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bounded least squares against SciPy's, and against known solutions."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from dlo_calibration.search.descent import bounded_least_squares


@pytest.mark.parametrize('seed', range(40))
def test_the_solution_costs_no_more_than_that_of_scipy(seed):
    generator = np.random.default_rng(seed)
    unknowns = int(generator.integers(1, 13))
    matrix = generator.standard_normal((unknowns + int(generator.integers(0, 6)), unknowns))
    matrix *= 10**generator.uniform(-3, 1, unknowns)
    if seed % 3 == 0 and unknowns > 1:  # two unknowns with the same column
        matrix[:, 1] = matrix[:, 0]
    right = 10**generator.uniform(-3, 2) * generator.standard_normal(len(matrix))
    least, most = -10**generator.uniform(-2, 1, unknowns), 10**generator.uniform(-2, 1, unknowns)
    ours = bounded_least_squares(matrix, right, least, most)
    theirs = lsq_linear(matrix, right, (least, most), method='bvls').x
    assert np.all((ours >= least) & (ours <= most))
    cost, other = (np.linalg.norm(matrix @ x - right) for x in (ours, theirs))
    assert cost <= other * (1 + 1e-9)
    if np.linalg.matrix_rank(matrix) == unknowns:
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9)


def test_bounds_hold_exactly_and_free_unknowns_compensate():
    matrix, right = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([3.0, 0.5])
    solution = bounded_least_squares(matrix, right, np.array([-1.0, -1.0]), np.array([1.0, 5.0]))
    assert solution[0] == 1.0 and solution[1] == pytest.approx(1.25)


def test_without_unknowns_the_solution_is_empty():
    nothing = np.zeros(0)
    assert bounded_least_squares(np.zeros((3, 0)), np.ones(3), nothing, nothing).shape == (0,)
