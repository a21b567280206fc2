# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Named actions: the paths of their hands, and refusals."""

import inspect

from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, grip_place
from dlo_calibration.model.named_actions import (
    Drag,
    GraspAndPlace,
    LiftAndHold,
    NAMED_ACTIONS,
    PushDown,
    Release,
    TwoHands,
)
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.bullet import BulletSimulator

#: Points apart by 0.1 m, the last one by 0.4 m.
CHAIN = Chain([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0.4, 0, 0], [0.8, 0, 0]])
SOME = {
    'grasp_and_place': GraspAndPlace(point=0, to=(0, 0.2, 0)),
    'drag': Drag(point=0, direction=(0, 1, 0), distance=0.1),
    'lift_and_hold': LiftAndHold(point=2),
    'push_down': PushDown(point=2),
    'two_hands': TwoHands(points=(0, -1)),
    'release': Release(start=5.0),
}
BEFORE = (Action((Hand('left_hand', (1, 2), np.array([0.0, 2.0]), np.array([[0.1, 0, 0], [0.3, 0.4, 0.5]]),
                       np.array([[0, 0, 0, 1], [0, 0, 1, 0]])),)),)


def only_hand(action, before=()):
    hand, = action.action(CHAIN, before).hands
    return hand


def speeds(hand):
    return np.linalg.norm(np.diff(hand.positions, axis=0), axis=1) / np.diff(hand.times)


def test_place_goes_up_across_and_down_at_its_speed():
    hand = only_hand(GraspAndPlace(point=1, to=(0.1, 0.3, 0.02), height=0.05, speed=0.2, start=1.5))
    np.testing.assert_allclose(hand.positions, [
        [0.1, 0, 0], [0.1, 0, 0.07], [0.1, 0.3, 0.07], [0.1, 0.3, 0.02]])
    np.testing.assert_allclose(speeds(hand), 0.2)
    assert (hand.start, hand.grips, hand.name) == (1.5, (1,), 'left_hand')


def test_direction_may_have_any_length():
    for size in (1e-3, 1.0, 1e5):
        hand = only_hand(GraspAndPlace(point=0, direction=(0, 3 * size, 4 * size), distance=0.5))
        np.testing.assert_allclose(hand.positions[-1], [0, 0.3, 0.4])


def test_drag_is_one_straight_move():
    hand = only_hand(Drag(point=-1, to=(0.8, 0.1, 0), speed=0.05, hand='gripper'))
    np.testing.assert_allclose(hand.positions, [[0.8, 0, 0], [0.8, 0.1, 0]])
    assert (hand.times[-1], hand.grips, hand.name) == (pytest.approx(2.0), (5,), 'gripper')


def test_lift_goes_up_and_push_goes_down():
    np.testing.assert_allclose(only_hand(LiftAndHold(point=2, height=0.3)).positions[:, 2], [0, 0.3])
    np.testing.assert_allclose(only_hand(PushDown(point=2, distance=0.3)).positions[:, 2], [0, -0.3])


@pytest.mark.parametrize('fraction, grip', [(0, 0), (0.25, 2), (0.5, 4), (0.7, 4), (0.8, 5), (1, 5)])
def test_fraction_grips_there_also_between_points(fraction, grip):
    hand = only_hand(LiftAndHold(fraction=fraction))
    assert hand.grips == (grip,)
    place = grip_place(CHAIN.arc_lengths(), grip, hand.offset)
    assert place == pytest.approx(fraction * CHAIN.length, abs=3e-3)
    np.testing.assert_allclose(hand.positions[0], CHAIN.resample([place])[0], atol=1e-9)


@pytest.mark.parametrize('motion, moving, ends', [
    ('together', 'both', (0.05, 0.75)), ('together', 'first', (0.1, 0.8)), ('together', 'second', (0, 0.7)),
    ('apart', 'both', (-0.05, 0.85)), ('apart', 'first', (-0.1, 0.8)), ('apart', 'second', (0, 0.9))])
@pytest.mark.parametrize('height', [0.0, 0.2])
def test_two_hands_change_their_distance(motion, moving, ends, height):
    action = TwoHands(points=(0, -1), motion=motion, moving=moving, distance=0.1, height=height, speed=0.1)
    first, second = action.action(CHAIN).hands
    assert (first.name, second.name, first.grips, second.grips) == ('left_hand', 'right_hand', (0,), (5,))
    np.testing.assert_allclose([first.positions[-1], second.positions[-1]],
                               [[ends[0], 0, height], [ends[1], 0, height]], atol=1e-12)
    np.testing.assert_array_equal(first.times, second.times)
    assert first.end == pytest.approx(height / 0.1 + (0.5 if moving == 'both' else 1.0))


def test_release_opens_a_hand_at_its_last_position_with_the_same_grip():
    hand = only_hand(Release(start=3.0), BEFORE)
    assert (hand.grips, hand.start, hand.end) == ((1, 2), 3.0, 3.0)
    np.testing.assert_array_equal(hand.positions, [[0.3, 0.4, 0.5]])
    np.testing.assert_array_equal(hand.orientations, [[0, 0, 1, 0]])


def test_names_say_who_holds_afterwards():
    assert {name: action.hold for name, action in SOME.items()} == {
        'grasp_and_place': False, 'drag': False, 'lift_and_hold': True, 'push_down': True, 'two_hands': True,
        'release': False}
    assert Drag(point=0, to=(0, 1, 0), hold=True).hold


