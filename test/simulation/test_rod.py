# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The rod's forces and steps against mechanics: energies, momentum, and textbook deflections."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from stepping import properties
from stepping import SteppedRod as Rod

from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation import core

GRAVITY = np.array([0, 0, -9.81])
NONE = np.zeros(3)
FREE = np.zeros((0, 3))
CABLE = properties(flexibility=1e-2, elasticity=500.0, mass=0.05)


def straight(rest_lengths):
    return np.concatenate([[0.0], np.cumsum(rest_lengths)])[:, None] * (1.0, 0, 0)


def crumpled(seed, rest_lengths, size=0.1):
    generator = np.random.default_rng(seed)
    points = straight(rest_lengths)
    return points + size * np.mean(rest_lengths) * generator.normal(size=points.shape)


def forces(rod, points, time_step):
    """Return the forces that a step so short that it changes nothing reveals."""
    return rod.state.masses[:, None] * rod.velocities(points, np.zeros_like(points), NONE, FREE) / time_step


def energy(points, rest, physical):
    segments = np.diff(points, axis=0)
    stretch = np.linalg.norm(segments, axis=1) - rest
    tangents = segments / rest[:, None]
    cells = (rest[1:] + rest[:-1]) / 2
    bend = np.linalg.norm(np.diff(tangents, axis=0), axis=1)
    return (physical['elasticity'] / (2 * rest) * stretch**2).sum() + (
        physical['flexibility'] / (2 * cells) * bend**2).sum()


@drawing(10, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_forces_are_the_slope_of_the_energy(seed, equal):
    generator = np.random.default_rng(seed)
    rest = np.full(7, 0.05) if equal else generator.uniform(0.02, 0.08, 7)
    points = crumpled(seed, rest)
    step = 1e-8
    simulated = forces(Rod(rest, CABLE, step), points, step)
    expected = np.zeros_like(points)
    for index in np.ndindex(points.shape):
        moved = np.zeros_like(points)
        moved[index] = 1e-6
        expected[index] = -(energy(points + moved, rest, CABLE) - energy(points - moved, rest, CABLE)) / 2e-6
    assert simulated == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize('step', [1.5e-3, 3e-3, 6e-3])
@pytest.mark.parametrize('internal_damping', [2e-3, 1e-2])
def test_a_vibration_fades_as_its_internal_damping_says_whatever_the_step(internal_damping, step):
    """The lowest mode of a free beam (Rao, Mechanical Vibrations, 8.5) with Kelvin-Voigt damping."""
    rest, length = np.full(40, 0.0125), 0.5
    physical = properties(1e-2, 500.0, 0.05, internal_damping=internal_damping)
    frequency = 4.730041**2 * np.sqrt(1e-2 / (0.05 * length**3))  # rad/s
    rod, points = Rod(rest, physical, step), straight(rest)
    along = 4.730041 * points[:, 0] / length
    shape = np.cosh(along) + np.cos(along) - 0.982502 * (np.sinh(along) + np.sin(along))
    points[:, 2] = 1e-3 * shape
    velocities, places, speeds = np.zeros_like(points), [], []
    for _ in range(round(1.2 / step)):
        velocities = rod.velocities(points, velocities, NONE, FREE)
        points = points + step * velocities
        places.append(points[:, 2] @ shape)
        speeds.append(velocities[:, 2] @ shape / frequency)
    times = step * np.arange(len(places))
    fading = -np.polyfit(times, np.log(np.hypot(places, speeds)), 1)[0]
    assert fading == pytest.approx(internal_damping * frequency**2 / 2, rel=0.05)


def test_a_straight_rod_of_its_rest_length_has_no_force():
    rest = np.array([0.03, 0.05, 0.02, 0.06])
    turned = straight(rest) @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    velocities = Rod(rest, CABLE, 0.004).velocities(turned + 3, np.zeros_like(turned), NONE, FREE)
    assert np.abs(velocities).max() < 1e-9


def test_masses_follow_the_lengths():
    masses = Rod(np.array([0.1, 0.3, 0.2]), CABLE, 0.004).state.masses
    assert masses == pytest.approx(0.05 / 0.6 * np.array([0.05, 0.2, 0.25, 0.1]))


def test_free_fall():
    rest = np.full(10, 0.05)
    rod = Rod(rest, CABLE, 0.004)
    points, velocities = straight(rest), np.tile((0.3, -0.2, 0.1), (11, 1))
    for _ in range(50):
        velocities = rod.velocities(points, velocities, GRAVITY, FREE)
        points = points + 0.004 * velocities
    assert velocities == pytest.approx(np.tile((0.3, -0.2, 0.1 - 9.81 * 0.2), (11, 1)), abs=1e-9)


@drawing(20, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0, 0.1))
def test_momentum_is_conserved_without_gravity_and_drag(seed, internal_damping):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.02, 0.08, 12)
    rod = Rod(rest, properties(1e-2, 500.0, 0.05, internal_damping=internal_damping), 0.004)
    points = crumpled(seed, rest)
    velocities = generator.normal(size=points.shape)
    before = rod.state.masses @ velocities
    for _ in range(20):
        velocities = rod.velocities(points, velocities, NONE, FREE)
        points = points + 0.004 * velocities
    assert rod.state.masses @ velocities == pytest.approx(before, abs=1e-10)


