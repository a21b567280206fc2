# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A robot that closes the loop: it lets the planner plan, executes the next action, looks, and plans again.

    ros2 run dlo_calibration planner --ros-args -p description:=msg_samples/xml/dlo.xml
    python3 examples/closed_loop.py

Robot, camera and rope are simulated here: the rope more finely than in the planner, with parameters that the
calibration does not rule out, and seen with a noise of 1 mm.  Replace `SimulatedRobot` by yours.
"""

import argparse
from dataclasses import replace
import json
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.duration import Duration
from robot_session import chain, LATCHED, values
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from dlo_calibration import Action, Chain, Hand
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation import Pool
from dlo_calibration.files.result import read_description
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.rehearsal import ActionStep, RehearsalJob, rehearse

NODES, SEEN = 81, 4  # of the simulated rope; the tracker gives every fourth one
NOISE = 0.001  # m, of the tracker
RATE = 20.0  # 1/s, of the tracker
MOST_ACTIONS = 8


def arc(length, height, turn, middle):
    """Return points of an arc on the table, (81, 3) [m], that turns by `turn` [rad] around its middle."""
    heading = turn * (np.linspace(0, 1, NODES) - 0.5)
    steps = length / (NODES - 1) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps, axis=0)
    return np.column_stack([places - places.mean(axis=0) + middle, np.full(NODES, height)])


class SimulatedRobot:
    """A rope on a table, a tracker that publishes where it is, and hands that do what an action says."""

    def __init__(self, node, description, pace):
        self.node, self.pace = node, pace
        posterior, options = Posterior.of(description), description.file_options.options()
        height = options.table_height + posterior.best['self_collision']
        self.start = Chain(arc(description.length, height, 0.0, (0.3, 0.0)))
        self.physical = posterior.lying(self.start, options).draws(1, seed=2)[0]
        self.pool = Pool(make_simulator(replace(options, nodes=NODES // 2 + 1)).refined())
        self.steps, self.points = [], self.start.points
        self.generator = np.random.default_rng(1)
        self.tracker = node.create_publisher(PointCloud2, '/planner/chain', 10)
        node.create_timer(1 / RATE, self.look)

    def look(self):
        """Publish what the tracker sees."""
        seen = self.points[::SEEN]
        seen = seen + self.generator.normal(0, NOISE, seen.shape)
        self.tracker.publish(chain(seen, self.node.get_clock().now()))

    def execute(self, message):
        """Do what an action says, `pace` times as fast as it says; each hand grips the nearest point."""
        times = [Duration.from_msg(point.time_from_start).nanoseconds / 1e9 for point in message.points]
        hands = []
        for k, name in enumerate(message.joint_names):
            places = [point.transforms[k].translation for point in message.points]
            path = np.array([(place.x, place.y, place.z) for place in places])
            grip = int(np.linalg.norm(self.points - path[0], axis=1).argmin())
            hands.append(Hand(name, (grip,), np.array(times), path))
        self.steps.append(ActionStep(Action(tuple(hands))))
        # From the very start each time, as a chain alone does not tell how much the rope is stretched.
        rehearsal, = rehearse(self.pool, [
            RehearsalJob(self.start, tuple(self.steps), self.physical, trajectories=True)])
        course = (*rehearsal.trajectories[-1], rehearsal.chains[-1])
        for self.points in course:
            self.rest(times[-1] / self.pace / len(course))

    def rest(self, seconds):
        """Let the tracker go on for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=end - time.monotonic())


def main():
    """Bring the rope to the goal, and log how near it is after each action."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('--pace', type=float, default=4.0, help='how much faster than planned the hands move')
    pace = parser.parse_args().pace
    rclpy.init()
    node = rclpy.create_node('robot')
    log, heard = node.get_logger(), {}
    goals = node.create_publisher(PointCloud2, '/planner/goal_chain', 10)
    client = node.create_client(Trigger, '/planner/plan')
    listening = [node.create_subscription(
        kind, f'/planner/{name}', lambda message, name=name: heard.update({name: message}), qos)
        for name, kind, qos in (
            ('dlo_description', String, LATCHED), ('status', DiagnosticArray, LATCHED),
            ('steps', String, LATCHED), ('action', MultiDOFJointTrajectory, 10))]

    def wait(ready):
        while not ready():
            rclpy.spin_once(node, timeout_sec=0.1)

    def status(key):
        return values(heard['status'], 'status')[key]

    log.info('waiting for the planner, and for a description of the rope')
    wait(lambda: {'dlo_description', 'status'} <= heard.keys() and client.service_is_ready()
         and goals.get_subscription_count() and all(topic.get_publisher_count() for topic in listening))
    description = read_description(heard['dlo_description'].data)
    robot = SimulatedRobot(node, description, pace)
    goal = arc(description.length, robot.points[0, 2], 2.0, (0.35, 0.12))
    goals.publish(chain(goal[::SEEN], node.get_clock().now()))

    def distance(points):
        error = np.linalg.norm(points - goal[::SEEN], axis=1).mean()
        return f'{1e3 * error:.1f} mm ({100 * error / description.length:.1f} % of its length) from the goal'

    log.info(f'the rope is {distance(robot.points[::SEEN])}')
    for number in range(1, MOST_ACTIONS + 1):
        wait(lambda: not status('missing'))
        robot.rest(0.5)  # so that the planner gets a chain at rest
        plans = int(status('plans'))
        heard.pop('action', None)
        answer = client.call_async(Trigger.Request())
        wait(answer.done)
        if not answer.result().success:
            sys.exit(answer.result().message)
        wait(lambda plans=plans: int(status('plans')) > plans and status('state') in ('done', 'failed'))
        if status('state') == 'failed' or status('actions') == '0':
            break
        wait(lambda: 'action' in heard)
        steps = json.loads(heard['steps'].data)['actions']
        log.info(f'action {number}: {steps[0]["name"]}, the first of {len(steps)} planned in '
                 f'{float(status("seconds")):.1f} s; predicted: {distance(np.array(steps[0]["predicted"]))}')
        robot.execute(heard['action'])
        log.info(f'action {number}: done; the rope is {distance(robot.points[::SEEN])}')
    log.info(f'the planner says: {status("detail")}')
    rclpy.shutdown()


if __name__ == '__main__':
    main()
