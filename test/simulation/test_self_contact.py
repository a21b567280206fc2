# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Contact of a DLO with itself: two of its strands are pushed together and along each other."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from oracles import without_penetration
import pytest
from random_examples import drawing
from stepping import properties, SteppedRod, Touching

STEP = 0.004
RADIUS = 0.005
STRAND = 9  # nodes in each of the two
UPPER, LOWER = slice(STRAND + 3, None), slice(0, STRAND)


def strands(gap, angle=0.0):
    """
    Return the (21, 3) points of a DLO with two strands, one `gap` above the other, and their places.

    They are joined by a wide bow that touches nothing; `angle` turns the upper about its middle.
    """
    along = np.linspace(-0.1, 0.1, STRAND)
    lower = np.stack([along, 0 * along, 0 * along], axis=1)
    upper = np.stack([-along * np.cos(angle), -along * np.sin(angle), 0 * along + gap], axis=1)
    bow = np.array([(0.3, 0.3, 0.1), (0.3, 0.5, 0.2), (0.3, 0.3, 0.3)])
    points = np.concatenate([lower, bow, upper])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return points, np.concatenate([[0.0], np.cumsum(lengths)])


def contact(places, friction=0.0, radius=RADIUS):
    return Touching(places, radius, friction, STEP)


def pushed(points, speed):
    """Return velocities that push the strands together with that speed."""
    velocities = np.zeros_like(points)
    velocities[LOWER, 2] = speed / 2
    velocities[UPPER, 2] = -speed / 2
    return velocities


def distance(points):
    """Return the least distance of the two strands, from a fine sampling."""
    at = np.linspace(0, STRAND - 1, 81)
    lower, upper = (np.stack([np.interp(at, np.arange(STRAND), axis) for axis in strand.T])
                    for strand in (points[LOWER], points[UPPER]))
    return np.sqrt(((lower[:, :, None] - upper[:, None, :])**2).sum(axis=0).min())


def masses(count, seed=None):
    return np.ones(count) if seed is None else np.random.default_rng(seed).uniform(0.5, 2, count)


def test_strands_that_are_far_apart_move_freely():
    points, places = strands(0.1)
    velocities = np.random.default_rng(0).normal(0, 0.1, points.shape)
    touching = contact(places)
    touching.start(points)
    assert touching.velocities(points, velocities, masses(21), 0 * points) == pytest.approx(
        velocities, rel=1e-12)


def nearest(angle, speed, friction, gap):
    """Throw two strands of a rod together and press them; return the least distance."""
    points, places = strands(gap, angle)
    rod = SteppedRod(np.diff(places), properties(1e-3, 1e3, 0.05), STEP)
    touching = contact(places, friction)
    touching.start(points)
    velocities = pushed(points, speed)
    pressing = pushed(points, 2 * 9.81 * STEP)  # each with its weight
    least = np.inf
    for _ in range(60):
        velocities = rod.velocities(points, velocities + pressing, np.zeros(3), np.zeros((0, 3)))
        velocities = touching.velocities(points, velocities, 1 / rod.rope.masses, 0 * points)
        points = points + STEP * velocities
        least = min(least, distance(points))
    return least


@drawing(20, derandomize=True)
@given(st.floats(0.4, 1.5), st.sampled_from([-1, 1]), st.floats(0, 2), st.floats(0, 1),
       st.floats(0.012, 0.03))
def test_crossing_strands_do_not_pass_through_each_other(angle, side, speed, friction, gap):
    assert 0.75 * 2 * RADIUS < nearest(side * angle, speed, friction, gap) < 1.2 * 2 * RADIUS


@drawing(20, derandomize=True)
@given(st.floats(-0.3, 0.3), st.floats(0, 0.5), st.floats(0, 1), st.floats(0.012, 0.03))
def test_strands_along_each_other_do_not_pass_through_each_other(angle, speed, friction, gap):
    assert nearest(angle, speed, friction, gap) > 0.5 * 2 * RADIUS


@drawing(25, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(-1.5, 1.5), st.floats(0, 1))
def test_contacts_conserve_momentum(seed, angle, friction):
    points, places = strands(0.011, angle)
    generator = np.random.default_rng(seed)
    velocities = pushed(points, 2.0) + generator.normal(0, 0.3, points.shape)
    weights = generator.uniform(0.5, 2, 21)
    touching = contact(places, friction)
    touching.start(points)
    after = touching.velocities(points, velocities, 1 / weights, 0 * points)
    assert np.abs(after - velocities).max() > 0.1
    assert weights @ after == pytest.approx(weights @ velocities, abs=1e-9)


def test_contacts_push_and_never_pull():
    points, places = strands(0.0101)
    separating = -pushed(points, 1.0)
    touching = contact(places, 0.5)
    touching.start(points)
    assert touching.velocities(points, separating, masses(21), 0 * points) == pytest.approx(separating)


def slid(friction, press, slide):
    """Return the velocities after a step in which crossing strands are pressed together, and the impulses."""
    points, places = strands(2 * RADIUS, np.pi / 2)
    velocities = pushed(points, press)
    velocities[UPPER, :2] = (0, slide)
    touching = contact(places, friction)
    touching.start(points)
    after = touching.velocities(points, velocities, masses(21), 0 * points)
    momentum = np.abs((after - velocities)[UPPER].sum(axis=0))
    return after, momentum[1], momentum[2]


@pytest.mark.parametrize('friction', [0.1, 0.3, 1.0])
def test_friction_is_its_coefficient_times_the_push(friction):
    _, rub, push = slid(friction, press=1.0, slide=4.0)
    assert push > 0.1
    assert rub == pytest.approx(friction * push, rel=1e-3)


