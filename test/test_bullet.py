# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The PyBullet rope against what is known: analytic solutions, and what must never happen."""

import hashlib
import subprocess
import sys

import numpy as np
import pybullet
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from dlo_calibration import Action, Chain, Goal, Hand, ParameterSpace, Trial
from dlo_calibration.bullet import BulletRope, BulletSimulator
from dlo_calibration.parameters import PARAMETERS

GRAVITY = 9.81
STIFF = {'flexibility': 1e-3, 'elasticity': 1e4, 'friction': 0.4, 'self_collision': 0.005, 'mass': 0.05,
         'damping': 5.0, 'internal_damping': 1e-3}


@pytest.fixture
def world():
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -GRAVITY, physicsClientId=client)
    pybullet.setTimeStep(0.005, physicsClientId=client)
    yield client
    pybullet.disconnect(physicsClientId=client)


def line(start, direction, length, count):
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return np.asarray(start, float) + np.linspace(0, length, count)[:, None] * direction


def table(client, height=0.0):
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    body = pybullet.createMultiBody(0, shape, basePosition=[0, 0, height], physicsClientId=client)
    pybullet.changeDynamics(body, -1, lateralFriction=1.0, physicsClientId=client)
    return body


def settle(rope, limit=20.0):
    """Step until nothing moves more than 10 micrometres in 0.25 s."""
    for _ in range(int(limit / 0.25)):
        before = rope.points
        for _ in range(round(0.25 / rope.time_step)):
            rope.step()
        if np.abs(rope.points - before).max() < 1e-5:
            return rope.points
    raise AssertionError('the rope never came to rest')


def elastica_tip(stiffness, load, length):
    """Return the tip (x, z) of a horizontal cantilever under its own weight `load` [N/m]: the elastica."""
    def slope(s, y):
        return np.stack([y[1], -load * (length - s) * np.cos(y[0]) / stiffness, np.cos(y[0]), np.sin(y[0])])

    def ends(a, b):
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0, length, 200)
    guess = np.zeros((4, len(s)))
    guess[2] = s
    for part in np.linspace(0.02, 1, 25):
        growing = np.array([[1], [part], [1], [1]])
        solution = solve_bvp(lambda s, y, growing=growing: slope(s, y) * growing, ends, s, guess,
                             tol=1e-6, max_nodes=20000)
        s, guess = solution.x, solution.y
    assert solution.success
    return np.array([solution.y[2, -1], -solution.y[3, -1]])


@pytest.mark.parametrize('stiffness', [0.5, 0.05, 0.005])
@pytest.mark.parametrize('count', [12, 31, 50])
def test_cantilever_tip_is_the_elastica(world, stiffness, count):
    clamp = 0.01
    places = np.append(0.0, clamp + np.linspace(0, 1, count - 1))
    points = np.stack([places - clamp, 0 * places, 0 * places], axis=1)
    rope = BulletRope(world, places, points, {**STIFF, 'flexibility': stiffness, 'mass': 0.05 * places[-1]})
    rope.hold((0, 1))
    tip = settle(rope, 60.0)[-1]
    expected = elastica_tip(stiffness, 0.05 * GRAVITY, 1.0)
    deflection = np.linalg.norm([1, 0] - expected)
    assert np.linalg.norm(tip[[0, 2]] - expected) < (0.02 if count < 20 else 0.003) * deflection
    assert abs(tip[1]) < 1e-9


@pytest.mark.parametrize('stiffness', [5.0, 50.0, 5000.0])
def test_hanging_rope_stretches_under_its_weight(world, stiffness):
    points = line((0, 0, 2), (0, 0, -1), 1.0, 31)
    rope = BulletRope(world, np.linspace(0, 1, 31), points, {**STIFF, 'elasticity': stiffness})
    rope.hold((0,))
    stretch = 1.0 - settle(rope)[-1, 2]
    # Hooke: the tension at s is m g (1 - s / L), so that the stretch is m g L / (2 EA).
    assert stretch == pytest.approx(0.05 * GRAVITY / (2 * stiffness), rel=0.01)


