# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Planner and tracker close the loop: a camera is all that tells the planner where the rope is.

    ros2 run dlo_calibration planner --ros-args -p description:=msg_samples/xml/dlo.xml \
        -r '~/chain:=/tracker/chain'
    ros2 run dlo_calibration tracker --ros-args -p "scale:=$(python3 examples/camera_loop.py --scale)"
    python3 examples/camera_loop.py

Robot, rope and camera are simulated here: the images are drawn, simply.  Replace `SimulatedRobot` by yours.
"""

import argparse
import sys
import time

from closed_loop import arc, LATCHED, NODES, SEEN, SimulatedRobot
import cv2
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from robot_session import chain, values
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from dlo_calibration.files.result import read_description

SIZE, FOCAL, HEIGHT = (640, 480), 520.0, 0.75  # px, px, m: a camera that looks down
MIDDLE = np.array([0.3, 0.05])  # m, of the table below it
RATE = 10.0  # images a second
MOST_ACTIONS = 4


def seen(points):
    """Return the pixels of points of the table (n, 2 or 3) [m]."""
    points = np.asarray(points, float)
    height = points[:, 2] if points.shape[1] > 2 else 0.0
    share = (FOCAL / (HEIGHT - height))[..., None] if points.shape[1] > 2 else FOCAL / HEIGHT
    return (points[:, :2] - MIDDLE) * share * (1, -1) + (np.array(SIZE) - 1) / 2


def scale():
    """Return the parameter `scale` of the tracker: four pixels and their places."""
    places = MIDDLE + 0.2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return ' '.join(f'{u:.2f},{v:.2f}={x:.3f},{y:.3f}' for (u, v), (x, y) in zip(
        seen(places), places, strict=True))


class FilmedRobot(SimulatedRobot):
    """The robot of `closed_loop`, with a camera instead of a tracker."""

    def __init__(self, node, description, pace):
        self.camera = node.create_publisher(Image, '/tracker/image', 2)
        self.noise = np.random.default_rng(2)
        super().__init__(node, description, pace)

    def look(self):
        """Publish the image."""
        image = np.full((SIZE[1], SIZE[0], 3), (190, 195, 200), np.uint8)
        line = np.rint(seen(self.points) * 16).astype(np.int32)
        cv2.polylines(image, [line], False, (30, 60, 140), 6, cv2.LINE_AA, 4)
        image = cv2.GaussianBlur(image, (0, 0), 0.8) + self.noise.normal(0, 2, image.shape)
        message = Image(height=SIZE[1], width=SIZE[0], encoding='rgb8', step=3 * SIZE[0],
                        data=np.clip(image, 0, 255).astype(np.uint8).tobytes())
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.camera.publish(message)


def main():
    """Let the tracker find the rope, and bring it to the goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('--pace', type=float, default=4.0, help='how much faster than planned the hands move')
    parser.add_argument('--scale', action='store_true', help='print the scale for the tracker, and end')
    given = parser.parse_args()
    if given.scale:
        print(scale())
        return 0
    rclpy.init()
    node = rclpy.create_node('robot')
    log, heard = node.get_logger(), {}
    goals = node.create_publisher(PointCloud2, '/planner/goal_chain', 10)
    plan = node.create_client(Trigger, '/planner/plan')
    clicks = node.create_client(SetParameters, '/tracker/set_parameters')
    listening = [node.create_subscription(
        kind, topic, lambda message, topic=topic: heard.update({topic: message}), qos)
        for topic, kind, qos in (
            ('/planner/dlo_description', String, LATCHED), ('/planner/status', DiagnosticArray, LATCHED),
            ('/tracker/status', DiagnosticArray, LATCHED), ('/planner/steps', String, LATCHED),
            ('/planner/action', MultiDOFJointTrajectory, 10))]

    def wait(ready):
        while not ready():
            rclpy.spin_once(node, timeout_sec=0.1)

    def status(name, key):
        return values(heard[f'/{name}/status'], 'status')[key]

    log.info('waiting for the planner and the tracker')
    wait(lambda: {'/planner/dlo_description', '/planner/status', '/tracker/status'} <= heard.keys()
         and plan.service_is_ready() and clicks.service_is_ready() and goals.get_subscription_count()
         and all(topic.get_publisher_count() for topic in listening))
    description = read_description(heard['/planner/dlo_description'].data)
    robot = FilmedRobot(node, description, given.pace)
    pixels = ' '.join(f'{u:.0f},{v:.0f}' for u, v in seen(robot.points[[0, NODES // 2, NODES - 1]]))
    points = Parameter('points', value=pixels).to_parameter_msg()
    clicks.call_async(SetParameters.Request(parameters=[points]))
    wait(lambda: status('tracker', 'state') == 'tracking')
    goal = arc(description.length, robot.points[0, 2], 1.6, (0.3, 0.08))
    for _ in range(MOST_ACTIONS):
        wanted = chain(goal[::SEEN], node.get_clock().now())
        wanted.header.frame_id = 'table'  # that of the tracker's chains
        goals.publish(wanted)
        robot.rest(1.0)
        heard.pop('/planner/action', None)
        before = status('planner', 'plans')
        future = plan.call_async(Trigger.Request())
        wait(future.done)
        wait(lambda before=before: status('planner', 'plans') != before
             and status('planner', 'state') in ('done', 'failed'))
        log.info(f'the planner says: {status("planner", "detail")}')
        end = time.monotonic() + 0.5
        while '/planner/action' not in heard and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        if '/planner/action' not in heard:
            break
        robot.execute(heard['/planner/action'])
        away = np.linalg.norm(robot.points - goal, axis=1).mean()
        log.info(f'the rope is {1e3 * away:.1f} mm from the goal; tracked in '
                 f'{status("tracker", "tracked")} of {status("tracker", "images")} images')
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
