# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials are appraised in the background: in order, once each, until they are stopped."""

from dataclasses import replace
import threading
import time

import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import new_toy, Stoppable, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.model.trial import Goal
from dlo_calibration.workspace.live_information import LiveInformation

PATIENCE = 60.0
OPTIONS = Options.of({'calibrate': ['flexibility', 'friction'], 'elasticity': TRUTH['elasticity'],
                      'self_collision': TRUTH['self_collision'], 'evaluations': 40, 'workers': 1})
TRIALS = toy_trials(3)


def appraised(appraiser, trials, *rest, **more):
    """Return the information from one appraisal."""
    appraiser.start(trials, OPTIONS, *rest, **more)
    assert appraiser.join(PATIENCE)
    return list(appraiser.waiting_information())


@pytest.fixture
def appraiser():
    live = LiveInformation(lambda _: ToySimulator())
    yield live
    live.stop()
    assert live.join(PATIENCE)


def test_each_trial_is_appraised_once_after_those_before_it(appraiser):
    first, second = appraised(appraiser, TRIALS[:2])
    assert (first.trial, second.trial) == ('trial 1', 'trial 2')
    assert first.improved == ('flexibility', 'friction')
    assert second.before.tolist() == first.after.tolist()
    assert appraised(appraiser, TRIALS[:2]) == []
    third, = appraised(appraiser, TRIALS)
    assert third.trial == 'trial 3'
    assert (third.before < first.before).all()


def test_a_trial_that_changed_is_appraised_again(appraiser):
    appraised(appraiser, TRIALS[:1])
    later = replace(TRIALS[0], goals=(replace(TRIALS[0].goals[0], time=3.0),))
    assert [each.trial for each in appraised(appraiser, [later])] == ['trial 1']
    more = replace(later, goals=(*later.goals, replace(later.goals[0], time=4.0)))  # it still lies there
    assert appraised(appraiser, [more]) == []


def test_a_repeat_to_the_digit_is_a_trial_of_its_own(appraiser):
    first, again = appraised(appraiser, [TRIALS[0], replace(TRIALS[0], name='trial 2')])
    assert again.words.startswith('trial 2 adds nothing new: repeat it only to average noise')
    assert again.after == pytest.approx(first.after, rel=0.3)


def test_a_trial_is_appraised_again_if_an_earlier_one_is_gone(appraiser):
    appraised(appraiser, TRIALS)
    assert [each.trial for each in appraised(appraiser, [TRIALS[0], TRIALS[2]])] == ['trial 3']


def test_after_a_stop_trials_are_appraised_again(appraiser):
    appraised(appraiser, TRIALS[:1])
    appraiser.stop()
    assert [each.trial for each in appraised(appraiser, TRIALS[:1])] == ['trial 1']


def test_a_trial_under_way_waits_until_it_has_a_goal_at_rest(appraiser):
    chain = TRIALS[1].goals[0].chain
    moving = replace(TRIALS[1], goals=(Goal(chain, 1.0, stable=False),))
    assert [each.trial for each in appraised(appraiser, [TRIALS[0], moving], whole=False)] == ['trial 1']
    assert [each.trial for each in appraised(appraiser, [TRIALS[0], moving])] == ['trial 2']


def test_trials_of_a_result_are_not_appraised_and_later_ones_add_to_it(appraiser):
    result = calibrate(TRIALS[:2], OPTIONS, make_simulator=new_toy)
    assert result.examination.regular
    information, = appraised(appraiser, TRIALS, result)
    assert information.trial == 'trial 3'
    assert information.before == pytest.approx(result.examination.uncertainty.std, rel=1e-3)


@pytest.mark.parametrize(('toy', 'words'), [
    (ToySimulator(fail_below=101.0), 'trial 1: diverged'),
    (ToySimulator(crash=True), 'RuntimeError: the toy')])
def test_a_trial_that_cannot_be_simulated_gives_a_sentence(toy, words):
    information, = appraised(LiveInformation(lambda _: toy), TRIALS[:1])
    assert information.failure.startswith(words)
    assert '\n' not in information.words


def test_an_engine_that_cannot_be_made_gives_a_sentence():
    def refuse(options):
        raise DloCalibrationError('no such engine')

    information, = appraised(LiveInformation(refuse), TRIALS[:2])
    assert information.words == 'the information of trial 2 is unknown: no such engine'


def test_a_stop_in_the_middle_of_a_rollout_ends_it_without_information():
    engine, before = Stoppable(), set(threading.enumerate())
    appraiser = LiveInformation(lambda _: engine)
    appraiser.start(TRIALS, OPTIONS)
    assert engine.begun.wait(PATIENCE)
    with pytest.raises(DloCalibrationError, match='under way'):
        appraiser.start(TRIALS, OPTIONS)
    begun = time.monotonic()
    appraiser.stop()
    assert appraiser.join(PATIENCE)
    assert time.monotonic() - begun < 0.2
    assert list(appraiser.waiting_information()) == []
    assert set(threading.enumerate()) <= before
