# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The next action: it tells much, keeps to the limits, is the same each time, and ends with a reason."""

from dataclasses import replace
import functools

import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Chain, InputError, Options, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.expectation import Expectation
from dlo_calibration.inference.target import read_targets, wanted_deviations
from dlo_calibration.inference.trial_information import Appraisal
from dlo_calibration.inference.uncertainty import DEVIATIONS
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.workspace.live_information import Appraised
from dlo_calibration.workspace.next_action import advise, next_action, resting

ALONG = np.linspace(0.0, 0.6, 15)
START = Chain(np.column_stack([ALONG, 0.03 * np.sin(8 * ALONG), np.full(15, 0.005)])
              + np.random.default_rng(0).normal(0, 5e-4, (15, 3)))
OPTIONS = Options(workers=1, nodes=15, time_step=0.006)
BOTH = 'flexibility 5, friction 8'
QUICK = {'kinds': ['drag'], 'speed': 0.5, 'pause': 0.0}  # few candidates, and short rollouts


def asked(**limits):
    return advise((), OPTIONS, AdviceOptions(**{**QUICK, 'wanted': BOTH, **limits}), start=START)


FIRST = functools.cache(asked)


@pytest.mark.long
def test_the_first_action_is_expected_to_tell_what_is_wanted_and_is_the_same_each_time():
    first, again = FIRST(), asked()
    assert first.words == again.words
    assert all((hand.positions == other.positions).all() for hand, other in zip(
        first.action.hands, again.action.hands, strict=True))
    assert set(first.distances) == {'flexibility', 'friction'}
    assert all(expected < now / 3 for now, expected, _ in first.distances.values())
    assert first.trials >= 1 and not first.reached


@pytest.mark.long
def test_an_action_keeps_to_the_reach_of_its_hand_the_kinds_and_the_height():
    action = asked(kinds=['grasp_and_place'], reach_1='box 0.25 -0.1 -1 0.7 0.1 1', height=0.03).action
    hand, = action.hands
    assert hand.positions[:, 0].min() >= 0.25 and np.abs(hand.positions[:, 1]).max() <= 0.1
    assert hand.positions[:, 2].max() <= START.points[:, 2].max() + 0.0301
    dragged, = FIRST().action.hands
    assert np.ptp(dragged.positions[:, 2]) < 0.005


@pytest.mark.long
def test_the_hands_wait_before_they_open():
    first = asked(pause=1.5)
    begin, end = first.pause
    hand = first.action.hands[0]
    assert end - begin == pytest.approx(1.5)
    assert hand.positions_at(np.array([begin]))[0] == pytest.approx(hand.positions_at(np.array([end]))[0])


def test_without_a_place_in_reach_there_is_no_action_and_the_reason_is_said():
    told = asked(reach_1='box 5 5 5 6 6 6')
    assert told.action is None and not told.reached
    assert 'hand_1 leaves its reach' in told.words


def known(std, trials=()):
    """Return options and appraised trials after which each parameter has a standard deviation."""
    before = Appraisal.before(OPTIONS.space.free, OPTIONS.space.default_point())
    std = np.array(std)
    return Appraised(replace(before, uncertainty=replace(
        before.uncertainty, std=std, covariance=np.diag(std**2), scale=1e-3)), trials)


@pytest.mark.long
def test_it_ends_when_each_wanted_parameter_is_certain_enough():
    certain = [0.01, 0.28, 0.02, 0.28]
    limits = AdviceOptions(**QUICK, wanted=BOTH)
    trial = Trial('trial 1', START, (FIRST().action,), (Goal(START, 60.0),))
    after_one = next_action(known(certain, (trial,)), OPTIONS, limits, START, make_simulator)
    assert not after_one.reached and after_one.action is not None  # one trial shows no error of its own
    told = next_action(known(certain, (trial, trial)), OPTIONS, limits, START, make_simulator)
    assert told.reached and told.action is None


@pytest.mark.long
def test_it_says_after_two_trials_what_the_hands_cannot_show():
    """A DLO that may not be laid over itself does not show how thick it is."""
    limits = AdviceOptions(**QUICK, wanted=f'{BOTH}, self_collision 5')
    trial = Trial('trial 1', START, (FIRST().action,), (Goal(START, 60.0),))
    told = next_action(known([0.01, 0.28, 0.02, 0.28], (trial, replace(trial, name='trial 2'))), OPTIONS,
                       limits, START, make_simulator)
    assert told.action is None and not told.reached
    assert told.hopeless == ('self_collision',)
    assert 'self_collision: ± 46.1 of 100 now' in told.words


@pytest.mark.long
def test_a_dlo_out_of_reach_is_only_tidied():
    """A hand reaches little of the DLO: whatever it would learn, the DLO must come into its reach first."""
    told = asked(reach_1='box 0.45 -0.4 -1 1.3 0.4 1')
    assert told.words.startswith('only to lay the DLO where it can be moved')
    hand, = told.action.hands
    assert hand.positions[-1, 0] > hand.positions[0, 0] + 0.1


def test_what_is_wanted_is_read_from_a_text():
    assert read_targets('flexibility 2, friction 3.5') == {
        'flexibility': pytest.approx(0.02 * 6.5 / 4.5), 'friction': 0.035}
    assert read_targets('EI 5 %')['flexibility'] == pytest.approx(np.log(1.05) / np.log(10**4.5))
    identifiable = wanted_deviations('', ParameterSpace())
    assert 2 * DEVIATIONS * identifiable == pytest.approx([0.2] * 4)
    assert wanted_deviations('friction 3', ParameterSpace())[0] == np.inf


@pytest.mark.parametrize('text, said', [
    ('flexibility', 'a name and a number'), ('flexibility 0', 'a name and a number'),
    ('flexibilty 2', 'flexibility'), ('friction 2, mu 3', 'friction twice'),
    ('natural_curvature 5 %', 'leave the % out'), ('flexibility 2; friction 3', 'a name and a number')])
def test_a_text_that_says_nothing_is_refused(text, said):
    with pytest.raises(InputError, match=said):
        AdviceOptions(wanted=text)


def test_what_is_wanted_must_be_calibrated():
    with pytest.raises(InputError, match='add damping to calibrate'):
        advise((), OPTIONS, AdviceOptions(wanted='damping 5'), start=START)


def test_a_dlo_that_a_hand_holds_is_not_at_rest():
    with pytest.raises(InputError, match='no DLO at rest'):
        resting(())


def test_a_shared_error_costs_information():
    """With the toy, whose points move linearly, the standard deviations follow from the formula."""
    space = ParameterSpace(('flexibility', 'friction'))
    trial = toy_trial({'flexibility': 58.5, 'friction': 60.0})
    unknown = Appraisal.before(space.free, space.default_point()).uncertainty
    points = np.array([[0.3, 0.4], [0.6, 0.5]])
    alone, shared = (Expectation.of([trial], space, Pool(ToySimulator()), points, unknown, 1e-3, 1.0,
                                    np.array([0.01, 0.01]), noise)
                     for noise in (0.0, 0.01))
    assert (shared.expected(0) > 1.5 * alone.expected(0)).any()
    assert alone.foreseen()[0] <= shared.foreseen()[0]
