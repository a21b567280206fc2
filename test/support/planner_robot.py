# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Robot software of a planner, on a real ROS graph."""

from ros_robot import Robot
from toy_messages import MINUTE
from toy_planner import CHAIN

from dlo_calibration.messages.codec import chain_cloud, rclpy_types
from dlo_calibration.ros.planner_session import INPUT_TYPES, OUTPUT_TYPES

CHAINS = {name: INPUT_TYPES[name] for name in ('chain', 'goal_chain')}


class PlannerRobot(Robot):
    """Sends chains, calls, and listens."""

    name = 'planner'
    inputs = CHAINS
    outputs = OUTPUT_TYPES
    unlatched = ('progress', 'action')
    services = ('plan', 'stop')

    def send_chains(self, start=CHAIN, goal=CHAIN):
        """Send a chain and a goal, and wait until the node has both."""
        types = rclpy_types()
        self.send([('chain', chain_cloud(types, start, MINUTE, 'table')),
                   ('goal_chain', chain_cloud(types, goal, MINUTE, 'table'))])
        self.until(lambda: not {'chain', 'goal_chain'} & set(self.status['missing'].split()))

    def plan(self):
        """Plan, and return the status when the steps are here, too."""
        count, steps = int(self.status['plans']), len(self.heard['steps'])
        answer = self.call('plan')
        assert answer.success, answer.message
        self.until(lambda: self.status['plans'] == str(count + 1)
                   and self.status['state'] in ('done', 'failed'))
        self.until(lambda: self.status['state'] == 'failed' or len(self.heard['steps']) > steps)
        return self.status
