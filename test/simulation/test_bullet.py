# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The PyBullet rope among obstacles: those of its world, and those of a scene.

What holds for every engine is in test_engine_contract.py.
"""

import os

import numpy as np
import pybullet
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, InputError, Trial
from dlo_calibration.simulation.bullet import BulletRope, BulletSimulator, IDENTITY
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.scene import read_scene

GRAVITY = 9.81
STIFF = {'flexibility': 1e-3, 'elasticity': 1e4, 'friction': 0.4, 'self_collision': 0.005, 'mass': 0.05,
         'damping': 5.0, 'internal_damping': 1e-3}


@pytest.fixture
def world():
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -GRAVITY, physicsClientId=client)
    pybullet.setTimeStep(0.005, physicsClientId=client)
    yield client
    pybullet.disconnect(physicsClientId=client)


def line(start, direction, length, count):
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return np.asarray(start, float) + np.linspace(0, length, count)[:, None] * direction


def table(client, height=0.0):
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    body = pybullet.createMultiBody(0, shape, basePosition=[0, 0, height], physicsClientId=client)
    pybullet.changeDynamics(body, -1, lateralFriction=1.0, physicsClientId=client)
    return body


def settle(rope, limit=20.0):
    """Step until nothing moves more than 10 micrometres in 0.25 s."""
    for _ in range(int(limit / 0.25)):
        before = rope.points
        for _ in range(round(0.25 / rope.time_step)):
            rope.step()
        if np.abs(rope.points - before).max() < 1e-5:
            return rope.points
    raise AssertionError('the rope never came to rest')


def test_a_rope_falls_onto_an_obstacle_of_its_world_and_rests_on_it(world):
    table(world)
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.1, 0.1, 0.05],
                                        physicsClientId=world)
    pybullet.createMultiBody(0, box, basePosition=[0.5, 0, 0.05], physicsClientId=world)
    rope = BulletRope.of(world, Chain(line((0, 0, 0.2), (1, 0, 0), 1.0, 11)), {**STIFF, 'flexibility': 1e-5})
    points = settle(rope)
    assert points[len(points) // 2, 2] == pytest.approx(0.105, abs=2e-3)
    assert points[[0, -1], 2] == pytest.approx(0.005, abs=2e-3)


PEG = ('<robot name="peg"><link name="peg"><collision><origin xyz="0.3 0 0.3" rpy="1.5707963 0 0"/>'
       '<geometry><cylinder radius="0.03" length="0.4"/></geometry></collision></link></robot>')
BOX = ('<robot name="box"><link name="box"><contact><lateral_friction value="{friction}"/></contact>'
       '<collision><origin xyz="0.3 0 0.1"/><geometry><box size="0.2 0.4 0.2"/></geometry></collision>'
       '</link></robot>')


@pytest.fixture
def scene(tmp_path):
    """Give a function that writes a URDF file and returns its path."""
    def write(text, name='scene.urdf'):
        (tmp_path / name).write_text(text, encoding='utf-8')
        return str(tmp_path / name)
    return write


@pytest.fixture(params=['bullet', 'compiled'])
def among(request):
    """Give a function that makes the simulator of an engine with the scene of a URDF file."""
    made = []

    def make(path):
        made.append(BulletSimulator(scene=path) if request.param == 'bullet' else
                    CompiledSimulator(obstacles=read_scene(path)))
        return made[-1]

    yield make
    for simulator in made:
        simulator.close()


def dropped(height, goal_time=3.0, push=(0, 0, 0)):
    """Return a level rope that falls from `height` [m], after a hand has pushed its middle."""
    points = line((0, 0, height), (1, 0, 0), 0.6, 31)
    hand = Hand('hand', (15,), [0.0, 1.0 if any(push) else 0.02], [points[15], points[15] + push])
    return Trial('drop', Chain(points), (Action((hand,)),), (Goal(Chain(points), goal_time),))


PHYSICAL = {**STIFF, 'flexibility': 1e-4, 'mass': 0.03, 'damping': 1.0}


@pytest.mark.parametrize('radius', [
    0.003, *(pytest.param(thick, marks=pytest.mark.long) for thick in (0.005, 0.01))])
def test_a_rope_laid_over_a_peg_hangs_over_it(scene, among, radius):
    simulator = among(scene(PEG))
    rollout = simulator.simulate(dropped(0.36), {**PHYSICAL, 'self_collision': radius})
    chain = rollout.chains[0]
    assert rollout.settled == (True,)
    # It touches with its own radius, and no point of it is inside.
    assert chain[15, 2] == pytest.approx(0.33 + radius, abs=1e-3)
    assert np.linalg.norm(chain[:, [0, 2]] - (0.3, 0.3), axis=1).min() > 0.03 + radius - 1e-3
    assert chain[[0, -1], 2].max() < 0.1


@pytest.mark.long
def test_a_rope_falls_onto_the_box_of_a_scene_and_onto_the_table(scene, among):
    simulator = among(scene(BOX.format(friction=1.0).replace('0.2 0.4 0.2', '0.16 0.4 0.2')))
    chain = simulator.simulate(dropped(0.25), {**PHYSICAL, 'flexibility': 1e-5}).chains[0]
    assert chain[15, 2] == pytest.approx(0.205, abs=1e-3)
    assert chain[[0, -1], 2] == pytest.approx(0.005, abs=1e-3)  # 0.22 m overhang at both ends of the box


@pytest.mark.long
def test_friction_is_that_of_the_scene(scene, among):
    """Pull a rope over a smooth and a rough box; the softer it is, the longer friction makes it."""
    points = line((0.0, 0, 0.205), (1, 0, 0), 0.6, 31)
    hand = Hand('hand', (30,), [0.0, 3.0], [points[30], points[30] + (0.3, 0, 0)])
    goal = Goal(Chain(points), 2.9, stable=False, held_by=('hand',))
    trial = Trial('pull', Chain(points), (Action((hand,)),), (goal,))
    physical = {**STIFF, 'elasticity': 20.0, 'friction': 0.5, 'mass': 0.05, 'damping': 0.01,
                'internal_damping': 0.03}
    wide = BOX.replace('0.2 0.4 0.2', '3 0.4 0.2')
    without = wide.replace('<contact><lateral_friction value="{friction}"/></contact>', '')
    for text, friction in (
            (wide.format(friction=0.4), 0.4), (wide.format(friction=0.8), 0.8), (without, 1.0)):
        simulator = among(scene(text))
        chain = simulator.simulate(trial, physical).chains[0]
        stretch = chain[30, 0] - chain[0, 0] - 0.6
        # The force at s is mu m g s / L, so that the stretch is mu m g L / (2 EA), with Bullet's product mu.
        expected = 0.5 * friction * 0.05 * GRAVITY * 0.6 / (2 * 20.0)
        assert stretch == pytest.approx(expected, rel=0.05)


@pytest.mark.long
def test_a_repeat_in_a_scene_is_bit_exact_whatever_was_simulated_between(scene):
    path = scene(BOX.format(friction=0.7))
    simulator = BulletSimulator(scene=path, settle_limit=0.1)
    sideways = dropped(0.22, push=(0.02, 0.15, 0.05))
    first = simulator.simulate(sideways, PHYSICAL).chains.tobytes()
    simulator.simulate(dropped(0.25), PHYSICAL)
    again = simulator.simulate(sideways, PHYSICAL).chains.tobytes()
    simulator.simulate(sideways, {**PHYSICAL, 'self_collision': 0.01, 'friction': 1.5})
    other_radius_between = simulator.simulate(sideways, PHYSICAL).chains.tobytes()
    fresh = BulletSimulator(scene=path, settle_limit=0.1)
    os.remove(path)  # what was read once is not read again
    assert first == again == other_radius_between == fresh.simulate(sideways, PHYSICAL).chains.tobytes()
    simulator.close()
    fresh.close()


MESH = ('<robot name="m"><link name="m"><collision><geometry><mesh filename="mesh.obj"/></geometry>'
        '</collision></link></robot>')


@pytest.mark.long
def test_a_hollow_mesh_is_hollow(scene, among):
    """A rope falls into a trough, which the convex hull of its mesh would cover."""
    vertices = [(x, y, z) for x in (0.0, 0.6) for y, z in ((-0.2, 0.3), (0.0, 0.1), (0.2, 0.3))]
    faces = [(1, 2, 5), (1, 5, 4), (2, 3, 6), (2, 6, 5)]
    scene(''.join(f'v {x} {y} {z}\n' for x, y, z in vertices)
          + ''.join(f'f {a} {b} {c}\nf {a} {c} {b}\n' for a, b, c in faces), 'mesh.obj')
    simulator = among(scene(MESH))
    chain = simulator.simulate(dropped(0.25), PHYSICAL).chains[0]
    assert chain[15, 2] == pytest.approx(0.1 + 0.005 * np.sqrt(2), abs=2e-3)


def test_a_mesh_that_would_end_pybullet_is_refused_without_output(scene, capfd):
    for text in ('solid nonsense', 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999'):
        scene(text, 'mesh.obj')
        with pytest.raises(InputError, match="scene .*scene.urdf: the mesh 'mesh.obj': "):
            BulletSimulator(scene=scene(MESH))
    assert capfd.readouterr() == ('', '')


def test_a_mesh_does_the_same_as_with_pybullets_own_reader(scene, monkeypatch):
    """A wavy sheet of 882 triangles, scaled."""
    grid = np.linspace(0, 1, 22)
    index = np.arange(22 * 22).reshape(22, 22)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4) + 1
    file = scene(''.join(f'v {x} {y} {0.02 * np.sin(9 * x + 7 * y)}\n' for x in grid for y in grid)
                 + ''.join(f'f {" ".join(map(str, quad))}\n' for quad in quads), 'mesh.obj')
    path = scene(MESH.replace('"mesh.obj"', '"mesh.obj" scale="0.7 0.5 1.3"').replace(
        '<geometry>', '<origin xyz="-0.05 -0.2 0.2"/><geometry>'))
    shape_of, chains = pybullet.createCollisionShape, []

    def theirs(*plane, **shape):
        return shape_of(*plane, **{**shape, **({'fileName': file} if 'fileName' in shape else {})})

    for make in (shape_of, theirs):
        monkeypatch.setattr(pybullet, 'createCollisionShape', make)
        simulator = BulletSimulator(scene=path, settle_limit=1.0)
        chains.append(simulator.simulate(dropped(0.25), PHYSICAL).chains)
        simulator.close()
    assert chains[0][0, :, 2].min() > 0.15
    assert chains[0].tobytes() == chains[1].tobytes()


@pytest.mark.long
def test_a_scene_stands_where_pybullets_own_importer_puts_it(scene, capfd):
    inertial = ('<inertial><origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0"/><mass value="1"/>'
                '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>')
    shapes = ['<box size="0.3 0.2 0.1"/>', '<cylinder radius="0.1" length="0.4"/>',
              '<capsule radius="0.1" length="0.3"/>', '<sphere radius="0.1"/>']
    places = ('0.4 0 0.1', '-0.4 0 0.1', '0 0.4 0.1', '0 -0.4 0.1')
    collisions = [f'<collision><origin xyz="{place}" rpy="0.3 0.2 0.1"/><geometry>{shape}</geometry>'
                  '</collision>' for place, shape in zip(places, shapes, strict=True)]
    path = scene(
        f'<robot name="r"><link name="a">{inertial}{"".join(collisions[:2])}</link>'
        f'<link name="b">{inertial}{"".join(collisions[2:])}</link>'
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
        '<origin xyz="0 0.1 0" rpy="0 0 0.5"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        '</robot>')
    simulator = BulletSimulator(scene=path, table=False)
    simulator.simulate(dropped(5.0, goal_time=1.1), PHYSICAL)
    ours = simulator._world._client
    theirs = pybullet.connect(pybullet.DIRECT)
    pybullet.loadURDF(path, useFixedBase=True, physicsClientId=theirs)
    pybullet.performCollisionDetection(physicsClientId=theirs)
    generator = np.random.default_rng(0)
    begin, end = (generator.uniform(-1, 1, (1000, 3)) * (1, 1, 0.4) for _ in range(2))
    hits = []
    for client in (ours, theirs):
        rays = pybullet.rayTestBatch(begin.tolist(), end.tolist(), physicsClientId=client)
        hits.append(np.array([ray[2] for ray in rays]))
    pybullet.disconnect(physicsClientId=theirs)
    simulator.close()
    assert (hits[0] < 1).sum() > 100
    # Their cylinder has corners, so that a few rays that graze it pass.
    assert (np.abs(hits[0] - hits[1]) > 0.01).mean() < 0.005


def hand(client, places=((0, 0, 0),)):
    """Add a body without weight, of blocks of 8 cm; it moves only where a test puts it."""
    block = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.04] * 3, physicsClientId=client)
    count = len(places) - 1
    return pybullet.createMultiBody(
        0, block, basePosition=places[0], linkMasses=[0] * count, linkCollisionShapeIndices=[block] * count,
        linkVisualShapeIndices=[-1] * count, linkPositions=list(places[1:]),
        linkOrientations=[IDENTITY] * count, linkInertialFramePositions=[(0, 0, 0)] * count,
        linkInertialFrameOrientations=[IDENTITY] * count, linkParentIndices=[0] * count,
        linkJointTypes=[pybullet.JOINT_FIXED] * count, linkJointAxis=[(0, 0, 1)] * count,
        physicsClientId=client)


def put(client, body, place, turn=IDENTITY):
    pybullet.resetBasePositionAndOrientation(body, place, turn, physicsClientId=client)


def stretch(rope, begun):
    """Return the largest factor by which a segment is longer than in (N, 3) `begun`."""
    return (np.linalg.norm(np.diff(rope.points, axis=0), axis=1)
            / np.linalg.norm(np.diff(begun, axis=0), axis=1)).max()


def test_a_gripper_holds_the_rope_inside_of_a_link_without_stretching_it(world):
    """Lift an end by 0.3 m, held in the middle of a block, and let go of it there."""
    table(world)
    rope = BulletRope.of(world, Chain(line((0, 0, 0.005), (1, 0, 0), 0.6, 21)), PHYSICAL)
    begun, largest = rope.points, 0.0
    body = hand(world, [begun[0] + (0, 0, 0.3), (0, 0, -0.3)])  # it holds with its second block
    rope.grip(body, 0)
    for height in np.linspace(0, 0.3, 150):
        put(world, body, begun[0] + (0, 0, 0.3 + height))
        rope.step()
        largest = max(largest, stretch(rope, begun))
        assert rope.points[:2, 2] == pytest.approx(0.005 + height, abs=1e-6)  # both: a clamp
    assert largest < 1.03  # with `hold`, the block pushes the neighbours away, to 4
    rope.release(body)
    for _ in range(20):
        rope.step()
        largest = max(largest, stretch(rope, begun))
    assert largest < 1.1  # the clamp was rigid, so that the end springs back
    assert np.linalg.norm(rope.points[0] - begun[0] - (0, 0, 0.3)) < 0.03  # nothing pushes it out


def test_a_released_rope_touches_the_gripper_again_once_it_was_clear_of_it(world):
    rope = BulletRope.of(world, Chain(line((0, 0, 0.3), (1, 0, 0), 0.06, 5)), PHYSICAL, nodes=5)
    body = hand(world, [(0.03, 0, 0.3)])
    rope.grip(body, -1, (-0.03, 0, 0))
    rope.release()
    rope.step()
    assert rope.points[:, 2].mean() == pytest.approx(0.3, abs=1e-3)  # still inside
    put(world, body, (0.03, 0, 0.2))
    for _ in range(200):
        rope.step()
    assert rope.points[:, 2] == pytest.approx(0.245, abs=2e-3)  # it lies on the block


def test_a_gripper_turns_a_rope_that_resists_twist_about_its_axis(world):
    """The result is that of `hold` with the turns of the hand."""
    twisting = {**PHYSICAL, 'torsion': 1e-4, 'natural_curvature': 5.0}
    ends = []
    for gripped in (False, True):
        rope = BulletRope.of(world, Chain(line((0, 0, 1), (1, 0, 0), 0.3, 11)), twisting, nodes=11,
                             group=1 << (6 + gripped))
        begun = rope.points
        body = hand(world, [(-0.5, 0, 1)])
        if gripped:
            rope.grip(body, -1, (0.5, 0, 0))
        else:
            rope.hold((0, 1))
        for k in range(40):
            turn = pybullet.getQuaternionFromEuler((0.05 * (k + 1), 0, 0))
            each = np.array(pybullet.getMatrixFromQuaternion(pybullet.getQuaternionFromEuler((0.05, 0, 0))))
            if gripped:
                put(world, body, (-0.5, 0, 1), turn)
                rope.step()
            else:
                rope.step(begun[:2], np.array([each, each]))
        ends.append(rope.points)
        rope.remove()
    np.testing.assert_allclose(*ends, atol=1e-6)
    assert np.ptp(ends[0][:, 1]) > 1e-3  # it was turned aside


def test_a_gripper_away_from_the_rope_is_refused(world):
    rope = BulletRope.of(world, Chain(line((0, 0, 0), (1, 0, 0), 0.6, 11)), PHYSICAL)
    body = hand(world, [(0, 0, 0.2)])
    with pytest.raises(InputError, match='a rope that is 200 mm away from it; expected at most 30 mm'):
        rope.grip(body, -1)
    rope.grip(body, -1, (0, 0, -0.2))
    with pytest.raises(InputError, match='held already'):
        rope.grip(body, -1, (0, 0, -0.2))
    with pytest.raises(InputError, match='release the gripper first'):
        rope.hold((1, 5))
