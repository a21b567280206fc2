# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Late and shifted hands of a made-up stream: seen from the chains, calibrated, and corrected."""

import argparse
from dataclasses import replace
from functools import cache
import re

from made_up_stream import MASS, messages, reversed_trial, TRUTH
import numpy as np
import pytest

from dlo_calibration import calibrate, Chain, InputError, Options
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.cli.arguments import add_options, given_options
from dlo_calibration.files.request import (
    GoalRequest,
    read_request,
    Request,
    request_trials,
    TrialRequest,
    write_request,
)
from dlo_calibration.files.result import read_result, write_result
from dlo_calibration.messages.codec import GOAL
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.parameters import HANDS
from dlo_calibration.workspace.validation import validated
from dlo_calibration.workspace.worker import Failure, Worker

PHYSICS = ('flexibility', 'friction')
GIVEN = {name: value for name, value in TRUTH.items() if name not in PHYSICS}


def collected(sent, **more):
    """Return the trials, and the warnings while they came."""
    collector = TrialCollector(Options(mass=MASS, **more))
    for message in sent:
        collector.add(message)
    warnings = collector.take_warnings()
    return collector.trials, warnings


@cache
def fit(names=PHYSICS, late=0.0, shift=(0.0, 0.0, 0.0), draw=1, **more):
    trials, _ = collected(messages(late, shift, draw))
    return calibrate(trials, Options(mass=MASS, engine='compiled', workers=1, parts=1, calibrate=names,
                                     values=GIVEN, **more))


def width(result, name):
    return result.parameters[name].upper - result.parameters[name].lower


@pytest.mark.long
def test_late_and_shifted_hands_come_back_within_their_intervals():
    right, wrong = fit(), fit((*PHYSICS, *HANDS[:3]), late=-0.08, shift=(0.015, 0.0, 0.0))
    physical = {name: wrong.parameters[name] for name in HANDS[:3]}
    for name, truth in zip(HANDS, (-0.08, 0.015, 0.0), strict=False):
        assert physical[name].physical_lower <= truth <= physical[name].physical_upper, name
    assert [physical[name].physical_unit for name in HANDS[:3]] == ['s', 'm', 'm']
    assert physical['hand_delay'].identifiable
    assert wrong.unusable == ''
    for name in PHYSICS:
        assert right.parameters[name].lower <= wrong.values[name] <= right.parameters[name].upper \
            or wrong.parameters[name].lower <= right.values[name] <= wrong.parameters[name].upper, name


@pytest.mark.long
def test_hands_that_are_right_cost_the_other_intervals_little():
    right, *wider = fit(), *(fit((*PHYSICS, *HANDS[:3]), draw=draw) for draw in (1, 2, 3, 4))
    hands = [result.parameters[name] for result in wider for name in HANDS[:3]]
    assert sum(hand.lower <= 50 <= hand.upper for hand in hands) >= 9  # of 12, 90 % each
    assert max(abs(hand.value - 50) / hand.std for hand in hands) < 3.5
    for name in PHYSICS:
        assert width(wider[0], name) <= 1.1 * width(right, name), name


@pytest.mark.long
def test_an_error_that_is_not_corrected_makes_the_result_unusable_and_names_the_remedy():
    result = fit(late=-0.08)
    assert "hands' stamps seem" in result.unusable and 'add hand_delay to calibrate' in result.unusable
    given = fit(late=-0.08, hand_delay=-0.08)
    assert given.unusable == ''
    assert given.values == pytest.approx(fit().values, abs=2.0)


def test_errors_of_all_hands_are_said_once_while_the_trials_come():
    _, warnings = collected(messages(late=-0.08))
    text, = warnings
    assert "hands' stamps seem" in text and 'early' in text and 'corrected as hand_delay' in text
    assert collected(messages(late=-0.08), hand_delay=-0.08)[1] == ()
    assert collected(messages())[1] == ()
    _, warnings = collected(messages(shift=(0.018, 0.0, 0.0)))
    assert len(warnings) == 1 and 'off in x' in warnings[0]


def test_a_reversed_trial_is_named_alone():
    _, warnings = collected(reversed_trial(messages(), 1))
    text, = warnings
    assert text.startswith('trial 2: a goal chain at') and 'from the other end' in text


def test_a_repeated_trial_is_named_as_it_comes():
    sent = messages()
    later = [replace(message, stamp=message.stamp + 10**12) for message in sent[:60]]
    _, warnings = collected([*sent, *later])
    assert any(text.startswith('trial 4') and 'trial 1, bit for bit' in text for text in warnings)


def test_a_grip_that_nobody_named_stays_so_in_messages_and_requests(tmp_path):
    trials, _ = collected(messages())
    assert all(hand.nearest for trial in trials for hand in trial.hands)
    again, _ = collected(trial_messages(trials, 'world'))
    requested = [TrialRequest(trial.name, trial.initial, trial.actions, tuple(
        GoalRequest(goal.chain, goal.time, goal.stable) for goal in trial.goals)) for trial in trials]
    write_request(tmp_path / 'request.xml', Request(tuple(requested)))
    request = read_request(tmp_path / 'request.xml')
    read, _ = request_trials(request, Options(frame_pose='1 0 0 0 0 0 1'))
    for others in (again, read):
        for trial, other in zip(trials, others, strict=True):
            for hand, its in zip(trial.hands, other.hands, strict=True):
                assert its.nearest
                assert (its.grips, its.offset) == (hand.grips, pytest.approx(hand.offset, abs=1e-6))


