# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A rest shape in a material frame: textbook shapes, and what turning a clamp does to a coiled DLO."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from stepping import properties
from stepping import SteppedRod as Rod
from test_rod import GRAVITY, NONE, straight

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator


def settled(rod, points, gravity=NONE, steps=2000):
    velocities = np.zeros_like(points)
    for _ in range(steps):
        velocities = rod.velocities(points, velocities, gravity, np.zeros((len(rod.rope.held), 3)))
        points = points + rod.time_step * velocities
    return points


@pytest.mark.parametrize(('torsion', 'curvature'), [(0.0, -3.0), (0.8, 3.0)])
def test_a_coiled_cantilever_hangs_like_the_elastica(torsion, curvature):
    """
    EI (angle' - k)' = w (L - s) cos(angle), angle(0) = 0, angle'(L) = k, for a weight w per length.

    A clamp that does not hold the material frame (torsion 0) would let a coil turn that curls upwards.
    """
    stiffness, load = 2e-3, 0.05 * 9.81 / 2e-3
    rest = np.concatenate([[0.01], np.full(40, 0.01)])
    rod = Rod(rest, properties(stiffness, 1e4, 0.05 * rest.sum(), 4.0, 0.03,
                                  natural_curvature=abs(curvature), torsion=torsion), 0.004)
    rod.hold((0, 1))
    points = straight(rest)
    points[2:, 2] += 0.5 * curvature * (points[2:, 0] - 0.01)**2
    points = settled(rod, points, GRAVITY)
    along = np.linspace(0, 0.4, 41)
    elastica = solve_bvp(
        lambda s, y: np.array([y[1], load * (0.4 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1] - curvature, a[2], a[3]]), along, np.zeros((4, 41)))
    assert elastica.success
    x, z = elastica.sol(along)[2:]
    assert points[1:] == pytest.approx(np.stack([0.01 + x, 0 * x, z], axis=1), abs=0.002)


@pytest.mark.parametrize(('share', 'leaves'), [(0.92, False), (1.08, True)])
def test_a_twisted_ring_leaves_its_plane_when_twisted_too_much(share, leaves):
    """
    Michell: an elastic ring is unstable if it is twisted by more than 2 pi sqrt(3) EI / GJ.

    Two clamps side by side, whose directions agree, hold the cross-section at which the ring was closed.
    """
    torsion, count = 1.2, 48
    corners = 2 * np.pi * np.arange(count + 1) / count
    points = 0.25 * np.stack([np.sin(corners), 1 - np.cos(corners), 0 * corners], axis=1)
    points = np.concatenate([[[-1e-3, 0, 0]], points, [[1e-3, 0, 0]]])
    rest = np.linalg.norm(np.diff(points, axis=0), axis=1)
    rod = Rod(rest, properties(1e-3, 1e4, 0.05, 1.0, 0.005, torsion=torsion), 0.004)
    rod.hold((0, 1, count + 1, count + 2))
    points[2:-2] += 1e-5 * np.random.default_rng(0).normal(size=(count - 1, 3))
    rod.frame_forces(points)
    rod.turned(points, {count + 1: (share * 2 * np.pi * np.sqrt(3) / torsion, 0, 0)})
    away = 0.0
    for _ in range(8):
        points = settled(rod, points, steps=250)
        away = max(away, np.abs(points[:, 2]).max())
    # The corners of the chain bend it out of the plane by a little.
    assert away > 0.1 if leaves else away < 0.003, away


def test_a_clamp_that_turns_carries_the_coil_around():
    rest = np.concatenate([[0.01], np.full(24, 0.02)])
    rod = Rod(rest, properties(2e-3, 1e4, 0.05, 3.0, 0.02, natural_curvature=2.5, torsion=1.0), 0.004)
    rod.hold((0, 1))
    points = straight(rest)
    points[2:, 1] += 0.5 * 2.5 * (points[2:, 0] - 0.01)**2
    before = settled(rod, points)
    rod.turned(before, {0: (np.pi / 2, 0, 0)})
    after = settled(rod, before)
    assert np.abs(before[:, 1]).max() > 0.1
    assert after == pytest.approx(np.stack([before[:, 0], 0 * before[:, 1], before[:, 1]], axis=1), abs=1e-3)


