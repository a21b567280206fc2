# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Friction between the strands of a DLO: loops of moment and curvature, energy, and bends that stay."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from stepping import properties, SteppedRope
from stepping import SteppedRod as Rod
from test_rod import crumpled, energy, FREE, NONE, straight

from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.bullet import BulletRope, pybullet

STIFFNESS, FRICTION, SLIP = 1e-3, 2.0, 0.5
TWISTS = {'torsion': 0.7, 'natural_curvature': 1e-12}  # it has a material frame, to which its strands belong


def moments(curvatures, steps=50, **others):
    """Return the moment [N m] of friction at the middle of three nodes that are bent to each curvature."""
    length = 0.05
    physical = properties(STIFFNESS, 1e4, 0.01, bending_friction=FRICTION, bending_slip=SLIP, **others)
    rod = Rod(np.full(2, length), physical, 1e-9)
    friction_moments, before = [], 0.0
    for curvature in curvatures:
        for now in np.linspace(before, curvature, steps + 1)[1:]:
            angle = length * now / 2
            end = length * np.array([np.cos(angle), np.sin(angle), 0])
            points = np.array([end * (-1, 1, 1), (0, 0, 0), end])
            rod.velocities(points, np.zeros_like(points), NONE, FREE)
        impulse = -rod.state.strand_forces[1, 4]
        if others:
            impulse += rod.state.frame_impulses[1, 1] / np.cos(angle)**2  # forces across the segments
        friction_moments.append(impulse / 1e-9 * length / 2)
        before = curvature
    return np.array(friction_moments)


def test_moment_and_curvature_go_around_a_closed_loop():
    up = np.linspace(0, 4, 81)
    virgin = moments(up)
    assert virgin[[1, -1]] == pytest.approx(STIFFNESS * FRICTION * np.array([0.05 / SLIP, 1.0]), rel=0.01)
    cycle = np.concatenate([up, up[::-1][1:], -up[1:], -up[::-1][1:], up[1:]])
    moment = moments(cycle)
    # Masing: the curve of unloading is that of loading, twice as large, from the point of reversal.
    doubled = np.interp(np.arange(161) / 2, np.arange(81), virgin)
    assert moment[80:241] == pytest.approx(moment[80] - 2 * doubled, abs=0.01 * STIFFNESS * FRICTION)
    assert moment[-1] == pytest.approx(moment[80])  # closed
    area = np.sum((moment[81:] + moment[80:-1]) / 2 * np.diff(cycle[80:]))
    assert area == pytest.approx(4 * STIFFNESS * FRICTION * (4 - SLIP), rel=0.02)  # lost in each cycle


def test_the_loop_is_the_same_in_the_material_frame():
    # A DLO with free ends would rather turn about its axis than be bent to the other side.
    cycle = np.array([SLIP / 2, 4.0, 4 - SLIP, 4 - 2 * SLIP, 2.0, 2 + SLIP, 2 + 2 * SLIP, 4.0])
    assert moments(cycle, **TWISTS) == pytest.approx(
        STIFFNESS * FRICTION * np.array([0.5, 1, 0, -1, -1, 0, 1, 1]), abs=0.02 * STIFFNESS * FRICTION)


def test_the_loop_is_independent_of_the_rate():
    curvatures = np.array([1.0, 0.2, 0.9, -2.0, 0.3, 3.0])
    assert moments(curvatures, 2000) == pytest.approx(moments(curvatures, 1000), rel=2e-3)


def stored(rod):
    """Return the energy [J] that the elements had before the last step."""
    state = rod.state
    return (state.strands[:, 3] * (state.plastic[:, 6:]**2).sum(axis=1)).sum() / 2


@drawing(20, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 0.1), st.floats(0.1, 30), st.floats(0.001, 10),
       st.sampled_from([0.001, 0.004, 0.01]))
def test_friction_never_gains_energy(seed, bending, friction, slip, step):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.02, 0.05, 15)
    physical = properties(bending, 1e3, 0.05, bending_friction=friction, bending_slip=slip)
    rod = Rod(rest, physical, step)
    points = crumpled(seed, rest, 0.05)
    velocities = generator.normal(0, 0.1, points.shape)
    velocities -= velocities.mean(axis=0)

    def total():
        return energy(points, rest, physical) + (rod.state.masses[:, None] * velocities**2).sum() / 2

    start = total()
    for _ in range(201):
        before, after = total(), rod.velocities(points, velocities, NONE, FREE)
        assert before + stored(rod) < 1.05 * start
        points, velocities = points + step * after, after
    assert before + stored(rod) < start


