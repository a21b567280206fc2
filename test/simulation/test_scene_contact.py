# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Contact with a scene in the core: capstan, rest, walls, thin pegs, energy, bits, and PyBullet beside it."""

import pickle

import numpy as np
import pytest
from touched_scenes import (
    ALONG_Y,
    AROUND_ONE,
    AROUND_TWO,
    box_mesh,
    line,
    obstacle,
    pegs,
    PHYSICAL,
    rope_at,
    sliding_speed,
    STEP,
)

from dlo_calibration import InputError
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import core
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.distance_grid import DistanceGrid
from dlo_calibration.simulation.protocol import Stop
from dlo_calibration.simulation.scene import core_scene

CASES = [(angle, radius, nodes)
         for angle in (np.pi, 3 * np.pi) for radius in (0.03, 0.05) for nodes in (41, 81)]


@pytest.mark.parametrize(('angle', 'radius', 'nodes'), CASES)
def test_a_rope_around_a_cylinder_slides_as_the_capstan_equation_says(angle, radius, nodes):
    """The coefficient at which it begins to slide is within 3 % of that of the equation."""
    for share, slides in ((0.97, False), (1.03, True)):
        speed = sliding_speed(share, angle, radius, nodes)
        assert (speed > 0.004) == slides, f'{speed} m/s at {share} of the coefficient'


RESTS = [  # an obstacle, and the height at which the middle of a DLO that lies across it rests
    pytest.param(obstacle('box', (0.2, 0.4, 0.2), (0, 0, 0.1)), 0.2, id='box'),
    pytest.param(obstacle('sphere', (0.5,), (0, 0, 0)), 0.5, id='sphere'),
    pytest.param(obstacle('cylinder', (0.4, 0.05), (0, 0, 0.1), ALONG_Y), 0.15, id='cylinder'),
    pytest.param(obstacle('capsule', (0.4, 0.05), (0, 0, 0.1), ALONG_Y), 0.15, id='capsule'),
    pytest.param(obstacle('mesh', (1, 1, 1), (0, 0, 0.1), triangles=box_mesh((0.2, 0.4, 0.2))), 0.2,
                 id='mesh'),
    pytest.param(obstacle('mesh', (2, 1, -1), (0, 0, 0.1), triangles=box_mesh((0.1, 0.4, 0.2))), 0.2,
                 id='mirrored mesh', marks=pytest.mark.long),
]


@pytest.mark.parametrize(('body', 'height'), RESTS)
def test_a_dlo_rests_where_geometry_says(body, height):
    points = line((-0.15, 0, height + 0.006), (1, 0, 0), 0.3, 41)
    rope = rope_at(points, {**PHYSICAL, 'flexibility': 0.05, 'friction': 1.0}, [body])
    for _ in range(int(3 / STEP)):
        assert rope.step()
    assert np.abs(rope.velocities).max() < 1e-4
    assert rope.points[20, 2] == pytest.approx(height + PHYSICAL['self_collision'], abs=2e-4)


def test_a_catenary_rests_on_an_edge():
    """A limp rope over the edge of a box hangs down from it, and touches the edge with its radius."""
    points = line((0, 0, 0.204), (1, 0, 0), 0.4, 41)
    rope = rope_at(points, {**PHYSICAL, 'flexibility': 1e-6, 'friction': 2.0},
                   [obstacle('box', (0.6, 0.4, 0.2), (-0.1, 0, 0.1))])  # its edge is at x = 0.2
    for _ in range(int(4 / STEP)):
        assert rope.step()
    dense = np.concatenate([rope.points[:-1] + share * np.diff(rope.points, axis=0)
                            for share in np.arange(10) / 10])
    away = np.maximum(dense[:, [0, 2]] - (0.2, 0.2), 0)
    beyond = (away > 0).all(axis=1)
    assert np.linalg.norm(away[beyond], axis=1).min() == pytest.approx(PHYSICAL['self_collision'], abs=3e-4)
    assert rope.points[:15, 2] == pytest.approx(0.204, abs=2e-4)
    assert rope.points[-1, 0] == pytest.approx(0.204, abs=4e-3)  # its end hangs beside the box


@pytest.mark.parametrize('body', [
    pytest.param(obstacle('box', (0.002, 1, 1), (0.05, 0, 0)), id='wall of 2 mm'),
    pytest.param(obstacle('cylinder', (1, 0.0015), (0.05, 0.007, 0)), id='peg of 3 mm between two nodes')])
