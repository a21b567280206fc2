# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Least squares: few evaluations, the lower minimum, no pull by outliers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dlo_calibration.calibration.calibrate import searched
from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.files.session import read_session
from dlo_calibration.search import Hints, LeastSquares, Observation
from dlo_calibration.simulation.compiled import CompiledSimulator

TRUTH = np.array([0.62, 0.35, 0.5])


def valley(point, outliers=0.0, roughness=0.0, flat=()):
    """Return residuals [m] of a smooth nonlinear problem in three parameters with 1 mm of noise."""
    generator = np.random.default_rng(4)
    lean, bend = generator.normal(size=(2, 90, 3))
    away = np.where(np.isin(np.arange(3), flat), 0.0, point - TRUTH)
    residuals = 0.1 * (lean @ away + 0.5 * np.sin(2 * bend @ away)) + generator.normal(scale=0.001, size=90)
    residuals *= 1 + roughness * np.sin(1e5 * (1 + point.sum()) * np.arange(90))
    residuals[::15] += outliers
    return residuals


def two_minima(point):
    """Return residuals [m] with a minimum near (0.2, 0.3), and a wider, worse one near (0.8, 0.3)."""
    x, y = point
    dip = np.exp(-((x - 0.2) / 0.25) ** 2)
    return np.array([0.1 * (x - 0.8) * (1 - dip), 0.02 * (1 - dip), 0.1 * (y - 0.3) * (1 + x), 0.001])


def solve(residuals_at, seed=1, budget=150, dimension=3, hints=None):
    """Return the search after it has ended or spent its budget, and the points asked."""
    search = LeastSquares(dimension, seed, hints)
    asked = []
    while len(asked) < budget:
        points = search.ask(budget - len(asked))
        if not len(points):
            break
        search.tell([Observation(p, float(np.linalg.norm(residuals_at(p))), residuals_at(p)) for p in points])
        asked.extend(points)
    return search, np.array(asked)


@pytest.mark.parametrize('roughness', [0.0, 1e-4, 1e-2])
def test_it_converges_in_few_evaluations_to_one_point_from_any_seed(roughness):
    best, counts = [], []
    for seed in range(8):
        search, asked = solve(lambda point: valley(point, roughness=roughness), seed)
        assert search.stop_reason.startswith('converged')
        best.append(search.best)
        counts.append(len(asked))
    assert np.ptp(best, axis=0).max() < 0.003
    assert np.mean(best, axis=0) == pytest.approx(TRUTH, abs=0.003)
    assert np.median(counts) < 45


def kinked(point):
    """Return residuals [m] of the valley with kinks in every parameter, as by stick and slip."""
    saw = np.abs((np.asarray(point) / 0.08) % 1 * 2 - 1)
    return valley(point + 0.03 * saw)


def test_kinks_do_not_keep_a_seed_in_a_worse_minimum():
    costs = []
    for seed in range(12):
        search, _ = solve(kinked, seed)
        costs.append(float(np.square(kinked(search.best)).sum()))
    assert max(costs) < 1.02 * min(costs)


def test_the_lowest_of_many_minima_along_a_valley_is_found_from_nine_of_ten_seeds():
    lean, side, along, scatter = np.random.default_rng(6).normal(size=(4, 60))

    def rough(point):
        x, y = point
        ratio, away = x + 0.5 * y - 0.6, y - 0.3  # friction that stiffness makes up for
        slips = 0.008 * np.sin(2 * np.pi * away / 0.1)
        return lean * ratio + along * slips + 0.06 * side * away + 1e-3 * scatter

    least = min(float(np.square(rough((0.6 - y / 2, y))).sum()) for y in np.linspace(0.0, 1.0, 1001))
    hints = replace(Hints.none(2), follows_valley=True)
    costs = [float(np.square(rough(solve(rough, seed, dimension=2, hints=hints)[0].best)).sum())
             for seed in range(10)]
    assert sorted(costs)[8] < 1.3 * least, costs  # a step of the scan may pass over one


def test_outliers_do_not_pull():
    best = solve(lambda point: valley(point, outliers=0.3))[0].best
    assert best == pytest.approx(TRUTH, abs=0.005)


def test_any_seed_leads_to_the_lower_of_two_minima():
    for seed in range(12):
        search = solve(two_minima, seed, dimension=2)[0]
        assert search.best == pytest.approx([0.2, 0.3], abs=0.02), f'seed {seed}'


def test_a_parameter_without_effect_keeps_the_value_of_its_start():
    hints = Hints([np.nan, 0.4, np.nan], [True, False, True])
    search = solve(lambda point: valley(point, flat=(1,)), hints=hints)[0]
    assert search.best[1] == 0.4


