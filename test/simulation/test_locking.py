# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Locking: a DLO of strands becomes stiffer where it is bent far."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from stepping import properties, SteppedRope
from stepping import SteppedRod as Rod
from test_rod import crumpled, energy, FREE, NONE

from dlo_calibration.model.parameters import bending_moments, GRAVITY, MOST_LOCKED, ParameterSpace

STIFFNESS, LENGTH = 1e-3, 0.02


def moment(curvature, locking, natural=0.0, **others):
    """Return the moment [N m] of locking alone at the middle of three nodes."""
    physical = properties(STIFFNESS, 1e4, 0.01, locking=locking, natural_curvature=natural, **others)
    angle = LENGTH * curvature / 2
    end = LENGTH * np.array([np.cos(angle), np.sin(angle), 0])
    points = np.array([end * (-1, 1, 1), (0, 0, 0), end])
    rod = Rod(np.full(2, LENGTH), physical, 1e-9)
    rod.velocities(points, np.zeros_like(points), NONE, FREE)
    impulse = rod.state.frame_impulses[2]
    return np.cross(end, impulse)[2] / -1e-9


@pytest.mark.parametrize('curvature', [0.5, 2.0, 5.0])
def test_the_moment_grows_with_the_cube_of_the_curvature(curvature):
    assert moment(curvature, 0.2) == pytest.approx(STIFFNESS * curvature * (0.2 * curvature)**2, rel=0.02)


def test_the_stiffening_has_a_bound():
    assert moment(5.0, 10.0) == pytest.approx(STIFFNESS * 5.0 * MOST_LOCKED, rel=0.02)


def test_a_dlo_that_is_curved_at_rest_locks_where_it_is_bent_from_there():
    alone = moment(5.0, 0.2, 3.0, torsion=1.0) - moment(5.0, 0.0, 3.0, torsion=1.0)
    assert alone == pytest.approx(STIFFNESS * 2.0 * (0.2 * 2.0)**2, rel=0.02)


def test_each_cross_section_of_a_cantilever_bears_the_weight_beyond_it():
    count, length, locking = 40, 0.4, 0.15
    places = np.linspace(0, length, count + 1)
    points = np.stack([places, 0 * places, 0 * places + 1.0], axis=1)
    physical = {**ParameterSpace().physical({}, length), 'flexibility': 2e-3, 'mass': 0.04, 'damping': 20.0,
                'elasticity': 1e4, 'locking': locking}
    rope = SteppedRope(places, points, np.zeros_like(points), physical, 0.002, level=-10.0)
    rope.hold((0, 1))
    rope.advance(np.tile(points[:2], (4000, 1, 1)))
    masses = np.full(count + 1, 0.04 / count)
    masses[-1] /= 2
    weights = np.array([GRAVITY * masses[i + 1:] @ (rope.points[i + 1:, 0] - rope.points[i, 0])
                        for i in range(2, count - 3)])
    tangents = np.diff(rope.points, axis=0)
    headings = np.arctan2(tangents[:, 2], tangents[:, 0])
    curvatures = -np.diff(headings)[1:count - 4] / (length / count)
    assert curvatures.max() * locking > 0.7  # it locks
    moments = bending_moments(curvatures, 2e-3, 0.0, 1.0, locking)
    assert moments == pytest.approx(weights, rel=0.02, abs=0.005 * weights.max())


def stored(rod):
    """Return the energy [J] of locking before the last step."""
    state = rod.state
    squares = state.joints[:, 0]**2 + state.joints[:, 1]**2
    stiffness, scale = state.locking.T
    below = np.minimum(squares, MOST_LOCKED / scale)  # beyond, the stiffness is constant
    return (stiffness * (scale * below**2 / 4 + MOST_LOCKED * (squares - below) / 2)).sum()


@drawing(20, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 0.1), st.floats(0.003, 0.3),
       st.sampled_from([0.001, 0.004, 0.01]))
def test_locking_never_gains_energy(seed, bending, locking, step):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.02, 0.05, 15)
    physical = properties(bending, 1e3, 0.05, locking=locking)
    rod = Rod(rest, physical, step)
    points = crumpled(seed, rest, 0.05)
    velocities = generator.normal(0, 0.1, points.shape)
    velocities -= velocities.mean(axis=0)
    start = None
    for _ in range(201):
        before = energy(points, rest, physical) + (rod.state.masses[:, None] * velocities**2).sum() / 2
        after = rod.velocities(points, velocities, NONE, FREE)
        start = before + stored(rod) if start is None else start
        assert before + stored(rod) < 1.05 * start
        points, velocities = points + step * after, after


def test_no_locking_is_the_plain_rod_bit_for_bit():
    rest = np.random.default_rng(0).uniform(0.02, 0.05, 12)
    points = crumpled(1, rest)
    plain, other = (Rod(rest, properties(1e-2, 500.0, 0.05, **changes), 0.004).velocities(
        points, points, NONE, FREE) for changes in ({}, {'locking': 0.0}))
    assert plain.tobytes() == other.tobytes()
