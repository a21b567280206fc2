# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The PyBullet engine: a rope in any PyBullet world, and trials simulated with it.

The rope's nodes are spheres.  Each step, `kernels` give their velocities from the
internal forces, gravity and the rope's contact with itself, and Bullet does contact
and friction with everything else.
"""

from __future__ import annotations

from contextlib import contextmanager
import ctypes
import os
from typing import Any, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.engine import Engine
from dlo_calibration.simulation.nodes import feature_shares, NodeLayout, spread_places
from dlo_calibration.simulation.obstacles import Obstacle, read_scene, unusable
from dlo_calibration.simulation.protocol import DEFAULT_NODES
from dlo_calibration.simulation.rope import diverged, Rope


@contextmanager
def _silence() -> Iterator[None]:
    """Keep native code from writing to stdout and stderr."""
    flush = ctypes.CDLL(None).fflush  # C buffers what it writes to a pipe
    flush(None)
    kept, nowhere = (os.dup(1), os.dup(2)), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        flush(None)
        for stream, before in enumerate(kept, 1):
            os.dup2(before, stream)
            os.close(before)
        os.close(nowhere)


with _silence():  # it greets every process with its build time, in the middle of a progress bar
    import pybullet

ROPE_GROUP = 1 << 6  # collision group whose members do not collide with each other in Bullet
NO_TURN = (0.0, 0.0, 0.0, 1.0)
INERTIA = 1e6  # kg m^2: spheres slide, they do not roll


class BulletRope:
    """
    A calibrated rope in a PyBullet world, beside robots and obstacles.

    The world's own gravity and time step apply to it.  Friction with another
    body is Bullet's product of both coefficients, so a table that the rope was
    calibrated on has `lateralFriction` 1.  Call `step` in place of
    `pybullet.stepSimulation`; or `before_step` and `after_step` around it.

    :param client: id of the PyBullet client.
    :param places: (N,) [m] of the nodes along the rope at rest, from 0, increasing.
    :param points: (N, 3) [m] of the nodes at the start.
    :param physical: physical values by parameter name, in SI units.
    :param radius: [m] at which it touches other bodies; None: its self-collision radius.
    :param velocities: (N, 3) [m/s] at the start; None: at rest.
    :param features: (N,) share of each node in the points annotated as feature; None: there are none.
    :param group: collision group of its own, one bit; two ropes that should
        touch each other need two.
    """

    def __init__(self, client: int, places: Floats, points: Floats, physical: Mapping[str, float], *,
                 radius: float | None = None, velocities: Floats | None = None,
                 features: Floats | None = None, group: int = ROPE_GROUP) -> None:
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
        self.reset(places, points, physical, velocities, features)

    @classmethod
    def of(cls, client: int, chain: Chain, physical: Mapping[str, float], *, nodes: int = DEFAULT_NODES,
           **rest: Any) -> BulletRope:
        """Put a rope where an observed chain is, with a marker where it is annotated as feature."""
        places = spread_places(np.array([0.0, chain.length]), nodes)
        rest.setdefault('features', feature_shares(chain, places))
        return cls(client, places, chain.resample(places), physical, **rest)

    def reset(self, places: Floats, points: Floats, physical: Mapping[str, float],
              velocities: Floats | None = None, features: Floats | None = None) -> None:
        """Start anew, with other properties, without building anything in the world."""
        assert len(places) == len(points) == len(self.bodies)
        velocities = np.zeros((len(places), 3)) if velocities is None else velocities
        self._rope = Rope(places, points, velocities, physical, self.time_step, self._gravity, features)
        state = self._rope.state
        for body, mass, point in zip(self.bodies, state.rod.masses, state.points.tolist(), strict=True):
            pybullet.changeDynamics(
                body, -1, mass=mass, localInertiaDiagonal=[INERTIA] * 3, lateralFriction=physical['friction'],
                restitution=0.0, linearDamping=0.0, angularDamping=0.0, physicsClientId=self._client)
            pybullet.resetBasePositionAndOrientation(body, point, NO_TURN, physicsClientId=self._client)
        self.hold(())

    @property
    def points(self) -> Floats:
        """The nodes' positions now, (N, 3) [m]; a copy."""
        return self._rope.points

    def hold(self, nodes: Sequence[int]) -> None:
        """Hold exactly these nodes from now on; none: let go."""
        self._rope.hold(tuple(dict.fromkeys(int(node) for node in nodes)))
        self._targets = self._rope.state.points[self._rope.state.rod.held]

    def step(self, targets: Floats | None = None) -> None:
        """Take one step of the whole world; see `before_step`."""
        self.before_step(targets)
        pybullet.stepSimulation(physicsClientId=self._client)
        self.after_step()

    def before_step(self, targets: Floats | None = None) -> None:
        """
        Give the nodes the velocities that internal forces and gravity cause.

        :param targets: (h, 3) [m] where the held nodes are after the step;
            None: where they were.
        :raises SimulationError: where the rollout diverges.
        """
        state = self._rope.state
        if targets is not None:
            self._targets = np.array(targets, dtype=float)
        if not kernels.want(state, self._targets):
            raise diverged()
        sent = state.wanted - self._gravity * self.time_step  # Bullet adds it again
        client = self._client
        for body, velocity in zip(self.bodies, sent.tolist(), strict=True):
            pybullet.resetBaseVelocity(body, velocity, physicsClientId=client)

    def after_step(self) -> None:
        """Take the positions and velocities that contacts left."""
        client, state = self._client, self._rope.state
        for node, target in zip(state.rod.held, self._targets.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(self.bodies[node], target, NO_TURN,
                                                     physicsClientId=client)
        points = np.array([pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0]
                           for body in self.bodies])
        state.velocities[:] = (points - state.points) / self.time_step
        state.support[:] = state.velocities - state.wanted
        state.points[:] = points

    def advance(self, targets: Floats, path: Floats | None = None) -> None:
        """
        Take k steps; targets (k, h, 3) [m] of the held nodes after each.

        :param path: (k, N, 3) to write all nodes to after each step [m].
        """
        for k, target in enumerate(targets):
            self.step(target)
            if path is not None:
                path[k] = self._rope.state.points

    def remove(self) -> None:
        """Take the rope out of the world."""
        for body in self.bodies:
            pybullet.removeBody(body, physicsClientId=self._client)