@drawing(20, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 0.1), st.floats(10, 1e4),
       st.sampled_from([0.001, 0.005, 0.02]))
def test_energy_never_grows(seed, bending, stretching, step):
    rest = np.random.default_rng(seed).uniform(0.02, 0.05, 15)
    physical = properties(bending, stretching, 0.05)
    rod = Rod(rest, physical, step)
    points = crumpled(seed, rest, 0.02)
    velocities = np.zeros_like(points)
    start = energy(points, rest, physical)
    for _ in range(200):
        velocities = rod.velocities(points, velocities, NONE, FREE)
        points = points + step * velocities
        total = energy(points, rest, physical) + (rod.state.masses[:, None] * velocities**2).sum() / 2
        assert total < 1.05 * start
    assert total < start


@pytest.mark.parametrize('drag', [0.5, 2.0, 10.0])
def test_drag_halves_the_velocity_in_the_time_it_says(drag):
    step = 0.001
    rest = np.full(5, 0.05)
    rod = Rod(rest, properties(1e-2, 500.0, 0.05, damping=drag), step)
    points, velocities = straight(rest), np.tile((1.0, 0, 0), (6, 1))
    for _ in range(round(np.log(2) / drag / step)):
        velocities = rod.velocities(points, velocities, NONE, FREE)
        points = points + step * velocities
    assert velocities[:, 0] == pytest.approx(np.full(6, 0.5), rel=0.01)


def rest_of(rod, points, held, gravity, steps=60):
    """Return where the rod comes to rest; steps as long as these are Newton's."""
    rod.hold(held)
    velocities = np.zeros_like(points)
    for _ in range(steps):
        velocities = rod.velocities(points, velocities, gravity, np.zeros((len(held), 3)))
        points = points + 0.2 * velocities
    assert np.abs(velocities).max() < 1e-7
    return points


def splits(name):
    """Divide 1 m, after a clamped centimetre."""
    widths = {'even': np.ones(40), 'alternating': np.tile([1.0, 2.5], 20), 'growing': np.geomspace(1, 8, 40),
              'coarse': np.ones(12)}[name]
    return np.concatenate([[0.01], widths / widths.sum()])


@pytest.mark.parametrize('name', ['even', 'alternating', 'growing', 'coarse'])
def test_a_cantilever_bends_by_the_textbook_whatever_its_segments(name):
    rest = splits(name)
    stiffness, mass = 0.8, 0.05  # it sinks by 8 cm in 1 m at gravity, by 0.8 mm at a hundredth of it
    rod = Rod(rest, properties(stiffness, 1e5, mass * rest.sum(), damping=5.0, internal_damping=0.2), 0.2)
    tip = rest_of(rod, straight(rest), (0, 1), 0.01 * GRAVITY)[-1]
    expected = -0.01 * 9.81 * mass / (8 * stiffness)
    assert tip[2] == pytest.approx(expected, rel=0.02 if name == 'coarse' else 0.005)


@pytest.mark.parametrize('name', ['even', 'alternating', 'growing'])
def test_a_hanging_rod_stretches_by_the_textbook_whatever_its_segments(name):
    rest = splits(name)
    rod = Rod(rest, properties(1e-3, 20.0, 0.05 * rest.sum(), damping=5.0, internal_damping=0.2), 0.2)
    points = straight(rest) @ np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    stretch = -rest_of(rod, points, (0,), GRAVITY)[-1, 2] - rest.sum()
    assert stretch == pytest.approx(9.81 * 0.05 * rest.sum()**2 / (2 * 20.0), rel=0.002)


@pytest.mark.parametrize('profile', [(1.0, 0.3, 4.0), (1.0, 5.0)])
@pytest.mark.parametrize('count', [12, 40])
def test_a_cantilever_of_parts_bends_like_its_parts_in_series(profile, count):
    rest = np.concatenate([[0.01], np.full(count, 1 / count)])
    stiffness, load = 0.8, 0.01 * 9.81 * 0.05
    physical = properties(stiffness, 1e5, 0.05 * rest.sum(), damping=5.0, internal_damping=0.2,
                               profile=profile)
    tip = rest_of(Rod(rest, physical, 0.2), straight(rest), (0, 1), 0.01 * GRAVITY)[-1]
    # Small deflections: the tip sinks by the integral of M x / EI, with M = load x^2 / 2 at x from the tip.
    ends = rest.sum() * np.linspace(0, 1, len(profile) + 1) - 0.01
    away = 1 - np.clip(ends, 0, 1)
    expected = sum(load * (a**4 - b**4) / (8 * stiffness * relative)
                   for a, b, relative in zip(away[:-1], away[1:], profile, strict=True))
    assert tip[2] == pytest.approx(-expected, rel=0.03 if count == 12 else 0.005)


