# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The uncertainty of calibrated parameters."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.inference.uncertainty import (
    at_minimum,
    bootstrap_counts,
    correlation_length,
    jackknife,
    optimum_shift,
    predictive_std,
    prior_information,
    resampled,
    spread_of_best,
    verdict,
)

TRUTH = np.array([0.4, 0.7])


@dataclass(frozen=True)
class Tried:
    point: np.ndarray
    score: float


def tried(count, seed=0, weights=(1.0, 1.0, 0.0)):
    """Return random evaluations whose score is the weighted distance from the truth."""
    points = np.random.default_rng(seed).random((count, len(weights)))
    away = points - [*TRUTH, *[0.5] * (len(weights) - 2)]
    return [Tried(point, float(np.linalg.norm(np.multiply(weights, offset))))
            for point, offset in zip(points, away, strict=True)]


def spread(evaluations):
    best = min(evaluations, key=lambda evaluation: evaluation.score).point
    return best, spread_of_best(evaluations, best)


@pytest.mark.parametrize('seed', range(10))
def test_a_parameter_with_effect_is_identifiable_and_one_without_is_not(seed):
    _, uncertainty = spread(tried(150, seed))
    assert uncertainty.verdicts[2] == 'not identifiable'
    assert 'not identifiable' not in uncertainty.verdicts[:2]
    assert (uncertainty.std[:2] < 0.15).all()
    assert uncertainty.std[2] > uncertainty.std[:2].max()


@pytest.mark.parametrize(('lower', 'upper', 'expected'), [
    (0.4, 0.6, 'identifiable'), (0.4, 0.61, 'weak'), (0.4, 0.8, 'weak'), (0.4, 0.81, 'not identifiable'),
    (0.9, 1.0, 'weak'), (0.0, 0.1, 'weak'), (0.5, 1.0, 'not identifiable')])
def test_the_verdict_is_the_width_of_the_interval_and_a_bound_is_weak_at_best(lower, upper, expected):
    assert verdict(lower, upper) == expected


@pytest.mark.parametrize('seed', range(10))
def test_the_interval_contains_the_best_and_all_good_evaluations(seed):
    best, uncertainty = spread(tried(150, seed))
    assert (uncertainty.lower <= best).all()
    assert (best <= uncertainty.upper).all()
    assert (uncertainty.lower[:2] <= TRUTH + 0.05).all()
    assert (uncertainty.upper[:2] >= TRUTH - 0.05).all()
    assert (uncertainty.lower >= 0).all()
    assert (uncertainty.upper <= 1).all()


@pytest.mark.parametrize('count', [1, 3, 15])
def test_from_few_evaluations_nothing_is_identifiable(count):
    _, uncertainty = spread(tried(count))
    assert uncertainty.verdicts == ('not identifiable',) * 3
    assert uncertainty.lower.tolist() == [0, 0, 0]
    assert uncertainty.upper.tolist() == [1, 1, 1]
    assert uncertainty.std == pytest.approx(np.full(3, 12**-0.5))  # as of any value between 0 and 1


def test_failed_evaluations_count_as_bad_ones():
    good = tried(150)
    best, _ = spread(good)
    failed, bad = ([Tried(np.full(3, 0.99), score)] * 100 for score in (float('inf'), 1e6))
    with_failed, with_bad = (spread_of_best(others + good, best) for others in (failed, bad))
    for name in ('std', 'lower', 'upper'):
        assert getattr(with_failed, name).tolist() == getattr(with_bad, name).tolist()
    assert set(spread_of_best(failed + good[:5], best).verdicts) == {'not identifiable'}


SHAPES = ((1, 40), (2, 20), (1, 40), (1, 40))
ROWS = 3 * sum(goals * points for goals, points in SHAPES)
LAYOUT = ResidualLayout(SHAPES)
POINT = np.array([0.4, 0.6, 0.5])


def linear_model(seed=0, columns=3):
    """Return a Jacobian whose columns are smooth along the DLO, as those of real parameters are."""
    generator = np.random.default_rng(seed)
    blocks = []
    for goals, points in SHAPES:
        along = np.linspace(0, 1, points)[:, None, None]
        waves = [np.cos(np.pi * k * along) * generator.normal(size=(3, columns)) for k in range(3)]
        blocks.append(np.tile(sum(waves), (goals, 1, 1)).reshape(-1, columns))
    return 0.03 * np.concatenate(blocks)


def fitted(jacobian, errors):
    """Return (d,) how far the optimum lies from the truth, and the residuals there, for errors (m,) [m]."""
    moved = -np.linalg.lstsq(jacobian, errors, rcond=None)[0]
    return moved, errors + jacobian @ moved


