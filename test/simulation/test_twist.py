# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Twist between two clamps: its energy and forces, and what turning a clamp does to a DLO."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from test_rod import CABLE, crumpled, NONE, straight

from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.compiled import CompiledRope
from dlo_calibration.simulation.rod import Rod, RodProperties
from dlo_calibration.simulation.twist import ANGLE, FIRST, LAST, spans_between, STIFFNESS, twist_forces


def clamped(count, stiffness=2.0):
    """Return the span between the first and the last segment of `count`."""
    rigid = np.isin(np.arange(count), (0, count - 1))
    return spans_between(rigid, np.full(count - 1, 1 / (stiffness * (count - 1))), np.zeros((0, 17)))


def forces(points, spans):
    segments = np.diff(points, axis=0)
    return twist_forces(segments, np.linalg.norm(segments, axis=1), spans)


def begun(seed, count=9):
    """Return points, and a span that began elsewhere: it is twisted."""
    rest = np.random.default_rng(seed).uniform(0.02, 0.06, count)
    spans = clamped(count)
    forces(crumpled(seed, rest, 0.15), spans)
    return crumpled(seed + 1, rest, 0.15), spans


@settings(deadline=None, derandomize=True, max_examples=10)
@given(st.integers(0, 2**31))
def test_forces_are_the_slope_of_the_energy(seed):
    points, spans = begun(seed)

    def energy(points):
        moved = spans.copy()
        forces(points, moved)
        return moved[0, STIFFNESS] * moved[0, ANGLE]**2 / 2

    got = forces(points, spans.copy())
    # A clamp's segment may turn its frame: what acts on it is the clamp's affair.
    for index in np.ndindex(points.shape):
        if 2 <= index[0] < len(points) - 2:
            moved = np.zeros_like(points)
            moved[index] = 1e-6
            expected = (energy(points - moved) - energy(points + moved)) / 2e-6
            assert got[index] == pytest.approx(expected, abs=1e-5 * np.abs(got).max())


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 2**31))
def test_the_compiled_forces_are_the_same(seed):
    points, spans = begun(seed)
    same = spans.copy()
    for shift in (0.0, 0.002, 0.004):
        here = points + shift * np.random.default_rng(seed).normal(size=points.shape)
        right = np.zeros(3 * len(points))
        kernels.add_twist(here, same, 0.004, right)
        expected = 0.004 * forces(here, spans)
        assert right.reshape(-1, 3) == pytest.approx(expected, abs=1e-10 * max(1, np.abs(expected).max()))
        assert same == pytest.approx(spans, abs=1e-9)


def test_the_compiled_frame_begins_untwisted():
    points = crumpled(3, np.full(9, 0.05), 0.3)
    spans, right = clamped(9), np.zeros(30)
    kernels.add_twist(points, spans, 0.004, right)
    assert np.abs(right).max() < 1e-12
    assert spans[0, ANGLE] == pytest.approx(0, abs=1e-9)


def test_nothing_twists_in_a_plane():
    angles = np.linspace(0, 5, 20)
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    spans = clamped(19)
    for size in (1.0, 0.8, 0.5):
        assert np.abs(forces(points * (size, 1, 1), spans)).max() < 1e-9


def test_parts_between_clamps_only_and_in_series():
    rod = Rod(np.full(12, 0.05), RodProperties(1e-2, 500.0, 0.05, torsion=0.7), 0.004)
    assert len(rod.spans) == 0
    rod.hold((3,))
    assert len(rod.spans) == 0
    rod.hold((0, 1, 5, 11, 12))  # the one in the middle is a pin
    (span,) = rod.spans
    assert (span[FIRST], span[LAST]) == (0, 11)
    assert span[STIFFNESS] == pytest.approx(0.7 * 1e-2 / 0.5)
    assert len(Rod(np.full(12, 0.05), CABLE, 0.004).spans) == 0


def test_what_stays_between_the_same_clamps_stays_twisted():
    rod = Rod(np.full(12, 0.05), RodProperties(1e-2, 500.0, 0.05, torsion=0.7), 0.004)
    rod.hold((0, 1, 11, 12))
    rod.spans[0, ANGLE] = 1.5
    rod.hold((0, 1, 6, 11, 12))
    assert rod.spans[0, ANGLE] == 1.5
    rod.hold((0, 1))
    rod.hold((0, 1, 11, 12))
    assert rod.spans[0, ANGLE] == 0


def test_a_twisted_straight_rod_stays_straight_until_twisted_too_much():
    """Greenhill: a clamped rod buckles at a torque of 8.987 EI / L; here just below and just above."""
    rest = np.full(42, 0.025)
    for turns, buckles in ((0.85, False), (1.15, True)):
        rod = Rod(rest, RodProperties(1e-3, 1e4, 0.05, 1.0, 0.02, torsion=1.0), 0.004)
        rod.hold((0, 1, 41, 42))
        points = straight(rest)
        points[2:-2] += 1e-4 * np.random.default_rng(0).normal(size=(39, 3))
        velocities = rod.velocities(points, np.zeros_like(points), NONE, np.zeros((4, 3)))
        rod.spans[0, ANGLE] = angle = 8.987 * turns
        # The frame of the last clamp is what holds it twisted.
        start, sideways = rod.spans[0, 14:17].copy(), np.cross(rod.spans[0, 11:14], rod.spans[0, 14:17])
        rod.spans[0, 14:17] = np.cos(angle) * start + np.sin(angle) * sideways
        for _ in range(2500):
            velocities = rod.velocities(points, velocities, NONE, np.zeros((4, 3)))
            points = points + 0.004 * velocities
        away = np.linalg.norm(points[:, 1:], axis=1).max()
        # Between fixed ends it has little room to.
        assert away > 2e-4 if buckles else away < 5e-5, away


def test_torsion_changes_a_loop_between_two_clamps_and_nothing_else():
    def rollout(torsion, clamps):
        rope = CompiledRope(21, 0.004)
        rest = np.full(20, 0.03)
        points = straight(rest)
        physical = {**ParameterSpace().physical({}, 0.6), 'torsion': torsion, 'flexibility': 1e-3}
        rope.reset(np.concatenate([[0.0], np.cumsum(rest)]), points, np.zeros((21, 3)), physical, None)
        rope.hold(clamps)
        way = np.linspace(0, 1, 500)[:, None, None] * (-0.45, 0.1, 0.0)
        still = np.array([0.0 if node < 10 else 1.0 for node in clamps])[:, None]
        swing = np.sin(np.linspace(0, np.pi, 500))[:, None, None] * (0.0, 0.0, 0.15)
        rope.advance(points[list(clamps)] + still * (way + swing))
        return rope.points

    assert np.abs(rollout(0.0, (0, 1, 19, 20)) - rollout(5.0, (0, 1, 19, 20))).max() > 1e-3
    assert rollout(0.0, (0, 20)).tobytes() == rollout(5.0, (0, 20)).tobytes()
