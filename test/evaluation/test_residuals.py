# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The residual vector by trial, goal and point; the robust loss."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Goal
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.evaluation.residuals import (
    at_every_goal,
    compared_goals,
    compared_rows,
    Huber,
    MOST_TIMED,
    ResidualLayout,
)
from dlo_calibration.model.parameters import ParameterSpace

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}


def test_a_layout_splits_residuals_into_the_chains_of_each_trial():
    first, second = (toy_trial(TRUTH, name, n=n) for name, n in (('trial 1', 11), ('trial 2', 7)))
    second = replace(second, goals=(*second.goals, Goal(second.goals[0].chain, 3.0)))
    evaluator = Evaluator((first, second), ParameterSpace(), ToySimulator())
    evaluation = evaluator.evaluate(0, np.full(4, 0.3))
    chains = ResidualLayout.of((first, second)).chains(evaluation.residuals)
    simulated = [ToySimulator().simulate(*job) for job in evaluator.jobs(evaluation.point)]
    for trial, block, rollout in zip((first, second), chains, simulated, strict=True):
        observed = [goal.chain.points for goal in trial.goals]
        assert np.array_equal(block, rollout.chains - observed)


def test_the_folds_of_a_cross_validation_are_neighbouring_trials_that_cover_all():
    layout = ResidualLayout(((1, 3), (2, 3), (1, 4)))
    assert layout.folds(8) == layout.rows
    assert layout.folds(2) == [slice(0, 27), slice(27, 39)]
    first, _, last = layout.by_point(np.arange(13))
    assert first.tolist() == [[0, 1, 2]]
    assert last.tolist() == [[9, 10, 11, 12]]


def moving(trial, times, stable=()):
    """Return a trial with other goals: one at each time, timed unless `stable` has the time."""
    chain = trial.goals[0].chain
    return replace(trial, goals=tuple(Goal(chain, time, stable=time in stable) for time in times))


def stream():
    """Return two trials: a stream of 200 timed goals that ends at rest, and one goal at rest."""
    first, second = (toy_trial(TRUTH, name, n=n) for name, n in (('trial 1', 11), ('trial 2', 7)))
    return moving(first, [0.51 + 0.01 * k for k in range(200)] + [4.0, 5.0], stable=(4.0, 5.0)), second


def test_few_goals_are_all_compared():
    trial = toy_trial(TRUTH)
    for times, stable in (((2.0,), (2.0,)), (np.linspace(2, 3, MOST_TIMED).tolist(), ()),
                          (np.linspace(2, 3, 90).tolist(), np.linspace(2, 3, 90).tolist()[MOST_TIMED:])):
        assert compared_goals(moving(trial, times, stable)) == list(range(len(times)))
    assert compared_rows([trial, trial]) is None


def test_the_compared_goals_of_a_stream_are_evenly_spread_over_time():
    trial, _ = stream()
    goals = compared_goals(trial)
    assert len(goals) == MOST_TIMED + 2
    assert goals[0] == 0
    assert goals[-3:] == [199, 200, 201]  # the last in motion, and both at rest
    assert set(np.diff(goals[:-2])) == {4, 5}
    # Twice as many frames in the second half: time counts, not their number.
    uneven = moving(trial, [*np.arange(100) / 10, *np.arange(10, 20, 0.05)])
    compared = np.array([uneven.goals[k].time for k in compared_goals(uneven)])
    assert compared == pytest.approx(np.linspace(0, 19.95, MOST_TIMED), abs=0.051)


def test_scores_and_errors_are_those_of_every_goal_and_residuals_those_of_compared_goals():
    trials, point = stream(), np.full(4, 0.3)
    whole = Evaluator(trials, ParameterSpace(), ToySimulator()).evaluate(0, point)
    evaluator = Evaluator(trials, ParameterSpace(), ToySimulator(), every_goal=False)
    for variant in (evaluator, copy.copy(evaluator), evaluator.of(evaluator.space)):
        thin = variant.evaluate(0, point)
        assert thin.scores == whole.scores
        assert thin.errors == whole.errors
        expected = [block[compared_goals(trial)] for trial, block in zip(
            trials, ResidualLayout.of(trials).chains(whole.residuals), strict=True)]
        blocks = ResidualLayout.compared(trials).chains(thin.residuals)
        assert all(np.array_equal(*pair) for pair in zip(blocks, expected, strict=True))


def test_between_compared_goals_a_value_is_interpolated_in_time():
    trials = stream()
    value = [np.array([goal.time for goal in trial.goals]) for trial in trials]  # linear in time
    shown = np.concatenate([np.repeat(times[compared_goals(trial)], len(trial.initial))
                            for times, trial in zip(value, trials, strict=True)])
    every = np.concatenate([np.repeat(times, len(trial.initial))
                            for times, trial in zip(value, trials, strict=True)])
    assert at_every_goal(shown, trials) == pytest.approx(every)
    few = (toy_trial(TRUTH), toy_trial(TRUTH))
    values = np.random.default_rng(0).random(22)
    assert np.array_equal(at_every_goal(values, few), values)


def hiding(trial, share, seed=0):
    """Return a trial in whose chains a share of the points, at random, was not seen."""
    random = np.random.default_rng(seed)

    def hidden(chain, first=0):
        there = np.arange(first, len(chain) - first)
        points = chain.points.copy()
        points[random.choice(there, round(share * len(chain)), replace=False)] = np.nan
        return replace(chain, points=points)

    return replace(trial, initial=hidden(trial.initial, 1), goals=tuple(
        replace(goal, chain=hidden(goal.chain)) for goal in trial.goals))


def test_points_that_were_not_seen_have_no_residuals_and_the_others_keep_theirs():
    trials, point = stream(), np.full(4, 0.3)
    some = tuple(replace(hiding(trial, 0.2), initial=trial.initial) for trial in trials)
    whole, thin, compared = (
        Evaluator(those, ParameterSpace(), ToySimulator(), every).evaluate(0, point).residuals
        for those, every in ((trials, True), (some, True), (some, False)))
    layout = ResidualLayout.of(some)
    assert layout.rows[-1].stop == len(thin) < len(whole)
    assert ResidualLayout.compared(some).rows[-1].stop == len(compared) == len(compared_rows(some))
    for trial, block, expected in zip(some, layout.chains(thin), ResidualLayout.of(trials).chains(whole),
                                      strict=True):
        seen = np.stack([goal.chain.seen for goal in trial.goals])
        assert np.isnan(block[~seen]).all()
        assert np.array_equal(block[seen], expected[seen])
    sizes = at_every_goal(np.linalg.norm(compared.reshape(-1, 3), axis=1), some)
    assert sizes.shape == (len(thin) // 3,)
    assert np.isfinite(sizes).all()


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
