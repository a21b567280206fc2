# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A robot program that calibrates a DLO: it sends four trials, starts the calibration, and logs the result.

    ros2 run dlo_calibration calibrator --ros-args -p mass:=0.02
    python3 examples/robot_session.py

Robot and camera are played here from a sample, a recorded session of an elastic rope of 20 g.  Replace
`observed` by your camera, and `move` by the motion of your robot.
"""

from pathlib import Path
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

from dlo_calibration import read_session

FRAME = 'table'  # the same in all messages; its z axis points up
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # as the calibrator publishes
PLAYED = read_session(Path(__file__).resolve().parents[1] / 'msg_samples' / 'object4').trials


def observed(number, moved):
    """Return what the camera sees before and after trial `number`: the points along the DLO, (n, 3) [m]."""
    trial = PLAYED[number]
    return trial.goals[-1].chain.points if moved else trial.initial.points


def move(number):
    """
    Do the action of trial `number`.

    :returns: for each hand, its times [s] and positions [m], from where it closes to where it opens; and for
        each point the number of the hand that holds it afterwards, 0 if none does.
    """
    trial = PLAYED[number]
    time.sleep(trial.goals[-1].time)  # the robot moves, and the DLO comes to rest
    held = np.zeros(len(trial.initial.points), int)
    for k, hand in enumerate(trial.hands, 1):
        if trial.holds(hand, trial.goals[-1]):
            held[list(hand.grips)] = k
    return [(hand.times, hand.positions) for hand in trial.hands], held


def chain(points, stamp, held=None):
    """Return the message of a chain; all chains of a trial have the same points in the same order."""
    cloud = PointCloud2(height=1, width=len(points), point_step=13, row_step=13 * len(points), is_dense=True)
    cloud.header.frame_id, cloud.header.stamp = FRAME, stamp.to_msg()
    cloud.fields = [*(PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                      for k, name in enumerate('xyz')),
                    PointField(name='hand', offset=12, datatype=PointField.UINT8, count=1)]
    packed = np.zeros(len(points), [('xyz', '<f4', 3), ('hand', 'u1')])
    packed['xyz'], packed['hand'] = points, 0 if held is None else held
    cloud.data = packed.tobytes()
    return cloud


def action(hands, stamp):
    """Return the action of hands, each of which grips the point nearest to its first waypoint."""
    message = MultiDOFJointTrajectory(joint_names=[f'hand_{k}' for k in range(1, len(hands) + 1)])
    message.header.frame_id, message.header.stamp = FRAME, stamp.to_msg()
    times = np.unique(np.concatenate([times for times, _ in hands]))
    for seconds in times:
        places = [[np.interp(seconds, own, positions[:, axis]) for axis in range(3)]
                  for own, positions in hands]
        message.points.append(MultiDOFJointTrajectoryPoint(
            transforms=[Transform(translation=Vector3(x=x, y=y, z=z)) for x, y, z in places],
            time_from_start=Duration(seconds=seconds).to_msg()))
    return message


def values(message, name):
    """Return the key-value pairs of one status of a DiagnosticArray."""
    return {pair.key: pair.value for part in message.status if part.name == name for pair in part.values}


def main():
    """Send the trials, calibrate, and log what was found."""
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
        publisher.get_subscription_count() for publisher in (initial, hands, goal)))
    for number in range(len(PLAYED)):
        before = status('trials'), status('last_refusal')
        initial.publish(chain(observed(number, moved=False), node.get_clock().now()))
        begun = node.get_clock().now()
        paths, held = move(number)
        hands.publish(action(paths, begun))
        goal.publish(chain(observed(number, moved=True), node.get_clock().now(), held))
        wait(lambda before=before: (status('trials'), status('last_refusal')) != before)
        log.info(f'trials: {status("trials")}; last refusal: {status("last_refusal") or "none"}')
    heard.clear()  # an earlier calibration may have left a result
    answer = start.call_async(Trigger.Request())
    wait(answer.done)
    log.info(answer.result().message)
    if answer.result().success:
        wait(lambda: 'result' in heard or 'status' in heard and status('state') == 'failed')
        for entry in heard['result'].status if 'result' in heard else heard['status'].status:
            log.info(f'{entry.name}: {entry.message}')
        if 'result' in heard:
            log.info(values(heard['result'], 'calibration')['findings'])
    rclpy.shutdown()


if __name__ == '__main__':
    main()
