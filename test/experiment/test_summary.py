# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The summary of an experiment: its numbers are those of known outcomes."""

import math

from experiment_outcomes import outcomes, ROPE
import numpy as np
import pytest

from dlo_calibration.experiment.study import Outcome, Subject, Task
from dlo_calibration.experiment.summary import Spread, summary


def test_the_numbers_are_those_of_the_runs():
    found = summary([*outcomes(1, 60.0, (10.0, 50.0)),
                     *outcomes(2, 70.0, (40.0, 80.0)), *outcomes(3, 80.0, (20.0, 40.0))])
    assert (found.subject, found.search, found.runs, found.failures) == ('rope', 'random', 3, 0)
    assert found.parameters['friction'] == Spread(70.0, 10.0, 3)
    assert found.parameters['elasticity'] == Spread(25.0, 0.0, 3)
    assert found.informed == {'friction': 3, 'elasticity': 0}
    # The scores of the runs are 30, 60 and 30.
    assert found.score.mean == pytest.approx(40.0)
    assert found.score.std == pytest.approx(np.sqrt(300))
    assert found.very_similar == 2
    assert found.error.mean == pytest.approx(0.04)
    assert found.share.mean == pytest.approx(4.0)
    assert found.actions['trial 2'].mean == pytest.approx((50 + 80 + 40) / 3)
    assert found.worst == 80.0
    assert found.evaluations == Spread(102.0, 1.0, 3)
    assert found.fitted.mean == pytest.approx(0.002)


def test_a_default_that_is_kept_in_all_runs_does_not_scatter():
    assert Spread.of([23.788672241957592] * 20) == Spread(23.788672241957592, 0.0, 20)
    assert Spread.of([23.8]) == Spread(23.8, None, 1)
    assert math.isnan(Spread.of([1.0, math.nan]).std)


def test_a_parameter_may_be_excited_in_some_runs_only():
    found = summary([*outcomes(1, 60.0, (1.0, 1.0), ('friction', 'elasticity')),
                     *outcomes(2, 70.0, (1.0, 1.0))])
    assert found.informed == {'friction': 2, 'elasticity': 1}


def test_an_unfinished_run_does_not_count():
    found = summary([*outcomes(1, 60.0, (10.0, 50.0)), *outcomes(2, 90.0, (40.0, 80.0))[:2]])
    assert found.runs == 1
    assert found.parameters['friction'] == Spread(60.0, None, 1)


def test_failures_are_counted_and_left_out_of_the_means():
    second = outcomes(2, 70.0, (None, 30.0))
    second[0] = (second[0][0], Outcome({}, failure='diverged'))
    found = summary([*outcomes(1, 60.0, (10.0, 50.0)), *second])
    assert found.failures == 2
    assert found.parameters['friction'] == Spread(60.0, None, 1)
    assert found.score == Spread(30.0, 0.0, 2)
    assert found.actions['trial 1'].count == 1


def test_without_judges_there_is_no_validity():
    alone = Subject('rope', ROPE.observed, ())
    outcome = Outcome({'friction': 1.0, 'elasticity': 2.0}, ('friction',), 5.0, 0.002, 10, 20, 1.0)
    found = summary([(Task(alone, 'random', seed, 'toy'), outcome) for seed in (1, 2)])
    assert (found.score, found.error, found.worst, found.actions) == (None, None, None, {})
    assert found.parameters['friction'] == Spread(1.0, 0.0, 2)
