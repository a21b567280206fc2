# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Examinations of models whose answer is known."""

from functools import partial

import numpy as np
import pytest

from dlo_calibration.evaluation.linearisation import Linearisation, STEP, WIDEST
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.examination import examine, extended, SHORTEST
from dlo_calibration.inference.uncertainty import DEVIATIONS, Uncertainty
from dlo_calibration.model.score import PointErrors

LAYOUT = ResidualLayout(((1, 20), (2, 20), (1, 20)))
ROWS = LAYOUT.rows[-1].stop
TRUTH = np.array([0.4, 0.6])
DEFAULT = np.array([0.5, 0.7])
NOISE = 1e-3


def linear(seed=0):
    """Return a (m, 2) Jacobian [m per unit]."""
    return 0.1 * np.random.default_rng(seed).normal(size=(ROWS, 2))


class Model:
    """
    A model with the residuals `errors + jacobian (x - truth)` that records the points it simulates.

    :param fails: whether a (d,) point cannot be simulated.
    """

    def __init__(self, jacobian, errors, fails=lambda point: False):
        self.jacobian, self.errors, self.fails = jacobian, errors, fails
        self.asked = []

    def at(self, point):
        return self.errors + self.jacobian @ (point - TRUTH)

    def __call__(self, points):
        self.asked.extend(points)
        return [None if self.fails(point) else self.at(point) for point in points]


def noisy_model(seed=1, **rest):
    return Model(linear(), np.random.default_rng(seed).normal(0, NOISE, ROWS), **rest)


def optimum(model, rows=slice(None)):
    return TRUTH - np.linalg.lstsq(model.jacobian[rows], model.errors[rows], rcond=None)[0]


def examined(model, point=None, finer=None, starts=(), **rest):
    point = optimum(model) if point is None else point
    fine, *others = (None if start is None else partial(start, point[None, :]) for start in (finer, *starts))
    return examine(point, model.at(point), LAYOUT, model, default=DEFAULT, noise=NOISE, finer=fine,
                   starts=others, **rest)


def test_the_jacobian_of_a_linear_model_is_recovered():
    model = noisy_model()
    examination = examined(model)
    assert examination.jacobian == pytest.approx(model.jacobian, abs=1e-9)
    assert examination.regular
    assert examination.noise == NOISE
    assert examination.evaluations == len(model.asked)
    assert examination.uncertainty.verdicts == ('identifiable', 'identifiable')


def test_steps_are_small_for_certain_parameters_and_wide_for_uncertain_ones():
    model = noisy_model()
    model.jacobian[:, 1] *= 1e-3  # it moves the points by a tenth of the noise over its scale
    point = optimum(model)
    point[1] = 0.6
    examination = examined(model, point)
    away = np.abs(np.array(model.asked) - point).round(9)
    beside = [away[away[:, 1 - k] == 0][:, k] for k in range(2)]
    assert set(beside[0]) <= {0, SHORTEST, STEP}
    assert beside[1].max() == pytest.approx(WIDEST)
    assert examination.jacobian[:, 1] == pytest.approx(model.jacobian[:, 1], abs=1e-9)
    assert examination.uncertainty.verdicts[1] == 'not identifiable'


def test_no_point_leaves_the_unit_cube():
    model = noisy_model()
    for point in ([0.0, 1.0], [0.01, 0.99]):
        examination = examined(model, np.array(point))
        assert examination.jacobian == pytest.approx(model.jacobian, abs=1e-9)
    assert np.min(model.asked) >= 0
    assert np.max(model.asked) <= 1


def test_cross_validation_is_the_error_of_refits_without_each_trial():
    model = noisy_model()
    distances = []
    for rows in LAYOUT.rows:
        others = np.delete(np.arange(ROWS), rows)
        left = model.at(optimum(model, others))[rows]
        distances.append(np.linalg.norm(left.reshape(-1, 3), axis=1))
    examination = examined(model)
    assert examination.cross_validated == pytest.approx(np.concatenate(distances).mean(), rel=0.01)
    assert examination.cross_validated > PointErrors.of(model.at(optimum(model))).mean


