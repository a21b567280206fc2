# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kill: kill -9 to the node while it collects, calibrates or writes a result.

Lost: a trial that the node told of and that its session does not give back, or a result that is cut.
Died: a node that ends by itself, or leaves a process behind.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
import random
import time

from processes import children
from ros_domain import ros_graph
from tally import peak_of, Tally
from toy_messages import session_messages

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session, session_trials

FULL = 110
ORPHANED = 5.0  # s that a process may outlive the node
MOMENTS = ('calibrating', 'writing', 'collecting')
EVALUATIONS = {'calibrating': 10000, 'writing': 20, 'collecting': 20}
TRIALS = 2  # before the calibration


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Kill `amount` times, at the moments in turn."""
    tally, choose = Tally(), random.Random(seed)
    for k in range(amount):
        moment = MOMENTS[k % len(MOMENTS)]
        tally.tried += 1
        try:
            with _node(folder / f'{k}', EVALUATIONS[moment]) as (process, robot):
                _kill_the_node(process, robot, moment, choose, tally)
        except AssertionError:  # it ended, or never answered
            tally.died += 1
            continue
        tally.lost += _lost(folder / f'{k}' / 'out', robot)
    return tally


@contextmanager
def _node(folder, evaluations):
    """Give a node that has collected two trials, and its robot."""
    from ros_robot import child, robot_of, TYPES

    folder.mkdir()
    with ros_graph(folder) as environment, child(
            environment, folder / 'out', '-p', 'workers:=2', '-p', f'evaluations:={evaluations}',
            '-p', 'search:=random', seconds=0.01) as process, robot_of(environment) as robot:
        robot.send(session_messages(TYPES, TRIALS))
        robot.until_status(trials=f'{TRIALS}')
        yield process, robot


def _kill_the_node(process, robot, moment, choose, tally):
    from ros_robot import TYPES

    if moment == 'collecting':
        stream = (pair for k in range(TRIALS, 40) for pair in session_messages(TYPES, 1, first=k))
    else:
        stream = iter(())
        assert robot.call('start').success
        if moment == 'calibrating':
            robot.until(lambda: robot.heard['progress'])
    end = time.monotonic() + choose.uniform(0.0, 2.0)
    while time.monotonic() < end:
        for kind, message in stream:
            robot.publishers[kind].publish(message)
            break
        robot.executor.spin_once(timeout_sec=0.01)
    assert process.poll() is None
    tally.remember(peak=peak_of(process.pid))
    started = list(children(process.pid))
    process.kill()
    process.wait()
    begun = time.monotonic()
    while any(Path(f'/proc/{pid}').exists() for pid in started):
        if time.monotonic() - begun > ORPHANED:
            tally.died += 1
            return
        time.sleep(0.02)


def _lost(out, robot):
    """Return how much of what the robot was told is not in the session's folder."""
    try:
        folder, = out.glob('dlo_session_*')
        session = read_session(folder)
        trials, _ = session_trials(session, Options())
        for path in folder.glob('*.xml'):
            read_result(path)
        results = len(robot.heard['result']) - len(session.outputs('result'))
        told = TRIALS if robot.heard['progress'] else int(robot.status['trials'])
        return max(told - len(trials), 0) + max(results, 0)
    except (InputError, ValueError):
        return 1
