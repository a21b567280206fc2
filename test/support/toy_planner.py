# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A planner's session behind a graph that is no ROS graph, and a search that finds what a test says."""

import json
from pathlib import Path
import threading
import time

from made_up_dlo import made_up_plan
from toy_graph import ToyNode, TYPES
from toy_messages import MINUTE

from dlo_calibration.files.record import encode
from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import chain_cloud
from dlo_calibration.planning import PlanProgress
from dlo_calibration.ros.planner_session import INPUT_TYPES, OUTPUT_TYPES, PlannerOptions, PlannerSession

RESULT = Path(__file__).resolve().parents[2] / 'msg_samples' / 'xml' / 'dlo.xml'
CHAIN = read_result(RESULT).chain


class ToyPlan:
    """
    Stands for `plan`: notes how it was called, and returns a made-up plan.

    :param held: whether it goes on until it is asked to stop.
    :param changes: of `made_up_plan`.
    """

    def __init__(self, held=False, error=None, **changes):
        self.held, self.error, self.changes = held, error, changes
        self.calls = []
        self.reported = threading.Event()  # it has reported its progress

    def __call__(self, dlo, start, goal, options, *, simulation, on_progress, should_stop, **_):
        self.calls.append((dlo, start, goal, options, simulation))
        for k in range(100):
            on_progress(PlanProgress(1, k, 100, 0.1 / (k + 1), 1.0))
        self.reported.set()
        while self.held and not should_stop():
            time.sleep(0.002)
        if self.error is not None:
            raise self.error
        return made_up_plan(start, **{'goal': goal, **self.changes})


class PlannerGraph(ToyNode):
    """The graph of a planner's session, whose clock stands still unless a test moves it."""

    def __init__(self, **options):
        super().__init__('planner', INPUT_TYPES, {**OUTPUT_TYPES, 'dlo_description': 'std_msgs/msg/String'})
        self.set = options
        self.decoded = 0
        self.session = PlannerSession(self, TYPES, lambda _: None, clock=self.clock)
        self.session.status_period = 0.0

    def clock(self):
        return self.elapsed

    def options(self):
        return PlannerOptions.of(self.set)

    def decode(self, kind, octets):
        self.decoded += 1
        return super().decode(kind, octets)

    def hear(self, kind, message):
        self.session.hear(kind, encode(message, INPUT_TYPES[kind]))

    def send_chains(self, start=CHAIN, goal=CHAIN, frame_id='table'):
        """Send a description, a chain and a goal."""
        self.hear('dlo_description', description())
        self.hear('chain', chain_cloud(TYPES, start, MINUTE, frame_id))
        self.hear('goal_chain', chain_cloud(TYPES, goal, MINUTE, frame_id))
        self.session.tick()

    def planned(self):
        """Plan, and return the status."""
        done, answer = self.session.request('plan')
        assert done, answer
        self.until(lambda: self.status['state'] != 'planning')
        return self.status

    @property
    def steps(self):
        """The plans that were published."""
        return [json.loads(message.data) for message in self.heard['steps']]


def description(text=None):
    """Return the message with a description."""
    return TYPES.build('std_msgs/msg/String', data=text or RESULT.read_text(encoding='utf-8'))
