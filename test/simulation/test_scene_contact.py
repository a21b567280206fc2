# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Contact with a scene in the core: capstan, rest, walls, thin pegs, energy, bits, and PyBullet beside it."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dlo_calibration import Action, Chain, Goal, Hand, InputError, Trial
from dlo_calibration.simulation import core
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.distance_grid import DistanceGrid
from dlo_calibration.simulation.protocol import Stop
from dlo_calibration.simulation.scene import core_scene, NO_TRIANGLES, Obstacle

GRAVITY = 9.81
STEP = 0.003
PHYSICAL = {'flexibility': 1e-4, 'elasticity': 2000.0, 'friction': 0.4, 'self_collision': 0.004, 'mass': 0.03,
            'damping': 1.0, 'internal_damping': 1e-3}
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ALONG_Y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
NO_TABLE = -1e6


def obstacle(shape, sizes, position=(0, 0, 0), turn=UPRIGHT, friction=1.0, triangles=NO_TRIANGLES):
    return Obstacle(shape, np.array(sizes, float), np.array(position, float), np.array(turn, float), friction,
                    np.array(triangles, float))


def rope_at(points, physical=PHYSICAL, obstacles=(), *, places=None, velocities=None, features=None):
    """Return a rope in the core whose segments have their lengths at rest, unless `places` says otherwise."""
    points = np.asarray(points, float)
    if places is None:
        places = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    velocities = np.zeros_like(points) if velocities is None else velocities
    return core.Rope(core.Start(places, points, velocities, features), physical, STEP, NO_TABLE,
                     (0, 0, -GRAVITY), core_scene(obstacles))


def line(start, direction, length, count):
    return np.asarray(start, float) + np.linspace(0, length, count)[:, None] * np.asarray(direction, float)