def test_limp_rope_hangs_in_a_catenary(world):
    span, length = 0.7, 1.0
    a = brentq(lambda a: 2 * a * np.sinh(span / 2 / a) - length, 0.05, 5)
    sag = a * (np.cosh(span / 2 / a) - 1)
    half = np.sqrt(length**2 - span**2) / 2
    left = line((0, 0, 0), (span / 2, 0, -half), length / 2, 26)
    points = np.concatenate([left, (left * (-1, 1, 1) + (span, 0, 0))[-2::-1]])
    rope = BulletRope(world, np.linspace(0, length, 51), points, {**STIFF, 'flexibility': 1e-6})
    rope.hold((0, 50))
    assert -settle(rope, 60.0)[:, 2].min() == pytest.approx(sag, rel=0.006)


@pytest.mark.parametrize('friction', [0.1, 0.4, 1.0])
def test_pulling_a_rope_over_a_table_takes_its_friction(world, friction):
    table(world)
    stiffness = 20.0  # N, soft, so that its stretch is a measure of the force
    points = line((0, 0, 0.005), (1, 0, 0), 1.0, 31)
    rope = BulletRope(world, np.linspace(0, 1, 31), points,
                      {**STIFF, 'elasticity': stiffness, 'friction': friction, 'damping': 0.01})
    rope.hold((30,))
    for _ in range(3000):
        rope.step(rope.points[[30]] + (0.1 * rope.time_step, 0, 0))
    # The force at s is mu m g s / L, so that the stretch is mu m g L / (2 EA); the held node slides too.
    stretch = rope.points[30, 0] - rope.points[0, 0] - 1.0
    assert stretch == pytest.approx(friction * 0.05 * GRAVITY / (2 * stiffness), rel=0.05)


def test_a_rope_on_a_table_stays_where_friction_holds_it(world):
    table(world)
    bend = np.linspace(0, np.pi / 2, 31)
    points = np.stack([0.6 * np.sin(bend), 0.6 * (1 - np.cos(bend)), 0 * bend + 0.005], axis=1)
    rope = BulletRope(world, np.linspace(0, 0.6 * np.pi / 2, 31), points, {**STIFF, 'flexibility': 1e-5})
    for _ in range(2000):
        rope.step()
    assert np.abs(rope.points - points).max() < 2e-4


@pytest.mark.parametrize('radius', [0.002, 0.005, 0.015])
def test_legs_laid_across_each_other_do_not_pass_through(world, radius):
    table(world)
    # A loop: the last leg lies, 6 cm higher, across the first, and falls onto it while it is pulled.
    turn = np.linspace(-np.pi / 2, np.pi, 40)
    loop = np.stack([0.12 + 0.1 * np.cos(turn), 0.1 * np.sin(turn) + 0.1, 0 * turn], axis=1)
    first = line((-0.3, 0, 0), (1, 0, 0), 0.41, 15)[:-1]
    last = line((0.02, 0.09, 0), (0, -1, 0), 0.3, 12)
    points = np.concatenate([first, loop, last]) + (0, 0, radius)
    points[14:54, 2] += np.linspace(0, 0.06, 40)
    points[54:, 2] += 0.06
    physical = {**STIFF, 'flexibility': 1e-4, 'self_collision': radius}
    rope = BulletRope.of(world, Chain(points), physical, nodes=61)
    assert crossing_side(rope.points) > 0.05  # the last leg is above the first
    rope.hold((0, 60))
    for _ in range(1500):
        targets = rope.points[[0, 60]]
        targets[1] += np.array((0, -0.02, -0.03 if targets[1, 2] > radius else 0)) * rope.time_step
        rope.step(targets)
        assert crossing_side(rope.points) > 0.5 * radius
    assert crossing_side(rope.points) > 1.5 * radius


def crossing_side(points):
    """Return the height of the later over the earlier of two crossing segments, seen from above."""
    for i in range(len(points) - 1):
        for j in range(i + 2, len(points) - 1):
            a, b = points[i + 1] - points[i], points[j + 1] - points[j]
            determinant = a[1] * b[0] - a[0] * b[1]
            if abs(determinant) < 1e-12:
                continue
            d = points[j] - points[i]
            s = (d[1] * b[0] - d[0] * b[1]) / determinant
            t = (a[0] * d[1] - a[1] * d[0]) / determinant
            if 0 <= s <= 1 and 0 <= t <= 1:
                return (points[j] + t * b - points[i] - s * a)[2]
    raise AssertionError('the legs do not cross')