@drawing(20, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 0.1), st.floats(0.1, 30), st.floats(0.001, 10),
       st.floats(0.03, 10), st.sampled_from([0.001, 0.004, 0.01]))
def test_friction_in_the_material_frame_never_gains_energy(seed, bending, friction, slip, torsion, step):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.02, 0.05, 15)
    physical = properties(bending, 1e3, 0.05, bending_friction=friction, bending_slip=slip,
                          **{**TWISTS, 'torsion': torsion})
    rod = Rod(rest, physical, step)
    points = crumpled(seed, rest, 0.05)
    velocities = generator.normal(0, 0.1, points.shape)
    velocities -= velocities.mean(axis=0)

    def twisted():
        return (rod.state.twisting * np.diff(rod.state.angles)**2).sum() / 2

    start = None
    for _ in range(201):
        before = energy(points, rest, physical) + (rod.state.masses[:, None] * velocities**2).sum() / 2
        after = rod.velocities(points, velocities, NONE, FREE)
        before += stored(rod) + twisted()
        start = before if start is None else start
        assert before < 1.05 * start
        points, velocities = points + step * after, after
    assert before < start


def arc(curvature, rest):
    """Return the (N, 3) [m] points of a part of a circle."""
    angles = np.concatenate([[0.0], 2 * np.arcsin(curvature * rest / 2).cumsum()])
    return np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], axis=1) / curvature


@pytest.mark.parametrize('curvature', [1.0, 3.0])
def test_a_bent_dlo_that_turns_about_its_axis_rubs(curvature):
    """
    Both clamps turn by the same angle, while the DLO stays an arc of curvature k.

    Its curvature then goes around a circle in the material.  The plastic part of it follows on a smaller
    circle, perpendicular to the strain: its radius is the square root of k^2 - slip^2.  So each metre takes
    the torque EI friction times that radius, which twist brings there from the clamps.
    """
    rest = np.full(24, 0.02)
    points = arc(curvature, rest)
    physical = properties(STIFFNESS, 1e4, 0.05, torsion=200.0, bending_friction=FRICTION, bending_slip=SLIP)
    rod = Rod(rest, physical, 1e-8)
    rod.hold((0, 1, 23, 24))
    rod.frame_forces(points)
    first, last = points[1] - points[0], points[24] - points[23]
    for _ in range(1000):
        rod.turned(points, {0: 0.003 * first / 0.02, 23: 0.003 * last / 0.02})
    twist = rod.state.twisting * np.diff(rod.state.angles)
    torques = np.diff(twist[1:-1]) / 0.02
    assert torques == pytest.approx(STIFFNESS * FRICTION * np.sqrt(curvature**2 - SLIP**2), rel=0.02)


def test_strands_keep_their_bend_when_a_clamp_opens_and_closes():
    """With a clamp at an end, they belong to a material frame; without one, to space."""
    rest = np.full(24, 0.02)
    physical = properties(STIFFNESS, 1e4, 0.05, torsion=0.5, bending_friction=FRICTION, bending_slip=20.0)
    rod = Rod(rest, physical, 1e-8)
    bent, straightened = arc(4.0, rest), arc(0.5, rest)
    strains = []
    for nodes, points in (((), bent), ((), straightened), ((0, 1), straightened), ((), straightened)):
        rod.hold(nodes)
        for _ in range(2):
            rod.velocities(points, np.zeros_like(points), NONE, np.zeros((len(nodes), 3)))
        strains.append(np.linalg.norm(rod.state.plastic[3:, 6:], axis=1))
    assert strains[0] == pytest.approx(0.0, abs=1e-12)
    assert strains[1] == pytest.approx(3.5 * 0.02, rel=1e-2)
    assert strains[2] == pytest.approx(strains[1], rel=1e-9)
    assert strains[3] == pytest.approx(strains[1], rel=1e-9)