def coverage(errors_of, draws=300, **options):
    """Return the share of draws of the errors whose intervals contain the truth, for each parameter."""
    jacobian = linear_model()
    inside = []
    for draw in range(draws):
        moved, residuals = fitted(jacobian, errors_of(np.random.default_rng(draw)))
        uncertainty = at_minimum(Linearisation(POINT + moved, residuals, jacobian), LAYOUT, **options)
        inside.append((uncertainty.lower <= POINT) & (POINT <= uncertainty.upper))
    return np.mean(inside, axis=0)


def test_nine_of_ten_intervals_contain_the_truth_under_white_noise():
    share = coverage(lambda generator: generator.normal(0, 1e-3, ROWS), noise=1e-3)
    assert (share > 0.85).all()
    assert (share < 0.95).all()


def test_errors_that_are_alike_at_neighbours_widen_the_intervals():
    def smooth(generator):
        blocks = []
        for goals, points in SHAPES:
            for _ in range(goals):
                rough = generator.normal(0, 1e-3, (points + 4, 3))
                blocks.append(sum(rough[k:k + points] for k in range(5)).ravel() / np.sqrt(5))
        return np.concatenate(blocks)

    share = coverage(smooth, noise=1e-3)
    assert (share > 0.8).all()
    assert (share < 0.97).all()


def test_where_the_model_is_wrong_the_disagreement_of_the_trials_counts():
    jacobian = linear_model()
    errors = np.random.default_rng(1).normal(0, 1e-3, ROWS)
    # Each trial sees another optimum.
    for rows, away in zip(LAYOUT.rows, (0.1, -0.1, 0.1, -0.1), strict=True):
        errors[rows] -= jacobian[rows, 0] * away
    moved, residuals = fitted(jacobian, errors)
    noise_alone = at_minimum(Linearisation(POINT + moved, residuals, jacobian), LAYOUT, noise=1.0)
    uncertainty = at_minimum(Linearisation(POINT + moved, residuals, jacobian), LAYOUT, noise=1e-3)
    assert uncertainty.std[0] > 1.4 * noise_alone.std[0]
    assert uncertainty.std[0] > 0.03


REPEATS = ResidualLayout(((1, 40),) * 4)


def repeated(residuals, trials=4):
    """Return the model of one trial that is repeated; its residuals are (trials, 120) [m]."""
    jacobian = linear_model()[LAYOUT.rows[0]]
    return Linearisation(POINT, residuals.ravel(), np.tile(jacobian, (trials, 1)))


def test_an_exact_repeat_of_a_trial_counts_once():
    once = np.random.default_rng(11).normal(0, 1e-3, (1, 120))
    moved = np.random.default_rng(12).normal(0, 1e-3, (3, 1, 120))
    single, fourfold = (
        at_minimum(repeated(np.tile(once, (count, 1)), count), ResidualLayout(((1, 40),) * count), noise=1e-3,
                   starts=[np.tile(once + noise, (count, 1)).ravel() for noise in moved]) for count in (1, 4))
    # The residuals of one trial count as fewer by the three parameters.
    assert fourfold.std == pytest.approx(single.std, rel=0.03)
    assert fourfold.std[0] > 0.001


def test_a_repeat_averages_its_noise_and_not_the_error_of_the_model():
    generator = np.random.default_rng(13)
    noise, error = generator.normal(0, 1e-3, (4, 120)), generator.normal(0, 3e-3, (1, 120))
    single, four = (at_minimum(repeated(noise[:count], count), ResidualLayout(((1, 40),) * count), noise=1e-3)
                 for count in (1, 4))
    assert four.std / single.std == pytest.approx(np.full(3, 0.5), rel=0.15)
    wrong, again = (at_minimum(repeated(noise[:count] + error, count), ResidualLayout(((1, 40),) * count),
                               noise=1e-3) for count in (1, 4))
    assert (again.std / wrong.std > 0.85).all()
    assert again.verdicts == wrong.verdicts


def test_repeats_of_which_not_all_points_were_seen_share_their_error():
    generator = np.random.default_rng(14)
    residuals = generator.normal(0, 1e-3, (2, 120)) + generator.normal(0, 3e-3, (1, 120))
    fit, whole = repeated(residuals, 2), ResidualLayout(((1, 40),) * 2)
    layout = ResidualLayout(((1, 40),) * 2, ((3,), (8, 9)))
    rows = np.delete(np.arange(240).reshape(80, 3), [3, 48, 49], axis=0).ravel()
    partly = at_minimum(fit.rows(rows), layout, noise=1e-3)
    assert partly.std == pytest.approx(at_minimum(fit, whole, noise=1e-3).std, rel=0.1)