def test_damping_does_not_move_the_resting_shape(world):
    shapes = []
    for damping, internal in ((0.5, 1e-4), (5.0, 1e-4), (5.0, 3e-2)):
        points = line((0, 0, 0), (1, 0, 0), 1.0, 31)
        rope = BulletRope(world, np.linspace(0, 1, 31), points,
                          {**STIFF, 'flexibility': 1e-2, 'damping': damping, 'internal_damping': internal})
        rope.hold((0, 1, 30))
        shapes.append(settle(rope, 120.0))
        rope.remove()
    assert np.abs(shapes[1] - shapes[0]).max() < 2e-4
    assert np.abs(shapes[2] - shapes[0]).max() < 2e-4


def test_a_rope_falls_onto_an_obstacle_of_its_world_and_rests_on_it(world):
    table(world)
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.1, 0.1, 0.05],
                                        physicsClientId=world)
    pybullet.createMultiBody(0, box, basePosition=[0.5, 0, 0.05], physicsClientId=world)
    rope = BulletRope.of(world, Chain(line((0, 0, 0.2), (1, 0, 0), 1.0, 11)), {**STIFF, 'flexibility': 1e-5})
    points = settle(rope)
    assert points[15, 2] == pytest.approx(0.105, abs=2e-3)
    assert points[[0, -1], 2] == pytest.approx(0.005, abs=2e-3)


def drag_trial(height=0.004, noise=0.0, release=True):
    """Return a rope on a table, bent a little, of which a hand drags one point sideways."""
    generator = np.random.default_rng(3)
    x = np.linspace(0, 0.6, 21)
    points = np.stack([x, 0.03 * np.sin(8 * x), 0 * x + height], axis=1)
    points = points + noise * generator.standard_normal(points.shape)
    hand = Hand('hand', (5,), [0.0, 1.0], [points[5], points[5] + (0.02, 0.1, 0)])
    held = () if release else ('hand',)
    return Trial('drag', Chain(points), (Action((hand,)),), (Goal(Chain(points), 3.0, held_by=held),))


def fold_trial():
    """Return a rope whose end is folded back over itself."""
    x = np.linspace(0, 0.6, 21)
    points = np.stack([x, 0.01 * np.sin(5 * x), 0 * x + 0.005], axis=1)
    path = [points[20], (0.5, 0, 0.07), (0.25, 0, 0.07), (0.2, 0.0, 0.012)]
    hand = Hand('hand', (20,), [0.0, 0.5, 1.5, 2.0], path)
    return Trial('fold', Chain(points), (Action((hand,)),), (Goal(Chain(points), 3.0),))


PHYSICAL = {**STIFF, 'flexibility': 1e-4, 'mass': 0.03, 'damping': 1.0, 'internal_damping': 1e-4}


def digest(rollout):
    return hashlib.sha256(rollout.chains.tobytes()).hexdigest()


def test_a_repeat_is_bit_exact_after_any_other_trial():
    simulator = BulletSimulator()
    first = simulator.simulate(drag_trial(), PHYSICAL)
    simulator.simulate(fold_trial(), {**PHYSICAL, 'friction': 1.5, 'flexibility': 1e-2})
    again = simulator.simulate(drag_trial(), PHYSICAL)
    fresh = BulletSimulator().simulate(drag_trial(), PHYSICAL)
    assert digest(first) == digest(again) == digest(fresh)
    simulator.close()
    assert digest(simulator.simulate(drag_trial(), PHYSICAL)) == digest(first)
    simulator.close()


def test_a_repeat_is_bit_exact_in_another_process():
    code = ('import sys; sys.path[:0] = sys.argv[1:]\n'
            'from test_bullet import *\n'
            'print(digest(BulletSimulator().simulate(fold_trial(), PHYSICAL)))')
    from pathlib import Path
    here = Path(__file__).parent
    printed = subprocess.run([sys.executable, '-c', code, str(here), str(here.parent)],
                             capture_output=True, text=True, check=True).stdout
    assert printed.split()[-1] == digest(BulletSimulator().simulate(fold_trial(), PHYSICAL))


