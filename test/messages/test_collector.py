# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials follow from the stamps of the messages, not from the order of their arrival."""

from collections import Counter
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from trial_contents import anew, contents

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages import checked_messages
from dlo_calibration.messages import collector as module
from dlo_calibration.messages.codec import ActionMessage, ChainMessage, GOAL, INITIAL
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.model.chain import Chain
from dlo_calibration.observation.rest import Stream

START = 1_700_000_000.0


def ns(seconds):
    return round((START + seconds) * 1000) * 1_000_000


def chain(kind, at, *, move=0.0, count=11, length=1.0, hands=None, frame='world'):
    points = np.zeros((count, 3))
    points[:, 0] = np.linspace(0, length, count)
    points[:, 1] = move
    return ChainMessage(kind, ns(at), frame, Chain(points, hands))


def initial(at, **rest):
    return chain(INITIAL, at, **rest)


def goal(at, **rest):
    return chain(GOAL, at, **rest)


def action(at, times=(0.0, 1.0), names=('left_hand',), grips=(0,), away=0.0, frame='world', length=1.0,
           begin=0.0):
    """Hands that close `away` from points of a straight chain of 11, and rise by 0.1 m from `begin`."""
    positions = np.zeros((len(times), len(names), 3))
    positions[:, :, 0] = np.array(grips) / 10 * length
    positions[:, :, 1] = away
    positions[:, :, 2] = begin + np.linspace(0, 0.1, len(times))[:, None]
    orientations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), len(names), 1))
    return ActionMessage(ns(at), frame, names, np.array(times), positions, orientations)


def collect(*messages, **options):
    collector = TrialCollector(Options(**options))
    for message in messages:
        collector.add(message)
    return collector


def only(*messages, **options):
    trial, = collect(*messages, **options).trials
    return trial


def refused(collector, message):
    """Return the refusal's text; it names the message, and the trials stay as they were."""
    before = contents(collector.trials)
    with pytest.raises(InputError) as caught:
        collector.add(message)
    assert contents(collector.trials) == before
    text = str(caught.value)
    assert text.startswith(f'{message}: ')
    return text


# ---- what makes a trial

def test_one_chain_of_each_and_an_action_make_a_trial():
    collector = collect(initial(1), action(2), goal(10, move=0.3))
    assert collector.count == 1
    trial, = collector.trials
    assert trial.name == 'trial 1'
    assert trial.velocity is None
    hand, = trial.hands
    assert (hand.name, hand.grips) == ('left_hand', (0,))
    np.testing.assert_allclose(trial.goals[0].chain.points[:, 1], 0.3)


def test_initial_chain_after_a_goal_or_an_action_begins_the_next_trial():
    trials = collect(
        initial(1), action(2), goal(5), initial(6, move=0.1), action(7, away=0.1), goal(9), goal(10),
        initial(11), action(12), initial(13, move=0.2), action(14, away=0.2), goal(16)).trials
    assert [t.name for t in trials] == ['trial 1', 'trial 2', 'trial 3']
    assert [t.initial.points[0, 1] for t in trials] == [0, 0.1, 0.2]
    assert [len(t.goals) for t in trials] == [1, 2, 1]


def test_message_order_at_equal_stamps_is_initial_action_goal():
    trial = only(goal(1), action(1), initial(1))
    assert len(trial.actions) == len(trial.goals) == 1


def test_two_hands_may_send_actions_of_their_own_at_one_instant():
    trial = only(initial(1), action(2), action(2, names=('right_hand',), grips=(10,)), goal(9))
    assert [hand.name for hand in trial.hands] == ['left_hand', 'right_hand']


# ---- the start

def test_last_initial_chain_in_a_row_is_where_the_dlo_is():
    trial = only(initial(1), initial(2, move=0.1), initial(3, move=0.2), action(4, away=0.2), goal(9))
    np.testing.assert_allclose(trial.initial.points[:, 1], 0.2)
    assert trial.velocity is None


@pytest.mark.parametrize(('elapsed', 'moving'), [(0.04, True), (0.099, True), (0.1, False), (3, False)])
def test_earlier_chain_less_than_a_tenth_of_a_second_older_gives_the_velocity(elapsed, moving):
    trial = only(initial(2 - elapsed), initial(2, move=0.02), action(2.5, away=0.02), goal(9))
    if moving:
        np.testing.assert_allclose(trial.velocity, np.tile([0, 0.02 / elapsed, 0], (11, 1)))
    else:
        assert trial.velocity is None


