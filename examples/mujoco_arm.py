# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
An arm in MuJoCo picks a calibrated rope up, carries it, and lays it down.

    python3 examples/mujoco_arm.py                       # with the parameters of a sample
    python3 examples/mujoco_arm.py fitted/result.xml     # with your own
    MUJOCO_GL=egl python3 examples/mujoco_arm.py --picture arm.png

It prints how far the rope was carried, and how much it was stretched.  The rope is attached to the world of
the arm, as to any world of your own.  It needs MuJoCo 3.2 or later: pip install mujoco.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np

from dlo_calibration import Chain, export_mjcf, Options, read_result

SAMPLE = Path(__file__).resolve().parents[1] / 'msg_samples' / 'xml' / 'dlo.xml'
SHOULDER, UPPER, FORE, HAND = 0.35, 0.4, 0.4, 0.2  # m: height, and lengths of the links
ROPE = 'rope/'  # begins the names of all that is attached
GRIPPED = f'{ROPE}dlo_point_1'  # the site at the point of the chain that the gripper takes
OPEN, CLOSED = 0.03, 0.008  # m, from the middle of the gripper to a finger
WORLD = f"""
<mujoco>
  <visual><global offwidth="540" offheight="600"/><headlight ambient="0.4 0.4 0.4"/></visual>
  <default>
    <geom contype="0" conaffinity="0" rgba="0.55 0.7 0.85 1"/>
    <joint damping="20" armature="0.5"/>
    <position kp="2000"/>
  </default>
  <worldbody>
    <camera name="view" pos="1.62 -1.15 1.28" xyaxes="0.62 0.78 0 -0.38 0.3 0.87" fovy="42"/>
    <geom type="cylinder" size="0.06 {SHOULDER / 2}" pos="0 0 {SHOULDER / 2}" rgba="0.35 0.35 0.4 1"/>
    <body pos="0 0 {SHOULDER}" gravcomp="1">
      <joint name="turn" axis="0 0 1"/>
      <geom type="sphere" size="0.07" rgba="0.35 0.35 0.4 1"/>
      <body gravcomp="1">
        <joint name="shoulder" axis="0 -1 0"/>
        <geom type="capsule" size="0.045" fromto="0 0 0 {UPPER} 0 0"/>
        <body pos="{UPPER} 0 0" gravcomp="1">
          <joint name="elbow" axis="0 -1 0"/>
          <geom type="sphere" size="0.055" rgba="0.35 0.35 0.4 1"/>
          <geom type="capsule" size="0.04" fromto="0 0 0 {FORE} 0 0"/>
          <body pos="{FORE} 0 0" gravcomp="1">
            <joint name="wrist" axis="0 -1 0"/>
            <geom type="capsule" size="0.035" fromto="0 0 0 {HAND - 0.09} 0 0" rgba="0.35 0.35 0.4 1"/>
            <geom type="box" size="0.012 0.02 0.05" pos="{HAND - 0.08} 0 0"/>
            <site name="gripper" pos="{HAND} 0 0" group="4"/>
            <body pos="{HAND - 0.03} 0 0" gravcomp="1">
              <joint name="left" type="slide" axis="0 0 1"/>
              <geom type="box" size="0.04 0.012 0.005"/>
            </body>
            <body pos="{HAND - 0.03} 0 0" gravcomp="1">
              <joint name="right" type="slide" axis="0 0 -1"/>
              <geom type="box" size="0.04 0.012 0.005"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="turn"/><position joint="shoulder"/><position joint="elbow"/><position joint="wrist"/>
    <position joint="left"/><position joint="right"/>
  </actuator>
</mujoco>
"""


def with_rope(description, chain):
    """Return the world of the arm with a calibrated rope at a chain."""
    world = mujoco.MjSpec.from_string(WORLD)
    rope = mujoco.MjSpec.from_string(export_mjcf(description, chain, options=Options(nodes=31)))
    # The options of a world hold for all that is attached to it.
    for name in ('timestep', 'integrator', 'cone', 'impratio', 'viscosity'):
        setattr(world.option, name, getattr(rope.option, name))
    world.attach(rope, prefix=ROPE, frame=world.worldbody.add_frame())
    grip = world.add_equality(name='grip', type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE,
                              name1='gripper', name2=GRIPPED, active=False)
    grip.solref = [0.004, 1]
    return world.compile()