def test_without_friction_strands_slide_freely():
    after, rub, push = slid(0.0, press=1.0, slide=0.5)
    assert push > 0.1
    assert rub == pytest.approx(0, abs=1e-9)


def test_friction_stops_a_slow_slide_and_does_not_turn_it_round():
    after, rub, push = slid(1.0, press=2.0, slide=0.1)
    middle_of_upper, middle_of_lower = STRAND + 3 + STRAND // 2, STRAND // 2
    assert after[middle_of_upper, 1] - after[middle_of_lower, 1] == pytest.approx(0, abs=0.01)
    assert rub < push


def test_held_nodes_do_not_move():
    points, places = strands(0.0105)
    velocities = pushed(points, 2.0)
    velocities[LOWER] = 0
    inverse = masses(21)
    inverse[LOWER] = 0
    touching = contact(places, 0.5)
    touching.start(points)
    after = touching.velocities(points, velocities, inverse, 0 * points)
    assert after[LOWER].tolist() == velocities[LOWER].tolist()
    assert (after[UPPER, 2] > -0.5).all()  # the other strand yields alone


def test_two_held_strands_keep_their_velocities():
    points, places = strands(0.0105)
    velocities = pushed(points, 2.0)
    touching = contact(places, 0.5)
    touching.start(points)
    after = touching.velocities(points, velocities, np.zeros(21), 0 * points)
    assert after == pytest.approx(velocities)


@pytest.mark.parametrize('gap', [0.001, 0.004, 0.008])
def test_strands_that_overlap_at_the_start_are_not_pushed_apart(gap):
    points, places = strands(gap)
    touching = contact(places, 0.5)
    touching.start(points)
    at_rest = np.zeros_like(points)
    assert touching.velocities(points, at_rest, masses(21), at_rest) == pytest.approx(at_rest, abs=1e-9)
    # It does not come nearer either.
    for _ in range(20):
        points = points + STEP * touching.velocities(points, pushed(points, 1.0), masses(21), at_rest)
    assert distance(points) > 0.8 * gap


def test_strands_that_overlapped_and_moved_apart_do_not_overlap_again():
    points, places = strands(0.004)
    touching = contact(places)
    touching.start(points)
    for speed, steps in ((-0.5, 20), (0.5, 60)):
        velocities = pushed(points, speed)
        for _ in range(steps):
            points = points + STEP * touching.velocities(points, velocities, masses(21), 0 * points)
    assert distance(points) > 0.9 * 2 * RADIUS


def test_a_penetration_is_pushed_out_gently():
    points, places = strands(0.02)
    touching = contact(places)
    touching.start(points)
    points[UPPER, 2] -= 0.018  # something outside has pressed them to a fifth of a diameter
    fastest = 0
    for _ in range(50):
        velocities = touching.velocities(points, np.zeros_like(points), masses(21), 0 * points)
        fastest = max(fastest, np.abs(velocities).max())
        points = points + STEP * velocities
    assert distance(points) == pytest.approx(2 * RADIUS, rel=0.02)
    assert fastest < 0.6


@given(st.integers(0, 2**32 - 1), st.sampled_from([6, 11, 20, 41]), st.sampled_from([0.001, 0.004, 0.02]),
       st.sampled_from([0.5, 3.0, 20.0]), st.floats(0.0, 1.0))
def test_no_contact_of_a_fast_dlo_is_missed(seed, nodes, radius, speed, curl):
    """The velocities are those from a check of every pair."""
    generator = np.random.default_rng(seed)
    directions = np.cumsum(curl * generator.normal(0, 1, (nodes - 1, 3)), axis=0) + (1.0, 0, 0)
    steps = 0.03 * directions / np.linalg.norm(directions, axis=1)[:, None]
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    velocities = speed * np.cumsum(generator.normal(0, 0.2, points.shape), axis=0)
    places = 0.03 * np.arange(nodes)
    touching = contact(places, 0.3, radius)
    touching.start(points)
    expected = without_penetration(
        places, points, radius, 0.3, points, velocities, masses(nodes), 0 * points, STEP)
    assert touching.velocities(points, velocities, masses(nodes), 0 * points) == pytest.approx(
        expected, abs=1e-6)


def test_neighbours_along_the_dlo_do_not_touch():
    """A straight DLO whose nodes are nearer than a diameter is at rest."""
    points = np.linspace(0, 0.2, 41)[:, None] * (1.0, 0, 0)
    touching = Touching(np.linspace(0, 0.2, 41), 0.02, 0.5, STEP)
    touching.start(points)
    velocities = np.random.default_rng(0).normal(0, 0.01, points.shape)
    assert touching.velocities(points, velocities, np.ones(41), 0 * points) == pytest.approx(velocities)


def test_a_strand_on_a_support_carries_the_other():
    """The lower strand lies on a table, which has pushed it up, and passes the push on to the table."""
    points, places = strands(2 * RADIUS, np.pi / 2)
    middle_of_upper, _middle_of_lower = STRAND + 3 + STRAND // 2, STRAND // 2
    falling = np.zeros_like(points)
    falling[UPPER, 2] = -0.5
    table = np.zeros_like(points)
    table[LOWER, 2] = 0.04
    after = {}
    for name, support in (('table', table), ('air', 0 * table)):
        touching = contact(places)
        touching.start(points)
        after[name] = touching.velocities(points, falling, masses(21), support)
    assert after['table'][middle_of_upper, 2] == pytest.approx(0, abs=0.05)
    assert after['air'][middle_of_upper, 2] == pytest.approx(-0.25, abs=0.05)
    # The table receives the momentum that the upper strand loses.
    for velocities in after.values():
        assert velocities.sum(axis=0) == pytest.approx(falling.sum(axis=0), abs=1e-9)