def test_of_several_earlier_chains_the_latest_gives_the_velocity():
    trial = only(initial(1.94), initial(1.97, move=0.01), initial(2, move=0.016), action(2.5), goal(9))
    np.testing.assert_allclose(trial.velocity[:, 1], 0.2)


def test_chain_with_other_points_gives_no_velocity():
    assert only(initial(1.97, count=12), initial(2), action(2.5), goal(9)).velocity is None


def test_goal_between_two_initial_chains_parts_them():
    assert only(initial(1.97), goal(1.98), initial(2), action(2.5), goal(9)).velocity is None


def test_clock_of_a_moving_start_begins_with_the_chain():
    trial = only(initial(1.97), initial(2, move=0.01), action(3, times=(0.5, 1.5)), goal(4), goal(6))
    np.testing.assert_array_equal(trial.hands[0].times, [1.5, 2.5])
    assert [g.time for g in trial.goals] == [2.0, 4.0]


def test_clock_of_a_start_at_rest_begins_when_the_first_hand_closes():
    trial = only(initial(2), action(30, times=(0.5, 1.5)), goal(31), goal(33))
    np.testing.assert_array_equal(trial.hands[0].times, [0, 1])
    assert [g.time for g in trial.goals] == [0.5, 2.5]


def test_clock_never_shows_a_negative_time():
    trial = only(initial(2), action(3, times=(5.0, 6.0)), goal(4), action(3.5), goal(20))
    assert [a.start for a in trial.actions] == [0.0, 4.5]
    trial = only(initial(2), action(3, times=(5.0, 6.0)), goal(4), goal(20))
    assert [g.time for g in trial.goals] == [0.0, 16.0]
    assert trial.actions[0].start == 4.0


# ---- other options

def test_other_options_judge_the_same_messages_again():
    collector = collect(initial(1), action(2), goal(5))
    refused(collector, goal(6, length=1.7))
    wide = anew(collector, Options(length_tolerance=100.0, release=False))
    assert [g.held_by for g in wide.trials[0].goals] == [('left_hand',)] * 2
    assert wide.refusals == ()
    assert [len(t.goals) for t in collector.trials] == [1]
    assert contents(anew(wide, Options()).trials) == contents(collector.trials)
    assert "expected 'world'" in refused(wide, initial(8, frame='map'))


# ---- trials that are taken back

FIRST, SECOND = (initial(1), action(2), goal(5)), (initial(11), action(12), goal(15))


@pytest.mark.parametrize('count', range(2, 4))
def test_the_newest_trial_is_discarded_complete_or_not_with_later_messages_of_a_tracker(count):
    collector = collect(*FIRST, *SECOND[:count])
    assert collector.take_back() == (ns(11), SECOND[count - 1].stamp)
    alone = contents(collect(*FIRST).trials)
    for message in (goal(16), goal(13, move=0.1), action(17), initial(11.5)):
        collector.add(message)
        assert contents(collector.trials) == contents(anew(collector, Options()).trials) == alone
    assert (collector.incomplete, collector.refusals, collector.loose_end) == ('', (), ())
    for message in (initial(21), action(22), goal(25)):
        collector.add(message)
    assert contents(collector.trials) == contents(collect(*FIRST, initial(21), action(22), goal(25)).trials)
    for _ in range(2):
        collector.take_back()
    with pytest.raises(InputError, match='no trial; expected one'):
        collector.take_back()


def test_initial_chains_of_the_next_trial_stay_when_a_trial_is_discarded():
    collector = collect(*FIRST, *SECOND, initial(20))
    assert collector.take_back() == (ns(11), ns(15))
    collector.add(goal(16))
    collector.add(initial(18))  # a late one, and an earlier start of a trial
    for message in (action(22), goal(25)):
        collector.add(message)
    assert contents(collector.trials) == contents(collect(*FIRST, initial(20), action(22), goal(25)).trials)


# ---- frames and repetitions

def test_another_frame_is_refused():
    collector = collect(initial(1))
    for message in (action(2, frame='map'), goal(3, frame=''), initial(4, frame='map')):
        text = refused(collector, message)
        assert f"frame_id {message.frame_id!r}; expected 'world'" in text


def test_repeated_stamp_is_refused():
    collector = collect(initial(1), action(2), goal(5))
    for message in (initial(1, move=1), action(2, away=0.01), goal(5, move=1)):
        assert f'a second {message.kind} with this stamp' in refused(collector, message)


