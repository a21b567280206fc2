# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Wrenches that hands publish: the forces of trials that follow from them, and which are refused."""

from dataclasses import replace
import random

from felt_trials import felt_trials
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wire import SOURCES, wire

from dlo_calibration import InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.messages.codec import ACTION, built, read, WRENCH, WrenchMessage
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.pose import Pose

SECOND = 10**9
DOWN = np.array([0.1, 0.2, -2.0])


@pytest.fixture(scope='module')
def felt():
    """Give two trials with forces."""
    return felt_trials(1)[:2]


def collected(messages, **options):
    collector = TrialCollector(Options(**options))
    for message in messages:
        collector.add(message)
    return collector


def forces(trials):
    return [[(k, hand.name, force.tared) for k, hand, force in trial.forces] for trial in trials]


def vectors(trials):
    return np.array([force.vector for trial in trials for *_, force in trial.forces])


def with_wrenches(trial, at_closing, later, name='hand_1', turned=None):
    """
    Return messages of a trial whose hand measures at 100 Hz, from 2 s before it closes to 9 s after.

    :param turned: rotation of the hand from its first lift on.
    """
    messages = [message for message in trial_messages([trial], 'world') if message.kind != WRENCH]
    action = next(message for message in messages if message.kind == ACTION)
    if turned is not None:
        turns = np.repeat(action.orientations[:1], len(action.times), axis=0)
        turns[1:] = turned.as_quat()
        messages[messages.index(action)] = replace(action, orientations=turns)
    for k in range(-200, 900):
        force = at_closing if k < 0 else later
        messages.append(WrenchMessage(action.stamp + k * SECOND // 100, name, force))
    return messages


@pytest.mark.parametrize('source', SOURCES)
def test_a_wrench_travels_to_the_digit(source):
    types = SOURCES[source]()
    sent = WrenchMessage(12 * SECOND + 5, 'tool0', np.array([1 / 3, -2.5, 1e-9]))
    received = read(WRENCH, wire(types)(built(types, sent)))
    assert (received.stamp, received.frame_id) == (sent.stamp, 'tool0')
    np.testing.assert_array_equal(received.force, sent.force)


def test_trials_with_forces_are_the_same_again(felt):
    again = collected(trial_messages(felt, 'world')).trials
    assert forces(again) == forces(felt)
    np.testing.assert_allclose(vectors(again), vectors(felt), atol=1e-8)


def test_the_order_of_arrival_does_not_matter(felt):
    messages = trial_messages(felt, 'world')
    before = vectors(collected(messages).trials)
    random.Random(1).shuffle(messages)
    np.testing.assert_array_equal(vectors(collected(messages).trials), before)


def test_what_a_hand_measures_before_it_closes_is_subtracted(felt):
    weight = np.array([0, 0, -8.0])
    trial, = collected(with_wrenches(felt[0], weight, weight + DOWN)).trials
    assert forces([trial]) == [[(0, 'hand_1', True), (1, 'hand_1', True)]]
    np.testing.assert_allclose(vectors([trial]), [DOWN, DOWN], atol=1e-8)


def test_without_that_the_offset_is_unknown(felt):
    messages = with_wrenches(felt[0], DOWN, DOWN)
    closed = next(message.stamp for message in messages if message.kind == ACTION)
    trial, = collected(each for each in messages if each.kind != WRENCH or each.stamp > closed).trials
    assert forces([trial]) == [[(0, 'hand_1', False), (1, 'hand_1', False)]]


def test_a_hand_that_turns_about_the_vertical_measures_in_its_own_axes(felt):
    yaw = Rotation.from_euler('z', 90, degrees=True)
    weight = np.array([0, 0, -8.0])
    trial, = collected(with_wrenches(felt[0], weight, weight + yaw.inv().apply(DOWN), turned=yaw)).trials
    np.testing.assert_allclose(vectors([trial]), [DOWN, DOWN], atol=1e-8)


def test_where_a_hand_has_tilted_the_weight_of_the_gripper_is_unknown_and_nothing_counts(felt):
    tilt = Rotation.from_euler('x', 5, degrees=True)
    collector = collected(with_wrenches(felt[0], DOWN, DOWN, turned=tilt))
    assert collector.trials[0].forces == ()
    assert 'has not turned since it closed' in str(collector.force_problems[0])


def test_forces_are_in_the_frame_of_the_table(felt):
    pose = Pose(np.array([0.3, 0, 1]), Rotation.from_euler('xyz', [180, 0, 30], degrees=True).as_quat())
    there = [pose.inverse.trial(trial) for trial in felt]
    again = collected(trial_messages(there, 'camera'), frame_pose=str(pose)).trials
    np.testing.assert_allclose(vectors(again), vectors(felt), atol=1e-8)


@pytest.mark.parametrize('force', [(0, 0, np.nan), (0, np.inf, 0), (1e9, 0, 0)])
def test_a_wrench_that_is_no_force_is_refused(force):
    with pytest.raises(InputError, match='wrench stamped 1 s of .tool0.: .*finite numbers'):
        WrenchMessage(SECOND, 'tool0', np.array(force, float))


@pytest.mark.parametrize(('stamp', 'frame', 'words'), [
    (0, 'tool0', 'a stamp of zero'), (-5, 'tool0', 'a negative stamp'), (5, '', 'an empty frame_id')])
def test_a_wrench_without_time_or_hand_is_refused(stamp, frame, words):
    with pytest.raises(InputError, match=words):
        WrenchMessage(stamp, frame, DOWN)


def test_a_wrench_of_an_unknown_hand_is_named_and_the_trials_stay(felt):
    collector = collected(with_wrenches(felt[0], DOWN, DOWN, name='ft_sensor'))
    assert collector.count == 1
    problem, = collector.force_problems
    assert "'ft_sensor'" in str(problem)
    assert 'hand_1' in str(problem)


@pytest.mark.parametrize('late', [1000, 10**9])
def test_wrenches_at_another_time_are_not_used_and_it_is_said(felt, late):
    messages = [replace(message, stamp=message.stamp + late * SECOND) if message.kind == WRENCH else message
                for message in with_wrenches(felt[0], DOWN, DOWN)]
    collector = collected(messages)
    assert collector.trials[0].forces == ()
    assert 'publish ~/wrench all the time, with the clock of the chains' in str(collector.force_problems[0])


def test_a_trial_stays_the_same_object_until_a_force_changes(felt):
    messages = with_wrenches(felt[0], DOWN, DOWN)
    collector = collected(messages)
    trial, = collector.trials
    collector.add(WrenchMessage(messages[-1].stamp + SECOND, 'hand_1', DOWN))
    assert collector.trials[0] is trial
    goal = messages[0].stamp + SECOND // 100 + round(trial.goals[-1].time * SECOND)
    collector.add(WrenchMessage(goal, 'hand_1', 3 * DOWN))
    assert collector.trials[0] is not trial
