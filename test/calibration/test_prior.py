# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a search is told before anything is simulated."""

import numpy as np
from toy_messages import toy_trials
from toy_simulator import ToySimulator

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import prior
from dlo_calibration.evaluation.evaluator import Evaluator


def test_hints_say_which_residuals_are_of_which_trial_and_what_each_shows():
    options, trials = Options(), toy_trials(3)
    found = prior(trials, options)
    evaluation = Evaluator(trials, found.space, ToySimulator()).evaluate(0, np.full(4, 0.5))
    assert sum(found.hints.rows) == len(evaluation.residuals)
    assert found.hints.excites.shape == (len(found.hints.rows), 4) == (3, 4)
