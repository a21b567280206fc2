# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials as messages: collected again, they are the same trials."""

from pathlib import Path

import numpy as np
import pytest

from dlo_calibration.calibration.options import Options
from dlo_calibration.files.request import read_request, request_trials
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import action_message, trial_messages
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Goal, Trial

SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples'
POINTS = np.stack([np.linspace(0, 0.5, 6), 0.01 * np.arange(6) ** 2, 0.004 + np.zeros(6)], axis=1)


def collected(trials):
    collector = TrialCollector(Options())
    for message in trial_messages(trials, 'world'):
        collector.add(message)
    assert not collector.refusals
    return collector.trials


def assert_same(collected_trials, trials):
    assert len(collected_trials) == len(trials)
    for received, sent in zip(collected_trials, trials, strict=True):
        np.testing.assert_array_equal(received.initial.points, sent.initial.points)
        assert (received.velocity is None) == (sent.velocity is None)
        if received.velocity is not None:
            np.testing.assert_allclose(received.velocity, sent.velocity, atol=1e-9)
        begin = received.hands[0].start - sent.hands[0].start  # time before the first closing is idle
        assert len(received.hands) >= len(sent.hands)  # a hand that goes on holding may come once more
        for b in sent.hands:
            a, = (a for a in received.hands if a.name == b.name and abs(a.start - begin - b.start) < 3e-9)
            assert a.grips == b.grips
            assert a.offset == pytest.approx(b.offset, abs=1e-3)
            assert a.end - begin == pytest.approx(b.end, abs=3e-9)
            np.testing.assert_allclose(a.positions_at(b.times + begin), b.positions, atol=1e-7)
        for a, b in zip(received.goals, sent.goals, strict=True):
            np.testing.assert_array_equal(a.chain.points, b.chain.points)
            assert a.time - begin == pytest.approx(b.time, abs=3e-9)
            assert a.stable == b.stable
            assert {hand.name for hand in received.holding(a)} == {hand.name for hand in sent.holding(b)}


@pytest.mark.parametrize('name', ['object1', 'object4', 'object5'])
def test_trials_of_a_session_are_the_same_again(name):
    session = read_session(SAMPLES / name)
    trials = session.trials
    assert_same(collected(trials), trials)


@pytest.mark.parametrize('name', ['named_actions', 'hand_paths', 'push_and_release'])
def test_trials_of_a_request_are_the_same_again(name):
    request = read_request(SAMPLES / 'xml' / f'{name}.xml')
    trials, _ = request_trials(request, request.file_options.options())
    assert_same(collected(trials), trials)


def test_a_tracked_trial_with_two_hands_of_their_own_times_is_the_same_again():
    left = Hand('left', (0, 1), [0.0, 0.4, 1.0], [POINTS[0], POINTS[0] + (0, 0, 0.1), POINTS[0]],
                [[0, 0, 0, 1], [0, 0, 0.6, 0.8], [0, 0, 0, 1]])
    right = Hand('right', (5,), [0.25, 0.8], [POINTS[5], POINTS[5] + (0, 0.05, 0)])
    goals = tuple(Goal(Chain(POINTS + (0, 0, 0.01 * t)), t, stable=False) for t in (0.1, 0.5, 1.0))
    velocity = np.tile((0.1, -0.2, 0.3), (6, 1))
    trial = Trial('tracked', Chain(POINTS), (Action((left, right)),), goals, velocity)
    assert_same(collected([trial]), [trial])


def moved(name, grip, start, to, begin=None):
    begin = POINTS[grip] if begin is None else begin
    return Action((Hand(name, (grip,), [start, start + 1.0], [begin, np.add(begin, to)]),))


ASIDE = (0, 0.1, 0)


def between(name, grip, offset, start):
    begin, = Chain(POINTS).gripped((grip,), offset)
    return Action((Hand(name, (grip,), [start, start + 1.0], [begin, begin + ASIDE], offset=offset),))


@pytest.mark.parametrize('actions, held_by', [
    ([moved('left', 0, 0, ASIDE), moved('right', 5, 3, ASIDE)], ()),
    ([moved('left', 0, 0, ASIDE), moved('left', 5, 3, ASIDE)], ()),
    ([moved('left', 0, 0, ASIDE), moved('left', 0, 3, ASIDE, POINTS[0] + ASIDE)], ()),
    ([moved('left', 0, 0, ASIDE), moved('right', 5, 3, ASIDE)], ('left',)),
    ([moved('left', 0, 0, ASIDE), moved('right', 5, 3, ASIDE)], ('left', 'right')),
    ([moved('left', 0, 0, ASIDE), moved('a', 5, 3, ASIDE), moved('b', 2, 6, ASIDE)], ('left', 'a')),
    ([between('left', 2, 0.3, 0), moved('right', 5, 3, ASIDE)], ('left', 'right')),
    ([moved('right', 5, 0, ASIDE), between('left', 2, -0.4, 3)], ()),
], ids=['two hands', 'one hand twice', 'one point twice', 'the first holds', 'both hold', 'three hands',
        'one between points holds', 'one between points'])
def test_actions_after_each_other_without_a_goal_between_keep_their_grips(actions, held_by):
    goal = Goal(Chain(POINTS + ASIDE), 8.0, True, held_by)
    trial = Trial('in turn', Chain(POINTS), tuple(actions), (goal,))
    assert_same(collected([trial]), [trial])


def test_hands_with_times_of_their_own_share_the_waypoints_of_one_message():
    half = 0.5**0.5
    early = Hand('early', (0,), [1.0, 3.0], [[0, 0, 0], [0.2, 0, 0]], [[0, 0, 0, 1], [0, 0, half, half]])
    late = Hand('late', (5,), [2.0, 3.0, 4.0], [[1, 0, 0], [1, 0, 0.1], [1, 0.1, 0]])
    message = action_message((early, late), 7, 'table')
    assert (message.stamp, message.frame_id, message.names) == (7, 'table', ('early', 'late'))
    np.testing.assert_array_equal(message.times, [0, 1, 2, 3])
    np.testing.assert_allclose(message.positions[:, 0, 0], [0, 0.1, 0.2, 0.2])
    np.testing.assert_allclose(message.positions[:, 1, 2], [0, 0, 0.1, 0])
    np.testing.assert_allclose(2 * np.arcsin(message.orientations[:, 0, 2]), np.radians([0, 45, 90, 90]))
    np.testing.assert_array_equal(message.orientations[:, 1], np.tile([0, 0, 0, 1], (4, 1)))


def test_points_that_were_not_seen_stay_unseen():
    hidden = [POINTS + (0, 0.01 * k, 0) for k in range(3)]
    for k, points in enumerate(hidden):
        points[k + 1] = np.nan
    velocity = np.tile([0.2, 0.0, 0.1], (6, 1))
    trial = Trial('trial 1', Chain(hidden[0]), (moved('left', 0, 0.0, ASIDE),),
                  (Goal(Chain(hidden[1]), 0.5, False), Goal(Chain(hidden[2]), 5.0)), velocity)
    trials, = collected([trial])
    for chain, seen in zip([trials.initial, *(goal.chain for goal in trials.goals)], hidden, strict=True):
        np.testing.assert_array_equal(chain.observed, seen)
    np.testing.assert_allclose(trials.velocity, velocity, atol=1e-9)