def test_free_ends_and_pins_bear_no_torque():
    rest = np.full(20, 0.03)
    shape = tuple(np.random.default_rng(1).normal(0, 4, (5, 2)))
    for held in ((), (0, 20), (0, 1, 20)):
        rod = Rod(rest, properties(2e-3, 1e4, 0.05, 3.0, 0.02, torsion=0.8, rest_curvature=shape), 0.004)
        rod.hold(held)
        points = straight(rest) + 0.003 * np.random.default_rng(2).normal(size=(21, 3))
        points = settled(rod, points, GRAVITY if held else NONE, 800)
        state = rod.state
        moments = state.twisting * np.diff(state.angles)
        bends, cosine, sine = state.joints[:, :2], state.joints[:, 4], state.joints[:, 5]
        x, y = (state.natural[:, 0] * cosine - state.natural[:, 1] * sine,
                state.natural[:, 0] * sine + state.natural[:, 1] * cosine)
        slopes = (bends[:, 0] * y - bends[:, 1] * x) / 2
        torques = np.concatenate([moments - slopes, [0.0]]) - np.concatenate([[0.0], moments + slopes])
        assert np.abs(torques[1 if 1 in held else 0:]).max() < 2e-3 * np.abs(moments).max()


def around(turn):
    """Return a trial: a coiled cable between two hands, one of which turns about its axis by `turn` [rad]."""
    points = np.stack([np.linspace(0, 0.5, 21), np.zeros(21), np.full(21, 0.5)], axis=1)
    points[1:-1, 2] -= 0.2 * (points[1:-1, 0] - 0.025) * (0.475 - points[1:-1, 0])
    quaternions = [[np.sin(angle / 2), 0, 0, np.cos(angle / 2)] for angle in (0, turn / 2, turn)]
    hands = (Hand('left', (0, 1), [0.0, 0.5, 1.0], [points[0]] * 3, quaternions),
             Hand('right', (19, 20), [0.0, 1.0], [points[20]] * 2))
    return Trial('turn', Chain(points), (Action(hands),),
                 (Goal(Chain(points), 1.0, stable=False, held_by=('left', 'right')),
                  Goal(Chain(points), 2.0, stable=False, held_by=('left', 'right'))))


@pytest.mark.parametrize('engine', [CompiledSimulator, BulletSimulator])
def test_a_hand_that_turns_about_the_axis_turns_the_dlo(engine):
    simulator = engine(table=False, nodes=21)
    physical = {**ParameterSpace().physical({}, 0.5), 'flexibility': 2e-3, 'damping': 3.0, 'torsion': 0.8,
                'natural_curvature': 3.0}
    plain, turned, back = (simulator.simulate(around(turn), physical).chains for turn in (0.0, 3.0, -3.0))
    assert np.abs(turned[-1] - plain[-1]).max() > 0.004
    # What turns to the other side swings to the other side of the plane.
    assert back[-1] == pytest.approx(turned[-1] * (1, -1, 1), abs=1e-6)
    without = {**physical, 'torsion': 0.0}
    assert simulator.simulate(around(3.0), without).chains == pytest.approx(
        simulator.simulate(around(0.0), without).chains, abs=1e-9)
    simulator.close()


def twisted(points, turns):
    """Return a trial: the first clamp of a DLO turns about its axis by `turns` [rad], evenly in time."""
    quaternions = [[np.sin(angle / 2), 0, 0, np.cos(angle / 2)] for angle in turns]
    hands = (Hand('left', (0, 1), np.linspace(0, 1, len(turns)), [points[0]] * len(turns), quaternions),
             Hand('right', (19, 20), [0.0, 1.0], [points[20]] * 2))
    return Trial('twisted', Chain(points), (Action(hands),),
                 tuple(Goal(Chain(points), time, stable=False, held_by=('left', 'right'))
                       for time in (4.0, 5.0)))


@pytest.mark.parametrize('turn', [3.0, 3.3, -3.3])
def test_a_dlo_twisted_by_about_half_a_turn_stays_as_it_is_in_the_next_trial(turn):
    # The directions of both clamps are the same after a turn in either direction.
    points = np.stack([np.linspace(0, 0.5, 21), np.zeros(21), np.full(21, 0.5)], axis=1)
    points[1:-1, 2] -= 0.8 * (points[1:-1, 0] - 0.025) * (0.475 - points[1:-1, 0])
    curved = {f'rest_curvature_{axis}{knot}': 6.0 * (axis == 'x') for axis in 'xy' for knot in (1, 2, 3)}
    physical = {**ParameterSpace().physical({}, 0.5), 'flexibility': 2e-3, 'damping': 3.0, 'torsion': 0.8,
                'clamp_twist': np.pi, **curved}  # the hands' directions differ by half a turn
    simulator = CompiledSimulator(table=False, nodes=21)
    rests, later = simulator.simulate(twisted(points, (0, turn / 2, turn)), physical).chains
    assert later == pytest.approx(rests, abs=1e-3)
    again = simulator.simulate(twisted(rests, (turn, turn)), physical).chains
    assert again[-1] == pytest.approx(later, abs=1e-3)