def test_table_has_all_and_each_knows_its_name():
    assert list(SOME) == list(NAMED_ACTIONS)
    for name, action in SOME.items():
        assert type(action) is NAMED_ACTIONS[name] and action.name == name
        assert action.hand_names == tuple(hand.name for hand in action.action(CHAIN, BEFORE).hands)


@pytest.mark.parametrize('name', NAMED_ACTIONS)
def test_each_docstring_says_how_much_the_action_shows_of_each_parameter(name):
    lines = inspect.getdoc(NAMED_ACTIONS[name]).splitlines()
    assert [head for line in lines if (head := line.partition(': ')[0]) in PAPER_PARAMETERS] == list(
        PAPER_PARAMETERS)


@pytest.mark.parametrize('make, match', [
    (lambda: LiftAndHold(), 'lift_and_hold: point None, fraction None'),
    (lambda: LiftAndHold(point=1, fraction=0.5), 'one of the two'),
    (lambda: LiftAndHold(point=6).action(CHAIN), 'point 6.*-6 to 5'),
    (lambda: LiftAndHold(point=-7).action(CHAIN), 'point -7'),
    (lambda: LiftAndHold(fraction=1.1).action(CHAIN), 'fraction 1.1'),
    (lambda: LiftAndHold(fraction=float('nan')).action(CHAIN), 'fraction nan'),
    (lambda: LiftAndHold(point=0, height=0), 'height 0'),
    (lambda: LiftAndHold(point=0, speed=-1), 'speed -1'),
    (lambda: LiftAndHold(point=0, speed=float('inf')), 'speed inf'),
    (lambda: LiftAndHold(point=0, start=-1), 'start -1'),
    (lambda: LiftAndHold(point=0, start=float('nan')), 'start nan'),
    (lambda: PushDown(point=0, distance=0), 'distance 0'),
    (lambda: Drag(point=0), 'say where the hand goes'),
    (lambda: Drag(point=0, to=(0, 0, 0), direction=(1, 0, 0), distance=1), 'say where the hand goes'),
    (lambda: Drag(point=0, direction=(1, 0, 0)), 'say where the hand goes'),
    (lambda: Drag(point=0, to=(0, 0, 0), distance=1), 'say where the hand goes'),
    (lambda: Drag(point=0, direction=(0, 0, 0), distance=1), 'direction'),
    (lambda: Drag(point=0, to=(0, 0)), 'drag.*three numbers'),
    (lambda: Drag(point=0, to=(0, 0, float('nan'))), 'drag.*three numbers'),
    (lambda: TwoHands(), 'two_hands.*where the hands grip'),
    (lambda: TwoHands(points=(0,)), '1 points'),
    (lambda: TwoHands(points=(0, 1), hands=('a',)), '1 hands'),
    (lambda: TwoHands(points=(0, 1), motion='up'), "motion 'up'"),
    (lambda: TwoHands(points=(0, 1), moving='none'), "moving 'none'"),
    (lambda: TwoHands(points=(5, -1)).action(CHAIN), 'both hands at point 5'),
    (lambda: TwoHands(points=(0, 1), distance=0.2).action(CHAIN), '0.2 m together of hands 0.1 m apart'),
    (lambda: TwoHands(points=(0, 1), hands=('a', 'a'), distance=0.01).action(CHAIN), 'different names'),
    (lambda: Release().action(CHAIN), "'left_hand', which holds nothing"),
    (lambda: Release(start=1.0).action(CHAIN, BEFORE), 'while hand .* moves'),
    (lambda: Release(hold=True), 'hold'),
    (lambda: Release(hands=()).action(CHAIN), '0 hands'),
])
def test_impossible_actions_are_refused(make, match):
    with pytest.raises(InputError, match=match):
        make()


@given(point=st.integers(-6, 5), to=st.tuples(*[st.floats(-10, 10)] * 3), speed=st.floats(1e-3, 10),
       height=st.floats(1e-3, 1), start=st.floats(0, 1e3))
@example(point=0, to=(0.0, 1.3e-114, 0.0), speed=1.0, height=0.1, start=0.0)
@example(point=0, to=(0.0, 1e-8, 0.0), speed=1.0, height=0.1, start=1e6)
def test_any_place_is_reached_at_constant_speed(point, to, speed, height, start):
    hand = only_hand(GraspAndPlace(point=point, to=to, speed=speed, height=height, start=start))
    np.testing.assert_allclose(hand.positions[-1], to, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(hand.positions[0], CHAIN.points[point])
    assert (np.diff(hand.times) > 0).all()
    assert hand.positions[:, 2].max() == pytest.approx(max(to[2], 0) + height)
    length = np.linalg.norm(np.diff(hand.positions, axis=0), axis=1).sum()
    assert hand.end - hand.start == pytest.approx(length / speed, abs=1e-9)


def test_simulated_hands_do_what_the_names_say():
    along = np.linspace(0, 0.6, 13)
    lying = Chain(np.column_stack([along, 0 * along, 0 * along + 0.005]))
    lift = LiftAndHold(fraction=0.5, height=0.1)
    up = lift.action(lying)
    drop = Release(start=3.0).action(lying, [up])
    trial = Trial('lift and drop', lying, (up, drop),
                  (Goal(lying, 2.0, held_by=('left_hand',)), Goal(lying, 5.0)))
    simulator = BulletSimulator()
    held, dropped = simulator.simulate(trial, ParameterSpace().physical(
        {name: Options().values[name] for name in PAPER_PARAMETERS}, 0.6)).chains
    simulator.close()
    assert held[6, 2] == pytest.approx(0.105, abs=1e-3)
    assert dropped[:, 2].max() < 0.05