def _add_obstacle(client: int, obstacle: Obstacle) -> None:
    """Put an obstacle into a world."""
    sizes = obstacle.sizes.tolist()
    shape = pybullet.createCollisionShape(physicsClientId=client, **{
        'box': {'shapeType': pybullet.GEOM_BOX, 'halfExtents': [size / 2 for size in sizes]},
        'sphere': {'shapeType': pybullet.GEOM_SPHERE, 'radius': sizes[0]},
        'cylinder': {'shapeType': pybullet.GEOM_CYLINDER, 'height': sizes[0], 'radius': sizes[-1]},
        'capsule': {'shapeType': pybullet.GEOM_CAPSULE, 'height': sizes[0], 'radius': sizes[-1]},
        'mesh': {'shapeType': pybullet.GEOM_MESH, 'fileName': obstacle.file, 'meshScale': sizes,
                 'flags': pybullet.GEOM_FORCE_CONCAVE_TRIMESH},
    }[obstacle.shape])
    body = pybullet.createMultiBody(
        0, shape, basePosition=obstacle.position.tolist(), baseOrientation=obstacle.turn.tolist(),
        useMaximalCoordinates=True, physicsClientId=client)
    pybullet.changeDynamics(body, -1, lateralFriction=obstacle.friction, restitution=0.0,
                            physicsClientId=client)


def _obstacles(scene: str) -> tuple[Obstacle, ...]:
    """
    Return the obstacles of a scene, after trying to build them.

    :raises InputError: where the file cannot be used.
    """
    found = read_scene(scene)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for obstacle in found:
            try:
                with _silence():
                    _add_obstacle(client, obstacle)
            except pybullet.error as error:
                raise unusable(scene, f'a {obstacle.shape} {obstacle.file} that PyBullet cannot load',
                               'export the mesh as .obj or .stl') from error
    finally:
        pybullet.disconnect(physicsClientId=client)
    return found


class BulletSimulator(Engine):
    """
    Simulates trials in a PyBullet world of its own: the rope, a table or none, and a scene or none.

    The world is built at the first trial and reset for every other.

    Obstacles of a scene stay where they are, and the rope touches them with the
    radius that is tried.  Bullet cannot change the radius of a sphere, so the
    world is built anew for every other radius: about 20 ms, and what reading
    the scene's meshes takes.

    :param scene: path of a URDF file with fixed obstacles; empty: none.
    :param settings: see `Engine`.
    :raises InputError: where the scene cannot be used.
    """

    name = 'bullet'

    def __init__(self, *, scene: str = '', **settings: Any) -> None:
        super().__init__(**settings)
        self._obstacles = _obstacles(scene) if scene else ()
        self._world: _World | None = None

    def _rope(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              level: float | None) -> BulletRope:
        radius = physical['self_collision'] if self._obstacles else _World.SPHERE
        if self._world is not None and self._world.radius != radius:
            self._end()
        if self._world is None:
            self._world = _World(layout, physical, self._time_step, radius, self._obstacles)
        return self._world.start(layout, points, physical, level)

    def close(self) -> None:
        """Forget the trials, and end the PyBullet client; the next trial starts another."""
        super().close()
        self._end()

    def _end(self) -> None:
        if self._world is not None:
            self._world.close()
            self._world = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the PyBullet client behind, too: it belongs to this process."""
        return {**super().__getstate__(), '_world': None}


class _World:
    """
    A PyBullet client with a rope, a plane and obstacles.

    :param radius: [m] at which the rope touches them; the plane is placed to suit it.
    """

    SPHERE = 0.005  # m; the radius where there is a plane only
    AWAY = -1e3  # m: where there is no table

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
            _add_obstacle(self._client, obstacle)
        self._rope = BulletRope(self._client, layout.places, layout.points, physical, radius=radius)
        self._among_obstacles = bool(obstacles)

    def start(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              touching: float | None) -> BulletRope:
        """Place rope and table; `touching` [m] is the height of the rope's middle on the table."""
        height = self.AWAY if touching is None else touching - self.radius
        # Bullet keeps contact points from step to step; a step without any forgets the last trial's.
        self._place_table(self.AWAY)
        if self._among_obstacles:
            self._rope.reset(layout.places, points + (0, 0, -self.AWAY), physical)
        pybullet.stepSimulation(physicsClientId=self._client)
        self._place_table(height)
        self._rope.reset(layout.places, points, physical, layout.velocities, layout.features)
        return self._rope

    def _place_table(self, height: float) -> None:
        pybullet.resetBasePositionAndOrientation(self._plane, [0, 0, height], NO_TURN,
                                                 physicsClientId=self._client)

    def close(self) -> None:
        pybullet.disconnect(physicsClientId=self._client)