@pytest.mark.parametrize('speed', [0.5, 5.0])
def test_nothing_passes_through_a_thin_body(body, speed):
    points = line((0, -0.3, 0), (0, 1, 0), 0.6, 41)
    rope = rope_at(points, {**PHYSICAL, 'self_collision': 0.002}, [body],
                   velocities=np.tile((speed, 0, 0), (41, 1)))
    nearest = []
    for _ in range(int(0.12 / speed / STEP)):
        assert rope.step()
        shares = np.linspace(0, 1, 9)[:, None, None]
        dense = rope.points[:-1] + shares * np.diff(rope.points, axis=0)
        beside = dense[np.abs(dense[:, :, 1] - body.position[1]) < 0.001]
        nearest.append(beside[:, 0].max(initial=0))
    half = body.sizes[0] / 2 if body.shape == 'box' else body.sizes[1]
    assert max(nearest) == pytest.approx(0.05 - half - 0.002, abs=2e-4)  # it arrives, and goes no further


def energy(rope):
    """Return the mechanical energy [J] of a straight rope without twist."""
    state, points = rope.state, rope.points
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    bending = sum((2 if k else 1) * (state['bending'][:len(points) - k, k, None]
                                     * points[:len(points) - k] * points[k:]).sum() for k in range(3))
    return ((rope.masses[:, None] * rope.velocities**2).sum() / 2
            + GRAVITY * (rope.masses * points[:, 2]).sum()
            + (state['stiffness'] * (lengths - state['rest_lengths'])**2).sum() / 2 + bending / 2)


def test_energy_never_grows_in_contact():
    """A stiff rope that falls onto a body never has more energy than before."""
    for seed in range(40):
        random = np.random.default_rng(seed)
        shape = str(random.choice(['box', 'sphere', 'cylinder', 'capsule']))
        sizes = random.uniform(0.02, 0.1, {'box': 3, 'sphere': 1}.get(shape, 2))
        turn = random.normal(size=4)
        body = obstacle(shape, sizes, turn=turn / np.linalg.norm(turn), friction=random.uniform(0, 2))
        physical = {**PHYSICAL, 'flexibility': 10**random.uniform(-3, -2), 'friction': random.uniform(0, 1),
                    'elasticity': 10**random.uniform(1.5, 3), 'damping': 0.01}
        points = line((-0.1, 0, 0.13), (1, 0, 0), 0.2, 21)
        rope = rope_at(points, physical, [body])
        energies = [energy(rope)]
        for _ in range(200):
            assert rope.step()
            energies.append(energy(rope))
        assert min(np.diff(energies)) < -1e-4  # it has touched the body
        assert max(energies) <= energies[0] * (1 + 1e-9), seed


@pytest.mark.long
@pytest.mark.parametrize(('trial', 'obstacles'), [
    pytest.param(AROUND_ONE, pegs((0.4, 0.05)), id='one peg'),
    pytest.param(AROUND_TWO, pegs((0.45, 0.04), (0.33, -0.03)), id='two pegs')])
def test_a_rope_around_pegs_moves_as_in_pybullet(trial, obstacles):
    """PyBullet adds contact after the step, so that it needs a much shorter one: see `BulletSimulator`."""
    ours = CompiledSimulator(obstacles=obstacles).simulate(trial, PHYSICAL)
    theirs = BulletSimulator(obstacles=obstacles, nodes=81, time_step=0.0005).simulate(trial, PHYSICAL)
    assert ours.settled == theirs.settled == (True, True, True)
    distances = np.linalg.norm(ours.chains - theirs.chains, axis=2).mean(axis=1)
    free = CompiledSimulator().simulate(trial, PHYSICAL)
    assert np.linalg.norm(ours.chains[1:] - free.chains[1:], axis=2).mean() > 0.02  # the pegs matter
    assert distances.mean() < 0.002, distances


def jobs_among(obstacles, count=9):
    """Return a simulator, and jobs with random properties."""
    random = np.random.default_rng(3)
    jobs = [(trial, {**PHYSICAL, 'flexibility': 10**random.uniform(-5, -2),
                     'friction': random.uniform(0, 1.5),
                     'self_collision': random.uniform(0.002, 0.01)})
            for trial in (AROUND_ONE, AROUND_TWO) for _ in range(count)]
    return CompiledSimulator(obstacles=obstacles, settle_limit=1.0), jobs


