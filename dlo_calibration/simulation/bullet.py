# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The PyBullet engine: a rope for any PyBullet world, and a simulator of trials that uses it.

The rope's nodes are spheres.  In each step, the core computes their velocities due to
internal forces, gravity and self-contact; Bullet adds contact and friction with all
other bodies: a table, obstacles, robots.  A robot's gripper can hold the rope.
"""

from __future__ import annotations

from contextlib import contextmanager
import ctypes
import os
from tempfile import gettempdir
from typing import Any, Iterator, Mapping, Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation import core
from dlo_calibration.simulation.compiled import Engine, NO_TABLE
from dlo_calibration.simulation.nodes import feature_shares, NodeLayout, spread_places
from dlo_calibration.simulation.protocol import DEFAULT_NODES, Rollout
from dlo_calibration.simulation.scene import Obstacle, read_scene, stl_octets
from dlo_calibration.writing import scratch_folder

if TYPE_CHECKING:
    from dlo_calibration.simulation.core._core import Outcome


@contextmanager
def _silence() -> Iterator[None]:
    """Keep native code from writing to stdout and stderr."""
    flush = ctypes.CDLL(None).fflush  # of C, which buffers output to a pipe
    flush(None)
    saved, nowhere = (os.dup(1), os.dup(2)), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        flush(None)
        for stream, copy in enumerate(saved, 1):
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


with _silence():  # its import prints the build time, which would disturb a progress bar
    import pybullet as pybullet  # so that others can use it


def add_obstacle(client: int, obstacle: Obstacle) -> None:
    """
    Add an obstacle to a world.

    :raises DloCalibrationError: if a mesh cannot be handed over.
    """
    sizes = obstacle.sizes.tolist()
    with _file_of(obstacle.triangles) as file:
        shape = pybullet.createCollisionShape(physicsClientId=client, **{
            'box': {'shapeType': pybullet.GEOM_BOX, 'halfExtents': [size / 2 for size in sizes]},
            'sphere': {'shapeType': pybullet.GEOM_SPHERE, 'radius': sizes[0]},
            'cylinder': {'shapeType': pybullet.GEOM_CYLINDER, 'height': sizes[0], 'radius': sizes[-1]},
            'capsule': {'shapeType': pybullet.GEOM_CAPSULE, 'height': sizes[0], 'radius': sizes[-1]},
            'mesh': {'shapeType': pybullet.GEOM_MESH, 'fileName': file, 'meshScale': sizes,
                     'flags': pybullet.GEOM_FORCE_CONCAVE_TRIMESH},
        }[obstacle.shape])
    body = pybullet.createMultiBody(
        0, shape, basePosition=obstacle.position.tolist(), baseOrientation=obstacle.turn.tolist(),
        useMaximalCoordinates=True, physicsClientId=client)
    pybullet.changeDynamics(body, -1, lateralFriction=obstacle.friction, restitution=0.0,
                            physicsClientId=client)


@contextmanager
def _file_of(triangles: Floats) -> Iterator[str]:
    """
    Give the path of a temporary file with triangles, or '' if there are none.

    PyBullet also takes arrays, but does not free them with the world.
    """
    if not len(triangles):
        yield ''
        return
    try:
        with scratch_folder() as folder:
            file = folder / 'mesh.stl'
            file.write_bytes(stl_octets(triangles))
            yield str(file)
    except OSError as error:
        raise DloCalibrationError(f'a mesh of the scene could not be handed to PyBullet ({error}); '
                                  f'free space in {gettempdir()}') from error


class Gripper:
    """
    A closed gripper.

    :param client: id of the PyBullet client.
    :param body: id of the robot.
    :param link: index of the link to whose frame `place` belongs; -1: the base.
    :param place: (3,) [m] where the gripper holds, in the frame of that link.
    """

    def __init__(self, client: int, body: int, link: int, place: Sequence[float]) -> None:
        self._client, self.body, self.link = client, body, link
        self._place = np.array(place, dtype=float)
        self._hand = _hand(client, body, link)
        self._offsets = np.empty((0, 3))
        #: rotation matrix (3, 3) of the link
        self.turn = np.eye(3)
        #: indices of the nodes that it holds
        self.nodes: tuple[int, ...] = ()

    def close(self, points: Floats, held: Sequence[int], count: int, reach: float) -> None:
        """
        Hold the nodes next to the place, at their positions.

        :param points: (N, 3) [m] all nodes of the rope.
        :param held: indices of nodes that are already held.
        :param count: number of neighbouring nodes to hold.
        :param reach: largest distance [m] of the rope from the place.
        :raises InputError: if the rope is further away, or already held there.
        """
        position, self.turn = self._pose()
        centre = position + self.turn @ self._place
        segments = np.diff(points, axis=0)
        along = np.einsum('sk,sk->s', centre - points[:-1], segments) / np.square(segments).sum(axis=1)
        shares = np.clip(along, 0.0, 1.0)
        distances = np.linalg.norm(points[:-1] + shares[:, None] * segments - centre, axis=1)
        nearest = int(distances.argmin())
        gripper = f'the gripper at link {self.link} of body {self.body}'
        if not distances[nearest] <= reach:
            raise InputError(gripper, f'a rope that is {1000 * distances[nearest]:.0f} mm away from it',
                             f'at most {1000 * reach:.0f} mm',
                             'move the gripper to the rope, or give the place between its fingers')
        first = round(nearest + float(shares[nearest]) - (count - 1) / 2)
        first = min(max(first, 0), len(points) - count)
        self.nodes = tuple(node for node in range(first, first + count) if node not in held)
        if not self.nodes:
            raise InputError(gripper, 'nodes that are held already', 'free ones', 'release them first')
        self._offsets = (points[list(self.nodes)] - position) @ self.turn

    def follow(self) -> tuple[Floats, Floats]:
        """Return positions of the nodes now, (n, 3) [m], and the rotation (3, 3) since the last call."""
        position, turn = self._pose()
        rotation = turn @ self.turn.T
        self.turn = turn
        return position + self._offsets @ turn.T, rotation

    def set_contact(self, bodies: Sequence[int], enabled: bool) -> None:
        """
        Enable or disable contact of the hand with bodies.

        The hand is the link with all links that are fixed to it or that it moves.

        :param bodies: their ids.
        """
        for link in self._hand:
            for body in bodies:
                pybullet.setCollisionFilterPair(self.body, body, link, -1, enabled,
                                                physicsClientId=self._client)

    def shares_links_with(self, other: Gripper) -> bool:
        """Return whether the hands of both have a link in common."""
        return self.body == other.body and not set(self._hand).isdisjoint(other._hand)

    def is_clear_of(self, points: Floats, radius: float) -> bool:
        """Return whether spheres at (N, 3) [m] are outside of the boxes around the links of the hand."""
        for link in self._hand:
            low, high = pybullet.getAABB(self.body, link, physicsClientId=self._client)
            outside = (points < np.array(low) - radius) | (points > np.array(high) + radius)
            if not outside.any(axis=1).all():
                return False
        return True

    def _pose(self) -> tuple[Floats, Floats]:
        """Return position (3,) [m] and rotation matrix (3, 3) of the link's frame."""
        client = self._client
        if self.link >= 0:
            position, turn = pybullet.getLinkState(self.body, self.link, computeForwardKinematics=True,
                                                   physicsClientId=client)[4:6]
        else:  # PyBullet gives the centre of mass of a base
            centre = pybullet.getDynamicsInfo(self.body, -1, physicsClientId=client)[3:5]
            position, turn = pybullet.multiplyTransforms(
                *pybullet.getBasePositionAndOrientation(self.body, physicsClientId=client),
                *pybullet.invertTransform(*centre))
        return np.array(position), np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)