def test_corrected_message_may_have_the_stamp_of_the_refused_one():
    collector = collect(initial(1))
    refused(collector, action(2, away=0.5))
    collector.add(action(2))
    refused(collector, goal(5, count=10))
    assert 'an action' not in collector.incomplete
    collector.add(goal(5))
    assert (collector.count, collector.refusals) == (1, ())


# ---- grips

def test_hand_grips_the_points_annotated_with_its_number():
    hands = [1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2]
    trial = only(initial(1, hands=hands), action(2, names=('a', 'b'), grips=(5, 6), away=3), goal(9))
    assert [hand.grips for hand in trial.hands] == [(0, 1), (8, 9, 10)]


def test_hand_without_annotation_grips_the_nearest_point():
    hands = [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    trial = only(initial(1, hands=hands), action(2, names=('a', 'b'), grips=(5, 6), away=0.019), goal(9))
    assert [hand.grips for hand in trial.hands] == [(0, 1), (6,)]


def test_hand_without_annotation_grips_between_points_at_the_nearest_place():
    trial = only(initial(1), action(2, names=('a', 'b'), grips=(5.3, 6.9), away=0.01), goal(9))
    assert [hand.grips for hand in trial.hands] == [(5,), (7,)]
    assert [hand.offset for hand in trial.hands] == pytest.approx([0.3, -0.1])


def test_hand_that_goes_on_holding_stays_where_it_grips():
    held = [0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]
    trial = only(initial(1), action(2, names=('a',), grips=(3.3,)), goal(4, hands=held),
                 action(5, names=('a',), grips=(3.3,)), goal(9))
    assert [a.hands[0].grips for a in trial.actions] == [(3,), (3,)]
    assert [a.hands[0].offset for a in trial.actions] == pytest.approx([0.3, 0.3])
    in_two = only(initial(1), action(2, names=('a',), grips=(3.3,), away=0.01),
                  action(4, names=('a',), grips=(3.3,), away=0.01, begin=0.1), goal(9))
    assert [(a.hands[0].grips, a.hands[0].offset) for a in in_two.actions] == 2 * [
        ((3,), pytest.approx(0.3))]


def test_hand_that_closes_too_far_away_is_refused():
    collector = collect(initial(1))
    text = refused(collector, action(2, away=0.03))
    assert 'left_hand closing 0.03 m from any point of initial_chain' in text
    assert 'at most 0.02 m (grip_tolerance)' in text
    collector = collect(initial(1), grip_tolerance=0.05)
    collector.add(action(2, away=0.03))


def test_two_hands_at_one_point_are_refused():
    collector = collect(initial(1))
    assert 'two hands that grip point 5' in refused(collector, action(2, names=('a', 'b'), grips=(5, 5)))


def test_later_action_grips_where_the_latest_chain_is():
    trial = only(initial(1), action(2), goal(4, move=0.3), action(5, grips=(7,), away=0.3), goal(9))
    assert [a.hands[0].grips for a in trial.actions] == [(0,), (7,)]
    collector = collect(initial(1), action(2), goal(4, move=0.3))
    assert 'from any point of goal_chain' in refused(collector, action(5))


def test_annotation_of_a_goal_counts_in_the_action_before_it():
    held = [0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0]
    trial = only(initial(1), action(2, names=('a',), grips=(3,)), goal(4, hands=held),
                 action(5, names=('b', 'a'), grips=(9, 3)), goal(9))
    assert [(h.name, h.grips) for h in trial.actions[1].hands] == [('b', (9,)), ('a', (3, 4))]
    trial = only(initial(1), action(2, names=('a',), grips=(3,)), goal(4, hands=held),
                 action(5, names=('b',), grips=(9,)), action(6, names=('a',), grips=(3,)), goal(9))
    assert [a.hands[0].grips for a in trial.actions] == [(3,), (9,), (3, 4)]


# ---- goals

@pytest.mark.parametrize(('at', 'stable'), [
    (2.5, False), (3, False), (4, False), (5, False), (5.001, True), (60, True)])
def test_goal_is_timed_until_the_last_waypoint(at, stable):
    trial = only(initial(1), action(2, times=(1.0, 3.0)), goal(at))
    assert trial.goals[0].stable is stable


def test_goal_between_actions_is_stable_and_one_while_any_hand_moves_is_not():
    first, second = action(2, times=(0.0, 4.0)), action(3, names=('b',), grips=(9,), times=(5.0, 8.0))
    trial = only(initial(1), first, second, goal(5), goal(7), goal(9), goal(11), goal(12))
    assert [g.stable for g in trial.goals] == [False, True, False, False, True]


def test_annotated_goal_gives_the_hands_that_hold():
    both = action(2, names=('a', 'b'), grips=(0, 9))
    trial = only(initial(1), both, goal(4, hands=[0] * 9 + [2, 2]), goal(5, hands=[0] * 11), goal(6))
    assert [g.held_by for g in trial.goals] == [('b',), (), ()]
    trial = only(initial(1), both, goal(4, hands=[0] * 9 + [2, 2]), goal(5, hands=[0] * 11), goal(6),
                 release=False)
    assert [g.held_by for g in trial.goals] == [('b',), (), ('a', 'b')]


def test_hand_that_never_opens_holds_in_every_goal_after_it_arrived():
    trial = only(initial(1), action(2, names=('a',)), goal(2.5), goal(4),
                 action(5, names=('b',), grips=(9,)), goal(5.5), goal(7), release=False)
    assert [g.held_by for g in trial.goals] == [(), ('a',), ('a',), ('a', 'b')]


def test_goal_that_annotates_a_hand_that_was_not_there_is_refused():
    collector = collect(initial(1), action(2))
    text = refused(collector, goal(4, hands=[2] + [0] * 10))
    assert 'points held by hand 2; expected hands 1 to 1 as in action' in text


def test_goal_with_other_points_is_refused():
    collector = collect(initial(1), action(2), goal(4))
    assert '12 points; expected 11 points as in initial_chain' in refused(collector, goal(5, count=12))


@pytest.mark.parametrize(('length', 'tolerance', 'fits'), [
    (1.49, 50, True), (1.51, 50, False), (0.51, 50, True), (0.49, 50, False), (1.0, 0, True),
    (1.01, 0, False)])
def test_goal_of_another_length_is_refused(length, tolerance, fits):
    collector = collect(initial(1), action(2), length_tolerance=tolerance)
    if fits:
        collector.add(goal(4, length=length))
        assert collector.count == 1
    else:
        assert f'at most {tolerance} % (length_tolerance)' in refused(collector, goal(4, length=length))


# ---- what comes late

def test_action_may_come_after_goals_observed_during_it():
    collector = collect(initial(1), *(goal(k / 10) for k in range(21, 50)))
    assert collector.incomplete.startswith('an action after initial_chain')
    assert '29 goal_chain waiting' in collector.incomplete
    collector.add(action(2, times=(0.0, 2.0)))
    trial, = collector.trials
    assert [g.stable for g in trial.goals] == [False] * 20 + [True] * 9


def test_late_goal_joins_the_trial_that_it_belongs_to():
    collector = collect(initial(1), action(2), goal(5), initial(6), action(7), goal(9))
    collector.add(goal(4))
    assert [len(t.goals) for t in collector.trials] == [2, 1]


def test_late_initial_chain_divides_a_trial():
    collector = collect(initial(1), action(2), goal(5), action(7), goal(9))
    assert collector.count == 1
    collector.add(initial(6))
    assert [len(t.actions) for t in collector.trials] == [1, 1]


def test_late_action_divides_a_row_of_initial_chains():
    collector = collect(initial(1), initial(1.05, move=0.01), initial(8), action(9), goal(11))
    collector.add(goal(5))
    collector.add(action(2, away=0.01))
    assert [t.initial.points[0, 1] for t in collector.trials] == [0.01, 0]
    assert collector.trials[0].velocity is not None


def test_refused_action_is_used_when_its_start_arrives_late():
    collector = collect(initial(1), action(2), goal(5))
    refused(collector, action(7, away=0.5))
    assert len(collector.refusals) == 1
    collector.add(initial(6, move=0.5))
    collector.add(goal(9))
    assert (collector.count, collector.refusals) == (2, ())


def test_refused_message_does_not_end_a_row_of_initial_chains():
    collector = collect(initial(1.95))
    refused(collector, action(1.97, away=0.5))
    for message in (initial(2, move=0.01), action(3), goal(9)):
        collector.add(message)
    trial, = collector.trials
    np.testing.assert_allclose(trial.velocity[:, 1], 0.2)


def test_messages_before_any_initial_chain_wait_for_it():
    collector = collect(action(2), goal(5))
    assert collector.incomplete.startswith('an initial_chain before action stamped')
    assert collector.trials == ()
    collector.add(initial(1))
    assert collector.count == 1


def test_messages_stamped_before_every_initial_chain_are_refused():
    collector = collect(initial(5))
    for message in (action(2), goal(3)):
        text = refused(collector, message)
        assert f'no initial_chain before it; expected one stamped earlier (the first is {initial(5)})' in text
    assert (collector.refusals, collector.take_refusals()) == ((), ())
    collector.add(initial(1))
    assert (collector.count, collector.refusals) == (1, ())


def test_waiting_messages_are_refused_together_if_the_first_initial_chain_is_later():
    collector = collect(goal(2), action(2.5), goal(4))
    assert collector.take_refusals() == ()
    collector.add(initial(5))
    refusal, = collector.take_refusals()
    assert str(refusal).startswith(f'{goal(2)} and 2 more: no initial_chain before them')
    assert collector.take_refusals() == ()
    collector.add(initial(1))  # late, but the refused messages are used after all
    assert (collector.count, collector.take_refusals()) == (1, ())


# ---- what status tells

def test_incomplete_names_the_messages_that_the_newest_trial_lacks():
    collector = collect()
    assert collector.incomplete == ''
    collector.add(initial(1))
    assert collector.incomplete == f'an action after {initial(1)}, and a goal_chain'
    collector.add(goal(1.5))
    assert collector.incomplete == f'an action after {initial(1)} (1 goal_chain waiting for it)'
    collector.add(action(2))
    assert collector.incomplete == f'a goal_chain after {action(2)}; {goal(1.5)} is before it'
    collector.add(goal(5))
    assert collector.incomplete == ''


def test_a_trial_that_the_next_one_cuts_off_is_refused():
    collector = collect(initial(1), action(2), initial(3))
    refusal, = collector.refusals
    assert f'no goal_chain between {action(2)} and {initial(3)}' in str(refusal)
    collector.add(goal(2.5))
    assert (collector.refusals, collector.count) == ((), 1)


def test_goals_without_action_before_the_next_trial_are_refused():
    collector = collect(initial(1), goal(2), goal(2.5), initial(3))
    refusal, = collector.refusals
    assert f'2 goal_chain, but no action between {initial(1)} and {initial(3)}' in str(refusal)
    assert collector.loose_end == ()


@pytest.mark.parametrize(('messages', 'words'), [
    ([goal(2), goal(3)], 'there is none'),
    ([initial(1), goal(2)], '1 goal_chain, but no action'),
    ([initial(1), action(2)], f'no goal_chain between {action(2)} and the end'),
])
def test_trial_that_the_end_cuts_off_is_a_loose_end(messages, words):
    collector = collect(*messages)
    refusal, = collector.loose_end
    assert words in str(refusal)
    assert collector.refusals == ()


@pytest.mark.parametrize('messages', [[], [initial(1)], [initial(1), action(2), goal(5)]])
def test_there_is_no_loose_end_before_a_trial_or_after_a_complete_trial(messages):
    assert collect(*messages).loose_end == ()


def test_same_trial_object_as_long_as_nothing_changes():
    collector = collect(initial(1), action(2), goal(5))
    before, = collector.trials
    collector.add(initial(6))
    assert collector.trials[0] is before
    collector.add(goal(5.5))
    assert len(collector.trials[0].goals) == 2


# ---- long streams

def test_an_hour_of_initial_chains_begins_one_trial(monkeypatch):
    monkeypatch.setattr(module, 'KEPT', 100)
    collector = TrialCollector(Options())
    first = initial(0)
    for k in range(2000):
        collector.add(replace(first, stamp=first.stamp + k * 33_000_000))
    text = refused(collector, action(10))
    assert 'after more than 50 later messages' in text
    collector.add(action(66))
    collector.add(goal(70))
    assert collector.trials[0].velocity is not None


def test_messages_that_trials_use_are_never_forgotten(monkeypatch):
    monkeypatch.setattr(module, 'KEPT', 20)
    collector = collect(initial(1), action(2, times=(0, 10)), *(goal(k / 10 + 2) for k in range(100)))
    before = contents(collector.trials)
    for k in range(300):
        collector.add((goal if k % 2 else initial)(20 + k))
    assert contents(collector.trials) == before
    collector.add(action(320))
    collector.add(goal(330))
    assert [len(t.goals) for t in collector.trials] == [100, 1]
    assert 'later messages' in refused(collector, action(150))


def test_refusals_do_not_pile_up(monkeypatch):
    monkeypatch.setattr(module, 'KEPT', 20)
    collector = collect(initial(1), action(2), goal(5))
    for k in range(100):
        refused(collector, goal(10 + k, count=12))
    assert len(collector.refusals) <= 20
    collector.add(goal(200))
    assert len(collector.trials[0].goals) == 2


@pytest.mark.parametrize(('name', 'most'), [('MOST_MESSAGES', 20), ('MOST_NUMBERS', 19 * 33 + 15)])
def test_messages_beyond_the_limit_are_refused_after_unused_ones_are_forgotten(monkeypatch, name, most):
    monkeypatch.setattr(module, name, most)
    collector = collect(initial(1), action(2, times=(0, 60)), goal(5))
    for k in range(10):
        refused(collector, goal(10 + k, count=12))
    for k in range(17):
        collector.add(goal(30 + k))
    assert collector.refusals == ()
    assert 'calibrate with these, or reset' in refused(collector, goal(60))
    assert [len(t.goals) for t in collector.trials] == [18]


# ---- any order of arrival

@st.composite
def sessions(draw):
    """Draw messages at different stamps, many of which do not fit, in any order of arrival."""
    messages = []
    for k in range(draw(st.integers(1, 14))):
        at = 1 + 0.05 * k + draw(st.sampled_from([0.0, 0.0, 0.02]))
        move = draw(st.sampled_from([0.0, 0.0, 0.0, 0.3]))
        kind = draw(st.sampled_from('iag'))
        if kind == 'a':
            names = draw(st.sampled_from([('a',), ('b',), ('a', 'b'), ('b', 'a')]))
            messages.append(action(at, names=names, grips=(0, 9)[:len(names)], away=move,
                                times=draw(st.sampled_from([(0.0, 0.04), (0.1, 0.12), (0.0,)]))))
        else:
            hands = draw(st.sampled_from([None, None, [0] * 11, [1, 2] + [0] * 9, [0, 1, 1] + [0] * 8]))
            messages.append((initial if kind == 'i' else goal)(at, move=move, hands=hands))
            if draw(st.integers(0, 5)) == 0:
                messages[-1] = chain(messages[-1].kind, at, count=12, move=move)
    return messages, draw(st.permutations(messages)), Options(release=draw(st.booleans()))


def feed(messages, options):
    """Collect what can be; check that no refusal changes a trial, and that refusals name their message."""
    collector = TrialCollector(options)
    for message in messages:
        before = contents(collector.trials)
        try:
            collector.add(message)
        except InputError as error:
            assert error.thing == str(message)
            assert contents(collector.trials) == before
    return collector


@drawing(40)
@given(session=sessions())
def test_any_order_of_arrival_gives_the_same_trials(session):
    ordered, arrived, options = session
    in_order, shuffled = feed(ordered, options), feed(arrived, options)
    assert contents(in_order.trials) == contents(shuffled.trials)
    assert in_order.count == shuffled.count == len(in_order.trials)
    assert in_order.incomplete == shuffled.incomplete
    assert list(map(str, in_order.refusals)) == list(map(str, shuffled.refusals))


@drawing(20)
@given(session=sessions(), again=st.data())
def test_messages_sent_twice_change_nothing(session, again):
    ordered, arrived, options = session
    twice = again.draw(st.permutations([*ordered, *ordered]))
    assert contents(feed(twice, options).trials) == contents(feed(arrived, options).trials)


ORDERS = {
    'in order': lambda messages: messages,
    'reversed': lambda messages: messages[::-1],
    'shuffled': lambda messages: [messages[k] for k in np.random.default_rng(1).permutation(len(messages))],
    'a little late': lambda messages: sorted(messages, key=lambda message: message.stamp // 200_000_000
                                             - message.stamp % 200_000_000 / 1e9),
    'goals reversed': lambda messages: sorted(messages, key=lambda message: (
        message.kind == GOAL, -message.stamp if message.kind == GOAL else message.stamp)),
    'goals, actions, chains': lambda messages: sorted(messages, key=lambda message: (
        ('goal_chain', 'action', 'initial_chain').index(message.kind))),
    'actions, chains, goals': lambda messages: sorted(messages, key=lambda message: (
        ('action', 'initial_chain', 'goal_chain').index(message.kind))),
}


def long_session(name, count):
    """Return at least `count` messages in order of their stamps."""
    if name == 'trials':
        return [message for k in range(0, 4 * count, 12)
                for message in (initial(k + 1), action(k + 2), goal(k + 6))]
    begin = [initial(1), action(2)]
    if name == 'actions':
        return begin + [message for k in range(count // 2)
                        for message in (goal(4 + k), action(4.5 + k, times=(0.0, 0.1)))]
    if name == 'swinging':
        return begin + stream(3.2, 3.2 + count / 30, move=lambda at: 0.3 * np.sin(3 * at))
    return begin + stream(3.2, 3.2 + count / 30)


@pytest.mark.parametrize('order', [
    'in order', *(pytest.param(order, marks=pytest.mark.long) for order in sorted({*ORDERS} - {'in order'}))])
@pytest.mark.parametrize('name', ['resting', 'swinging', 'actions', 'trials'])
def test_the_work_is_in_proportion_to_the_messages_in_any_order_of_arrival(monkeypatch, name, order):
    work = Counter()

    def counted(place, what, size=lambda *_: 1):
        before = getattr(place, what)

        def call(*args, **rest):
            work[what] += size(*args)
            return before(*args, **rest)

        monkeypatch.setattr(place, what, call)

    counted(Chain, 'nearest')
    counted(checked_messages, 'length_change')
    counted(Stream, 'add')
    counted(module, 'implausible', lambda trial, *_: len(trial.goals))
    messages, collector = long_session(name, 300), TrialCollector(Options())
    for message in ORDERS[order](messages):
        try:
            collector.add(message)
        except InputError:
            pass  # of actions and goal chains that come before their initial chain
    trials = collector.trials
    for what, most in (('nearest', 4), ('length_change', 4), ('add', 10), ('implausible', 10)):
        assert work[what] <= most * len(messages), what
    assert contents(trials) == contents(collect(*messages).trials)


@pytest.mark.parametrize('order', ORDERS)
def test_warnings_are_the_same_in_any_order_of_arrival(order):
    """A collector warns once of each fault of a trial, at the latest when trials are asked for."""
    def high(message):
        return replace(message, chain=Chain(message.chain.points + (0, 0, 0.5))) if isinstance(
            message, ChainMessage) else replace(message, positions=message.positions + (0, 0, 0.5))

    messages = [*long_session('resting', 60), *(
        replace(message, stamp=message.stamp + ns(100) - ns(0)) for message in long_session('trials', 3))]
    collector = TrialCollector(Options())
    for message in ORDERS[order]([*map(high, messages)]):
        try:
            collector.add(message)
        except InputError:
            pass
    assert collector.count == 2
    assert len(collector.trials) == 2
    warnings = collector.take_warnings()
    assert sorted(text.partition(': ')[2][:15] for text in warnings) == [
        *2 * ['a DLO at rest a'], *2 * ['left_hand has m']]


# ---- a tracker's stream

def stream(begin, end, rate=30, move=lambda t: 0.0, seed=1, **rest):
    """Goals of a tracker with noise of 1 mm, from `begin` to `end` [s]; `move` tells where the DLO is."""
    generator = np.random.default_rng(seed)
    messages = []
    for at in np.arange(begin, end, 1 / rate):
        message = goal(at, move=move(at), **rest)
        noisy = Chain(message.chain.points + generator.normal(0, 1e-3, (11, 3)), message.chain.hands)
        messages.append(replace(message, chain=noisy))
    return messages


def test_a_stream_that_shows_rest_is_one_goal_the_mean():
    messages = stream(3.2, 13.2, move=lambda t: 0.3)
    mean, = only(initial(1), action(2), *messages).goals
    assert mean.stable
    assert mean.count > 280
    np.testing.assert_allclose(mean.chain.points[:, 1], 0.3, atol=3e-4)
    assert mean.time == pytest.approx(1.2, abs=1e-3)
    longer, = only(initial(1), action(2), *messages, *stream(13.2, 23.2, seed=2)).goals
    assert longer.time == mean.time


def test_after_a_hand_opened_a_stream_is_used_only_from_rest_on():
    messages = stream(3.01, 6, move=lambda t: max(0.3 - 4.9 * (t - 3) ** 2, 0))
    trial = only(initial(1), action(2), *stream(2, 3), *messages)
    assert [shown.stable for shown in trial.goals] == [False] * 30 + [True]
    assert np.abs(trial.goals[-1].chain.points[:, 1]).max() < 1e-3
    early, = only(initial(1), action(2), *messages[:15]).goals
    assert early.stable and early.chain.points.tobytes() == messages[14].chain.points.tobytes()


def test_while_the_hand_holds_on_a_stream_in_motion_is_compared_at_its_instants():
    messages = stream(3.01, 9, move=lambda t: 0.2 * np.exp(3 * (3 - t)) * np.cos(6 * t))
    trial = only(initial(1), action(2), *messages, release=False)
    *moving, last = trial.goals
    assert len(moving) > 15 and not any(shown.stable for shown in moving)
    assert [shown.chain.points.tobytes() for shown in moving] == [
        message.chain.points.tobytes() for message in messages[:len(moving)]]
    assert last.stable and last.held_by == ('left_hand',) and last.count > 60


def test_a_few_goals_are_no_stream():
    messages = stream(4, 5, rate=11)
    assert [shown.stable for shown in only(initial(1), action(2), *messages).goals] == [True] * 11


def test_each_action_ends_in_a_goal_of_its_own():
    trial = only(initial(1), action(2), *stream(3.2, 6), action(6), *stream(7.2, 10, move=lambda t: 0.2))
    assert [shown.stable for shown in trial.goals] == [True, True]
    for rest, place in zip(trial.goals, (0.0, 0.2), strict=True):
        np.testing.assert_allclose(rest.chain.points[:, 1], place, atol=1e-3)


def test_a_dlo_that_moves_after_rest_is_reported_once_when_the_next_trial_begins():
    touched = stream(3.2, 9, move=lambda t: 0.1 * (t > 6))
    collector = collect(initial(1), action(2), *touched)
    assert collector.take_refusals() == ()  # an action that explains it may still come
    refusal, = collector.refusals
    assert 'goal_chain' in str(refusal) and 'had come to rest and moves again' in str(refusal)
    assert str(refusal).endswith('the next trial; if a hand moved it in this trial, send that action')
    rest, = collector.trials[0].goals
    assert np.abs(rest.chain.points[:, 1]).max() < 1e-3
    collector.add(initial(10, move=0.1))
    assert list(map(str, collector.take_refusals())) == [str(refusal)]
    collector.add(action(11, away=0.1))
    assert collector.take_refusals() == ()


def test_an_action_that_is_sent_when_it_is_over_explains_why_the_dlo_moved():
    messages = [initial(1), action(2), *stream(3.2, 10, move=lambda t: 0.3 * np.clip(t - 5.5, 0, 1))]
    collector = collect(*messages)
    assert collector.trials and collector.refusals
    collector.add(action(5.5))
    assert collector.refusals == ()
    assert contents(collector.trials) == contents(collect(*messages, action(5.5)).trials) == contents(
        collect(*sorted([*messages, action(5.5)], key=lambda message: message.stamp)).trials)


def test_each_chain_of_a_stream_is_examined_once(monkeypatch):
    looked = []
    add = Stream.add
    monkeypatch.setattr(Stream, 'add', lambda self, *rest: looked.append(self) or add(self, *rest))
    collector = collect(initial(1), action(2))
    for message in stream(3.2, 13.2):
        collector.add(message)
        assert len(collector.trials) == 1
    assert len(looked) == 300
    assert len(collector.trials[0].goals) == 1


def test_there_is_no_warning_about_a_falling_dlo_before_it_rests():
    def at_height(message, height):
        return replace(message, chain=Chain(message.chain.points + (0, 0, height)))

    fall = [at_height(message, max(0.3 - 4.9 * (k / 30) ** 2, 0))
            for k, message in enumerate(stream(3.01, 6))]
    collector = collect(initial(1), action(2), *(at_height(message, 0.3) for message in stream(2, 3)), *fall)
    assert not any('the table' in text for text in collector.take_warnings())
    collector = collect(initial(1), action(2), *(at_height(message, 0.3) for message in stream(2, 6)))
    doubt, = (text for text in collector.take_warnings() if 'the table' in text)
    assert '300 mm above the table' in doubt


def test_points_that_a_stream_shows_at_times_are_the_mean_of_when_it_does():
    messages = stream(3.2, 6)
    places = np.arange(11)[:, None]
    hidden = [replace(message, chain=Chain(np.where(places == k % 4 + 2, np.nan, message.chain.points)))
              for k, message in enumerate(messages)]
    mean, = only(initial(1), action(2), *hidden).goals
    assert mean.chain.seen.all()
    np.testing.assert_allclose(mean.chain.points, initial(1).chain.points, atol=1e-3)