def test_rollouts_among_bodies_have_the_same_bits_alone_and_together_and_on_every_processor():
    bodies = [*pegs((0.4, 0.05), (0.33, -0.03)), obstacle('box', (0.1, 0.1, 0.02), (0.15, 0, 0.01)),
              obstacle('mesh', (1, 1, 1), (0.5, 0.1, 0.02), triangles=box_mesh((0.05, 0.05, 0.04)))]
    simulator, jobs = jobs_among(bodies)
    together = [rollout.chains.tobytes() for rollout in simulator.simulate_together(jobs, Stop())]
    assert together == [simulator.simulate(*job).chains.tobytes() for job in jobs]
    copied = pickle.loads(pickle.dumps(simulator))  # noqa: S301
    assert together[0] == copied.simulate(*jobs[0]).chains.tobytes()
    packed = []
    for trial, physical in jobs:
        prepared, start, level = simulator._prepare(trial, physical)
        packed.append((prepared.script.events, start, physical, level))
    outcomes = [core.roll_out(packed, STEP, target=target, scene=core_scene(bodies))
                for target in core.TARGETS]
    for others in outcomes[1:]:
        assert [nodes.tobytes() for nodes, *_ in others] == [nodes.tobytes() for nodes, *_ in outcomes[0]]


def test_what_lies_in_a_body_at_the_start_is_not_thrown_away():
    """A self-collision radius that is too large must not move a rope that rests on a box, or beside a peg."""
    points = line((0, 0, 0.204), (1, 0, 0), 0.3, 41)
    bodies = [obstacle('box', (2, 2, 0.2), (0, 0, 0.1)), obstacle('cylinder', (0.2, 0.01), (0.1, 0.014, 0.3))]
    rope = rope_at(points, {**PHYSICAL, 'self_collision': 0.01}, bodies)
    for _ in range(300):
        assert rope.step()
    assert rope.points == pytest.approx(points, abs=1e-4)


def test_meshes_must_be_closed():
    with pytest.raises(InputError, match=r'scene: a mesh that is not closed: 3 of 18 edges are open; '):
        CompiledSimulator(obstacles=[obstacle('mesh', (1, 1, 1), triangles=box_mesh((1, 1, 1))[1:])])


def test_a_distance_grid_knows_inside_from_outside():
    random = np.random.default_rng(0)
    edges = np.array([0.1, 0.2, 0.04])
    grid = DistanceGrid.of(box_mesh(edges))
    body = core.Body.of_grid(grid.shared, (0, 0, 0), np.eye(3), 1.0)
    exact = core.Body('box', edges / 2, (0, 0, 0), np.eye(3), 1.0)
    for point in random.uniform(-1, 1, (500, 3)) * (edges / 2 + 0.03):
        if abs(expected := exact.distance(point)) < 0.012:
            assert body.distance(point) == pytest.approx(expected, abs=0.5 * grid.cell)
        else:
            assert body.distance(point) * expected > 0  # inside or outside


@pytest.mark.parametrize(('change', 'message'), [
    ({'shape': 'cone'}, r'shape: cone; expected sphere, box'),
    ({'sizes': (0.1,)}, r'sizes: 1 numbers; expected 3 of a box'),
    ({'sizes': (0.1, -1, 1)}, r'sizes: -1 m; expected a positive'),
    ({'position': (0, np.nan, 0)}, r'position: nan; expected a finite'),
    ({'turn': np.eye(2)}, r'turn: 4 numbers; expected the 9'),
    ({'friction': -1.0}, r'friction: -1; expected a finite number, 0 or more')])
def test_the_core_refuses_wrong_bodies(change, message):
    given = {'shape': 'box', 'sizes': (1, 1, 1), 'position': (0, 0, 0), 'turn': np.eye(3), 'friction': 1.0}
    with pytest.raises(ValueError, match=message):
        core.Body(**{**given, **change})


@pytest.mark.parametrize(('change', 'message'), [
    ({'distances': np.zeros((2, 2))}, r'distances: 2 dimensions and 4 numbers'),
    ({'distances': np.zeros((2, 1, 2))}, r'distances: 1 points in one direction'),
    ({'distances': np.full((2, 2, 2), np.inf)}, r'distances: a number that is not finite'),
    ({'cell': 0.0}, r'cell: 0 m; expected a positive')])
def test_the_core_refuses_wrong_grids(change, message):
    with pytest.raises(ValueError, match=message):
        core.Grid(**{'distances': np.ones((2, 2, 2)), 'corner': (0, 0, 0), 'cell': 1.0, **change})