def angles_at(point):
    """Return the angles of the first four joints at which the gripper, pointing down, is at a point [m]."""
    reach, height = np.hypot(*point[:2]), point[2] + HAND - SHOULDER
    distance = np.hypot(reach, height)
    inside = np.arccos((UPPER**2 + distance**2 - FORE**2) / (2 * UPPER * distance))
    shoulder = np.arctan2(height, reach) + inside
    elbow = -np.arccos((distance**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE))
    return [np.arctan2(point[1], point[0]), shoulder, elbow, -np.pi / 2 - shoulder - elbow]


class Scene:
    """
    The simulated world.

    :param description: path of a `result.xml`, or of another description of a DLO.
    :param pace: how many times as fast the arm moves.
    """

    def __init__(self, description, pace):
        result = read_result(description)
        points = np.linspace((0.5, -0.25, 0.0), (0.5, -0.25 + result.chain.length, 0.0), 41)
        self.model = with_rope(result, Chain(points + (0, 0, result.physical()['self_collision'])))
        self.state, self.pace = mujoco.MjData(self.model), pace
        mujoco.mj_resetDataKeyframe(self.model, self.state, self.model.key(f'{ROPE}start').id)
        self.position, self.fingers = np.array([0.45, -0.15, 0.3]), OPEN
        self.command(self.position, OPEN)
        self.state.qpos[[self.model.joint(name).qposadr[0] for name in (
            'turn', 'shoulder', 'elbow', 'wrist', 'left', 'right')]] = self.state.ctrl
        mujoco.mj_forward(self.model, self.state)
        self.slides = [self.model.jnt_qposadr[k] for k in range(self.model.njnt)
                       if self.model.joint(k).name.startswith(f'{ROPE}dlo_stretch')]
        self.length = result.chain.length  # m
        self.stretch, self.height = 0.0, 0.0  # the largest until now: of the whole rope; of the point [m]

    @property
    def gripped(self):
        """The point of the rope that the gripper takes, (3,) [m]."""
        return np.array(self.state.site(GRIPPED).xpos)

    def command(self, point, fingers):
        """Let the gripper go to a point, (3,) [m], with the fingers so far from its middle [m]."""
        self.state.ctrl[:] = [*angles_at(point), fingers, fingers]

    def hold(self, held):
        """Close or open the gripper's hold on the rope."""
        self.state.eq_active[self.model.equality('grip').id] = held

    def move(self, target, seconds, fingers):
        """Move the gripper to `target` (3,) [m] on a straight line, and the fingers."""
        start, before = self.position, self.fingers
        self.position, self.fingers = np.array(target), fingers
        for share in np.linspace(0, 1, round(seconds / self.pace / self.model.opt.timestep) + 1)[1:]:
            smooth = share**2 * (3 - 2 * share)
            self.command(start + smooth * (self.position - start), before + smooth * (fingers - before))
            mujoco.mj_step(self.model, self.state)
            self.stretch = max(self.stretch, self.state.qpos[self.slides].sum() / self.length)
            self.height = max(self.height, self.gripped[2])

    def picture(self):
        """Return an image of the world, (height, width, 3)."""
        with mujoco.Renderer(self.model, 600, 540) as renderer:
            renderer.update_scene(self.state, camera='view')
            return renderer.render()


def main():
    """Pick the rope up, carry it, lay it down, and print what happened to it."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('description', nargs='?', default=SAMPLE)
    parser.add_argument('--picture', metavar='FILE')
    parser.add_argument('--pace', type=float, default=1.0, help='how many times as fast the arm moves')
    words = parser.parse_args()
    scene, pictures = Scene(words.description, words.pace), []

    def shown():
        if words.picture:
            pictures.append(scene.picture())

    begin = x, y, z = scene.gripped
    scene.move((x, y, 0.15), 1.0, OPEN)
    scene.move((x, y, z), 1.0, OPEN)
    scene.move((x, y, z), 0.5, CLOSED)
    scene.hold(True)
    shown()
    scene.move((x, y + 0.1, 0.3), 2.0, CLOSED)
    shown()
    scene.move((x - 0.1, y + 0.45, 0.3), 2.0, CLOSED)
    shown()
    scene.move((x - 0.1, y + 0.5, z), 2.0, CLOSED)
    scene.hold(False)
    scene.move((x - 0.1, y + 0.5, z), 0.5, OPEN)
    scene.move((x - 0.1, y + 0.5, 0.25), 1.0, OPEN)
    shown()
    moved = 1000 * np.linalg.norm(scene.gripped - begin)
    print(f'It was lifted by {1000 * (scene.height - z):.0f} mm, and lies {moved:.0f} mm away.')
    print(f'The largest stretch was {100 * scene.stretch:.1f} %.')
    if words.picture:
        import matplotlib.image

        matplotlib.image.imsave(words.picture, np.concatenate(pictures, axis=1))


if __name__ == '__main__':
    main()
