# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The forces that a simulated DLO exerts on the hands that hold it."""

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Force, Goal, Hand, InputError, Trial
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator

LENGTH, MASS = 0.6, 0.03
ROPE = {'flexibility': 1e-4, 'elasticity': 300.0, 'friction': 0.5, 'self_collision': 0.004, 'mass': MASS,
        'damping': 0.1, 'internal_damping': 1e-3}
ALONG = np.linspace(0, LENGTH, 31)
HANGING = np.column_stack([0 * ALONG, 0 * ALONG, -ALONG])
TAUT = np.column_stack([ALONG, 0 * ALONG, 0 * ALONG])
DOWN = np.array([0, 0, -MASS * GRAVITY])


@pytest.fixture(params=(CompiledSimulator, BulletSimulator), ids=lambda engine: engine.name)
def simulator(request):
    """Give a simulator of one engine."""
    made = request.param(nodes=31, table=False)
    yield made
    made.close()


def held(points, *hands, at=None):
    """
    Return a trial in which hands hold points, and their forces are wanted.

    :param hands: of each, the gripped points and its way [m] within the first second.
    :param at: instants of timed goals [s]; None: one goal at rest.
    """
    paths = tuple(Hand(f'hand {k}', grips, (0.0, 1.0), points[grips[0]] + np.array([(0, 0, 0), way], float))
                  for k, (grips, way) in enumerate(hands))
    names = tuple(path.name for path in paths)
    forces = tuple(Force(name, np.zeros(3)) for name in names)
    goals = [Goal(Chain(points), time, at is None, names, forces=forces) for time in (at or [1.01])]
    return Trial('held', Chain(points), (Action(paths),), tuple(goals))


@pytest.mark.parametrize('grips', [(0,), (0, 1, 2)])
def test_a_hanging_rope_pulls_down_with_its_weight(simulator, grips):
    rollout = simulator.simulate(held(HANGING, (grips, (0, 0, 0))), ROPE)
    np.testing.assert_allclose(rollout.forces, [DOWN], atol=0.01 * MASS * GRAVITY)


def test_two_hands_share_the_weight_and_pull_against_each_other(simulator):
    trial = held(TAUT, ((0,), (0.1, 0, 0)), ((30,), (-0.1, 0, 0)))
    left, right = simulator.simulate(trial, {**ROPE, 'damping': 3.0}).forces
    np.testing.assert_allclose(left, right * (-1, 1, 1), atol=1e-3)
    np.testing.assert_allclose(left + right, DOWN, atol=0.01 * MASS * GRAVITY)
    assert left[0] > 0.05  # towards the other hand


def test_a_rope_that_is_stretched_pulls_with_a_known_force(simulator):
    trial = held(TAUT, ((0,), (0, 0, 0)), ((30,), (0.006, 0, 0)))  # by 1 %
    forces = simulator.simulate(trial, {**ROPE, 'mass': 1e-3}).forces
    np.testing.assert_allclose(forces[:, 0], [3.0, -3.0], rtol=0.01)


def test_while_a_rope_swings_its_hand_bears_what_accelerates_it(simulator):
    times = np.linspace(1.5, 2.5, 41)
    trial = held(HANGING, ((0,), (0.15, 0, 0)), at=times.tolist())
    rollout = simulator.simulate(trial, {**ROPE, 'damping': 0.0})
    middle = (rollout.chains[:, 1:] + rollout.chains[:, :-1]).mean(axis=1) / 2
    step = times[1] - times[0]
    acceleration = (middle[2:] - 2 * middle[1:-1] + middle[:-2]) / step**2
    smoothed = acceleration - 0.01 * np.gradient(acceleration, step, axis=0)  # forces are, over 10 ms
    off = rollout.forces[1:-1] - DOWN + MASS * smoothed
    assert np.linalg.norm(off) < 0.07 * np.linalg.norm(MASS * acceleration)


@pytest.mark.parametrize('force', [np.array([0, np.nan, 0]), np.zeros(2), np.array([0, 0, 1e9])])
def test_a_force_that_is_none_is_refused(force):
    with pytest.raises(InputError, match='force on hand .left.*three finite numbers'):
        Force('left', force)


@pytest.mark.parametrize('names', [('right',), ('left', 'left')])
def test_a_force_on_a_hand_that_does_not_hold_the_dlo_is_refused(names):
    hand = Hand('left', (0,), (0.0, 1.0), np.zeros((2, 3)))
    forces = tuple(Force(name, np.zeros(3)) for name in names)
    with pytest.raises(InputError, match='one for each hand that holds the DLO then .left.'):
        Trial('trial 1', Chain(HANGING), (Action((hand,)),),
              (Goal(Chain(HANGING), 2.0, held_by=('left',), forces=forces),))