def box_mesh(edges):
    """Return the 12 triangles of a box."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(edges) / 2
    faces = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6),
             (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    return corners[np.array(faces)]


LIGHT, LEG, DENSITY = 0.1, 0.15, 0.03  # kg at the lighter end, m, kg/m


def capstan_tensions(mu, angle, radius):
    """
    Return the tension [N] along the arc of a heavy rope that begins to slide, by Euler's equation.

    dT/da = mu (T + w R cos b) - w R sin b, with w the weight per length and b the angle from the top.
    """
    weight = DENSITY * GRAVITY * radius
    tension = (LIGHT + DENSITY * LEG) * GRAVITY

    def slope(a, t):
        b = a - np.pi / 2  # from the top of the cylinder
        return mu * (t + weight * np.cos(b)) - weight * np.sin(b)

    return solve_ivp(slope, (0, angle), [tension], rtol=1e-8, dense_output=True).sol


def sliding_speed(mu, angle, radius, nodes, heavier):
    """Return how fast [m/s] a rope with weights at its ends slides around a cylinder."""
    thickness = PHYSICAL['self_collision']
    turn = radius + thickness
    along = np.linspace(0, angle * turn + 2 * LEG, nodes)
    arc = np.clip((along - LEG) / turn, 0, angle)
    points = np.stack([-turn * np.cos(arc), 2.5 * thickness * arc / (2 * np.pi), turn * np.sin(arc)], axis=1)
    points[:, 2] -= np.maximum(LEG - along, 0) + np.maximum(along - LEG - angle * turn, 0)
    tensions = capstan_tensions(mu, angle, turn)(arc)[0]
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    strain = (tensions[1:] + tensions[:-1]) / 2 / PHYSICAL['elasticity']
    weights = np.zeros(nodes)
    weights[0], weights[-1] = 1.0, heavier / LIGHT
    rope = rope_at(points, {**PHYSICAL, 'flexibility': 1e-6, 'friction': mu, 'mass': DENSITY * along[-1],
                            'marker_mass': LIGHT, 'damping': 5.0, 'internal_damping': 0.01},
                   [obstacle('cylinder', (2.0, radius), turn=ALONG_Y)],
                   places=np.append(0.0, np.cumsum(lengths / (1 + strain))), features=weights)
    heights = []
    for _ in range(int(1.0 / STEP)):
        assert rope.step()
        heights.append(rope.points[-1, 2])
        if rope.points[0, 2] > -0.05:  # the lighter end is almost on the cylinder
            break
    half = len(heights) // 2
    return (heights[half] - heights[-1]) / (len(heights) - 1 - half) / STEP


CASES = [(angle, radius, nodes)
         for angle in (np.pi, 3 * np.pi) for radius in (0.03, 0.05) for nodes in (41, 81)]


@pytest.mark.parametrize(('angle', 'radius', 'nodes'), CASES)
def test_a_rope_around_a_cylinder_slides_as_the_capstan_equation_says(angle, radius, nodes):
    """The coefficient at which it begins to slide is within 3 % of that of the equation."""
    mu = 0.2
    for share, slides in ((0.97, False), (1.03, True)):
        tension = capstan_tensions(share * mu, angle, radius + PHYSICAL['self_collision'])(angle)[0]
        speed = sliding_speed(mu, angle, radius, nodes, tension / GRAVITY - DENSITY * LEG)
        assert (speed > 0.004) == slides, f'{speed} m/s at {share} of the coefficient'


RESTS = [  # an obstacle, and the height at which the middle of a DLO that lies across it rests
    pytest.param(obstacle('box', (0.2, 0.4, 0.2), (0, 0, 0.1)), 0.2, id='box'),
    pytest.param(obstacle('sphere', (0.5,), (0, 0, 0)), 0.5, id='sphere'),
    pytest.param(obstacle('cylinder', (0.4, 0.05), (0, 0, 0.1), ALONG_Y), 0.15, id='cylinder'),
    pytest.param(obstacle('capsule', (0.4, 0.05), (0, 0, 0.1), ALONG_Y), 0.15, id='capsule'),
    pytest.param(obstacle('mesh', (1, 1, 1), (0, 0, 0.1), triangles=box_mesh((0.2, 0.4, 0.2))), 0.2,
                 id='mesh'),
    pytest.param(obstacle('mesh', (2, 1, -1), (0, 0, 0.1), triangles=box_mesh((0.1, 0.4, 0.2))), 0.2,
                 id='mirrored mesh'),
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


def dragged(way, duration, height=PHYSICAL['self_collision']):
    """Return a trial: one end of a rope that lies along x goes a way [m] and is released."""
    points = line((0, 0, height), (1, 0, 0), 0.6, 41)
    way = np.array(way, float)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    hand = Hand('hand', (40,), along / along[-1] * duration, way)
    goals = [Goal(Chain(points), share * duration, stable=False, held_by=('hand',)) for share in (0.5, 1.0)]
    return Trial('drag', Chain(points), (Action((hand,)),), (*goals, Goal(Chain(points), duration + 3)))


def pegs(*places, radius=0.01):
    return [obstacle('cylinder', (0.1, radius), (x, y, 0.05)) for x, y in places]


AROUND_ONE = dragged([(0.6, 0, 0.004), (0.55, 0.2, 0.02), (0.3, 0.25, 0.02), (0.1, 0.15, 0.02)], 3.0)
AROUND_TWO = dragged([(0.6, 0, 0.004), (0.55, 0.15, 0.02), (0.4, 0.15, 0.02), (0.28, -0.1, 0.02)], 3.0)


@pytest.mark.long
@pytest.mark.parametrize(('trial', 'obstacles'), [
    pytest.param(AROUND_ONE, pegs((0.4, 0.05)), id='one peg'),
    pytest.param(AROUND_TWO, pegs((0.45, 0.04), (0.33, -0.03)), id='two pegs')])
def test_a_rope_around_pegs_moves_as_in_pybullet(trial, obstacles):
    """PyBullet adds contact after the step, so that it needs a much shorter one: see `BulletSimulator`."""
    ours = CompiledSimulator(obstacles=obstacles).simulate(trial, PHYSICAL)
    theirs = BulletSimulator(obstacles=obstacles, nodes=81, time_step=0.0015).simulate(trial, PHYSICAL)
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
