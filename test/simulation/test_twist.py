# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Twist between two clamps: its energy and forces, and what turning a clamp does to a DLO."""

import numpy as np
import pytest
from stepping import properties, SteppedRope
from stepping import SteppedRod as Rod
from test_rod import crumpled, NONE, straight

from dlo_calibration.model.parameters import ParameterSpace

ENDS = (0, 1, 11, 12)
CLAMPED = properties(1e-2, 500.0, 0.05, torsion=0.7)


def held(points, nodes=ENDS):
    """Return a rod whose clamps have just closed, as they find it."""
    rod = Rod(np.full(len(points) - 1, 0.05), CLAMPED, 1e-8)
    rod.hold(nodes)
    rod.frame_forces(points)
    return rod


def moments(rod, points):
    """Return the (N - 2,) [N m] twisting moments at rest."""
    rod.frame_forces(points, 100)
    state = rod.state
    return state.twisting * np.diff(state.angles) if len(state.angles) else np.zeros(len(points) - 2)


def test_a_dlo_is_clamped_without_twist():
    points = crumpled(3, np.full(12, 0.05), 0.3)
    rod = held(points)
    assert np.abs(moments(rod, points)).max() < 1e-12
    assert np.abs(rod.frame_forces(points)).max() < 1e-12


def test_nothing_twists_in_a_plane():
    angles = np.linspace(0, 5, 13)
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    rod = held(points)
    for size in (1.0, 0.8, 0.5):
        assert np.abs(moments(rod, points * (size, 1, 1))).max() < 1e-9


def test_clamps_twist_the_part_between_them_and_nothing_else():
    points = straight(np.full(12, 0.05))
    for nodes, lengths in (((0, 1, 11, 12), {(1, 11): 0.5}), ((0, 1, 6, 7), {(1, 6): 0.25}),
                           ((0, 1, 5, 11, 12), {(1, 11): 0.5}), ((0, 6, 7), {}), ((3,), {}), ((0, 12), {}),
                           ((0, 1, 7, 8, 11, 12), {(1, 7): 0.3, (8, 11): np.inf})):
        rod = held(points, nodes)
        rod.turned(points, {node: (0.8, 0, 0) for node in nodes if node > 5 and node + 1 in nodes})
        expected = np.zeros(11)
        for (first, last), length in lengths.items():
            expected[first - 1:last] = 0.7 * 1e-2 * 0.8 / length
        assert moments(rod, points) == pytest.approx(expected, abs=1e-9), nodes


@pytest.mark.parametrize('turn', [1.0, 3.0, 9.0, -20.0])
def test_a_clamp_that_turns_about_its_axis_twists_the_dlo_by_that_angle(turn):
    angles = np.linspace(0, 2, 13)
    points = 0.3 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    axis = (points[12] - points[11]) / np.linalg.norm(points[12] - points[11])
    rod = held(points)
    rod.turned(points, {11: turn * axis})
    assert moments(rod, points) == pytest.approx(np.full(11, 0.7 * 1e-2 * turn / 0.5))


def test_the_part_between_the_same_clamps_stays_twisted():
    points = straight(np.full(12, 0.05))
    rod = held(points)
    rod.turned(points, {11: (1.5, 0, 0)})
    twisted = moments(rod, points)
    assert twisted.min() > 0.01
    rod.hold((0, 1, 6, 11, 12))
    assert moments(rod, points) == pytest.approx(twisted)
    rod.hold((0, 1, 5, 6, 11, 12))  # a clamp in the middle keeps what it finds
    assert moments(rod, points)[[1, 9]] == pytest.approx(twisted[[1, 9]], rel=0.15)
    rod.hold((0, 1))
    assert moments(rod, points) == pytest.approx(np.zeros(11), abs=1e-12)
    rod.hold((0, 1, 11, 12))
    assert moments(rod, points) == pytest.approx(np.zeros(11), abs=1e-12)


@pytest.mark.parametrize(('turns', 'buckles'), [(0.85, False), (1.15, True)])
def test_a_twisted_straight_rod_stays_straight_until_twisted_too_much(turns, buckles):
    """Greenhill: a clamped rod buckles at a torque of 8.987 EI / L; here just below and just above."""
    rest = np.full(42, 0.025)
    rod = Rod(rest, properties(1e-3, 1e4, 0.05, 1.0, 0.02, torsion=1.0), 0.004)
    rod.hold((0, 1, 41, 42))
    points = straight(rest)
    points[2:-2] += 1e-4 * np.random.default_rng(0).normal(size=(39, 3))
    rod.velocities(points, np.zeros_like(points), NONE, np.zeros((4, 3)))
    rod.turned(points, {41: (8.987 * turns, 0, 0)})
    velocities = np.zeros_like(points)
    for _ in range(2500):
        velocities = rod.velocities(points, velocities, NONE, np.zeros((4, 3)))
        points = points + 0.004 * velocities
    away = np.linalg.norm(points[:, 1:], axis=1).max()
    # Between fixed ends it has little room to.
    assert away > 2e-4 if buckles else away < 5e-5, away


def test_torsion_changes_a_loop_between_two_clamps_and_nothing_else():
    def rollout(torsion, clamps):
        rest = np.full(20, 0.03)
        points = straight(rest)
        physical = {**ParameterSpace().physical({}, 0.6), 'torsion': torsion, 'flexibility': 1e-3}
        rope = SteppedRope(points[:, 0], points, np.zeros((21, 3)), physical, 0.004)
        rope.hold(clamps)
        way = np.linspace(0, 1, 500)[:, None, None] * (-0.45, 0.1, 0.0)
        still = np.array([0.0 if node < 10 else 1.0 for node in clamps])[:, None]
        swing = np.sin(np.linspace(0, np.pi, 500))[:, None, None] * (0.0, 0.0, 0.15)
        rope.advance(points[list(clamps)] + still * (way + swing))
        return rope.points

    assert np.abs(rollout(0.0, (0, 1, 19, 20)) - rollout(5.0, (0, 1, 19, 20))).max() > 1e-3
    assert rollout(0.0, (0, 20)).tobytes() == rollout(5.0, (0, 20)).tobytes()
