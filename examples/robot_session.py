# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A robot program that calibrates a DLO: it sends one trial, starts the calibration, and logs the result.

    ros2 run dlo_calibration calibrator --ros-args -p mass:=0.03
    python3 examples/robot_session.py

Replace `observed` by your camera, and `move` by the motion of your robot.
"""

import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Transform, Vector3
import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

FRAME = 'table'  # the same in all messages; its z axis points up
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # as the calibrator publishes


def observed(moved):
    """Return the points along the DLO, (n, 3) [m]; here, invented ones of a DLO on a table."""
    along = np.linspace(0, 0.6, 13)
    aside = 0.1 * np.exp(-along / 0.2) if moved else 0 * along
    return np.stack([along, aside, 0 * along + 0.004], axis=1)


def move(gripper):
    """Return times [s] and positions [m] of the gripper, which closes at the first and opens at the last."""
    return zip((0.0, 0.3, 0.7, 1.0), gripper + np.array(
        [(0, 0, 0), (0, 0, 0.05), (0, 0.1, 0.05), (0, 0.1, 0)]), strict=True)


def chain(points, stamp):
    """Return the message of a chain; all chains of a trial have the same points in the same order."""
    cloud = PointCloud2(height=1, width=len(points), point_step=12, row_step=12 * len(points), is_dense=True)
    cloud.header.frame_id, cloud.header.stamp = FRAME, stamp.to_msg()
    cloud.fields = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                    for k, name in enumerate('xyz')]
    cloud.data = np.asarray(points, '<f4').tobytes()
    return cloud


def action(waypoints, stamp):
    """Return the action of one hand, which grips the point of the chain nearest to its first waypoint."""
    message = MultiDOFJointTrajectory(joint_names=['left_hand'])
    message.header.frame_id, message.header.stamp = FRAME, stamp.to_msg()
    for seconds, (x, y, z) in waypoints:
        message.points.append(MultiDOFJointTrajectoryPoint(
            transforms=[Transform(translation=Vector3(x=x, y=y, z=z))],
            time_from_start=Duration(seconds=seconds).to_msg()))
    return message


def values(message, name):
    """Return the key-value pairs of one status of a DiagnosticArray."""
    return {pair.key: pair.value for one in message.status if one.name == name for pair in one.values}


def main():
    """Send a trial, calibrate, and log what was found."""
    rclpy.init()
    node = rclpy.create_node('robot')
    log, heard = node.get_logger(), {}
    initial = node.create_publisher(PointCloud2, '/calibrator/initial_chain', 10)
    hands = node.create_publisher(MultiDOFJointTrajectory, '/calibrator/action', 10)
    goal = node.create_publisher(PointCloud2, '/calibrator/goal_chain', 10)
    start = node.create_client(Trigger, '/calibrator/start')
    for name in ('status', 'result'):
        node.create_subscription(DiagnosticArray, f'/calibrator/{name}',
                                 lambda message, name=name: heard.update({name: message}), LATCHED)

    def wait(ready):
        while not ready():
            rclpy.spin_once(node, timeout_sec=0.1)

    def status(key):
        return values(heard['status'], 'status')[key]

    log.info('waiting for the calibrator')
    wait(lambda: 'status' in heard and start.service_is_ready() and all(
        one.get_subscription_count() for one in (initial, hands, goal)))
    before = status('trials'), status('last_refusal')
    points, begun = observed(moved=False), node.get_clock().now()
    initial.publish(chain(points, begun))
    hands.publish(action(move(points[0]), begun))
    time.sleep(1.5)  # the robot moves, and the DLO comes to rest
    goal.publish(chain(observed(moved=True), node.get_clock().now()))
    wait(lambda: (status('trials'), status('last_refusal')) != before)
    heard.clear()  # an earlier calibration may have left a result
    answer = start.call_async(Trigger.Request())
    wait(answer.done)
    log.info(answer.result().message)
    if answer.result().success:
        wait(lambda: 'result' in heard or 'status' in heard and status('state') == 'failed')
        for one in heard['result'].status if 'result' in heard else ():
            log.info(f'{one.name}: {one.message}')
    rclpy.shutdown()


if __name__ == '__main__':
    main()
