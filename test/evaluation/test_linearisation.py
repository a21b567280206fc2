# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A linear model of residuals: its differences stay in the cube, its step finds the optimum."""

import numpy as np
import pytest

from dlo_calibration.evaluation.linearisation import (
    broyden,
    Differences,
    information,
    Linearisation,
    standard_deviations,
)

JACOBIAN = np.random.default_rng(1).normal(size=(30, 3))
AWAY = np.array([0.1, -0.2, 0.05])
FIT = Linearisation(np.full(3, 0.5), JACOBIAN @ AWAY, JACOBIAN)


def test_points_of_a_difference_stay_in_the_unit_cube():
    sides = Differences.central(np.array([0.01, 0.5, 1.0]), [0, 2], np.array([0.03, 0.1, 0.2]))
    assert sides.points == pytest.approx(
        np.array([[0, 0.5, 1], [0.04, 0.5, 1], [0.01, 0.5, 0.8], [0.01, 0.5, 1]]))


def test_a_difference_uses_the_outermost_values_that_could_be_simulated():
    sides = Differences.central(np.array([0.5]), [0], np.array([0.1]))
    before, here, low, high = np.array([[7.0]]), np.array([1.0]), np.array([0.0]), np.array([4.0])
    assert sides.jacobian(before, [low, high], here) == pytest.approx(np.array([[20]]))
    assert sides.jacobian(before, [low, high]) == pytest.approx(np.array([[20]]))
    assert sides.jacobian(before, [None, high], here) == pytest.approx(np.array([[30]]))


def test_a_column_without_two_values_is_unchanged():
    sides = Differences.central(np.array([0.5, 1.0]), [0], np.array([0.1, 0.1]))
    before = np.array([[7.0, 8.0]])
    assert np.array_equal(sides.jacobian(before, [None, np.zeros(1)]), before)
    nowhere = Differences.one_sided(np.array([0.5, 1.0]), [1], np.zeros(2))
    assert np.array_equal(nowhere.jacobian(before, [np.ones(1)], np.zeros(1)), before)


def test_an_updated_jacobian_predicts_the_step_and_changes_nothing_across_it():
    step, across = np.array([0.2, 0.1, 0.0]), np.array([-0.1, 0.2, 0.5])
    surprise = np.linspace(-1, 1, 30)
    updated = broyden(JACOBIAN, step, surprise)
    assert updated @ step == pytest.approx(JACOBIAN @ step + surprise)
    assert updated @ across == pytest.approx(JACOBIAN @ across)


def test_the_step_leads_to_the_lowest_sum_of_squares():
    assert FIT.step() == pytest.approx(-AWAY)
    assert FIT.step(FIT.ridge) == pytest.approx(-AWAY, abs=1e-6)
    assert FIT.predicted(-AWAY) == pytest.approx(np.zeros(30), abs=1e-12)
    assert FIT.columns(np.array([0, 2])).weighted(np.ones(30)).step().shape == (2,)


def test_a_parameter_without_effect_keeps_its_value():
    flat = JACOBIAN * [1.0, 0.0, 1.0]
    fit = Linearisation(FIT.point, flat @ AWAY, flat)
    assert fit.step(fit.ridge) == pytest.approx([-0.1, 0, -0.05], abs=1e-6)


def test_own_weights_give_the_change_of_a_single_parameter():
    assert [float(FIT.own_weights(k) @ (JACOBIAN @ AWAY)) for k in range(3)] == pytest.approx(AWAY)


def test_standard_deviations_are_those_of_fits_to_noise():
    small, large = (standard_deviations(information(JACOBIAN, scale)) for scale in (1e-3, 2e-3))
    assert large == pytest.approx(2 * small)
    noise = np.random.default_rng(2).normal(0, 1e-3, (4000, 30))
    fits = np.linalg.lstsq(JACOBIAN, noise.T, rcond=None)[0]
    assert fits.std(axis=1) == pytest.approx(small, rel=0.05)
