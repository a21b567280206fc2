# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The trial: the order of actions and goals, which hands hold when, and refusals."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, InputError, Trial

POINTS = np.stack([np.linspace(0, 0.5, 6), np.zeros(6), np.zeros(6)], axis=1)
CHAIN = Chain(POINTS)


def hand(name, start, end, grips=(0,)):
    return Hand(name, grips, [start, end], np.zeros((2, 3)))


def trial(actions=None, goals=None, **rest):
    actions = [Action([hand('left', 0.0, 1.0)])] if actions is None else actions
    goals = [Goal(CHAIN, 2.0)] if goals is None else goals
    return Trial('pull', CHAIN, actions, goals, **rest)


def test_a_stable_goal_while_a_hand_moves_is_refused():
    with pytest.raises(InputError, match='a stable goal at 2 s, while hand .left. moves'):
        trial([Action([hand('left', 1.0, 3.0)])])
    trial([Action([hand('left', 1.0, 3.0)])], [Goal(CHAIN, 2.0, stable=False)])


def test_actions_and_goals_are_ordered_by_time():
    actions = [Action([hand('left', start, start + 1)]) for start in (0.0, 3.0, 6.0)]
    goals = [Goal(CHAIN, time) for time in (2.0, 5.0, 8.0)]
    for order in permutations(range(3)):
        mixed = trial([actions[k] for k in order], [goals[k] for k in order])
        assert [action.start for action in mixed.actions] == [0, 3, 6]
        assert [goal.time for goal in mixed.goals] == [2, 5, 8]
        assert [hand.start for hand in mixed.hands] == [0, 3, 6]


def test_hands_of_overlapping_actions_come_in_the_order_of_their_start():
    first = Action([hand('a', 0.0, 9.0), hand('b', 4.0, 5.0)])
    second = Action([hand('c', 2.0, 3.0)])
    assert [hand.name for hand in trial([second, first], [Goal(CHAIN, 9.5)]).hands] == ['a', 'c', 'b']