def test_one_trial_cannot_be_cross_validated():
    model = noisy_model()
    point = optimum(model)
    examination = examine(point, model.at(point), ResidualLayout(((1, ROWS // 3),)), model,
                    default=DEFAULT, noise=NOISE)
    assert np.isnan(examination.cross_validated)


def test_the_error_of_the_defaults_is_simulated():
    model = noisy_model()
    assert examined(model).default_error == pytest.approx(PointErrors.of(model.at(DEFAULT)).mean)
    model.fails = lambda point: np.array_equal(point, DEFAULT)
    assert np.isnan(examined(model).default_error)


@pytest.mark.parametrize(('away', 'regular'), [(0.0, True), (0.3, False)])
def test_a_point_on_a_slope_is_no_minimum(away, regular):
    model = noisy_model()
    assert examined(model, optimum(model) + [away, 0.0]).regular is regular


def test_if_a_side_fails_the_other_gives_the_derivative():
    model = noisy_model(fails=lambda point: point[0] > 0.41)
    examination = examined(model)
    assert examination.jacobian == pytest.approx(model.jacobian, abs=1e-9)


def test_if_both_sides_fail_the_parameter_counts_as_not_excited():
    model = noisy_model()
    point = optimum(model)
    model.fails = lambda other: other[0] != point[0] and not np.array_equal(other, DEFAULT)
    examination = examined(model)
    assert not examination.jacobian[:, 0].any()
    assert examination.uncertainty.excited.tolist() == [False, True]


def test_a_finer_simulation_widens_what_it_moves():
    model = noisy_model()
    shift = np.array([0.1, 0.0])
    finer = Model(model.jacobian, model.errors - model.jacobian @ shift)
    plain, examination = examined(model), examined(model, finer=finer)
    missing = 2 * shift[0]  # an error of first order: halving the step removes half of it
    std, before = examination.uncertainty.std, plain.uncertainty.std
    assert std == pytest.approx([np.hypot(before[0], missing), before[1]], rel=0.02)
    assert examination.evaluations == plain.evaluations + 1  # no noise: the effect is known
    assert len(finer.asked) == 1


def test_if_the_finer_simulation_fails_nothing_is_identifiable():
    examination = examined(noisy_model(), finer=lambda points: [None])
    assert examination.uncertainty.verdicts == ('not identifiable', 'not identifiable')


def test_other_noise_of_the_initial_chains_is_simulated_and_widens_what_it_moves():
    model = noisy_model()
    moved = model.jacobian @ np.array([0.003, 0.0])
    starts = [Model(model.jacobian, model.errors + sign * moved) for sign in (1, -1)]
    broken = Model(model.jacobian, model.errors, fails=lambda point: True)
    plain, examination = examined(model), examined(model, starts=[*starts, broken])
    assert [len(model.asked) for model in (*starts, broken)] == [1, 1, 1]
    assert examination.evaluations == plain.evaluations + 3
    assert examination.uncertainty.std[0] > 2 * plain.uncertainty.std[0]
    assert examination.uncertainty.std[1] < 1.5 * plain.uncertainty.std[1]


class Elsewhere(Model):
    """Points jump aside, which no parameter does, unless the first parameter is at least `valley`."""

    def __init__(self, jacobian, errors, valley):
        super().__init__(jacobian, errors)
        aside = np.random.default_rng(5).normal(size=ROWS)
        self.valley = valley
        self.jump = 5 * NOISE * (aside - jacobian @ np.linalg.lstsq(jacobian, aside, rcond=None)[0])

    def at(self, point):
        return super().at(point) + self.jump * (point[0] < self.valley)


def test_where_other_noise_leads_trials_elsewhere_the_optimum_is_looked_for():
    model = noisy_model()
    point, plain = optimum(model), examined(model)
    move = 2.5 * plain.uncertainty.std[0]
    draws = [Elsewhere(model.jacobian, model.errors, point[0] + move) for _ in range(2)]
    quiet = [Model(model.jacobian, model.errors) for _ in range(2)]
    linear_only = examined(model, starts=[*draws, *quiet])
    assert linear_only.uncertainty.std[0] < 1.2 * plain.uncertainty.std[0]
    examination = examined(model, starts=[*draws, *quiet], restarted=[*draws, *quiet])
    assert [len(model.asked) > 2 for model in (*draws, *quiet)] == [True, True, False, False]
    assert examination.evaluations == linear_only.evaluations + sum(len(model.asked) - 2 for model in draws)
    expected = move / np.sqrt(2)  # two of four draws
    assert expected <= examination.uncertainty.std[0] <= 1.5 * expected
    assert examination.uncertainty.std[1] < 1.2 * linear_only.uncertainty.std[1]
    assert examination.uncertainty.lower[0] < point[0] - 1.6 * expected


class Fading(Model):
    """The effect of the first parameter is exponential: like a strain, which fades as the stiffness grows."""

    GROWTH = 12.0

    def at(self, point):
        effect = (np.exp(self.GROWTH * (point[0] - TRUTH[0])) - 1) / self.GROWTH
        return self.errors + self.jacobian @ (effect, point[1] - TRUTH[1])


def fading(seed, size):
    model = noisy_model(seed)
    return Fading(model.jacobian * (size, 1.0), model.errors - model.jacobian @ (optimum(model) - TRUTH) * -1)


def strain(value):
    return np.exp(Fading.GROWTH * (value - TRUTH[0]))


def test_an_interval_reaches_to_where_the_effect_has_really_changed():
    certain, uncertain = (examined(fading(1, size), TRUTH).uncertainty for size in (1.0, 0.007))
    # The interval is far narrower than the range over which the effect fades: symmetric.
    assert certain.upper[0] - TRUTH[0] == pytest.approx(TRUTH[0] - certain.lower[0], rel=0.1)
    # The effect is about as large as the noise, and may be nothing.
    assert TRUTH[0] - 1.645 * uncertain.std[0] > 0.1
    assert uncertain.lower[0] == 0.0
    # The interval ends where the effect grows.
    assert uncertain.upper[0] < TRUTH[0] + 1.7 * uncertain.std[0]
    width, certain_width = (each.upper[1] - each.lower[1] for each in (uncertain, certain))
    assert width == pytest.approx(certain_width, rel=0.1)


def test_an_interval_ends_where_the_effect_is_as_large_as_expected():
    """The effect begins beyond a dead zone of a quarter of the first half width."""
    column = np.random.default_rng(1).normal(0, 1, ROWS)
    fit = Linearisation(np.array([0.5]), np.zeros(ROWS), column[:, None])
    half = DEVIATIONS * 0.04
    given = Uncertainty(np.array([0.04]), np.array([0.5 - half]), np.array([0.5 + half]), np.array([True]),
                        np.array([False]))

    def residuals_at(points):
        away = points[:, 0] - 0.5
        return list((np.sign(away) * np.maximum(np.abs(away) - half / 4, 0.0))[:, None] * column)

    found = extended(fit, given, residuals_at, np.array([True]))
    assert found.upper - 0.5 == pytest.approx([1.25 * half])
    assert 0.5 - found.lower == pytest.approx([1.25 * half])


def test_intervals_of_a_linear_model_stay_as_they_are():
    model = noisy_model()
    model.jacobian[:, 0] *= 0.01
    point = np.array([0.5, 0.6])
    examination = examined(model, point).uncertainty
    half = 1.645 * examination.std
    assert 0.02 < half[0] < 0.4
    assert examination.lower == pytest.approx(point - half)
    assert examination.upper == pytest.approx(point + half)


def test_an_end_that_cannot_be_simulated_stays_where_it_is():
    model = fading(1, 0.007)
    usual = examined(model, TRUTH).uncertainty
    model.fails = lambda point: point[0] < TRUTH[0] - usual.std[0]
    examination = examined(model, TRUTH).uncertainty
    assert examination.lower[0] > usual.lower[0]


def test_a_stop_in_the_middle_is_passed_on():
    class Stopped(Exception):
        pass

    def stopping(points):
        raise Stopped

    model = noisy_model()
    with pytest.raises(Stopped):
        examine(TRUTH, model.at(TRUTH), LAYOUT, stopping, default=DEFAULT, noise=NOISE)