def _hand(client: int, body: int, link: int) -> tuple[int, ...]:
    """Return the links of a hand that have a collision shape; see `Gripper.set_contact`."""
    joints = [pybullet.getJointInfo(body, k, physicsClientId=client)
              for k in range(pybullet.getNumJoints(body, physicsClientId=client))]
    parents = [joint[16] for joint in joints]
    while link >= 0 and joints[link][2] == pybullet.JOINT_FIXED:
        link = parents[link]
    hand = {link}
    for k, parent in enumerate(parents):  # a parent has a smaller index than its children
        if parent in hand:
            hand.add(k)
    return tuple(link for link in sorted(hand)
                 if pybullet.getCollisionShapeData(body, link, physicsClientId=client))


FINER = 6  # steps among obstacles, in the time of one without
IDENTITY = (0.0, 0.0, 0.0, 1.0)  # quaternion x y z w of no rotation


class BulletRope:
    """
    A calibrated rope in a PyBullet world, beside robots and obstacles.

    The world's gravity and time step apply to it.  In Bullet, friction with another
    body is the product of both coefficients: give the table of the calibration
    `lateralFriction` 1.  Call `step` instead of `pybullet.stepSimulation`, or
    `before_step` and `after_step` around it.

    :param client: id of the PyBullet client.
    :param places: (N,) [m] arc lengths of the nodes at rest, from 0, increasing.
    :param points: (N, 3) [m] positions of the nodes at the start.
    :param physical: physical values by parameter name, in SI units.
    :param radius: [m] for contact with other bodies; None: the self-collision radius.
    :param velocities: (N, 3) [m/s] at the start; None: at rest.
    :param features: (N,) number of points annotated as feature at each node; None: there are none.
    :param directions: (N - 1, 3) unit vectors across the segments in clamps that hold from the start, from
        which the rest shape is measured, nan elsewhere; None: unknown.
    :param group: collision group, one bit; its bodies do not touch each other in Bullet.  Ropes
        that may touch each other need different groups.
    """

    def __init__(self, client: int, places: Floats, points: Floats, physical: Mapping[str, float], *,
                 radius: float | None = None, velocities: Floats | None = None,
                 features: Floats | None = None, directions: Floats | None = None, group: int = 1 << 6
                 ) -> None:
        self._client = client
        world = pybullet.getPhysicsEngineParameters(physicsClientId=client)
        self.time_step: float = world['fixedTimeStep']
        self._gravity = np.array([world[f'gravityAcceleration{axis}'] for axis in 'XYZ'])
        self._radius = physical['self_collision'] if radius is None else radius
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=self._radius,
                                              physicsClientId=client)
        #: PyBullet's body ids of the nodes, first to last
        self.bodies: tuple[int, ...] = tuple(
            pybullet.createMultiBody(
                baseMass=1.0, baseCollisionShapeIndex=shape, basePosition=list(point),
                useMaximalCoordinates=True, physicsClientId=client)
            for point in np.asarray(points, dtype=float))
        for body in self.bodies:
            pybullet.setCollisionFilterGroupMask(body, -1, group, ~group, physicsClientId=client)
        self._held: tuple[int, ...] = ()
        self._grippers: list[Gripper] = []
        self._leaving: list[Gripper] = []  # have opened, and may still be around the rope
        velocities = np.zeros((len(places), 3)) if velocities is None else velocities
        self.begin(core.Start(places, points, velocities, features, directions), physical)

    @classmethod
    def of(cls, client: int, chain: Chain, physical: Mapping[str, float], *, nodes: int = DEFAULT_NODES,
           **rest: Any) -> BulletRope:
        """Return a rope at an observed chain, with a marker at each point annotated as feature."""
        places = spread_places(np.array([0.0, chain.length]), nodes)
        rest.setdefault('features', feature_shares(chain, places))
        return cls(client, places, chain.resample(places), physical, **rest)

    def begin(self, start: core.Start, physical: Mapping[str, float]) -> None:
        """Restart with the same bodies at a start with the same number of nodes, and other properties."""
        self._rope = core.Rope(start, physical, self.time_step, NO_TABLE, self._gravity)
        self._held = ()
        self.release()
        for body, mass in zip(self.bodies, self._rope.masses.tolist(), strict=True):
            pybullet.changeDynamics(
                body, -1, mass=mass, lateralFriction=physical['friction'],
                localInertiaDiagonal=[1e6] * 3,  # kg m^2: so large that spheres slide and do not roll
                restitution=0.0, linearDamping=0.0, angularDamping=0.0, physicsClientId=self._client)
        self.move_bodies(self._rope.points)

    def move_bodies(self, points: Floats) -> None:
        """Move the bodies in the world to (N, 3) [m]."""
        for body, point in zip(self.bodies, points.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(body, point, IDENTITY, physicsClientId=self._client)

    def follow(self, script: core.Script) -> Outcome | None:
        """
        Follow the script of a trial from its start; return the outcome as `core.roll_out` does.

        :raises SimulationError: if velocities are not finite.
        """
        return self._rope.follow(script, self._take_step)

    @property
    def points(self) -> Floats:
        """The nodes' current positions, (N, 3) [m]; a copy."""
        return self._rope.points.copy()

    def hold(self, nodes: Sequence[int]) -> None:
        """
        Hold exactly these nodes from now on, besides those in grippers; an empty sequence releases them.

        They still touch other bodies.  For a robot that holds the rope, `grip` is better.

        :raises InputError: if a gripper holds one of them.
        """
        nodes = tuple(dict.fromkeys(int(node) for node in nodes))
        gripped = {node for gripper in self._grippers for node in gripper.nodes}.intersection(nodes)
        if gripped:
            raise InputError('hold', f'the nodes {sorted(gripped)}, which a gripper holds', 'free nodes',
                             'release the gripper first')
        self._held = nodes
        self._hold_all()

    def grip(self, body: int, link: int, place: Sequence[float] = (0.0, 0.0, 0.0), *, nodes: int = 2,
             reach: float = 0.03) -> None:
        """
        Let a gripper of a robot hold the rope at its position; the rope follows the gripper in each step.

        The rope does not touch the hand, i.e. this link with all links that are fixed to it or that it
        moves, until the gripper is released and has moved away.  The rope touches all other links.

        :param body: PyBullet's id of the robot.
        :param link: index of a link of the hand; -1: the base.
        :param place: (3,) [m] between the fingers, in the frame of that link (in URDF: of its joint).
        :param nodes: number of nodes next to this place that are held; 1: the rope turns freely about it;
            2: the gripper also keeps the direction of the rope.
        :param reach: largest distance [m] between the place and the rope.
        :raises InputError: if the rope is further away, or already held there.
        """
        gripper = Gripper(self._client, body, link, place)
        gripper.close(self._rope.points, self._rope.held, nodes, reach)
        gripper.set_contact(self.bodies, False)
        self._grippers.append(gripper)
        self._hold_all()

    def release(self, body: int | None = None, link: int | None = None) -> None:
        """Open the gripper at a link of a robot; None: all grippers of the robot, or of all robots."""
        opened = [gripper for gripper in self._grippers
                  if body in (None, gripper.body) and link in (None, gripper.link)]
        self._grippers = [gripper for gripper in self._grippers if gripper not in opened]
        self._leaving += opened
        self._hold_all()

    def _hold_all(self) -> None:
        nodes = [*self._held, *(node for gripper in self._grippers for node in gripper.nodes)]
        self._rope.hold(nodes)
        self._rope.aim(self._rope.points[nodes])

    def step(self, targets: Floats | None = None, turns: Floats | None = None) -> None:
        """Take one step of the whole world; see `before_step`."""
        self.before_step(targets, turns)
        pybullet.stepSimulation(physicsClientId=self._client)
        self.after_step()

    def before_step(self, targets: Floats | None = None, turns: Floats | None = None) -> None:
        """
        Give the nodes the velocities due to internal forces, gravity and self-contact.

        :param targets: (h, 3) [m] positions after the step of the nodes that `hold` holds;
            None: they stay.  Nodes in a gripper follow the gripper.
        :param turns: (h, 9) rotation matrices, row by row, by which the clamps that hold these nodes turn in
            this step; None: a clamp turns with its segment, and not about it.
        :raises SimulationError: if the rollout diverges.
        """
        all_targets = self._rope.targets
        if targets is not None:
            all_targets[:len(self._held)] = targets
        all_turns = None if turns is None else np.asarray(turns, dtype=float)
        if self._grippers:
            all_turns = self._follow(all_targets, all_turns)
        self._rope.aim(all_targets, all_turns)
        self._send()

    def _follow(self, targets: Floats, turns: Floats | None) -> Floats:
        """Write the gripped nodes to `targets` (h, 3) [m]; return the `turns` (h, 9) of all held nodes."""
        count = len(self._held)
        all_turns = [np.tile(np.eye(3).ravel(), (count, 1)) if turns is None else turns]
        for gripper in self._grippers:
            points, turn = gripper.follow()
            targets[count:count + len(points)] = points
            all_turns.append(np.tile(turn.ravel(), (len(points), 1)))
            count += len(points)
        return np.concatenate(all_turns)

    def _send(self) -> None:
        """
        Give the nodes in Bullet their velocities before contact.

        :raises SimulationError: if they are not finite.
        """
        if not self._rope.predict():
            raise SimulationError('the rollout diverged: the chain is no longer finite')
        sent = self._rope.predicted - self._gravity * self.time_step  # Bullet adds it again
        client = self._client
        for body, velocity in zip(self.bodies, sent.tolist(), strict=True):
            pybullet.resetBaseVelocity(body, velocity, physicsClientId=client)

    def after_step(self) -> None:
        """Read positions and velocities after contact from Bullet."""
        client, rope = self._client, self._rope
        for node, target in zip(rope.held, rope.targets.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(self.bodies[node], target, IDENTITY,
                                                     physicsClientId=client)
        # The client by position: looking up its keyword for each node would take a fifth longer.
        points = np.array([pybullet.getBasePositionAndOrientation(body, client)[0] for body in self.bodies])
        rope.velocities[:] = (points - rope.points) / self.time_step
        rope.support[:] = rope.velocities - rope.predicted
        rope.points[:] = points
        for gripper in [gripper for gripper in self._leaving if gripper.is_clear_of(points, self._radius)]:
            self._leaving.remove(gripper)
            if not any(gripper.shares_links_with(other) for other in (*self._grippers, *self._leaving)):
                gripper.set_contact(self.bodies, True)

    def _take_step(self) -> None:
        """Take one step of the whole world to the targets of a script."""
        self._send()
        pybullet.stepSimulation(physicsClientId=self._client)
        self.after_step()

    def remove(self) -> None:
        """Take the rope out of the world."""
        for body in self.bodies:
            pybullet.removeBody(body, physicsClientId=self._client)


class BulletSimulator(Engine):
    """
    Simulates trials in a PyBullet world of its own: a rope, perhaps a table and a scene.

    The first trial builds the world; the others reset it.  The obstacles of a scene do
    not move.  The rope touches them with the evaluated radius.  Bullet cannot change the
    radius of a sphere, so that the world is built again for each new radius: about 20 ms,
    plus the time for the meshes.

    Bullet adds contact after a step of the rope, node by node.  At a point of a taut rope this is a blow that
    the step spreads over many nodes: with steps of 3 ms, a rope around a peg is 20 mm off.  So the steps
    among obstacles are shorter.

    :param scene: path of a URDF file with fixed obstacles; empty: none.
    :param obstacles: instead, those of a scene that was already read.
    :param settings: see `Engine`.
    :raises InputError: if the scene cannot be used.
    """

    name = 'bullet'

    def __init__(self, *, scene: str = '', obstacles: Sequence[Obstacle] = (), **settings: Any) -> None:
        super().__init__(**settings)
        self._obstacles = read_scene(scene) if scene else tuple(obstacles)
        if self._obstacles:
            self._time_step /= FINER
        self._world: _World | None = None

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units); one thread at a time may call this.

        :raises SimulationError: if the rollout diverges.
        :raises InputError: if the trial grips more points than there are nodes.
        """
        prepared, start, level = self._prepare(trial, physical)
        radius = physical['self_collision'] if self._obstacles else _World.SPHERE
        if self._world is not None and self._world.radius != radius:
            self._end()
        if self._world is None:
            self._world = _World(prepared.layout, physical, self._time_step, radius, self._obstacles)
        rope = self._world.start(start, physical, level)
        return self._rollout(prepared, rope.follow(prepared.script.events))

    def close(self) -> None:
        """Drop the prepared trials, and end the PyBullet client; the next trial starts another."""
        super().close()
        self._end()

    def _end(self) -> None:
        if self._world is not None:
            self._world.close()
            self._world = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the PyBullet client, too, which belongs to this process."""
        return {**super().__getstate__(), '_world': None}


class _World:
    """
    A PyBullet client with a rope, a plane and obstacles.

    :param radius: [m] of the rope's spheres; the height of the plane depends on it.
    """

    SPHERE = 0.005  # m; the radius if there is only a plane, so that one world serves all trials
    AWAY = -1e3  # m; height of the plane where nothing can touch it

    def __init__(self, layout: NodeLayout, physical: Mapping[str, float], time_step: float, radius: float,
                 obstacles: Sequence[Obstacle]) -> None:
        self.radius = radius
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=time_step, numSolverIterations=10, deterministicOverlappingPairs=1,
            warmStartingFactor=0.0,
            physicsClientId=self._client)
        pybullet.setGravity(0, 0, -GRAVITY, physicsClientId=self._client)
        shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=self._client)
        self._plane = pybullet.createMultiBody(0, shape, useMaximalCoordinates=True,
                                               physicsClientId=self._client)
        pybullet.changeDynamics(self._plane, -1, lateralFriction=1.0, restitution=0.0,
                                physicsClientId=self._client)
        for obstacle in obstacles:
            add_obstacle(self._client, obstacle)
        self._rope = BulletRope(self._client, layout.places, layout.points, physical, radius=radius)
        self._among_obstacles = bool(obstacles)

    def start(self, start: core.Start, physical: Mapping[str, float], touching: float | None) -> BulletRope:
        """Place rope and table; `touching` [m] is the height of nodes that touch the table."""
        height = self.AWAY if touching is None else touching - self.radius
        # Bullet keeps contact points between steps; a step without contact drops those of the trial before.
        self._place_table(self.AWAY)
        if self._among_obstacles:
            self._rope.move_bodies(self._rope.points + (0, 0, -self.AWAY))
        pybullet.stepSimulation(physicsClientId=self._client)
        self._place_table(height)
        self._rope.begin(start, physical)
        return self._rope

    def _place_table(self, height: float) -> None:
        pybullet.resetBasePositionAndOrientation(self._plane, [0, 0, height], IDENTITY,
                                                 physicsClientId=self._client)

    def close(self) -> None:
        pybullet.disconnect(physicsClientId=self._client)