@pytest.mark.long
def test_a_result_corrects_the_hands_of_the_trials_that_it_is_validated_on(tmp_path):
    wrong = fit((*PHYSICS, *HANDS[:3]), late=-0.08, shift=(0.015, 0.0, 0.0))
    write_result(tmp_path / 'result.xml', wrong)
    file = read_result(tmp_path / 'result.xml')
    for name in HANDS[:2]:
        assert file.physical()[name] == pytest.approx(wrong.physical()[name], rel=1e-6)
    trials, _ = collected(messages(-0.08, (0.015, 0.0, 0.0)))
    options = Options(mass=MASS, engine='compiled', workers=1)
    assert validated(file, trials, options).errors.mean == pytest.approx(wrong.errors.mean, rel=1e-3)
    right, _ = collected(messages())
    elsewhere = validated(file, right, options)
    assert elsewhere.errors.mean == pytest.approx(wrong.errors.mean, rel=0.2)
    assert not elsewhere.unusable
    assert [text.partition(':')[0] for text in elsewhere.warnings] == list(HANDS[:2])
    assert set(elsewhere.parameters) == set(PHYSICS) | {HANDS[2]}
    first, *others = right
    missed = [replace(first, goals=tuple(replace(g, chain=first.initial) for g in first.goals)), *others]
    assert [trial.name for trial in validated(file, missed, options).trials] == ['trial 2', 'trial 3']
    with pytest.raises(InputError, match='no trial to use: in trial 1, hand has missed the DLO'):
        validated(file, missed[:1], options)


@pytest.mark.long
def test_a_result_is_not_usable_on_trials_of_another_dlo(tmp_path):
    write_result(tmp_path / 'result.xml', fit())
    file, options = read_result(tmp_path / 'result.xml'), Options(mass=MASS, engine='compiled', workers=1)
    trials, _ = collected(messages())
    assert not validated(file, trials, options).unusable
    stiff = replace(file, parameters={**file.parameters, 'flexibility': replace(
        file.parameters['flexibility'], value=37.7)})
    assert re.match(r'the mean error is \d+\.?\d* times that of the calibration', validated(
        stiff, trials, options).unusable)


@pytest.mark.long
def test_a_result_with_given_errors_of_the_hands_keeps_them(tmp_path):
    given = fit((*PHYSICS,), late=-0.08, hand_delay=-0.08)
    write_result(tmp_path / 'fixed.xml', given)
    assert read_result(tmp_path / 'fixed.xml').physical()['hand_delay'] == pytest.approx(-0.08)


@pytest.mark.long
def test_trials_that_all_hands_missed_are_refused_in_a_sentence():
    trials, warnings = collected([
        replace(message, chain=Chain(messages()[0].chain.points)) if message.kind == GOAL else message
        for message in messages()[:60]])
    assert any('has missed the DLO' in text for text in warnings)
    with pytest.raises(InputError, match='no trial to use: in trial 1, hand has missed the DLO') as refusal:
        calibrate(trials, Options(mass=MASS, engine='compiled', workers=1))
    assert str(refusal.value).endswith('repeat the trials')


def test_errors_of_hands_are_options_of_the_command_line():
    parser = argparse.ArgumentParser()
    add_options(parser, HANDS)
    chosen = parser.parse_args(['--hand-delay', '-0.08', '--hand-shift-x', '-0.015'])
    assert given_options(chosen) == {'hand_delay': -0.08, 'hand_shift_x': -0.015}


def test_predictions_of_recorded_actions_correct_shifted_hands():
    collector = TrialCollector(Options(mass=MASS))
    for message in messages(shift=(0.015, 0.0, 0.0)):
        collector.add(message)
    recorded, _ = collector.manipulations()
    shift = np.array([0.015, 0.0, 0.0])
    for manipulation in recorded:
        moved = manipulation.with_shifted_hands(shift)
        (action,), (other,) = manipulation.steps[0].actions, moved.steps[0].actions
        for hand, its in zip(action.hands, other.hands, strict=True):
            np.testing.assert_allclose(its.positions, hand.positions - shift)
            place, = manipulation.start.gripped(its.grips, its.offset)
            assert np.linalg.norm(place - its.positions[0]) < 0.005


@pytest.mark.long
def test_a_calibration_without_a_usable_trial_ends_with_the_reason():
    trials, _ = collected([
        replace(message, chain=Chain(messages()[0].chain.points)) if message.kind == GOAL else message
        for message in messages()[:60]])
    worker = Worker(make_simulator)
    worker.start(trials, Options(mass=MASS, engine='compiled', workers=1))
    assert worker.join(60.0)
    *_, end = worker.waiting_events()
    assert isinstance(end, Failure)
    assert 'no trial to use: in trial 1, hand has missed the DLO' in str(end)
