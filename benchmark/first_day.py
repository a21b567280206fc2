# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Play the first day with a robot and a tracker, and print each message to the user with its time.

    python benchmark/first_day.py [--minutes 10] [--output DIR]

The node is a process of its own with new folders.  A tracker sends 30 clouds a second from the beginning to
the end: first in a frame 0.75 m above the table, then the same with the parameter `frame_pose`.  A hand
moves a simulated rope three times, the node calibrates twice: after the third trial, and again when the
tracker has shown the rope at rest for minutes.  Another thread calls a service of the node ten times a
second, and measures how long each answer takes.  At last the recorded session is calibrated again, with the
command line.  The table is written to benchmark/results/first_day.md.
"""

from __future__ import annotations

import argparse
from bisect import bisect_right
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.msg import Log, Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from dlo_calibration import Action, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.model.parameters import ParameterSpace

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'examples'))
from robot_session import action, FRAME, LATCHED, values  # noqa: E402 - an example shows how to send messages

NODE = '/calibrator'
RATE = 30.0  # 1/s, of the tracker
NOISE = 0.0007  # m, of one coordinate that it sees
LIFTED = 0.75  # m; so far above the table's frame is the frame of tracker and hand
MASS = 0.03  # kg
NODES, SEEN = 81, 4  # of the simulated rope; the tracker sees every fourth one
TRUTH = {'flexibility': 59.8, 'elasticity': 60.0, 'friction': 45.0, 'self_collision': 30.0}
SWING = 3.0  # s after an action, in which the rope comes to rest
ACTIONS = (  # place of the grip along the rope, 0..1; way of the hand [m]: up, then aside, then down
    (0.0, (0.10, 0.20)), (0.5, (0.15, -0.18)), (1.0, (-0.25, 0.12)), (0.25, (0.05, 0.22)))


def cloud(points, stamp):
    """Return the message of a tracker, which does not know about hands."""
    message = PointCloud2(height=1, width=len(points), point_step=12, row_step=12 * len(points),
                          is_dense=True)
    message.header.frame_id, message.header.stamp = FRAME, stamp.to_msg()
    message.fields = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                      for k, name in enumerate('xyz')]
    message.data = np.asarray(points, '<f4').tobytes()
    return message


class Rope:
    """A simulated rope on a table, and its points at each instant of the day."""

    def __init__(self) -> None:
        along = np.linspace(-0.5, 0.5, NODES)
        curve = np.stack([0.6 * along, 0.04 * np.sin(5 * along), 0 * along], axis=1)
        length = Chain(curve).length
        self.physical = ParameterSpace(mass=MASS).physical(TRUTH, length)
        options = Options(mass=MASS, nodes=(NODES + 1) // 2, engine='compiled')
        self.simulator = make_simulator(options).refined()
        self.times = [0.0]
        self.movie = [curve + (0.0, 0.0, self.physical['self_collision'])]
        self.scenes = []
        points = self.movie[0]
        for place, way in ACTIONS:
            self.scenes.append(self.scene(points, round(place * (NODES - 1)), way))
            points = self.scenes[-1][-1][-1]

    def scene(self, points, grip, aside):
        """Return times and places of the hand, and instants and points of the rope, in an action."""
        x, y = aside
        times = np.array([0.0, 0.5, 1.7, 2.2])
        way = points[grip] + np.array([(0, 0, 0), (0, 0, 0.06), (x, y, 0.06), (x, y, 0.0)])
        start, hand = Chain(points), Hand('hand', (grip,), times, way)
        instants = np.arange(1, round((times[-1] + SWING) * 100)) / 100
        goals = tuple(Goal(start, float(t), stable=False, held_by=('hand',) if t < times[-1] else ())
                      for t in instants)
        trial = Trial('the day', start, (Action((hand,)),), goals)
        return times, way, instants, self.simulator.simulate(trial, self.physical).chains

    def at(self, now: float):
        """Return the (n, 3) [m] points that a perfect tracker sees at a time [s]."""
        return self.movie[max(bisect_right(self.times, now) - 1, 0)][::SEEN]

    def act(self, number: int, begin: float):
        """Let the hand act from a time [s] on; return times and places of its way."""
        times, way, instants, shown = self.scenes[number]
        self.movie += list(shown)
        self.times += (begin + instants).tolist()
        return times, way


class Day:
    """Tracker, hand and user: their messages, and those that they receive."""

    def __init__(self, minutes: float) -> None:
        self.rope, self.minutes = Rope(), minutes
        self.generator = np.random.default_rng(0)
        self.events: list[tuple[float, str, str]] = []
        self.waits: list[tuple[float, float]] = []  # s for an answer, and when it came
        self.heard, self.over = {}, False
        self.node = rclpy.create_node('day')
        self.begun, self.dawn = time.monotonic(), self.node.get_clock().now()
        self.initial = self.node.create_publisher(PointCloud2, f'{NODE}/initial_chain', 10)
        self.goal = self.node.create_publisher(PointCloud2, f'{NODE}/goal_chain', 10)
        self.hands = self.node.create_publisher(MultiDOFJointTrajectory, f'{NODE}/action', 10)
        for name in ('status', 'result'):
            self.node.create_subscription(DiagnosticArray, f'{NODE}/{name}',
                                          lambda message, name=name: self.hear(name, message), LATCHED)
        self.node.create_subscription(Log, '/rosout', self.hear_log, 100)
        self.clients = {name: self.node.create_client(Trigger, f'{NODE}/{name}')
                        for name in ('start', 'reset')}
        self.get = self.node.create_client(GetParameters, f'{NODE}/get_parameters')
        self.set = self.node.create_client(SetParameters, f'{NODE}/set_parameters')
        self.node.create_timer(1 / RATE, self.track)
        self.executor = MultiThreadedExecutor(2)
        self.executor.add_node(self.node)
        threading.Thread(target=self.executor.spin, daemon=True).start()
        threading.Thread(target=self.probe, daemon=True).start()

    @property
    def now(self) -> float:
        """Seconds since the day began."""
        return time.monotonic() - self.begun

    def report(self, who: str, text: str) -> None:
        """Print and record an event: a message to the user, or an act."""
        if not self.events or self.events[-1][1:] != (who, text):
            self.events.append((self.now, who, text))
            print(f'{self.now:7.1f} s  {who:8} {text}', flush=True)

    def hear(self, name: str, message: DiagnosticArray) -> None:
        """Record a status or result."""
        self.heard[name] = message
        for status in message.status if name == 'result' else message.status[:1]:
            self.report(name, f'{status.name}: {status.message}' if name == 'result' else status.message)

    def hear_log(self, message: Log) -> None:
        """Record a line of the node's log."""
        if message.name.endswith('calibrator'):
            self.report('log', message.msg)

    def track(self) -> None:
        """Publish what the tracker sees now, in its own frame."""
        self.goal.publish(self.look())

    def look(self):
        """Return what the tracker sees now."""
        stamp = self.node.get_clock().now()
        points = self.rope.at((stamp - self.dawn).nanoseconds / 1e9)
        seen = points + self.generator.normal(0, NOISE, points.shape) + (0.0, 0.0, LIFTED)
        return cloud(seen, stamp)

    def probe(self) -> None:
        """Call a service again and again; record the duration of each answer."""
        while not self.get.wait_for_service(0.1):
            pass
        while not self.over:
            begun = time.monotonic()
            self.call(self.get, GetParameters.Request(names=['mass']))
            self.waits.append((time.monotonic() - begun, self.now))
            time.sleep(0.1)

    def call(self, client, request, patience=120.0):
        """Call a service; return its answer."""
        future, end = client.call_async(request), time.monotonic() + patience
        while not future.done():
            if time.monotonic() > end:
                raise TimeoutError(f'{client.srv_name} was not answered within {patience:.0f} s')
            time.sleep(0.002)
        return future.result()

    def ask(self, name: str) -> float:
        """Call a request of the node; return the time at which it was sent [s]."""
        sent = self.now
        answer = self.call(self.clients[name], Trigger.Request())
        self.waits.append((self.now - sent, self.now))
        self.report('~/' + name, f'answered after {self.now - sent:.2f} s: {answer.message}')
        return sent

    def move(self, number: int) -> None:
        """Send the chain before an action, move the rope, and wait until it rests."""
        self.initial.publish(self.look())
        stamp = self.node.get_clock().now() + Duration(seconds=0.5)
        begin = (stamp - self.dawn).nanoseconds / 1e9
        times, way = self.rope.act(number, begin)
        self.hands.publish(action([(times, way + (0.0, 0.0, LIFTED))], stamp))
        self.report('robot', f'action {number + 1}')
        self.wait(begin + times[-1] + SWING)

    def wait(self, until: float) -> None:
        """Sleep until a time [s] of the day."""
        time.sleep(max(0.0, until - self.now))

    def result(self, since: float, patience: float = 600.0) -> float:
        """Wait for the result of a calibration that was requested at a time [s]; return its duration [s]."""
        self.heard.pop('result', None)
        while 'result' not in self.heard:
            if self.now - since > patience:
                raise TimeoutError('no result')
            time.sleep(0.01)
        return self.now - since

    def play(self) -> dict[str, float]:
        """Play the day; return figures."""
        while not all(client.service_is_ready() for client in (*self.clients.values(), self.set)):
            time.sleep(0.01)
        figures = {'services ready after': self.now}
        self.report('user', "the node is there; the hand acts, in a frame that is not the table's")
        self.move(0)
        self.wait(self.now + 4.0)
        figures['warned about the frame'] = float(any(
            'frame_pose' in text for _, who, text in self.events if who in ('status', 'log')))
        self.ask('reset')
        pose = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=f'0 0 {-LIFTED} 0 0 0 1')
        answer = self.call(self.set, SetParameters.Request(
            parameters=[Parameter(name='frame_pose', value=pose)])).results[0]
        self.report('user', f'sets frame_pose to {pose.string_value}: '
                  f'{"done" if answer.successful else answer.reason}')
        for number in (1, 2, 3):
            self.move(number)
            self.wait(self.now + 5.0)
        figures['from ~/start to the first result'] = self.result(self.ask('start'))
        self.wait(60 * self.minutes - 90.0)
        figures['from ~/start to the second result'] = self.result(self.ask('start'))
        self.wait(60 * self.minutes)
        self.over = True
        time.sleep(1.0)
        for rank, (wait, when) in enumerate(sorted(self.waits)[:-4:-1], 1):
            figures[f'longest wait for an answer, {rank}'], figures[f'it ended at, {rank}'] = wait, when
        figures['99.9 % of the waits are below'] = float(np.quantile([wait for wait, _ in self.waits], 0.999))
        figures['answers'] = len(self.waits)
        return figures


