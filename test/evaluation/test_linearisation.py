# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A linear model of residuals: its differences stay in the cube, its step finds the optimum."""

import numpy as np
import pytest

from dlo_calibration.evaluation.linearisation import (
    both_sides,
    information,
    Linearisation,
    slope,
    standard_deviations,
)

JACOBIAN = np.random.default_rng(1).normal(size=(30, 3))
AWAY = np.array([0.1, -0.2, 0.05])
FIT = Linearisation(np.full(3, 0.5), JACOBIAN @ AWAY, JACOBIAN)


def test_points_of_a_difference_stay_in_the_unit_cube():
    beside = both_sides(np.array([0.01, 0.5, 1.0]), [0, 2], np.array([0.03, 0.1, 0.2]))
    assert beside == pytest.approx(np.array([[0, 0.5, 1], [0.04, 0.5, 1], [0.01, 0.5, 0.8], [0.01, 0.5, 1]]))


def test_a_difference_uses_the_outermost_values_that_could_be_simulated():
    here, low, high = np.array([1.0]), np.array([0.0]), np.array([4.0])
    assert slope((0.5, 0.4, 0.6), (here, low, high)) == pytest.approx([20])
    assert slope((0.5, 0.4, 0.6), (here, None, high)) == pytest.approx([30])
    assert slope((0.5, 0.5, 0.6), (here, here, None)) is None


def test_the_step_leads_to_the_lowest_sum_of_squares():
    assert FIT.step() == pytest.approx(-AWAY)
    assert FIT.step(FIT.ridge) == pytest.approx(-AWAY, abs=1e-6)
    assert FIT.predicted(-AWAY) == pytest.approx(np.zeros(30), abs=1e-12)
    assert FIT.columns(np.array([0, 2])).weighted(np.ones(30)).step().shape == (2,)


def test_a_parameter_without_effect_stays():
    flat = JACOBIAN * [1.0, 0.0, 1.0]
    fit = Linearisation(FIT.point, flat @ AWAY, flat)
    assert fit.step(fit.ridge) == pytest.approx([-0.1, 0, -0.05], abs=1e-6)


def test_a_change_tells_of_one_parameter_how_far_it_moved():
    assert [float(FIT.own_weights(k) @ (JACOBIAN @ AWAY)) for k in range(3)] == pytest.approx(AWAY)


def test_more_error_leaves_larger_standard_deviations():
    one, two = (standard_deviations(information(JACOBIAN, scale)) for scale in (1e-3, 2e-3))
    assert two == pytest.approx(2 * one)
    errors = np.random.default_rng(2).normal(0, 1e-3, (4000, 30))
    found = np.linalg.lstsq(JACOBIAN, errors.T, rcond=None)[0]
    assert found.std(axis=1) == pytest.approx(one, rel=0.05)
