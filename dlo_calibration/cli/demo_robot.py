# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The demo's robot: it sends a sample to the real node over the ROS graph, and receives the result."""

from __future__ import annotations

from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import time
from typing import Any, Callable, Iterator

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.files.result import HOW, read_result
from dlo_calibration.files.session import read_session, Session, session_trials
from dlo_calibration.messages.codec import INPUT_TYPES, OUTPUT_TYPES, rclpy_types
from dlo_calibration.report import terminal
from dlo_calibration.report.drawing import session_picture
from dlo_calibration.workspace.folder import RESULT
from dlo_calibration.workspace.validation import validated
from dlo_calibration.writing import make_folder

NODE = '/calibrator'  # its full name, the namespace of its topics
LAST_DOMAIN = 101  # of ROS; the ports of higher ones lie in the operating system's ephemeral range
PATIENCE = 60.0  # s without a message from the node, after which the demo gives up


def calibrate_sample(output: Path, sample: Path, evaluations: int, stop: Callable[[], bool]) -> None:
    """
    Send a sample to a node, let it calibrate, and show the result.

    :param output: folder for all files; made if it does not exist.
    :param evaluations: budget of the search.
    :raises KeyboardInterrupt: if `stop` becomes true before the result is there.
    :raises DloCalibrationError: if something does not work.
    """
    session = read_session(sample)
    recorded = {} if session.file_options is None else session.file_options.values
    make_folder(output)
    os.environ['ROS_DOMAIN_ID'] = str(_unused_domain())
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ.setdefault('ROS_LOG_DIR', str(output.resolve() / 'ros_log'))
    before = set(output.glob('dlo_session_*'))
    options = {**recorded, 'evaluations': evaluations,
               'output_directory': str(output.resolve())}
    out, log, picture = terminal.console(sys.stdout), output / 'calibrator.log', output / 'demo.png'
    with _node(options, log) as child, _robot(child, log, stop) as robot:
        out.print(f'sending {sample.name} to the node {NODE} ...')
        robot.send(session)
        expected = len(session_trials(session, Options.of(options))[0])
        robot.wait(lambda: robot.value('status', 'trials') == str(expected), f'{expected} trials in ~/status')
        out.print(f'the node has {expected} trials; calling ~/start')
        robot.start()
        with terminal.SearchBar(evaluations, sys.stderr) as bar:
            robot.wait(lambda: _show(robot, bar), 'a result')
    folder, = set(output.glob('dlo_session_*')) - before
    file = read_result(folder / RESULT)
    used = Options.of(file.file_options.values)
    result = validated(file, session_trials(read_session(folder), used)[0], used)
    session_picture(result.trials, result.chains, picture)
    terminal.print_result(result, sys.stdout, {key: getattr(file, key) for key in HOW})
    out.print(f'session and {RESULT}: {folder}', soft_wrap=True)
    out.print(f'picture of measured and simulated chains: {picture}', soft_wrap=True)


def _show(robot: Any, bar: terminal.SearchBar) -> bool:
    """Move the progress bar; return whether the result has arrived."""
    if robot.value('status', 'state') == 'failed':
        raise DloCalibrationError(f'the node reports: {robot.value("status", "detail")}')
    if robot.value('progress', 'evaluation'):
        bar.move(int(robot.value('progress', 'evaluation')), float(robot.value('progress', 'best_score')))
    return 'result' in robot.heard


@contextmanager
def _node(options: dict[str, Any], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start the node in a process of its own, and end it as Ctrl-C would."""
    command = [sys.executable, '-m', 'dlo_calibration.ros.executable', 'calibrator', '--ros-args']
    for name, value in options.items():
        command += ['-p', f'{name}:={json.dumps(value)}']  # ROS expects YAML, and JSON is valid YAML
    log.unlink(missing_ok=True)  # it may be a link
    with log.open('xb') as stream:
        child = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
        try:
            yield child
        finally:
            child.send_signal(signal.SIGINT)
            try:
                code = child.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                child.kill()
                code = child.wait()
        if code:
            raise DloCalibrationError(f'the node ended with exit code {code}; see {log}')


@contextmanager
def _robot(child: subprocess.Popen[bytes], log: Path, stop: Callable[[], bool]) -> Iterator[_Robot]:
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise DloCalibrationError(
            f"{error}; source a ROS 2 Jazzy installation, or, in the folder of dlo_calibration, install "
            "the libraries: pip install '.[ros]'") from error
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node('robot')
        yield _Robot(node, child, log, stop)
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


class _Robot:
    """The robot's software: sends messages, calls services, and keeps the last message of each topic."""

    def __init__(self, node: Any, child: subprocess.Popen[bytes], log: Path,
                 stop: Callable[[], bool]) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_srvs.srv import Trigger

        self.heard: dict[str, Any] = {}
        self._node, self._child, self._log, self._stop = node, child, log, stop
        self._request = Trigger.Request()
        find = rclpy_types().find
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for name, kind in OUTPUT_TYPES.items():
            node.create_subscription(
                find(kind), f'{NODE}/{name}', lambda message, name=name: self.heard.update({name: message}),
                QoSProfile(depth=10) if name == 'progress' else latched)
        self._publishers = {name: node.create_publisher(find(kind), f'{NODE}/{name}', QoSProfile(depth=1000))
                            for name, kind in INPUT_TYPES.items()}
        self._client = node.create_client(Trigger, f'{NODE}/start')

    def value(self, topic: str, key: str) -> str:
        """Return a value of the first status in the last message of a topic; empty if there is none."""
        if topic not in self.heard:
            return ''
        return str(next((pair.value for pair in self.heard[topic].status[0].values if pair.key == key), ''))

    def wait(self, ready: Callable[[], bool], what: str) -> None:
        """Listen until `ready` returns true; raise DloCalibrationError after PATIENCE without a message."""
        import rclpy

        last, quiet_since = dict(self.heard), time.monotonic()
        while not ready():
            if self._stop():
                raise KeyboardInterrupt
            if self._child.poll() is not None:
                raise DloCalibrationError(f'the node ended by itself; see {self._log}')
            rclpy.spin_once(self._node, timeout_sec=0.05)
            if any(last.get(name) is not message for name, message in self.heard.items()):
                last, quiet_since = dict(self.heard), time.monotonic()
            if time.monotonic() - quiet_since > PATIENCE:
                raise DloCalibrationError(f'waited {PATIENCE:.0f} s for {what}; see {self._log}')

    def send(self, session: Session) -> None:
        """Publish the input messages of a session, byte by byte as they were recorded."""
        self.wait(lambda: all(p.get_subscription_count() for p in self._publishers.values())
                  and self._client.service_is_ready() and 'status' in self.heard, 'the node')
        for record in session.records:
            if INPUT_TYPES.get(record.name) == record.type:
                self._publishers[record.name].publish(record.data)

    def start(self) -> None:
        """Call ~/start."""
        future = self._client.call_async(self._request)
        self.wait(future.done, 'the answer of ~/start')
        answer = future.result()
        if not answer.success:
            raise DloCalibrationError(f'the node refuses: {answer.message}')


def _unused_domain() -> int:
    """Return a ROS domain in which no other program of this machine takes part."""
    for turn in range(LAST_DOMAIN):
        domain = 1 + (os.getpid() + turn) % LAST_DOMAIN
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', 7410 + 250 * domain))  # the port of a domain's first participant in DDS
            except OSError:
                continue
            return domain
    return LAST_DOMAIN