def test_nine_of_ten_intervals_contain_the_truth_where_repeats_share_the_error_of_the_model():
    jacobian, inside = repeated(np.zeros((4, 120))).jacobian, []
    for seed in range(200):
        generator = np.random.default_rng(seed)
        errors = (generator.normal(0, 2e-3, 120) + generator.normal(0, 1e-3, (4, 120))).ravel()
        moved, residuals = fitted(jacobian, errors)
        uncertainty = at_minimum(Linearisation(POINT + moved, residuals, jacobian), REPEATS, noise=1e-3)
        inside.append((uncertainty.lower <= POINT) & (POINT <= uncertainty.upper))
    assert (np.mean(inside, axis=0) > 0.85).all()
    assert (np.mean(inside, axis=0) < 0.96).all()


def test_leaving_a_trial_out_moves_the_optimum_as_a_new_fit_would():
    jacobian = linear_model()
    errors = np.random.default_rng(2).normal(0, 1e-3, ROWS)
    moved, residuals = fitted(jacobian, errors)
    at = LAYOUT.rows[0].stop
    again, _ = fitted(jacobian[at:], errors[at:])
    fit = Linearisation(POINT, residuals, jacobian)
    assert jackknife(fit, LAYOUT.rows, fit.ridge)[0] == pytest.approx(again - moved, abs=1e-6)


def test_trials_drawn_again_scatter_as_their_mean_does():
    # One parameter that each of 12 trials measures for itself: its mean has the standard error s / sqrt(T).
    count = 12
    values = np.random.default_rng(6).normal(0, 0.02, count)
    values -= values.mean()
    jacobian = np.ones((30 * count, 1))
    fit = Linearisation(np.zeros(1), np.repeat(-values, 30), jacobian)
    moved, by_chance = resampled(fit, ResidualLayout(((2, 5),) * count).rows, np.zeros((1, 1)),
                                 bootstrap_counts(count, draws=4000))
    assert moved.shape == (4000, 1)
    assert moved.std() == pytest.approx(values.std() / np.sqrt(count), rel=0.05)
    assert moved.mean() == pytest.approx(0, abs=3e-4)
    # With residuals of standard deviation 1, that mean has the variance (1 - 1 / T) / (30 T) by chance.
    assert by_chance.mean() == pytest.approx((count - 1) / count / (30 * count), rel=0.05)


def test_trials_that_agree_move_the_optimum_as_far_as_chance_does_also_where_one_of_them_tells_most():
    jacobian = linear_model()
    for rows in LAYOUT.rows[1:]:
        jacobian[rows, 0] *= 0.2
    counts = np.concatenate([1 - np.eye(len(SHAPES)), bootstrap_counts(len(SHAPES), draws=20)])
    squares, prior = [], 1e-9 * np.eye(jacobian.shape[1])
    for draw in range(1000):
        residuals = fitted(jacobian, np.random.default_rng(draw).normal(0, 1, ROWS))[1]
        moved, by_chance = resampled(Linearisation(POINT, residuals, jacobian), LAYOUT.rows, prior, counts)
        squares.append(moved**2)
    determined = by_chance[:, 0] < 1e6  # not where a draw has the same trial four times
    assert np.mean(squares, axis=0)[determined] == pytest.approx(by_chance[determined], rel=0.3, abs=1e-6)
    assert by_chance[0, 0] > 5 * by_chance[1:4, 0].max()


def test_a_parameter_without_effect_is_not_excited_and_can_be_anything():
    jacobian = linear_model()
    jacobian[:, 1] = 0.0
    residuals = np.random.default_rng(3).normal(0, 1e-3, ROWS)
    uncertainty = at_minimum(Linearisation(POINT, residuals, jacobian), LAYOUT, noise=1e-3)
    assert uncertainty.excited.tolist() == [True, False, True]
    assert uncertainty.verdicts == ('identifiable', 'not identifiable', 'identifiable')
    assert (uncertainty.lower[1], uncertainty.upper[1]) == (0, 1)