REFUSED = {
    'no action': ({'actions': []}, 'no action', 'at least one'),
    'no goal': ({'goals': []}, 'no goal chain', 'at least one'),
    'points': ({'goals': [Goal(CHAIN, 2.0), Goal(Chain(POINTS[:5]), 3.0)]}, 'a goal of 5 points', '6 points'),
    'grip beyond': ({'actions': [Action([hand('left', 0, 1, (2, 6))])]}, "'left' gripping points (2, 6)",
                    'points 0 to 5'),
    'grip before': ({'actions': [Action([hand('left', 0, 1, (-1,))])]}, "'left' gripping points (-1,)",
                    'points 0 to 5'),
    'velocity shape': ({'velocity': np.zeros((5, 3))}, '(5, 3)', '(6, 3)'),
    'velocity nan': ({'velocity': np.full((6, 3), np.nan)}, 'a velocity', 'finite'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_refused_trials(name):
    arguments, came, expected = REFUSED[name]
    with pytest.raises(InputError) as refusal:
        trial(**arguments)
    text = str(refusal.value)
    assert text.startswith("trial 'pull': ")
    assert text.index(came) < text.index(expected)
    assert refusal.value.remedy


def test_the_velocity_is_a_read_only_copy():
    velocity = np.ones((6, 3))
    moving = trial(velocity=velocity)
    velocity[0] = 5
    assert moving.velocity.tolist() == np.ones((6, 3)).tolist()
    with pytest.raises(ValueError):
        moving.velocity[0] = 1


def names(trial, goal):
    return [hand.name for hand in trial.holding(goal)]


def test_a_hand_holds_from_its_first_waypoint_to_its_last():
    waiting = trial([Action([hand('left', 1.0, 3.0)])], [Goal(CHAIN, 4.0)])
    early = Goal(CHAIN, 0.5, stable=False)
    assert names(waiting, early) == []
    assert not waiting.holds(waiting.hands[0], early)
    for time in (1.0, 2.0, 3.0):
        assert names(waiting, Goal(CHAIN, time, stable=False)) == ['left']


def test_after_its_last_waypoint_a_hand_holds_if_the_goal_says_so():
    done = trial([Action([hand('left', 0.0, 1.0), hand('right', 0.0, 1.0, (5,))])])
    assert names(done, Goal(CHAIN, 2.0)) == []
    assert names(done, Goal(CHAIN, 2.0, held_by=('right',))) == ['right']
    assert names(done, Goal(CHAIN, 2.0, held_by=('left', 'right'))) == ['left', 'right']


def test_a_goal_cannot_be_held_by_a_hand_that_comes_later():
    later = trial([Action([hand('left', 0.0, 1.0)]), Action([hand('right', 5.0, 6.0)])])
    assert names(later, Goal(CHAIN, 2.0, held_by=('left', 'right'))) == ['left']


def test_a_later_hand_of_the_same_name_takes_over():
    twice = trial([Action([hand('left', 0.0, 1.0, (0,))]), Action([hand('left', 3.0, 4.0, (5,))])])
    for goal, grips in ((Goal(CHAIN, 2.0, held_by=('left',)), (0,)),
                        (Goal(CHAIN, 3.5, stable=False), (5,)),
                        (Goal(CHAIN, 6.0, held_by=('left',)), (5,))):
        assert [hand.grips for hand in twice.holding(goal)] == [grips]
    assert twice.holding(Goal(CHAIN, 6.0)) == ()


@pytest.mark.parametrize('places', [
    [0.0, 0.1, 0.2], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.0, 0.1, 0.1, 0.2, 0.3, 0.4],
    [0.0, 0.1, 0.2, 0.3, 0.4, np.nan]], ids=['few', 'late', 'same', 'nan'])
def test_arc_lengths_that_do_not_increase_from_0_are_refused(places):
    with pytest.raises(InputError, match='6 increasing numbers from 0'):
        trial(places=places)
    assert trial(places=np.arange(6) / 10).places.tolist() == (np.arange(6) / 10).tolist()


def test_clamps_are_neighbours_that_one_hand_holds_from_the_start():
    assert trial([Action([hand('a', 0.0, 1.0, (1, 0)), hand('b', 0.0, 1.0, (3, 5))]),
                  Action([hand('c', 1.5, 1.9, (2, 3))])]).clamped == (0,)
    assert trial().clamped == ()


UNEVEN = np.array([0.0, 0.02, 0.1, 0.16, 0.3, 0.34, 0.4, 0.5])


def uneven(hidden):
    points = np.stack([UNEVEN, np.zeros(8), np.zeros(8)], axis=1)
    points[hidden] = np.nan
    return Chain(points)


def test_the_goals_place_a_point_unseen_in_the_initial_chain():
    goals = [Goal(uneven([6]), 2.0), Goal(uneven([1, 4]), 3.0)]
    observed = Trial('t', uneven([3, 7]), (Action((hand('left', 0.0, 1.0),)),), goals)
    np.testing.assert_allclose(observed.initial.points[:, 0], UNEVEN, atol=2e-3)
    assert np.flatnonzero(~observed.initial.seen).tolist() == [3, 7]
    assert replace(observed, name='u').initial is observed.initial


def test_a_copy_of_a_trial_with_unseen_points_has_the_same_points_to_the_digit():
    angle = np.linspace(0, np.pi, 8)
    arc = np.random.default_rng(0).normal(0, 2e-3, (8, 3)) + 0.1 * np.stack(
        [np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    hidden = Chain(np.where(np.isin(np.arange(8), (2, 5))[:, None], np.nan, arc))
    first = Trial('t', hidden, (Action((hand('left', 0.0, 1.0),)),), [Goal(hidden, 2.0)])
    for name in ('u', 'v', 'w'):
        copy = replace(first, name=name)
        assert (copy.initial.points == first.initial.points).all()


@pytest.mark.parametrize('turned', [False, True])
def test_the_goals_place_a_gripped_end_unseen_in_the_initial_chain(turned):
    angle = np.linspace(0, np.pi, 8)
    arc = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    hidden = np.where(np.arange(8)[:, None] > 0, arc, np.nan)
    path = arc[0] + np.array([[0.005, 0, 0], [0.005, 0, 0.1]])  # the hand is beside the point
    turns = [[0, 0, 0, 1], [0, 0, 1, 0] if turned else [0, 0, 0, 1]]
    grip = Hand('left', (0,), [0.0, 1.0], path, turns)
    goals = [Goal(Chain(arc + [0, 0, 0.1 * time]), time, stable=False) for time in (0.5, 1.0)]
    observed = Trial('t', Chain(hidden), (Action((grip,)),), goals)
    distance = np.linalg.norm(observed.initial.points[0] - arc[0])
    assert distance > 0.005 if turned else distance < 1e-12
    assert not observed.initial.seen[0]


def test_an_initial_chain_without_an_end_is_refused():
    with pytest.raises(InputError, match='whose last 2 points were not seen; expected at most one'):
        Trial('t', uneven([6, 7]), (Action((hand('left', 0.0, 1.0),)),), [Goal(uneven([0, 1]), 2.0)])


# ---- errors of the hands

def late_stream(velocity=None, start=0.5):
    """Return a trial whose hand moves from 0.5 s to 1.5 s, with timed goals, and stable ones after it."""
    points = np.stack([np.linspace(0, 0.5, 11), np.zeros(11), np.zeros(11)], axis=1)
    hand = Hand('hand', (2,), np.array([start, 1.5]), points[2] + [[0, 0, 0], [0, 0.2, 0]], nearest=True)
    goals = [Goal(Chain(points), time, stable=False) for time in (0.6, 0.9, 1.2)]
    return Trial('t', Chain(points), (Action((hand,)),), (*goals, Goal(Chain(points), 1.6)), velocity)


@pytest.mark.parametrize('velocity', [None, np.zeros((11, 3))], ids=['at rest', 'moving'])
@pytest.mark.parametrize('late', [-0.2, -0.05, 0.05, 0.2])
def test_late_hands_moved_earlier_against_the_timed_goals(late, velocity):
    trial = late_stream(velocity)
    moved = trial.with_late_hands(late)
    before, after = ([goal.time - each.hands[0].times[-1] for goal in each.goals if not goal.stable]
                     for each in (trial, moved))
    assert after == pytest.approx(np.array(before) + late)
    assert [goal.stable for goal in moved.goals] == [goal.stable for goal in trial.goals]
    assert all(goal.time >= moved.hands[0].end for goal in moved.goals if goal.stable)
    assert min(goal.time for goal in moved.goals) >= 0
    np.testing.assert_array_equal(moved.hands[0].positions[-1], trial.hands[0].positions[-1])


def test_a_hand_that_holds_from_the_start_still_does_where_its_stamps_are_early():
    trial = late_stream(start=0.0)
    early = trial.with_late_hands(-0.1)
    assert early.hands[0].start == 0.0
    assert early.clamped == trial.clamped
    np.testing.assert_allclose(early.hands[0].positions_at(0.1), trial.hands[0].positions[:1])
    np.testing.assert_allclose(early.hands[0].positions_at(1.6), trial.hands[0].positions[-1:])


@pytest.mark.parametrize('shift', [(0.05, 0.01, 0.0), (-0.05, 0.0, 0.02)])
def test_shifted_hands_grip_where_the_dlo_is_nearest(shift):
    trial = late_stream()
    moved = trial.with_shifted_hands(np.array(shift))
    hand = moved.hands[0]
    np.testing.assert_allclose(hand.positions, trial.hands[0].positions - shift)
    assert hand.grips[0] + hand.offset == pytest.approx(2 - shift[0] / 0.05)
    named = replace(trial, actions=(Action((replace(trial.hands[0], nearest=False),)),))
    assert named.with_shifted_hands(np.array(shift)).hands[0].grips == (2,)


def test_a_hand_that_goes_on_from_where_it_was_grips_the_same_after_a_shift():
    trial = late_stream()
    first = trial.hands[0]
    again = replace(first, times=np.array([2.0, 3.0]), positions=first.positions[::-1], nearest=False)
    both = replace(trial, actions=(Action((first,)), Action((again,))))
    hands = both.with_shifted_hands(np.array([0.05, 0, 0])).hands
    assert [hand.grips for hand in hands] == [(1,), (1,)]


def test_hands_without_errors_stay_bit_for_bit():
    trial = late_stream()
    for same in (trial.with_late_hands(0.0), trial.with_shifted_hands(np.zeros(3))):
        assert [goal.time for goal in same.goals] == [goal.time for goal in trial.goals]
        for hand, other in zip(same.hands, trial.hands, strict=True):
            assert (hand.grips, hand.offset) == (other.grips, other.offset)
            assert hand.times.tobytes() == other.times.tobytes()
            assert hand.positions.tobytes() == other.positions.tobytes()