@pytest.mark.parametrize('count', [12, 40])
def test_a_cantilever_whose_stiffness_varies_smoothly_bends_by_the_textbook(count):
    rest, knots = np.concatenate([[0.01], np.full(count, 1 / count)]), (1.0, 0.6, 0.3, 2.0, 3.0)
    stiffness, load = 0.8, 0.01 * 9.81 * 0.05
    physical = properties(stiffness, 1e5, 0.05 * rest.sum(), damping=5.0, internal_damping=0.2)
    physical.update((f'stiffness_knot_{knot}', value) for knot, value in enumerate(knots[1:], 2))
    tip = rest_of(Rod(rest, physical, 0.2), straight(rest), (0, 1), 0.01 * GRAVITY)[-1]
    away = (np.arange(10_000) + 0.5) / 10_000  # from the tip
    relative = np.interp(1 - away / rest.sum(), np.linspace(0, 1, 5), knots)
    expected = (load * away**3 / (2 * stiffness * relative)).mean()
    assert tip[2] == pytest.approx(-expected, rel=0.03 if count == 12 else 0.005)


def test_equal_parts_are_one_rod_bit_for_bit():
    rest, plain = np.full(12, 0.03), properties(1e-2, 500.0, 0.05)
    parts = properties(1e-2, 500.0, 0.05, profile=(1.0,) * 6)
    points = crumpled(4, rest)
    assert Rod(rest, plain, 0.004).velocities(points, points, GRAVITY, FREE).tobytes() == Rod(
        rest, parts, 0.004).velocities(points, points, GRAVITY, FREE).tobytes()


def test_a_rod_takes_the_length_that_its_scale_says():
    rest = np.array([0.03, 0.05, 0.02, 0.06])
    rod = Rod(rest, properties(1e-2, 500.0, 0.05, length_scale=1.1), 0.004)
    assert np.abs(rod.velocities(1.1 * straight(rest), np.zeros((5, 3)), NONE, FREE)).max() < 1e-9
    velocities = rod.velocities(straight(rest), np.zeros((5, 3)), NONE, FREE)
    assert velocities[-1, 0] - velocities[0, 0] > 0.1  # it is compressed
    assert rod.state.masses.sum() == pytest.approx(0.05)


def test_markers_add_their_mass_where_they_are():
    features = np.array([0, 0.25, 0.75, 0, 1.0])
    rest = np.full(4, 0.05)
    plain = Rod(rest, CABLE, 0.004).state.masses
    marked = Rod(rest, properties(1e-2, 500.0, 0.05, marker_mass=0.02), 0.004, features).state.masses
    assert marked - plain == pytest.approx(0.02 * features)


def test_a_weight_at_the_end_of_a_hanging_rod_stretches_it():
    rest = splits('even')
    physical = properties(1e-3, 20.0, 0.05 * rest.sum(), 5.0, 0.2, marker_mass=0.1)
    rod = Rod(rest, physical, 0.2, np.eye(len(rest) + 1)[-1])
    points = straight(rest) @ np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    stretch = -rest_of(rod, points, (0,), GRAVITY)[-1, 2] - rest.sum()
    assert stretch == pytest.approx(9.81 * (0.05 * rest.sum() / 2 + 0.1) * rest.sum() / 20.0, rel=0.002)


def test_held_nodes_follow_their_velocities():
    rest = np.full(10, 0.05)
    rod = Rod(rest, CABLE, 0.004)
    rod.hold((7, 2))
    given_velocities = np.array([[0.1, 0, 0], [0, -0.2, 0.3]])
    velocities = rod.velocities(crumpled(0, rest), np.zeros((11, 3)), GRAVITY, given_velocities)
    assert velocities[[7, 2]] == pytest.approx(given_velocities)
    rod.hold(())
    assert rod.velocities(straight(rest), np.zeros((11, 3)), GRAVITY, FREE) == pytest.approx(
        np.tile(0.004 * GRAVITY, (11, 1)))


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused_at_the_start_and_diverge_later(bad):
    rest = np.full(4, 0.05)
    points = straight(rest)
    points[2, 1] = bad
    with pytest.raises(ValueError, match='points: a number that is not finite; expected finite ones'):
        core.Start(points[:, 0], points, np.zeros_like(points))
    start = core.Start(points[:, 0], straight(rest), np.zeros_like(points))
    rope = core.Rope(start, ParameterSpace().physical({}, 0.2), 0.004, -1e6, GRAVITY)
    assert rope.step()
    rope.points[:] = points
    assert not rope.step()