@pytest.mark.parametrize('friction', [0.0, 2.0, 5.0])
def test_a_bend_stays_on_a_table(friction):
    """An arc of 12 1/m is let go: it opens slowly, up to the curvature whose moment friction bears."""
    count, length = 30, 0.3
    places = np.linspace(0, length, count + 1)
    points = np.stack([places, np.zeros(count + 1), np.zeros(count + 1)], axis=1)
    physical = {**ParameterSpace().physical({}, length), 'flexibility': 2e-3, 'mass': 0.02, 'damping': 200.0,
                'friction': 0.0, 'bending_friction': friction, 'bending_slip': 0.2}
    rope = SteppedRope(places, points, np.zeros_like(points), physical, 0.003, level=0.0)
    held = (0, 15, 30)
    rope.hold(held)
    curvatures = np.linspace(0, 12, 400)[1:, None]
    angles = curvatures * places[list(held)]
    way = np.stack([np.sin(angles) / curvatures, (1 - np.cos(angles)) / curvatures, 0 * angles], axis=2)
    rope.advance(way)
    rope.hold(())
    rope.advance(np.zeros((3000, 0, 3)))
    tangents = np.diff(rope.points, axis=0)
    headings = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    curvature = np.diff(headings)[8:-8].mean() / (length / count)
    assert curvature == pytest.approx(friction, rel=0.15, abs=0.05)


def test_no_bending_friction_is_the_plain_rod_bit_for_bit():
    rest = np.random.default_rng(0).uniform(0.02, 0.05, 12)
    points = crumpled(1, rest)
    plain, other = (Rod(rest, properties(1e-2, 500.0, 0.05, **given_), 0.004).velocities(
        points, points, NONE, FREE) for given_ in ({}, {'bending_friction': 0.0, 'bending_slip': 3.0}))
    assert plain.tobytes() == other.tobytes()


ALL = {**ParameterSpace().physical({}, 0.6), 'flexibility': 2e-3, 'mass': 0.06, 'damping': 1.0,
       'torsion': 0.8, 'bending_friction': 1.0, 'bending_slip': 0.1, 'natural_curvature': 1.0,
       'self_collision': 0.002,
       **{f'rest_curvature_{axis}{knot}': (-1)**knot * 2.0 for axis in 'xy' for knot in (1, 2, 3)}}
PLACES = np.linspace(0, 0.6, 21)
COURSE = ((0, 1, 19, 20), (0, 1), (0, 1, 10, 19, 20), (), (0, 1, 19, 20))


def wave(points, nodes, steps=60):
    """Return targets and turns of held nodes."""
    swing = np.sin(np.linspace(0, np.pi, steps))[:, None, None] * (0.0, 0.05, 0.05)
    turn = np.array([[1, 0, 0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]]).reshape(9)
    targets = points[list(nodes)] + swing * np.ones((1, len(nodes), 1))
    return targets, np.tile(turn, (steps, len(nodes), 1))


def rope(physical=ALL):
    points = straight(np.diff(PLACES)) + 0.001 * np.random.default_rng(3).normal(size=(21, 3))
    return SteppedRope(PLACES, points, np.zeros_like(points), physical, 0.003)


def test_ropes_that_take_turns_do_not_affect_each_other():
    alone = [rope(), rope({**ALL, 'torsion': 0.3})]
    together = [rope(), rope({**ALL, 'torsion': 0.3})]
    for first in alone:
        for nodes in COURSE:
            first.hold(nodes)
            first.advance(*wave(first.points, nodes))
    for nodes in COURSE:
        for second in together:
            second.hold(nodes)
            targets, turns = wave(second.points, nodes)
            for k in range(60):
                second.advance(targets[k:k + 1], turns=turns[k:k + 1])
    for first, second in zip(alone, together, strict=True):
        assert np.isfinite(first.points).all()
        assert first.points.tobytes() == second.points.tobytes()


def test_bullet_and_the_compiled_engine_take_the_same_steps():
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setPhysicsEngineParameter(fixedTimeStep=0.003, physicsClientId=client)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    compiled = rope()
    bullet = BulletRope(client, PLACES, compiled.points, ALL)
    for nodes in COURSE:
        compiled.hold(nodes)
        bullet.hold(nodes)
        targets, turns = wave(compiled.points, nodes)
        compiled.advance(targets, turns)
        for target, turn in zip(targets, turns, strict=True):
            bullet.step(target, turn)
        assert bullet.points == pytest.approx(compiled.points, abs=1e-9)
    pybullet.disconnect(physicsClientId=client)
