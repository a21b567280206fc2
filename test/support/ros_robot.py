# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A real ROS graph: a robot in this process, and the node with the toy, here or in a process of its own."""

from contextlib import contextmanager
import os
from pathlib import Path
import subprocess
import sys
import time

import pytest
import toy_calibrator

from dlo_calibration.messages.codec import INPUT_TYPES, OUTPUT_TYPES, rclpy_types

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
pytest.importorskip('diagnostic_msgs', reason='needs the message packages common_interfaces')

from rcl_interfaces.msg import Log  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

PATIENCE = 60.0  # s
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CHILD = Path(toy_calibrator.__file__)
TYPES = rclpy_types()


class Robot:
    """Robot software: publishes, calls and listens; spins the node too, where it is in this process."""

    name = 'calibrator'  # of the node
    inputs = INPUT_TYPES
    outputs = {name: OUTPUT_TYPES[name] for name in ('progress', 'status', 'result')}
    unlatched = ('progress',)
    services = ('start', 'stop', 'reset', 'discard_last')

    def __init__(self, context, reliability=ReliabilityPolicy.RELIABLE):
        self.context = context
        self.node = Node('robot', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.calibrator = None
        self.heard = {'log': []}
        for name, kind in self.outputs.items():
            self.heard[name] = []
            self.node.create_subscription(
                TYPES.find(kind), f'/{self.name}/{name}', self.heard[name].append,
                QoSProfile(depth=1000) if name in self.unlatched else LATCHED)
        self.node.create_subscription(Log, '/rosout', self.heard['log'].append, QoSProfile(depth=100))
        qos = QoSProfile(depth=1000, reliability=reliability)
        self.publishers = {kind: self.node.create_publisher(TYPES.find(name), f'/{self.name}/{kind}', qos)
                           for kind, name in self.inputs.items()}
        self.clients = {name: self.node.create_client(Trigger, f'/{self.name}/{name}')
                        for name in self.services}

    def until(self, condition, why='it never happened'):
        begun = time.monotonic()
        while not condition():
            assert time.monotonic() - begun < PATIENCE, f'{why}; status {self.status}'
            self.executor.spin_once(timeout_sec=0.02)

    def matched(self):
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values())
                   and all(c.service_is_ready() for c in self.clients.values()) and self.heard['status'])

    def send(self, pairs):
        self.matched()
        for kind, message in pairs:
            self.publishers[kind].publish(message)

    def call(self, name):
        future = self.clients[name].call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    @property
    def status(self):
        return values(self.heard['status'][-1].status[0]) if self.heard['status'] else {}

    def until_status(self, **expected):
        self.until(lambda: expected.items() <= self.status.items(), str(expected))

    def until_result(self, count=1):
        results = self.heard['result']
        self.until(lambda: len(results) >= count or self.status['state'] == 'failed', 'no result')
        assert self.status['state'] != 'failed', self.status
        self.until_status(state='done')
        return self.heard['result'][-1]


def values(status):
    return {pair.key: pair.value for pair in status.values}


def whole(result):
    return values(next(status for status in result.status if status.name == 'calibration'))


@contextmanager
def robot_of(environment, kind=Robot, **arguments):
    context = Context()
    rclpy.init(args=[], context=context, domain_id=int(environment['ROS_DOMAIN_ID']),
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        robot = kind(context, **arguments)
        yield robot
        robot.executor.shutdown()
        robot.node.destroy_node()
    finally:
        context.try_shutdown()


@contextmanager
def python_process(environment, *arguments):
    """Run Python in a process group of its own, and kill it at the end."""
    process = subprocess.Popen(
        [sys.executable, *arguments], env={**environment, 'PYTHONPATH': os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def child(environment, folder, *arguments, seconds=0.0):
    """Run the node with the toy in a process of its own."""
    folder.mkdir(exist_ok=True)
    return python_process(environment, str(CHILD), str(seconds), '--ros-args', '-p',
                          f'output_directory:={folder}', *arguments)


def ended(process):
    _, errors = process.communicate(timeout=PATIENCE)
    assert 'Traceback' not in errors, errors
    return process.returncode
