# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The paths of hands: poses at any time, and refusals."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from scipy.spatial.transform import Rotation

from dlo_calibration import Action, Hand, InputError


def about(axis, degrees):
    """Return the quaternion x y z w of a turn about a coordinate axis."""
    return Rotation.from_euler(axis, degrees, degrees=True).as_quat()


def test_positions_between_before_and_after_the_waypoints():
    hand = Hand('left_hand', (3,), [1.0, 2.0, 4.0], [[0, 0, 0], [0.1, 0, 0], [0.1, 0.4, 0]])
    assert (hand.start, hand.end) == (1.0, 4.0)
    positions, turns = hand.poses([0.0, 1.0, 1.25, 2.0, 3.0, 4.0, 9.0])
    assert positions == pytest.approx(np.array(
        [[0, 0, 0], [0, 0, 0], [0.025, 0, 0], [0.1, 0, 0], [0.1, 0.2, 0], [0.1, 0.4, 0], [0.1, 0.4, 0]]))
    assert turns == pytest.approx(np.tile(np.eye(3), (7, 1, 1)))


def test_a_small_rotation_of_a_hand_counts():
    hand = Hand('h', (0,), [0, 2], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1], about('z', 1e-6)])
    turn = Rotation.from_matrix(hand.poses(2.0)[1][0])
    assert turn.as_rotvec(degrees=True)[2] == pytest.approx(1e-6)


def test_a_hand_turns_at_constant_speed_on_the_shortest_way():
    hand = Hand('h', (0,), [0.0, 1.0], np.zeros((2, 3)), [about('z', 170), about('z', -170)])
    for share in (0, 0.25, 0.5, 1):
        turn = Rotation.from_matrix(hand.poses(share)[1][0])
        assert turn.as_rotvec(degrees=True) == pytest.approx([0, 0, 20 * share], abs=1e-9)


def test_the_turn_counts_from_where_the_hand_closed():
    hand = Hand('h', (0,), [0.0, 1.0], np.zeros((2, 3)), [about('x', 90), about('x', 120)])
    assert hand.poses([0.0, 1.0])[1][0] == pytest.approx(np.eye(3), abs=1e-12)
    assert hand.poses(1.0)[1][0] == pytest.approx(Rotation.from_euler('x', 30, degrees=True).as_matrix())


@drawing(30)
@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=4, max_size=4), st.floats(0.6, 30))
def test_sign_and_length_of_a_quaternion_do_not_matter(seed, flips, size):
    generator = np.random.default_rng(seed)
    turns = Rotation.random(4, random_state=generator.integers(2**31)).as_quat()
    times = np.arange(4.0)
    at = generator.uniform(0, 3, 20)
    plain = Hand('h', (0,), times, np.zeros((4, 3)), turns)
    factors = np.where(flips, -size, size)[:, None]
    flipped = Hand('h', (0,), times, np.zeros((4, 3)), factors * turns)
    assert flipped.poses(at)[1] == pytest.approx(plain.poses(at)[1], abs=1e-9)


def test_a_single_waypoint_is_a_hand_that_rests():
    hand = Hand('h', (2,), 3.0, [0.1, 0.2, 0.3], about('y', 40))
    assert (hand.start, hand.end) == (3.0, 3.0)
    positions, turns = hand.poses([0.0, 3.0, 5.0])
    assert positions == pytest.approx(np.tile([0.1, 0.2, 0.3], (3, 1)))
    assert turns == pytest.approx(np.tile(np.eye(3), (3, 1, 1)))


def test_a_repeated_point_is_gripped_once():
    assert Hand('h', (4, 2, 4), 0.0, [0, 0, 0]).grips == (4, 2)


def test_a_hand_is_a_read_only_copy():
    times, positions = np.array([0.0, 1.0]), np.zeros((2, 3))
    hand = Hand('h', (1, 2), times, positions)
    times[1] = positions[1] = 7
    assert hand.end == 1.0
    assert hand.poses(1.0)[0].tolist() == [[0, 0, 0]]
    for array in (hand.times, hand.positions, hand.orientations):
        with pytest.raises(ValueError):
            array[0] = 1


PATH = {'times': [0.0, 1.0], 'positions': np.zeros((2, 3))}
REFUSED = {
    'no grip': ({'grips': ()}, 'no gripped point', 'at least one'),
    'positions': ({'positions': np.zeros((3, 3))}, '(3, 3)', 'one pose per waypoint'),
    'orientations': ({'orientations': [[0, 0, 0, 1]]}, '(1, 4)', 'one pose per waypoint'),
    'no waypoint': ({'times': [], 'positions': np.zeros((0, 3))}, '0 times', 'one pose per waypoint'),
    'nan time': ({'times': [0.0, np.nan]}, 'NaN or infinity', 'finite'),
    'nan position': ({'positions': [[0, 0, 0], [0, np.inf, 0]]}, 'NaN or infinity', 'finite'),
    'nan orientation': ({'orientations': np.full((2, 4), np.nan)}, 'NaN or infinity', 'finite'),
    'equal times': ({'times': [1.0, 1.0]}, 'time 1 s of waypoint 1 after 1 s', 'increasing times'),
    'backward': ({'times': [1.0, 0.0]}, 'time 0 s of waypoint 1 after 1 s', 'increasing times'),
    'zero quaternion': ({'orientations': [[0, 0, 0, 1], [0, 0, 0, 0]]}, 'quaternion of length 0', 'unit'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_refused_paths(name):
    arguments, came, expected = REFUSED[name]
    with pytest.raises(InputError) as refusal:
        Hand(**{'name': 'left_hand', 'grips': (0,), **PATH, **arguments})
    text = str(refusal.value)
    assert text.startswith("hand 'left_hand': ")
    assert text.index(came) < text.index(expected)
    assert refusal.value.remedy


def test_an_action_lasts_from_the_first_hand_to_the_last():
    later, earlier = (Hand(name, (0,), times, np.zeros((2, 3)))
                      for name, times in (('a', [1.0, 2.0]), ('b', [0.5, 1.5])))
    action = Action([later, earlier])
    assert (action.start, action.end) == (0.5, 2.0)
    assert [hand.name for hand in action.hands] == ['a', 'b']


def hands(count):
    return [Hand(f'hand {k}', (k,), **PATH) for k in range(count)]


def test_an_action_has_one_to_eight_hands_with_names_of_their_own():
    assert len(Action(hands(8)).hands) == 8
    for count in (0, 9):
        with pytest.raises(InputError, match=f'action: {count} hands; expected 1 to 8; leave out'):
            Action(hands(count))
    with pytest.raises(InputError, match='hands named hand 0, hand 0; expected different names'):
        Action([*hands(1), *hands(1)])
