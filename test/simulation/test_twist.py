# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Twist between two clamps: its energy and forces, and what turning a clamp does to a DLO."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from oracles import twist_forces
import pytest
from stepping import SteppedRod as Rod
from test_rod import CABLE, crumpled, NONE, straight

from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.compiled import CompiledRope
from dlo_calibration.simulation.kernels import SPAN
from dlo_calibration.simulation.rod import RodProperties


def clamped(count, stiffness=2.0):
    """Return the span between the first and the last segment of `count`."""
    spans = np.zeros(1, SPAN)
    spans['last'], spans['stiffness'] = count - 1, stiffness
    return spans


def forces(points, spans):
    compiled = np.zeros(points.size)
    kernels.add_twist(points, spans, 1.0, compiled)
    return compiled.reshape(-1, 3)


def begun(seed, count=9):
    """Return points, and a span that began elsewhere: it is twisted."""
    rest = np.random.default_rng(seed).uniform(0.02, 0.06, count)
    spans = clamped(count)
    forces(crumpled(seed, rest, 0.15), spans)
    return crumpled(seed + 1, rest, 0.15), spans


@settings(derandomize=True, max_examples=10)
@given(st.integers(0, 2**31))
def test_forces_are_the_slope_of_the_energy(seed):
    points, spans = begun(seed)

    def energy(points):
        moved = spans.copy()
        forces(points, moved)
        return moved['stiffness'][0] * moved['angle'][0]**2 / 2

    got = forces(points, spans.copy())
    # A clamp's segment may turn its frame: what acts on it is the clamp's affair.
    for index in np.ndindex(points.shape):
        if 2 <= index[0] < len(points) - 2:
            moved = np.zeros_like(points)
            moved[index] = 1e-6
            expected = (energy(points - moved) - energy(points + moved)) / 2e-6
            assert got[index] == pytest.approx(expected, abs=1e-5 * np.abs(got).max())


@settings(derandomize=True, max_examples=20)
@given(st.integers(0, 2**31))
def test_the_compiled_forces_are_the_same(seed):
    points, spans = begun(seed)
    same = spans.copy()
    for shift in (0.0, 0.002, 0.004):
        here = points + shift * np.random.default_rng(seed).normal(size=points.shape)
        expected = twist_forces(here, spans)
        assert forces(here, same) == pytest.approx(expected, abs=1e-10 * max(1, np.abs(expected).max()))
        for name in SPAN.names:
            assert same[name] == pytest.approx(spans[name], abs=1e-9)


def test_the_compiled_frame_begins_untwisted():
    points = crumpled(3, np.full(9, 0.05), 0.3)
    spans = clamped(9)
    assert np.abs(forces(points, spans)).max() < 1e-12 / 0.004
    assert spans['angle'][0] == pytest.approx(0, abs=1e-9)


def test_nothing_twists_in_a_plane():
    angles = np.linspace(0, 5, 20)
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    spans = clamped(19)
    for size in (1.0, 0.8, 0.5):
        assert np.abs(forces(points * (size, 1, 1), spans)).max() < 1e-9


def test_parts_between_clamps_only_and_in_series():
    rod = Rod(np.full(12, 0.05), RodProperties(1e-2, 500.0, 0.05, torsion=0.7), 0.004)
    assert len(rod.state.spans) == 0
    rod.hold((3,))
    assert len(rod.state.spans) == 0
    rod.hold((0, 1, 5, 11, 12))  # the one in the middle is a pin
    (span,) = rod.state.spans
    assert (span['first'], span['last']) == (0, 11)
    assert span['stiffness'] == pytest.approx(0.7 * 1e-2 / 0.5)
    assert len(Rod(np.full(12, 0.05), CABLE, 0.004).state.spans) == 0


def test_what_stays_between_the_same_clamps_stays_twisted():
    rod = Rod(np.full(12, 0.05), RodProperties(1e-2, 500.0, 0.05, torsion=0.7), 0.004)
    rod.hold((0, 1, 11, 12))
    rod.state.spans['angle'][0] = 1.5
    rod.hold((0, 1, 6, 11, 12))
    assert rod.state.spans['angle'][0] == 1.5
    rod.hold((0, 1))
    rod.hold((0, 1, 11, 12))
    assert rod.state.spans['angle'][0] == 0


def test_a_twisted_straight_rod_stays_straight_until_twisted_too_much():
    """Greenhill: a clamped rod buckles at a torque of 8.987 EI / L; here just below and just above."""
    rest = np.full(42, 0.025)
    for turns, buckles in ((0.85, False), (1.15, True)):
        rod = Rod(rest, RodProperties(1e-3, 1e4, 0.05, 1.0, 0.02, torsion=1.0), 0.004)
        rod.hold((0, 1, 41, 42))
        points = straight(rest)
        points[2:-2] += 1e-4 * np.random.default_rng(0).normal(size=(39, 3))
        velocities = rod.velocities(points, np.zeros_like(points), NONE, np.zeros((4, 3)))
        rod.state.spans['angle'][0] = angle = 8.987 * turns
        # The frame of the last clamp is what holds it twisted.
        frame, tangent = rod.state.spans['end_frame'][0], rod.state.spans['end'][0]
        frame[:] = np.cos(angle) * frame + np.sin(angle) * np.cross(tangent, frame)
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
        rope = CompiledRope(points[:, 0], points, np.zeros((21, 3)), physical, 0.004)
        rope.hold(clamps)
        way = np.linspace(0, 1, 500)[:, None, None] * (-0.45, 0.1, 0.0)
        still = np.array([0.0 if node < 10 else 1.0 for node in clamps])[:, None]
        swing = np.sin(np.linspace(0, np.pi, 500))[:, None, None] * (0.0, 0.0, 0.15)
        rope.advance(points[list(clamps)] + still * (way + swing))
        return rope.points

    assert np.abs(rollout(0.0, (0, 1, 19, 20)) - rollout(5.0, (0, 1, 19, 20))).max() > 1e-3
    assert rollout(0.0, (0, 20)).tobytes() == rollout(5.0, (0, 20)).tobytes()
