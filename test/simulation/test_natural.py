# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A DLO that is coiled: its energy and forces, and the circle that it curls to."""

from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
from oracles import frame_forces, HAIRPIN, least_energy
import pytest
from random_examples import drawing
from stepping import properties
from stepping import SteppedRod as Rod
from test_rod import crumpled, energy, FREE, NONE, straight


def coiled(curvature, **rest):
    return properties(2e-3, 1e4, 0.05, 1.0, 0.05, natural_curvature=curvature, **rest)


def bent(rest, seed=0):
    """Return a rod that is slightly bent, in a plane that is no coordinate plane."""
    turned = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    points = straight(rest)
    points[:, 1] += 0.05 * points[:, 0]**2
    return points @ turned


def go_on(rod, points, steps=3000, step=0.004):
    velocities = np.zeros_like(points)
    for _ in range(steps):
        velocities = rod.velocities(points, velocities, NONE, np.zeros((len(rod.rope.held), 3)))
        points = points + step * velocities
    return points, velocities


def circle(points):
    """Return the radius of the circle through the first, middle and last of three points."""
    a, b, c = points
    area = np.linalg.norm(np.cross(b - a, c - a)) / 2
    return np.linalg.norm(a - b) * np.linalg.norm(b - c) * np.linalg.norm(c - a) / (4 * area)


@pytest.mark.parametrize(('curvature', 'equal'), [(0.5, True), (5.0, True), (3.0, False)])
def test_a_free_coiled_rod_curls_to_its_circle(curvature, equal):
    rest = np.full(24, 0.04) if equal else np.random.default_rng(1).uniform(0.02, 0.06, 24)
    points, velocities = go_on(Rod(rest, coiled(curvature), 0.004), bent(rest))
    assert np.abs(velocities).max() < 1e-4
    for k in range(len(points) - 4):
        assert circle(points[[k, k + 2, k + 4]]) == pytest.approx(1 / curvature, rel=0.01)
    flat = np.linalg.svd(points - points.mean(axis=0))[1]
    assert flat[2] < 1e-3 * flat[0]  # it lies in a plane


def test_a_coiled_weightless_cantilever_takes_the_arc():
    rest = np.concatenate([[0.01], np.full(30, 0.02)])
    rod = Rod(rest, coiled(2.5), 0.004)
    rod.hold((0, 1))
    points = straight(rest)
    points[2:, 1] += 0.05 * (points[2:, 0] - 0.01)**2
    points, _ = go_on(rod, points)
    along = np.cumsum(rest) - 0.01
    turned = 2.5 * along
    expected = np.stack([0.01 + np.sin(turned) / 2.5, (1 - np.cos(turned)) / 2.5, 0 * along], axis=1)
    assert np.abs(points[1:] - expected).max() < 0.003


def tight(points):
    """Tell whether two segments almost fold onto each other, where energies are limited."""
    tangents = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1)[:, None]
    return (1 + (tangents[1:] * tangents[:-1]).sum(axis=1).min()) / 2 <= 2 * HAIRPIN


@drawing(12, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([0.0, 0.1, 1.0, 10.0]),
       st.sampled_from([(), (4,), (0, 1), (3, 4), (0, 1, 8, 9), (0, 1, 4, 5, 6, 8, 9)]))
def test_forces_of_the_material_frame_are_the_slope_of_its_least_energy(seed, wild, torsion, held):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.02, 0.08, 9)
    points = crumpled(seed, rest, 0.6 if wild else 0.1)
    assume(not tight(points))
    rod = Rod(rest, coiled(1.0, torsion=torsion, rest_curvature=tuple(generator.normal(0, 5, (3, 2)))), 1e-8)
    rod.hold(held)
    rod.frame_forces(points)
    rod.turned(points, {8: generator.normal(0, 2, 3)} if len(held) > 2 else {})
    forces = rod.frame_forces(points, 100)
    state = rod.state
    assert forces == pytest.approx(frame_forces(points, state), abs=1e-9 * np.abs(forces).max())
    for index in np.ndindex(points.shape):
        if index[0] not in held:
            moved = np.zeros_like(points)
            moved[index] = 1e-6
            expected = (least_energy(points - moved, state, state.clamps)[0]
                        - least_energy(points + moved, state, state.clamps)[0]) / 2e-6
            assert forces[index] == pytest.approx(expected, abs=1e-5 * np.abs(forces).max())


@drawing(10, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 0.1), st.floats(0.1, 10.0), st.sampled_from([0.001, 0.004]),
       st.sampled_from([0.0, 0.3]))
def test_energy_of_a_coiled_rod_never_grows(seed, bending, curvature, step, torsion):
    rest = np.random.default_rng(seed).uniform(0.02, 0.05, 15)
    physical = properties(bending, 1e3, 0.05, natural_curvature=curvature, torsion=torsion)
    rod = Rod(rest, physical, step)
    points = crumpled(seed, rest, 0.1)
    velocities = np.zeros_like(points)

    def total():
        return energy(points, rest, physical) + least_energy(points, rod.state)[0] + (
            rod.state.masses[:, None] * velocities**2).sum() / 2 + (
                (curvature**2 * physical['flexibility'] * rest.sum()) / 2)

    rod.frame_forces(points)
    start = total()
    for k in range(150):
        velocities = rod.velocities(points, velocities, NONE, FREE)
        points = points + step * velocities
        assert k % 10 or total() < 1.05 * start
    assert total() < start


@drawing(10, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_a_coiled_rod_neither_flies_away_nor_begins_to_spin(seed):
    rest = np.random.default_rng(seed).uniform(0.02, 0.05, 12)
    rod = Rod(rest, properties(1e-3, 1e3, 0.05, natural_curvature=5.0, torsion=float(seed % 2)), 1e-7)
    points = crumpled(seed, rest, 0.3)
    pushed = rod.state.masses[:, None] * rod.velocities(points, np.zeros_like(points), NONE, FREE) / 1e-7
    assert np.abs(pushed.sum(axis=0)).max() < 1e-6 * np.abs(pushed).max()
    assert np.abs(np.cross(points, pushed).sum(axis=0)).max() < 1e-5 * np.abs(pushed).max()


def test_a_coiled_rod_that_is_straight_stays_so_until_something_bends_it():
    rest = np.full(12, 0.03)
    velocities = Rod(rest, coiled(5.0), 0.004).velocities(straight(rest), np.zeros((13, 3)), NONE, FREE)
    assert np.abs(velocities).max() < 1e-9
