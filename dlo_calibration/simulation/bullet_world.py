# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""PyBullet, and what else than a rope is in its worlds: obstacles, and grippers that hold a rope."""

from __future__ import annotations

from contextlib import contextmanager
import ctypes
import os
from tempfile import gettempdir, NamedTemporaryFile
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.mesh import stl_octets
from dlo_calibration.simulation.obstacles import Obstacle


@contextmanager
def _silence() -> Iterator[None]:
    """Keep native code from writing to stdout and stderr."""
    flush = ctypes.CDLL(None).fflush  # of C, which buffers output to a pipe
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


with _silence():  # at import it prints its build time, also in the middle of a progress bar
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
    Give the path of a file with checked triangles, for a while; empty if there are none.

    PyBullet takes arrays, too, but does not free them with the world.
    """
    if not len(triangles):
        yield ''
        return
    try:
        with NamedTemporaryFile(prefix='dlo_mesh_', suffix='.stl') as file:
            file.write(stl_octets(triangles))
            file.flush()
            yield file.name
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

    def close(self, points: Floats, taken: Sequence[int], count: int, reach: float) -> None:
        """
        Hold the nodes next to the place, where they are.

        :param points: (N, 3) [m] all nodes of the rope.
        :param taken: indices of nodes that something else holds.
        :param count: number of neighbouring nodes to hold.
        :param reach: largest distance [m] of the rope from the place.
        :raises InputError: if the rope is further away, or if there something else holds it.
        """
        position, self.turn = self._pose()
        centre = position + self.turn @ self._place
        segments = np.diff(points, axis=0)
        along = np.einsum('sk,sk->s', centre - points[:-1], segments) / np.square(segments).sum(axis=1)
        shares = np.clip(along, 0.0, 1.0)
        distances = np.linalg.norm(points[:-1] + shares[:, None] * segments - centre, axis=1)
        nearest = int(distances.argmin())
        what = f'the gripper at link {self.link} of body {self.body}'
        if not distances[nearest] <= reach:
            raise InputError(what, f'a rope that is {1000 * distances[nearest]:.0f} mm away from it',
                             f'at most {1000 * reach:.0f} mm',
                             'move the gripper to the rope, or give the place between its fingers')
        first = round(nearest + float(shares[nearest]) - (count - 1) / 2)
        first = min(max(first, 0), len(points) - count)
        self.nodes = tuple(node for node in range(first, first + count) if node not in taken)
        if not self.nodes:
            raise InputError(what, 'nodes that are held already', 'free ones', 'release them first')
        self._offsets = (points[list(self.nodes)] - position) @ self.turn

    def follow(self) -> tuple[Floats, Floats]:
        """Return positions of the nodes now, (n, 3) [m], and the rotation (3, 3) since the last call."""
        position, turn = self._pose()
        since = turn @ self.turn.T
        self.turn = turn
        return position + self._offsets @ turn.T, since

    def touch(self, nodes: Sequence[int], touches: bool) -> None:
        """
        Say whether the hand, i.e. the link with all that is fixed to it or moved by it, touches bodies.

        :param nodes: ids of the bodies.
        """
        for link in self._hand:
            for node in nodes:
                pybullet.setCollisionFilterPair(self.body, node, link, -1, touches,
                                                physicsClientId=self._client)

    def shares_links_with(self, other: Gripper) -> bool:
        """Tell whether a link belongs to the hands of both."""
        return self.body == other.body and not set(self._hand).isdisjoint(other._hand)

    def is_clear_of(self, points: Floats, radius: float) -> bool:
        """Tell whether spheres at (N, 3) [m] are outside of the boxes around the links of the hand."""
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
    """Return the links that collide, of a link, of those that are fixed to it, and of all that these move."""
    joints = [pybullet.getJointInfo(body, k, physicsClientId=client)
              for k in range(pybullet.getNumJoints(body, physicsClientId=client))]
    parents = [joint[16] for joint in joints]
    while link >= 0 and joints[link][2] == pybullet.JOINT_FIXED:
        link = parents[link]
    found = {link}
    for k, parent in enumerate(parents):  # which has a smaller index than its children
        if parent in found:
            found.add(k)
    return tuple(one for one in sorted(found)
                 if pybullet.getCollisionShapeData(body, one, physicsClientId=client))
