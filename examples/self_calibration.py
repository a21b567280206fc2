# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A robot that asks its own questions: it does what the calibrator advises, until the rope is known well enough.

    ros2 run dlo_calibration calibrator --ros-args -p wanted:="flexibility 2, friction 3" -p height:=0.1
    python3 examples/self_calibration.py

Robot, camera and rope are played here (`played_rope.py`): the rope more finely than in the calibrator, seen
with a noise of 1.5 mm and hidden points, and gripped up to 5 mm beside where the hands think.  Replace
`PlayedRope` by yours.  With --trouble, the hands stop half way in every second action: what they did counts.
"""

import argparse
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from played_rope import PlayedRope, STEADY
import rclpy
from rclpy.duration import Duration
from robot_session import action, chain, LATCHED, values
from sensor_msgs.msg import PointCloud2
from trajectory_msgs.msg import MultiDOFJointTrajectory

TRUTH = {'flexibility': 61.9, 'elasticity': 35.0, 'friction': 60.0, 'self_collision': 45.0}
REST = 1.0  # s from the end of an action until the rope rests


def paths(message):
    """Return the hands of an advice: names -> times [s] and positions, (k, 3) [m]."""
    times = np.array([Duration.from_msg(point.time_from_start).nanoseconds / 1e9 for point in message.points])
    return {name: (times, np.array([(place.x, place.y, place.z) for place in (
        point.transforms[k].translation for point in message.points)]))
        for k, name in enumerate(message.joint_names)}


def waits(hands):
    """Return the times at which the camera looks, because the hands wait."""
    times, positions = next(iter(hands.values()))
    still = np.linalg.norm(np.diff(positions, axis=0), axis=1) < 1e-9
    return [float(max(end - STEADY, (begin + end) / 2))
            for begin, end, rests in zip(times[:-1], times[1:], still, strict=True) if rests]


def stopped_half_way(hands):
    """Return hands that stop, open and leave after half of the way."""
    return {name: (times[:1 + len(times) // 2], positions[:1 + len(times) // 2])
            for name, (times, positions) in hands.items()}


def main():
    """Do what is advised, and log what the calibrator says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('--seed', type=int, default=1, help='of noise and errors')
    parser.add_argument('--trouble', action='store_true', help='stop half way in every second action')
    parser.add_argument('--most', type=int, default=15, help='number of actions after which it gives up')
    chosen = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('robot')
    log, heard = node.get_logger(), {}
    rope = PlayedRope(TRUTH, np.random.default_rng(chosen.seed))
    publishers = [node.create_publisher(kind, f'/calibrator/{name}', 10) for name, kind in (
        ('initial_chain', PointCloud2), ('action', MultiDOFJointTrajectory), ('goal_chain', PointCloud2))]
    initial, doing, goal = publishers
    listening = [node.create_subscription(
        kind, f'/calibrator/{name}', lambda message, name=name: heard.update({name: message}), LATCHED)
        for name, kind in (('status', DiagnosticArray), ('result', DiagnosticArray),
                           ('advice', MultiDOFJointTrajectory))]

    def wait(ready):
        while not ready():
            rclpy.spin_once(node, timeout_sec=0.1)

    def status(key):
        return values(heard['status'], 'status').get(key, '')

    log.info('waiting for the calibrator')
    wait(lambda: 'status' in heard and all(publisher.get_subscription_count() for publisher in publishers)
         and all(topic.get_publisher_count() for topic in listening))
    now = node.get_clock().now()  # the robot moves faster than its stamps say, as nobody watches
    heard.pop('advice', None)
    for number in range(1, chosen.most + 1):
        initial.publish(chain(rope.look(), now))
        wait(lambda: 'advice' in heard or status('state') == 'calibrating')
        message = heard.pop('advice', None)
        if message is None or not message.joint_names:
            break
        log.info(f'action {number}: {status("advice")}')
        hands = paths(message)
        if chosen.trouble and number % 2 == 0:
            hands = stopped_half_way(hands)
            log.info('the hands stop half way')
        pauses = waits(hands)
        views = rope.do(hands, pauses)
        start, end = now + Duration(seconds=1.0), max(times[-1] for times, _ in hands.values())
        doing.publish(action(list(hands.values()), start))
        for seconds, points in zip((*pauses, end + REST), views, strict=True):
            goal.publish(chain(points, start + Duration(seconds=float(seconds))))
        now = start + Duration(seconds=float(end + REST + 1.0))
        begun = time.monotonic()
        wait(lambda: 'advice' in heard or status('state') in ('calibrating', 'done', 'failed'))
        seconds = time.monotonic() - begun
        widths = [f'{name} ± {float(status(f"half_width_{name}")):.1f}' for name in TRUTH
                  if status(f'half_width_{name}')]
        log.info(f'after {status("trials")} trials: {", ".join(widths)}; {status("trials_left")} left '
                 f'(told in {seconds:.1f} s)')
    log.info(f'the calibrator says: {status("advice")}')
    wait(lambda: 'result' in heard or status('state') == 'failed')
    if status('state') == 'failed':
        sys.exit(status('detail'))
    for entry in heard['result'].status:
        log.info(f'{entry.name}: {entry.message}')
    for name, value in TRUTH.items():
        found = values(heard['result'], name)
        log.info(f'{name}: {float(found["value"]):.1f} ({float(found["lower"]):.1f} to '
                 f'{float(found["upper"]):.1f}); in truth {value:g}')
    rclpy.shutdown()


if __name__ == '__main__':
    main()