def main() -> None:
    """Play the day in a new folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--minutes', type=float, default=10.0, help='length of the day')
    parser.add_argument('--output', type=Path, default=None, help='folder of the node')
    chosen = parser.parse_args()
    folder = chosen.output or Path(tempfile.mkdtemp(prefix='first_day_'))
    folder.mkdir(parents=True, exist_ok=True)
    os.environ |= {'ROS_DOMAIN_ID': str(1 + os.getpid() % 100), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                   'ROS_LOG_DIR': str(folder / 'log')}
    sys.setswitchinterval(0.0005)  # as the node, so that no answer waits for these threads
    rclpy.init()
    day = Day(chosen.minutes)
    child = subprocess.Popen([sys.executable, '-m', 'dlo_calibration.ros.executable', 'calibrator',
                              '--ros-args', '-p', f'mass:={MASS}', '-p', f'output_directory:={folder}'])
    try:
        figures = day.play()
        begun = day.now
        child.send_signal(signal.SIGINT)
        figures['exit code of the node'] = child.wait(60)
        figures['from SIGINT to the end'] = day.now - begun
    finally:
        child.kill()
        child.wait()
    day.executor.shutdown()
    rclpy.try_shutdown()
    print_day(day, figures, folder)


def print_day(day: Day, figures: dict[str, float], folder: Path) -> None:
    """Calibrate the recorded session again, and write the table."""
    session = max(folder.glob('dlo_session_*'), key=lambda path: path.stat().st_mtime)
    done = subprocess.run([sys.executable, '-m', 'dlo_calibration', 'fit', str(session), '--json'],
                          check=True, stdout=subprocess.PIPE)
    replayed = json.loads(done.stdout)
    result = {status.name: values(day.heard['result'], status.name) for status in day.heard['result'].status}
    rows = ['| parameter | truth | found by the node | 90 % interval | replayed |', '|---|---|---|---|---|']
    for name, truth in TRUTH.items():
        estimate, again = result[name], replayed['parameters'][name]
        value, lower, upper = (float(estimate[key]) for key in ('value', 'lower', 'upper'))
        rows.append(f'| {name} | {truth:.1f} | {value:.4f} | {lower:.1f} to {upper:.1f} '
                    f'| {again["value"]:.4f} |')
    lines = [f'| {name} | {value:.4g} |' for name, value in figures.items()]
    events = [f'{when:7.1f} s  {who:8} {text}' for when, who, text in day.events]
    text = '\n'.join([
        '# first day', '',
        f'`python benchmark/first_day.py --minutes {day.minutes:g}`; times in seconds.', '',
        '| figure | value |', '|---|---|', *lines, '', *rows, '',
        f'Mean error of the replay {1e3 * replayed["mean_error_m"]:.2f} mm.', '',
        'What the user read:', '', '```', *events, '```', ''])
    (HERE / 'results' / 'first_day.md').write_text(text)
    print('\n'.join([*lines, '', *rows]))


if __name__ == '__main__':
    main()