# Two segments at an angle have a bend of twice the sine of half of it.
ANGLE = 2 * np.arcsin(np.hypot(0.2, 0.1) / 2)
LEAVES = np.array([np.cos(ANGLE), *(np.sin(ANGLE) / np.hypot(0.2, 0.1) * np.array([-0.1, 0.2]))])


@pytest.mark.parametrize(('clamp', 'leaves'), [(1, LEAVES), (2, -LEAVES)])
def test_a_dlo_that_nothing_bends_leaves_its_clamp_in_the_direction_of_the_bend(clamp, leaves):
    points = np.stack([np.linspace(0, 0.5, 21), np.zeros(21), np.full(21, 0.5)], axis=1)
    held = (0, 1) if clamp == 1 else (20, 19)
    hand = Hand('hand', tuple(sorted(held)), [0.0, 1.0], [points[held[0]]] * 2)
    trial = Trial('held', Chain(points), (Action((hand,)),), (Goal(Chain(points), 9.0, held_by=('hand',)),))
    askew = {f'clamp_bend_{axis}{clamp}': bend for axis, bend in (('x', 0.2), ('y', 0.1))}
    straight = {f'rest_curvature_{axis}{knot}': 0.0 for axis in 'xy' for knot in (1, 2, 3)}
    physical = {**ParameterSpace().physical({}, 0.5), 'flexibility': 1e-2, 'damping': 3.0, 'torsion': 1.0,
                'clamp_twist': 0.0, 'mass': 1e-6, **straight, **askew}
    simulator = CompiledSimulator(table=False, nodes=21)
    chain = simulator.simulate(trial, physical).chains[-1]
    along = (chain[::-1] if clamp == 2 else chain)[2:] - chain[held[1]]
    assert along[-1] / np.linalg.norm(along[-1]) == pytest.approx(leaves, abs=1e-3)
    bent = np.linalg.norm(np.cross(along, along[-1]), axis=1) / np.linalg.norm(along[-1])
    assert bent.max() < 1e-3  # from there on, it is straight
    # Without resistance to twist, its hands do not say which side of it is bent.
    assert simulator.simulate(trial, {**physical, 'torsion': 0.0}).chains[-1] == pytest.approx(
        simulator.simulate(trial, {**physical, 'torsion': 0.0, **dict.fromkeys(askew, 0.0)}).chains[-1])
    simulator.close()


@pytest.mark.parametrize('ratio', [0.5, 1.2])
def test_a_twisted_ring_leaves_its_plane_as_michell_says(ratio):
    """At 2 pi sqrt(3) EI / GJ (Michell, On the stability of a bent and twisted wire, 1889)."""
    around, critical = np.linspace(0, 2 * np.pi, 101), 2 * np.pi * 3**0.5 / ratio
    points = np.stack([np.sin(around), 1e-3 * np.sin(around), 1 - np.cos(around)], axis=1) / (2 * np.pi)
    angles = np.linspace(0, 1.1 * critical, 80)
    times, axis = angles / 0.2, (points[-1] - points[-2]) / np.linalg.norm(points[-1] - points[-2])
    turns = np.column_stack([np.sin(angles / 2)[:, None] * axis, np.cos(angles / 2)])
    hands = (Hand('left', (0, 1), [0.0, times[-1]], [points[0]] * 2),
             Hand('right', (99, 100), times, [points[-1]] * len(times), turns))
    shares = np.linspace(0.5, 0.999, 100)
    trial = Trial('ring', Chain(points), (Action(hands),), tuple(
        Goal(Chain(points), float(share * times[-1]), stable=False, held_by=('left', 'right'))
        for share in shares))
    physical = {**ParameterSpace().physical({}, 1.0), 'flexibility': 1e-2, 'mass': 1e-4, 'damping': 3.0,
                'torsion': ratio, 'elasticity': 1e5, 'self_collision': 2e-3, 'internal_damping': 0.01}
    simulator = CompiledSimulator(table=False, nodes=101)
    away = np.abs(simulator.simulate(trial, physical).chains[:, :, 1]).max(axis=1)
    assert away[0] < 0.01  # m, of a ring of 318 mm
    assert 1.1 * shares[np.argmax(away > 0.03)] == pytest.approx(0.97, abs=0.04)
    simulator.close()