def test_two_parameters_that_only_show_together_are_named_as_a_combination():
    jacobian = linear_model()
    jacobian[:, 1] = jacobian[:, 0] * (1 + 1e-3 * np.linspace(-1, 1, ROWS))
    residuals = np.random.default_rng(4).normal(0, 1e-3, ROWS)
    uncertainty = at_minimum(Linearisation(POINT, residuals, jacobian), LAYOUT, noise=1e-3)
    assert uncertainty.verdicts == ('not identifiable', 'not identifiable', 'identifiable')
    assert uncertainty.correlations[0, 1] < -0.95
    combination, = uncertainty.undetermined
    assert np.abs(combination) == pytest.approx([2**-0.5, 2**-0.5, 0], abs=0.05)
    assert combination[0] * combination[1] < 0


def test_two_parameters_of_which_nothing_is_known_are_no_combination():
    covariance = np.array([[0.08, 0.04, 0.0], [0.04, 0.08, 0.0], [0.0, 0.0, 1e-6]])
    fit = Linearisation(POINT, np.random.default_rng(4).normal(0, 1e-3, ROWS), linear_model())
    uncertainty = at_minimum(fit, LAYOUT, noise=1e-3)
    assert replace(uncertainty, covariance=covariance).undetermined == ()


def test_a_value_at_the_end_of_the_scale_is_flagged_and_its_interval_ends_there():
    residuals = np.random.default_rng(5).normal(0, 1e-3, ROWS)
    fit = Linearisation(np.array([0.0, 0.6, 1.0]), residuals, linear_model())
    uncertainty = at_minimum(fit, LAYOUT, noise=1e-3)
    assert uncertainty.at_bound.tolist() == [True, False, True]
    assert uncertainty.lower[0] == 0
    assert uncertainty.upper[2] == 1


def test_an_interval_contains_the_optimum_of_a_finer_simulation():
    jacobian = linear_model()
    moved, residuals = fitted(jacobian, np.random.default_rng(6).normal(0, 1e-3, ROWS))
    finer_optimum = np.array([0.1, 0.0, -0.05])
    finer = residuals - jacobian @ finer_optimum
    shift = optimum_shift(Linearisation(POINT, residuals, jacobian), finer)
    assert shift == pytest.approx(finer_optimum, abs=1e-4)
    uncertainty = at_minimum(Linearisation(POINT, residuals, jacobian), LAYOUT, noise=1e-3, shift=shift)
    assert (uncertainty.lower <= POINT + finer_optimum).all()
    assert (POINT + finer_optimum <= uncertainty.upper).all()
    assert uncertainty.std[1] < 0.02


def test_a_finer_simulation_that_leads_elsewhere_by_chance_moves_the_optimum_little():
    jacobian, generator = linear_model(), np.random.default_rng(6)
    _, residuals = fitted(jacobian, generator.normal(0, 1e-3, ROWS))
    fit = Linearisation(POINT, residuals, jacobian)
    chaos = generator.normal(0, 0.1, ROWS)
    whole = np.linalg.lstsq(jacobian, -chaos, rcond=None)[0]
    assert np.linalg.norm(optimum_shift(fit, residuals + chaos)) < 0.02 * np.linalg.norm(whole)


def test_other_noise_of_the_initial_chains_widens_an_interval_by_what_it_moves():
    jacobian = linear_model(columns=1)
    residuals = np.random.default_rng(9).normal(0, 1e-3, ROWS)
    rows = slice(3 * 40, 3 * 80)  # of the second trial
    moved = np.zeros(ROWS)
    moved[rows] = jacobian[rows, 0] * 0.01
    share = np.sum(jacobian[rows]**2) / np.sum(jacobian**2)  # of the information is from there
    fit = Linearisation(POINT[:1], residuals, jacobian)
    plain = at_minimum(fit, LAYOUT, noise=1e-3)
    uncertainty = at_minimum(fit, LAYOUT, noise=1e-3, starts=[residuals + moved, residuals - moved])
    assert uncertainty.std[0] == pytest.approx(np.hypot(plain.std[0], 0.01 * share), rel=0.2)
    assert uncertainty.std[0] > 2 * plain.std[0]
    unmoved = at_minimum(fit, LAYOUT, noise=1e-3, starts=[residuals])
    assert unmoved.std == pytest.approx(plain.std)
    single_start = at_minimum(fit, LAYOUT, noise=1e-3, starts=[residuals + moved, *[residuals] * 3])
    assert single_start.std[0] == pytest.approx(np.hypot(plain.std[0], 0.005 * share), rel=0.2)


def test_a_start_that_ends_elsewhere_altogether_is_an_outlier():
    jacobian = linear_model()
    residuals = np.random.default_rng(10).normal(0, 1e-3, ROWS)
    there, further = residuals.copy(), residuals.copy()
    there[:30] += 0.1
    further[:30] += 10.0
    near, far = (at_minimum(Linearisation(POINT, residuals, jacobian), LAYOUT, noise=1e-3, starts=[start])
                 for start in (there, further))
    assert far.std == pytest.approx(near.std, rel=0.01)