def test_random_and_corner_parameter_sets_stay_finite():
    """Hundreds of them, free parameters and the fixed ones, over a drag and a fold."""
    simulator = BulletSimulator(settle_limit=1.0)
    names = tuple(parameter.name for parameter in PARAMETERS)
    space = ParameterSpace(names)
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * len(names)), axis=-1).reshape(-1, len(names))
    sets = np.concatenate([corners, np.random.default_rng(0).random((80, len(names)))])
    assert len(sets) > 200
    for k, point in enumerate(sets):
        trial = (drag_trial(noise=0.001), fold_trial())[k % 2]
        chains = simulator.simulate(trial, space.physical(space.values(point), 0.6)).chains
        assert np.isfinite(chains).all()
        assert np.abs(chains).max() < 2.0, space.values(point)
    simulator.close()


@pytest.mark.parametrize('noise', [0.0, 0.001])
def test_a_radius_that_is_not_the_measured_height_neither_kicks_nor_floats(noise):
    simulator = BulletSimulator()
    trial = drag_trial(height=0.008, noise=noise)
    hand = Hand('hand', (5,), [0.0, 1.0], [trial.initial.points[5]] * 2)
    waiting = Trial('wait', trial.initial, (Action((hand,)),), trial.goals)
    dragged = []
    for radius in (0.002, 0.004, 0.008, 0.03):
        physical = {**PHYSICAL, 'self_collision': radius, 'friction': 1.0}
        chain = simulator.simulate(waiting, physical).chains[0]
        assert chain[:, 2] == pytest.approx(np.full(21, 0.008), abs=1e-3)
        assert np.abs(chain[:, :2] - trial.initial.points[:, :2]).max() < 0.001 + noise
        dragged.append(simulator.simulate(trial, physical).chains[0])
    for chain in dragged:
        assert np.abs(chain - dragged[2]).max() < 1e-9  # no part touches another: the radius changes nothing


def test_a_trial_that_never_settles_says_so():
    trial = drag_trial()
    slow = BulletSimulator(table=False, settle_limit=0.5).simulate(trial, PHYSICAL)
    assert slow.settled == (False,)  # it falls for ever
    assert BulletSimulator().simulate(trial, PHYSICAL).settled == (True,)


def test_a_hand_that_holds_stays_and_one_that_released_lets_the_point_sink():
    points = line((0, 0, 0.005), (1, 0, 0), 0.6, 21)
    hand = Hand('hand', (10,), [0.0, 1.0], [points[10], points[10] + (0, 0, 0.1)])
    for held_by, height in ((('hand',), 0.105), ((), 0.005)):
        trial = Trial('hold', Chain(points), (Action((hand,)),), (Goal(Chain(points), 2.0, held_by=held_by),))
        chain = BulletSimulator().simulate(trial, PHYSICAL).chains[0]
        assert chain[10, 2] == pytest.approx(height, abs=1e-3)


def test_a_clamp_keeps_the_direction_and_turns_with_the_hand():
    points = line((0, 0, 0.5), (1, 0, 0), 0.6, 21)
    turn = [[0, 0, 0, 1], [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]]  # a quarter about z
    hand = Hand('hand', (0, 1), [0.0, 1.0], [points[0], points[0]], turn)
    trial = Trial('turn', Chain(points), (Action((hand,)),), (Goal(Chain(points), 2.0, held_by=('hand',)),))
    chain = BulletSimulator(table=False).simulate(trial, PHYSICAL).chains[0]
    assert chain[1] == pytest.approx((0, 0.03, 0.5), abs=1e-4)


def test_timed_goals_see_the_chain_in_motion():
    points = line((0, 0, 1.0), (1, 0, 0), 0.6, 21)
    velocity = np.tile((0.0, 1.0, 0.0), (21, 1))
    hand = Hand('hand', (0,), [0.0, 0.2], [points[0], points[0] + (0, 0.2, 0)])
    goals = tuple(Goal(Chain(points), t, stable=False, held_by=('hand',)) for t in (0.05, 0.1033))
    trial = Trial('throw', Chain(points), (Action((hand,)),), goals, velocity)
    simulator = BulletSimulator(table=False)
    chains = simulator.simulate(trial, {**PHYSICAL, 'damping': 0.01}).chains
    for chain, t in zip(chains, (0.05, 0.1033), strict=True):
        # All of it moves at 1 m/s; the free end falls freely.
        assert chain[:, 1] == pytest.approx(np.full(21, t), abs=1e-3)
        assert chain[-1, 2] == pytest.approx(1.0 - GRAVITY * t**2 / 2, abs=3e-3)
