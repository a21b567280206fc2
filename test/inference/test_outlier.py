# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A trial that does not fit the others is named; one that only shows more of the DLO is not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.files.session import read_session
from dlo_calibration.inference.outlier import candidate, is_outlier, Outlier

SAMPLE = Path(__file__).resolve().parents[2] / 'msg_samples/object1'


@pytest.mark.parametrize(('errors', 'expected'), [
    ([1.8, 2.0, 2.1, 1.8], None),  # samples
    ([1.6, 2.2, 1.9, 8.9], 3),
    ([50.0, 1.9, 2.2, 2.0], 0),
    ([1.6, 3.0], None)])  # of two, nothing says which is right
def test_a_trial_with_larger_errors_may_be_an_outlier(errors, expected):
    assert candidate(np.array(errors) * 1e-3) == expected


@pytest.mark.parametrize(('errors', 'expected'), [
    ([1.6, 2.2, 1.9, 8.9], True),
    ([1.6, 2.2, 1.9, 3.0], False),
    # Recordings of a real cable: the seventh is the fastest.
    ([7.9, 8.8, 11.9, 10.8, 7.3, 7.9, 30.6, 18.9], False)])
def test_an_outlier_differs_by_more_than_the_others_among_themselves(errors, expected):
    assert is_outlier(int(np.argmax(errors)), np.array(errors) * 1e-3) == expected


@pytest.fixture(scope='module')
def session():
    return read_session(SAMPLE)


def calibrated(session, trials):
    return calibrate(trials, replace(session.options, engine='compiled', workers=1))


def test_no_trial_of_a_sample_is_an_outlier(session):
    assert calibrated(session, session.trials).outlier is None


def test_an_outlier_is_named_with_the_values_without_it(session):
    trials = list(session.trials)
    goal = trials[1].goals[-1]
    chain = replace(goal.chain, points=goal.chain.points + np.linspace(0, 0.1, 21)[:, None] * (0.0, 1.0, 0.0))
    trials[1] = replace(trials[1], goals=(*trials[1].goals[:-1], replace(goal, chain=chain)))
    result, without = calibrated(session, trials), calibrated(session, [trials[0], *trials[2:]])
    assert (result.outlier.trial, result.outlier.number) == (trials[1].name, 2)
    assert result.outlier.error > 10 * result.outlier.usual
    for name in ('flexibility', 'friction'):
        assert result.outlier.values[name] == pytest.approx(without.values[name], abs=1.0)
    words, = (text for text in result.warnings if 'does not fit the others' in text)
    assert words.startswith(trials[1].name)
    assert words.endswith('(--without 2)')
    assert bool(result.unusable) == bool(result.outlier.decided)


def test_a_result_that_an_outlier_decides_is_not_usable(session):
    result = calibrated(session, session.trials)
    estimate = result.parameters['flexibility']
    outlier = Outlier('trial 2', 2, error=0.03, usual=0.002, values={'flexibility': 50.0}, turned=False,
                      decided=('flexibility',))
    words = replace(result, outlier=outlier).unusable
    assert estimate.identifiable
    assert 'flexibility 50 instead of' in words
    assert '--without 2' in words


def test_goals_from_the_other_end_are_named_as_such(session):
    trials = list(session.trials)
    goal = trials[1].goals[-1]
    chain = replace(goal.chain, points=goal.chain.points[::-1])
    trials[1] = replace(trials[1], goals=(*trials[1].goals[:-1], replace(goal, chain=chain)))
    result = calibrated(session, trials)
    assert result.outlier.turned
    assert 'run from the other end' in result.outlier_words
