# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The summary of an experiment, from known outcomes."""

import math

from experiment_outcomes import outcomes, ROPE
import numpy as np
import pytest

from dlo_calibration.experiment.study import Outcome, Subject, Task
from dlo_calibration.experiment.summary import Spread, summary


def test_the_numbers_are_those_of_the_runs():
    findings = summary([*outcomes(1, 60.0, (10.0, 50.0)),
                     *outcomes(2, 70.0, (40.0, 80.0)), *outcomes(3, 80.0, (20.0, 40.0))])
    assert (findings.subject, findings.search, findings.runs, findings.failures) == ('rope', 'random', 3, 0)
    assert findings.parameters['friction'] == Spread(70.0, 10.0, 3)
    assert findings.parameters['elasticity'] == Spread(25.0, 0.0, 3)
    assert findings.informed == {'friction': 3, 'elasticity': 0}
    # The scores of the runs are 30, 60 and 30.
    assert findings.score.mean == pytest.approx(40.0)
    assert findings.score.std == pytest.approx(np.sqrt(300))
    assert findings.very_similar == 2
    assert findings.error.mean == pytest.approx(0.04)
    assert findings.share.mean == pytest.approx(4.0)
    assert findings.actions['trial 2'].mean == pytest.approx((50 + 80 + 40) / 3)
    assert findings.worst == 80.0
    assert findings.evaluations == Spread(102.0, 1.0, 3)
    assert findings.fitted.mean == pytest.approx(0.002)


def test_equal_values_have_no_deviation():
    assert Spread.of([23.788672241957592] * 20) == Spread(23.788672241957592, 0.0, 20)
    assert Spread.of([23.8]) == Spread(23.8, None, 1)
    assert math.isnan(Spread.of([1.0, math.nan]).std)


def test_a_parameter_may_be_excited_in_some_runs_only():
    findings = summary([*outcomes(1, 60.0, (1.0, 1.0), ('friction', 'elasticity')),
                     *outcomes(2, 70.0, (1.0, 1.0))])
    assert findings.informed == {'friction': 2, 'elasticity': 1}


def test_an_unfinished_run_does_not_count():
    findings = summary([*outcomes(1, 60.0, (10.0, 50.0)), *outcomes(2, 90.0, (40.0, 80.0))[:2]])
    assert findings.runs == 1
    assert findings.parameters['friction'] == Spread(60.0, None, 1)


def test_failures_are_counted_and_do_not_affect_the_means():
    second = outcomes(2, 70.0, (None, 30.0))
    second[0] = (second[0][0], Outcome({}, failure='diverged'))
    findings = summary([*outcomes(1, 60.0, (10.0, 50.0)), *second])
    assert findings.failures == 2
    assert findings.parameters['friction'] == Spread(60.0, None, 1)
    assert findings.score == Spread(30.0, 0.0, 2)
    assert findings.actions['trial 1'].count == 1


def test_without_judges_there_is_no_validity():
    alone = Subject('rope', ROPE.observed, ())
    outcome = Outcome({'friction': 1.0, 'elasticity': 2.0}, ('friction',), 5.0, 0.002, 10, 20, 1.0)
    findings = summary([(Task(alone, 'random', seed, 'toy'), outcome) for seed in (1, 2)])
    assert (findings.score, findings.error, findings.worst, findings.actions) == (None, None, None, {})
    assert findings.parameters['friction'] == Spread(1.0, 0.0, 2)
