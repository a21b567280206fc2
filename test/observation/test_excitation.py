# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a trial surely cannot show."""

import numpy as np
import pytest
from rods_at_rest import LENGTH, trial_of

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.excitation import excites, motions

ALL = ParameterSpace(free=tuple(BY_NAME))


def straight(height, count=21, shift=0.0):
    along = np.linspace(0, LENGTH, count)
    wave = 0.001 * np.random.default_rng(1).normal(size=(count, 3))
    return np.stack([along, 0 * along + shift, height + 0 * along], axis=1) + wave


def shown(trial, name, table_height=0.0, space=ALL):
    return bool(excites([trial], space, table_height)[0, space.free.index(name)])


def test_friction_needs_something_to_touch():
    assert shown(trial_of(straight(0.005, shift=0.1), None, straight(0.005)), 'friction')
    assert not shown(trial_of(straight(2.0, shift=0.1), [(0, 1)], straight(2.0)), 'friction')
    assert not shown(trial_of(straight(0.005, shift=0.1), None, straight(0.005)), 'friction', None)


def test_a_hand_that_dips_far_between_may_touch_the_table():
    points = straight(1.0)
    hand = Hand('hand', (0,), [0.0, 1.0, 2.0], [points[0], points[0] - [0, 0, 1], points[0]])
    trial = Trial('dip', Chain(points), (Action((hand,)),), (Goal(Chain(points), 3.0, True, ('hand',)),))
    assert shown(trial, 'friction')


def test_self_collision_needs_parts_that_come_near():
    assert not shown(trial_of(straight(0.005, shift=0.1), None, straight(0.005)), 'self_collision')
    assert shown(trial_of(straight(0.005)[::-1], None, straight(0.005)), 'self_collision')


def test_a_hand_that_passes_over_the_dlo_may_touch_it():
    points = straight(0.005)
    hand = Hand('hand', (0,), [0.0, 1.0, 2.0], [points[0], points[12] + [0, 0, 0.05], points[0]])
    trial = Trial('pass', Chain(points), (Action((hand,)),), (Goal(Chain(points), 3.0),))
    assert shown(trial, 'self_collision')
    assert shown(trial, 'friction', None)


def test_elasticity_needs_a_pull():
    light = ParameterSpace(free=tuple(name for name in BY_NAME if name != 'mass'), mass=1e-6)
    points = straight(0.005)
    assert not shown(trial_of(points, None, points), 'elasticity', space=light)
    assert shown(trial_of(points, [(0,), (20,)], points), 'elasticity', space=light)
    heavy = ParameterSpace(free=light.free, mass=1.0)
    assert shown(trial_of(points, None, points), 'elasticity', space=heavy)


@pytest.mark.parametrize('name', ['damping', 'internal_damping'])
def test_damping_needs_motion(name):
    points = straight(0.005)
    assert not shown(trial_of(points, None, points), name)
    assert shown(trial_of(points, None, points, stable=False), name)


def test_mass_shows_only_beside_a_known_stiffness():
    points = straight(0.005)
    trial = trial_of(points, None, points)
    assert not shown(trial, 'mass')
    assert shown(trial, 'mass', space=ParameterSpace(free=('mass', 'friction')))


def seen(*trials):
    """Tell whether trials show a motion, and one between clamps."""
    return motions(trials)


def waiting_hand(goals, grips=((0,),), moving=0.0, **rest):
    """Return a trial whose hands wait from 1 to 9 s, after and before they move; goals are (time, lift)."""
    points = straight(0.5)
    hands = tuple(Hand(f'hand {k}', own, [0.0, 1.0, 9.0, 10.0],
                       points[own[0]] + np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.1 + moving], [0, 0, 0]]))
                  for k, own in enumerate(grips))
    return Trial('wait', Chain(points), (Action(hands),), tuple(
        Goal(Chain(points + [0, 0, lift]), time, False) for time, lift in goals), **rest)


def test_goals_are_seen_in_motion_while_a_hand_moves():
    points = straight(0.005)
    assert seen(trial_of(points, None, points)) == (False, False)
    assert seen(waiting_hand([(0.5, 0.0)])) == (True, False)
    assert seen(waiting_hand([(5.0, 0.0)])) == (False, False)
    assert seen(waiting_hand([(5.0, 0.0)], moving=0.2)) == (True, False)
    assert seen(waiting_hand([(5.0, 0.0)], velocity=np.ones((21, 3)))) == (True, False)
    assert seen(trial_of(points, None, points, stable=False)) == (True, False)  # after the hand


def test_a_hand_that_only_turns_moves():
    points = straight(0.5)
    turned = [[0, 0, 0, 1], [0, 0, 1, 0]]
    hand = Hand('hand', (0, 1), [0.0, 1.0], points[[0, 0]], turned)
    assert seen(Trial('turn', Chain(points), (Action((hand,)),), (Goal(Chain(points), 0.5, False),)))[0]


def test_a_dlo_that_swings_below_waiting_hands_is_in_motion():
    swinging = [(5.0, 0.0), (5.1, 0.02), (5.2, 0.04)]
    assert seen(waiting_hand(swinging)) == (True, False)
    assert seen(waiting_hand([(5.0, 0.0), (5.1, 0.0001)])) == (False, False)  # less than the noise
    assert seen(waiting_hand([(5.0, 0.0), (8.0, 0.02)])) == (False, False)  # nobody knows when it moved


def test_clamps_hold_two_points_each():
    clamps = ((0, 1), (19, 20))
    assert seen(waiting_hand([(0.5, 0.0)], clamps)) == (True, True)
    assert seen(waiting_hand([(5.0, 0.0), (5.1, 0.05)], clamps)) == (True, True)
    assert seen(waiting_hand([(0.5, 0.0)], ((0, 1), (20,)))) == (True, False)
    assert seen(waiting_hand([(5.0, 0.0)], clamps)) == (False, False)
    points = straight(0.5)
    assert seen(trial_of(points, list(clamps), points)) == (False, False)  # hung up, and seen at rest
