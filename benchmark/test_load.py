# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure how fast the node answers while it calibrates on all cores: `make bench`."""

import contextlib
import os
from pathlib import Path
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.clock import Clock, ClockType  # noqa: E402 - where there is a ROS

from dlo_calibration.cli import demo_robot  # noqa: E402
from dlo_calibration.files.session import read_session  # noqa: E402
from dlo_calibration.ros.calibrator_node import CalibratorNode  # noqa: E402
from dlo_calibration.ros.graph_node import spin  # noqa: E402
from dlo_calibration.signals import StopFlag  # noqa: E402

SAMPLE = Path(__file__).resolve().parent.parent / 'msg_samples' / 'object1'
RESULTS = Path(__file__).resolve().parent / 'results' / 'load.md'
PERIOD = 0.02  # s of the node's timer, and between two calls
CALLS = 500


class Watched(CalibratorNode):
    """The node, with a timer that records the times at which it fires."""

    fired: list[float] = []

    def __init__(self, *args, **keywords):
        super().__init__(*args, **keywords)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD, lambda: self.fired.append(time.monotonic()), clock=clock)


def watched_node(file, *args):
    """Run the node until Ctrl-C, then write the times at which the timer fired."""
    with StopFlag() as stop:
        spin('calibrator', Watched, args, stop)
    np.savetxt(file, Watched.fired)


@contextlib.contextmanager
def running_node(folder, **options):
    """Give the robot of the demo with a watched node in another process."""
    words = [word for name, value in options.items() for word in ('-p', f'{name}:={value}')]
    with (folder / 'log').open('wb') as log:
        child = subprocess.Popen([sys.executable, __file__, str(folder / 'fired'), '--ros-args', *words],
                                 stdout=log, stderr=subprocess.STDOUT)
    try:
        with demo_robot._robot(child, folder / 'log', lambda: False) as robot:
            yield robot
        child.send_signal(demo_robot.signal.SIGINT)
        assert child.wait(60) == 0
    finally:
        child.kill()
        child.wait()


def round_trips(robot):
    """Call a service of the node many times; return the duration of each call [s]."""
    from rcl_interfaces.srv import GetParameters
    import rclpy

    client = robot._node.create_client(GetParameters, f'{demo_robot.NODE}/get_parameters')
    assert client.wait_for_service(60)
    request, durations = GetParameters.Request(names=['evaluations']), []
    for _ in range(CALLS):
        begun = time.monotonic()
        future = client.call_async(request)
        while not future.done():
            rclpy.spin_once(robot._node, timeout_sec=1.0)
        durations.append(time.monotonic() - begun)
        time.sleep(PERIOD)
    return np.array(durations)


@pytest.fixture(scope='module')
def rows():
    """Collect the rows of a table, and write it to results/load.md."""
    lines = []
    yield lines
    RESULTS.write_text(
        '# load\n\n`make bench`: object 1; the node calibrates on all cores, `search` random. Another '
        f'process calls a service of the\nnode {CALLS} times; a timer of the node wants to fire every '
        f'{PERIOD * 1e3:.0f} ms. On a machine that others use, they are in the figures, too.\n\n'
        '| engine | evaluations per s | round trip, median | p99 | max | timer late, median | p99 | max |\n'
        '|---|---|---|---|---|---|---|---|\n' + '\n'.join(lines) + '\n')


@pytest.mark.parametrize('engine', ['none', 'compiled', 'bullet'])
def test_the_node_answers_while_it_calibrates(engine, rows, tmp_path, monkeypatch):
    """Measure the node; without a calibration if the engine is `none`."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(1 + os.getpid() % demo_robot.LAST_DOMAIN))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros'))
    with running_node(tmp_path, engine='auto' if engine == 'none' else engine, search='random',
                      evaluations=1000000, output_directory=tmp_path) as robot:
        robot.send(read_session(SAMPLE))
        robot.wait(lambda: robot.value('status', 'trials') == '4', '4 trials')
        if engine != 'none':
            robot.start()
            robot.wait(lambda: int(robot.value('progress', 'evaluation') or 0) > 3, 'evaluations')
        first, begun = int(robot.value('progress', 'evaluation') or 0), time.monotonic()
        trips = round_trips(robot)
        ended, last = time.monotonic(), int(robot.value('progress', 'evaluation') or 0)
    fired = np.loadtxt(tmp_path / 'fired')
    late = np.diff(fired[(fired >= begun) & (fired <= ended)]) - PERIOD
    assert len(late) > CALLS / 2
    row = [f'{(last - first) / (ended - begun):.1f}']
    for values in (trips, np.maximum(late, 0.0)):
        row += [f'{1e3 * value:.1f} ms' for value in (*np.percentile(values, [50, 99]), values.max())]
    rows.append(f'| {engine} | {" | ".join(row)} |')
    print(f'\n{rows[-1]}')


if __name__ == '__main__':
    watched_node(*sys.argv[1:])
