# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a trial surely cannot show."""

import numpy as np
import pytest
from resting import LENGTH, trial_of

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.excitation import excites

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
