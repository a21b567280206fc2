# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The flat residual vector is seen by trial, goal and point."""

from dataclasses import replace

import numpy as np
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Goal
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.model.parameters import ParameterSpace

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}


def test_each_trial_finds_its_chains_in_the_residuals_of_an_evaluation():
    first, second = (toy_trial(TRUTH, name, n=n) for name, n in (('trial 1', 11), ('trial 2', 7)))
    second = replace(second, goals=(*second.goals, Goal(second.goals[0].chain, 3.0)))
    evaluator = Evaluator((first, second), ParameterSpace(), ToySimulator())
    evaluation = evaluator.evaluate(0, np.full(4, 0.3))
    chains = ResidualLayout.of((first, second)).chains(evaluation.residuals)
    simulated = evaluator.simulate(evaluation.values)
    for trial, found, rollout in zip((first, second), chains, simulated, strict=True):
        observed = [goal.chain.points for goal in trial.goals]
        assert np.array_equal(found, rollout.chains - observed)


def test_the_folds_of_a_cross_validation_are_neighbouring_trials_that_cover_all():
    layout = ResidualLayout(((1, 3), (2, 3), (1, 4)))
    assert layout.folds(8) == layout.rows
    assert layout.folds(2) == [slice(0, 27), slice(27, 39)]
    first, _, last = layout.by_point(np.arange(13))
    assert first.tolist() == [[0, 1, 2]]
    assert last.tolist() == [[9, 10, 11, 12]]