def test_a_parameter_with_only_a_random_effect_stays():
    def trembling(point):
        residuals = valley(point, flat=(1,))
        return residuals + 1e-7 * np.sin(1e6 * point[1] * np.arange(90))

    search, asked = solve(trembling)
    assert search.best[1] in asked[:8, 1]


def test_some_points_have_the_estimate_and_others_do_not():
    hints = Hints([0.9, np.nan, 0.1], [True] * 3)
    asked = LeastSquares(3, 1, hints).ask(100)
    with_estimate = (asked[:, [0, 2]] == [0.9, 0.1]).all(axis=1)
    assert 0 < with_estimate.sum() < len(asked)
    wrong = Hints([0.1, np.nan, np.nan], [True] * 3)
    assert solve(valley, hints=wrong)[0].best == pytest.approx(TRUTH, abs=0.005)


def test_a_scale_that_becomes_wider_does_not_change_a_search():
    _, before = solve(valley, hints=Hints([np.nan, np.nan, 0.1], [True] * 3))
    moved = np.array([0.4, 0.0, 0.0])  # the scale of the first parameter begins lower, and ends higher
    hints = Hints([np.nan, np.nan, 0.1], [True] * 3, upper=[1.5, 1.0, 1.0], middle=[0.9, 0.5, 0.1])
    search, after = solve(lambda point: valley(point - moved), hints=hints)
    assert after - moved == pytest.approx(before, abs=1e-6)
    search, _ = solve(lambda point: valley(point - [0.8, 0, 0]), hints=hints)  # beyond all start points
    assert search.best == pytest.approx(TRUTH + [0.8, 0, 0], abs=0.005)


def test_an_optimum_on_the_border_is_reached():
    search = solve(lambda point: valley(point * [0.5, 1, 1]))[0]  # its minimum is at 1.24
    assert search.best[0] == 1.0
    assert search.stop_reason.startswith('converged')


def test_two_starts_that_share_an_estimate_and_end_alike_do_not_hide_a_better_place():
    # On sample object2, both end with too much stretch, for which less friction compensates.
    session = read_session(Path(__file__).resolve().parents[2] / 'msg_samples/object2', None)
    trials, options = session.trials, session.options
    evaluator = Evaluator(trials, options.space, CompiledSimulator())
    search = LeastSquares(options.space.dimension, 10, Prior.of(trials, options).hints)
    while len(points := search.ask(150)):
        search.tell([Observation(e.point, e.score, e.residuals)
                     for e in (evaluator.evaluate(0, point) for point in points)])
    assert evaluator.evaluate(0, search.best).errors.mean < 2e-3


def test_a_minimum_beyond_a_ridge_is_not_descended_with_the_slope_from_this_side():
    lean, side, scatter = np.random.default_rng(4).normal(size=(3, 60))

    def residuals_at(point):
        x, y = point
        beyond = 1 / (1 + np.exp(-(y - 0.5) / 0.03))  # there, x has the opposite effect
        return 0.1 * lean * ((x - 0.3) * (1 - 2 * beyond) + 0.08 * beyond) + 0.01 * side * (1 - beyond) + \
            0.01 * scatter * (y - 0.2) * (1 - beyond) + 2e-4 * np.random.default_rng(5).normal(size=60)

    start = Hints(np.array([0.3, 0.1]), np.ones(2, bool))
    counts = []
    for seed in (0, 1, 3):
        search, asked = solve(residuals_at, seed, dimension=2, hints=start)
        assert search.best[0] == pytest.approx(0.38, abs=0.003)
        counts.append(len(asked))
    assert sum(counts) < 170


def test_a_budget_that_ends_within_a_measurement_leaves_a_whole_model():
    search, models = LeastSquares(3, 1), []
    while len(points := search.ask(1)):
        residuals = valley(points[0], roughness=0.01)
        search.tell([Observation(points[0], float(np.sum(residuals**2)), residuals)])
        models += [] if search.model is None else [search.model]
    assert len(models) > 20
    assert all(model.jacobian.any(axis=0).all() for model in models)


@pytest.mark.long
@pytest.mark.parametrize('name, seed', [('object1', 19), ('object3', 10), ('object5', 2)])
def test_a_descent_does_not_stall_in_the_valley_that_a_missing_lift_leaves(name, seed):
    """Without the lift of trial 3, a DLO shows little more than the ratio of stiffness to friction."""
    session = read_session(Path(__file__).resolve().parents[2] / 'msg_samples' / name)
    trials = tuple(trial for k, trial in enumerate(session.trials) if k != 2)
    options = choose(trials, session.options).options
    flexibility = []
    for each in (1, seed):
        setting = Setting(trials, replace(options, seed=each), CompiledSimulator())
        best = searched(setting, Prior.of(setting.trials, setting.options)).best
        flexibility.append(best.values['flexibility'])
    assert flexibility[1] == pytest.approx(flexibility[0], abs=5)
