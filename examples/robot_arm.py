# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A simulated robot arm picks a calibrated rope up, carries it, and lays it down.

    python3 examples/robot_arm.py                           # with the parameters of a sample
    python3 examples/robot_arm.py fitted/result.xml --gui   # with your own; --gui: in PyBullet's window
    python3 examples/robot_arm.py --picture arm.png

It prints how far the rope was carried, and how much it was stretched.  The arm is the KUKA iiwa with a
gripper that comes with PyBullet.
"""

import argparse
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data

from dlo_calibration import BulletRope, Chain, read_result

SAMPLE = Path(__file__).resolve().parents[1] / 'msg_samples' / 'xml' / 'dlo.xml'
TIME_STEP = 0.003  # s
HAND = 7  # link of the gripper, which moves both fingers
BETWEEN_FINGERS = (0.0, 0.022, 0.225)  # m, in the frame of that link
OPEN = {8: -0.3, 11: 0.3, 10: 0.3, 13: -0.3}  # rad, of the joints of the fingers
CLOSED = dict.fromkeys(OPEN, 0.0)
DOWN = pybullet.getQuaternionFromEuler((np.pi, 0.0, 0.0))  # the fingers point to the table
AT_FIRST = (0.0, 0.4, 0.0, -1.4, 0.0, 1.3, 0.0)  # rad, of the joints of the arm


class World:
    """
    A table with a rope on it, and an arm beside it.

    :param client: id of the PyBullet client.
    :param description: path of a `result.xml`, or of another description of a DLO.
    :param pace: how many times as fast the arm moves.
    """

    def __init__(self, client, description, pace):
        self.client, self.pace = client, pace
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setTimeStep(TIME_STEP, physicsClientId=client)
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
        table = pybullet.loadURDF('plane.urdf', physicsClientId=client)
        pybullet.changeDynamics(table, -1, lateralFriction=1.0, physicsClientId=client)
        self.arm = pybullet.loadSDF('kuka_iiwa/kuka_with_gripper2.sdf', physicsClientId=client)[0]
        joints = [pybullet.getJointInfo(self.arm, k, physicsClientId=client)
                  for k in range(pybullet.getNumJoints(self.arm, physicsClientId=client))]
        self.movable = [joint[0] for joint in joints if joint[2] != pybullet.JOINT_FIXED]
        self.angles = {**dict.fromkeys(self.movable, 0.0), **dict(enumerate(AT_FIRST)), **OPEN}
        for joint, angle in self.angles.items():
            pybullet.resetJointState(self.arm, joint, angle, physicsClientId=client)
        result = read_result(description)
        points = np.linspace((0.55, -0.25, 0.0), (0.55, -0.25 + result.chain.length, 0.0), 41)
        physical = result.physical()
        self.rope = BulletRope.of(client, Chain(points + (0, 0, physical['self_collision'])), physical)
        self.lengths = np.linalg.norm(np.diff(self.rope.points, axis=0), axis=1)  # m, of its segments
        self.stretch, self.height = 0.0, 0.0  # the largest until now, of any segment; of any point [m]
        self.position = self.between_fingers()

    def between_fingers(self):
        """Return the point between the fingers, (3,) [m]."""
        link = pybullet.getLinkState(self.arm, HAND, computeForwardKinematics=True,
                                     physicsClientId=self.client)
        return np.array(pybullet.multiplyTransforms(*link[4:6], BETWEEN_FINGERS, (0, 0, 0, 1))[0])

    def move(self, target, seconds, fingers=None):
        """Move the point between the fingers to `target` (3,) [m] on a straight line, and the fingers."""
        start, self.position = self.position, np.array(target, dtype=float)
        before = dict(self.angles)
        for share in np.linspace(0, 1, round(seconds / self.pace / TIME_STEP) + 1)[1:]:
            smooth = share**2 * (3 - 2 * share)
            self._reach(start + smooth * (self.position - start))
            for joint, angle in (fingers or {}).items():
                self.angles[joint] = before[joint] + smooth * (angle - before[joint])
            self._step()

    def _reach(self, point):
        """Set the angles of the arm at which the point between the fingers is at `point`, by iteration."""
        hand = pybullet.multiplyTransforms(point, DOWN, *pybullet.invertTransform(
            BETWEEN_FINGERS, (0, 0, 0, 1)))
        inverse = pybullet.calculateInverseKinematics(
            self.arm, HAND, *hand, maxNumIterations=20, residualThreshold=1e-5, physicsClientId=self.client)
        for joint, angle in zip(self.movable, inverse, strict=True):
            if joint < HAND:
                self.angles[joint] = angle

    def _step(self):
        pybullet.setJointMotorControlArray(
            self.arm, list(self.angles), pybullet.POSITION_CONTROL, list(self.angles.values()),
            forces=[500.0] * len(self.angles), physicsClientId=self.client)
        self.rope.step()  # instead of pybullet.stepSimulation()
        points = self.rope.points
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self.stretch = max(self.stretch, (lengths / self.lengths).max() - 1)
        self.height = max(self.height, points[:, 2].max())

    def picture(self):
        """Return an image of the world, (height, width, 3)."""
        view = pybullet.computeViewMatrix((1.75, -0.85, 0.95), (0.35, 0.05, 0.28), (0, 0, 1))
        projection = pybullet.computeProjectionMatrixFOV(42, 0.9, 0.1, 10)
        shape = pybullet.createVisualShape(pybullet.GEOM_SPHERE, radius=0.006, rgbaColor=(0.85, 0.2, 0.1, 1),
                                           physicsClientId=self.client)
        chain = Chain(self.rope.points)
        spheres = [pybullet.createMultiBody(0, -1, shape, point.tolist(), physicsClientId=self.client)
                   for point in chain.resample(np.linspace(0, chain.length, 200))]
        image = pybullet.getCameraImage(540, 600, view, projection, lightDirection=(1, -1, 3), shadow=1,
                                        renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self.client)[2]
        for sphere in spheres:
            pybullet.removeBody(sphere, physicsClientId=self.client)
        return np.reshape(image, (600, 540, 4))[:, :, :3].astype(np.uint8)


def main():
    """Pick the rope up, carry it, lay it down, and print what happened to it."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('description', nargs='?', default=SAMPLE)
    parser.add_argument('--gui', action='store_true')
    parser.add_argument('--picture', metavar='FILE')
    parser.add_argument('--pace', type=float, default=1.0, help='how many times as fast the arm moves')
    words = parser.parse_args()
    client = pybullet.connect(pybullet.GUI if words.gui else pybullet.DIRECT)
    world = World(client, words.description, words.pace)
    rope, arm, pictures = world.rope, world.arm, []

    def shown():
        if words.picture:
            pictures.append(world.picture())

    x, y, z = rope.points[3]
    world.move((x, y, 0.15), 1.5)
    world.move((x, y, 0.02), 1.5)
    rope.grip(arm, HAND, BETWEEN_FINGERS)
    world.move((x, y, 0.02), 0.5, CLOSED)
    shown()
    world.move((x, y + 0.1, 0.3), 2.0)
    shown()
    world.move((x - 0.05, y + 0.45, 0.3), 2.0)
    shown()
    world.move((x - 0.05, y + 0.5, 0.02), 2.0)
    world.move((x - 0.05, y + 0.5, 0.02), 0.5, OPEN)
    rope.release(arm)
    world.move((x - 0.05, y + 0.5, 0.25), 2.0)
    shown()
    moved = 1000 * np.linalg.norm(rope.points[3] - (x, y, z))
    print(f'It was lifted by {1000 * (world.height - z):.0f} mm, and lies {moved:.0f} mm away.')
    print(f'The largest stretch was {100 * world.stretch:.1f} %.')
    if words.picture:
        import matplotlib.image

        matplotlib.image.imsave(words.picture, np.concatenate(pictures, axis=1))
    pybullet.disconnect(physicsClientId=client)


if __name__ == '__main__':
    main()