def test_outliers_hardly_widen_the_intervals():
    residuals = np.random.default_rng(7).normal(0, 1e-3, ROWS)
    spoilt = residuals.copy()
    spoilt[::60] += 0.1
    clean = at_minimum(Linearisation(POINT, residuals, linear_model()), LAYOUT, noise=1e-3)
    uncertainty = at_minimum(Linearisation(POINT, spoilt, linear_model()), LAYOUT, noise=1e-3)
    assert (uncertainty.std < 3 * clean.std).all()


def test_white_residuals_count_each_and_smooth_ones_do_not():
    generator = np.random.default_rng(8)
    white = generator.normal(size=3 * 10 * 50)
    assert correlation_length(white, ResidualLayout(((10, 50),))) < 1.3
    alike = np.repeat(generator.normal(size=(10, 10, 1, 3)), 5, axis=2)  # five neighbours each
    assert 3 < correlation_length(alike.ravel(), ResidualLayout(((10, 50),))) < 8
    in_time = np.repeat(generator.normal(size=(2, 1, 50, 3)), 5, axis=1)
    assert correlation_length(in_time.ravel(), ResidualLayout(((10, 50),))) > 3


def test_the_band_of_a_chain_follows_from_the_covariance():
    jacobian = np.array([[3.0], [0.0], [4.0], [0.0], [0.0], [0.0]])  # one point moves by 5 m per unit
    assert predictive_std(jacobian, np.array([[0.01]])) == pytest.approx([0.5, 0.0])


def test_an_interval_contains_what_the_trials_say_without_any_one_of_them():
    residuals = np.random.default_rng(11).normal(0, 1e-3, ROWS)
    jacobian = linear_model()
    first = LAYOUT.rows[0]
    residuals[first] += 0.02 * jacobian[first, 0] / np.abs(jacobian[first, 0]).max()
    fit = Linearisation(POINT, residuals, jacobian)
    uncertainty = at_minimum(fit, LAYOUT, noise=1e-4)
    loss = Huber.of(residuals)
    weighted = fit.weighted(loss.roots(residuals) / uncertainty.scale)
    without = POINT + jackknife(weighted, LAYOUT.rows, prior_information(len(POINT)))
    assert (uncertainty.lower <= np.clip(without, 0, 1)).all()
    assert (uncertainty.upper >= np.clip(without, 0, 1)).all()


def test_trials_that_hardly_tell_a_parameter_do_not_disagree_about_it():
    generator, jacobian = np.random.default_rng(13), linear_model()
    others = slice(LAYOUT.rows[0].stop, None)
    jacobian[others, 0] *= 0.02  # the first trial alone tells the first parameter
    residuals = generator.normal(0, 1e-3, ROWS)
    residuals[others] += 1e-3 * jacobian[others, 0] / np.abs(jacobian[others, 0]).max()
    fit = Linearisation(POINT, residuals, jacobian)
    agree, disagree = (at_minimum(fit, LAYOUT, noise=noise) for noise in (1e-3, 1e-4))
    assert disagree.upper[0] - disagree.lower[0] < 1.2 * (agree.upper[0] - agree.lower[0])


def test_an_error_of_the_hands_widens_the_intervals_as_far_as_it_moves_the_optimum():
    residuals, jacobian = np.random.default_rng(12).normal(0, 1e-3, ROWS), linear_model()
    fit = Linearisation(POINT, residuals, jacobian)
    alone = at_minimum(fit, LAYOUT, noise=1e-3)
    other = at_minimum(fit, LAYOUT, noise=1e-3, hands=[residuals + 0.05 * jacobian[:, 0]])
    assert other.std[0] == pytest.approx(np.hypot(alone.std[0], 0.05), rel=0.05)
    assert other.std[1] == pytest.approx(alone.std[1], rel=0.05)


def test_slow_errors_are_others_in_each_trial():
    residuals, jacobian = np.random.default_rng(12).normal(0, 1e-3, ROWS), linear_model()
    fit = Linearisation(POINT, residuals, jacobian)
    shared, slow = (at_minimum(fit, LAYOUT, noise=1e-3, **{name: [residuals + 0.05 * jacobian[:, 0]]})
                    for name in ('hands', 'slow'))
    alone = at_minimum(fit, LAYOUT, noise=1e-3)
    # Errors of several trials partly cancel; those that all of them share do not.
    assert alone.std[0] < slow.std[0] < 0.9 * shared.std[0]
