# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The robust loss: outliers count less, and the standard deviation of the rest is found."""

import numpy as np
import pytest

from dlo_calibration.evaluation.robust import Huber


def test_hubers_loss_is_quadratic_then_linear():
    loss = Huber(2.0)
    assert loss.cost(np.array([1.0])) == 0.5
    assert loss.cost(np.array([5.0])) == pytest.approx(2 * (5 - 1))
    assert loss.cost(None) == np.inf
    assert loss.roots(np.array([1.0, -8.0])) == pytest.approx([1.0, 0.5])
    normal = np.random.default_rng(1).normal(scale=0.002, size=4000)
    assert Huber.of(normal).threshold == pytest.approx(1.345 * 0.002, rel=0.05)
    assert Huber.of(np.zeros(4)).threshold > 0


def test_the_standard_deviation_is_that_of_the_residuals_without_outliers():
    normal = np.random.default_rng(2).normal(scale=0.002, size=4000)
    assert Huber.of(normal).deviation(normal, 4) == pytest.approx(0.002, rel=0.03)
    spoilt = normal.copy()
    spoilt[::100] += 0.5
    assert Huber.of(normal).deviation(spoilt, 4) == pytest.approx(0.002, rel=0.05)
    assert Huber.of(np.zeros(4)).deviation(np.zeros(4), 4) > 0
