# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Disk: a disk that becomes full at some moment, for `fit`, for the node and for `experiment`.

Lost: a result that is not told, a file that is neither whole nor absent, a missing file that is not named.
Died: a process that ended with another exit code than it should, or with a traceback.

Each disk is a tmpfs in a mount namespace; where Linux does not permit that, each file has a largest size.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import random
import resource
import signal
import subprocess
import sys
from unittest import mock

from interrupt import unfinished
from tally import Tally
from toy_messages import session_messages, write_session

from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import bag_types

FULL = 45
PATIENCE = 90.0  # s for a process
SIZES = 4, 600  # kB; the largest has room for all files of most commands
SMALL = {'calibrate': ['flexibility', 'damping'], 'nodes': 12, 'time_step': 0.01, 'settle_limit': 0.2,
         'evaluations': 6}
#: A disk of $1 kB at $2, for the command in the other words; its files are in $3 afterwards.
DISK = """trap : INT; size=$1 disk=$2 kept=$3; shift 3
mount -t tmpfs -o size=${size}k tmpfs "$disk" || exit 99
"$@"; code=$?; cp -a "$disk/." "$kept/"; exit $code"""
LIMIT = 'trap : INT; ulimit -f $1; shift 3; "$@"'
FIT = ('result.xml', 'session.mcap', 'report.html', 'evaluations.csv')
EXPERIMENT = ('experiment.md', 'experiment.json', 'consistency.csv', 'validity.csv', 'calibrations.csv',
              'parameters.png', 'session_random.png')


class Disk:
    """A disk of `size` [kB]; its files are in `kept` when `command` has ended."""

    def __init__(self, folder: Path, size: int, real: bool) -> None:
        self.path = folder / 'disk'
        self.kept = folder / 'kept' if real else self.path
        for path in (folder, self.path, self.kept):
            path.mkdir(exist_ok=True)
        self._words = [*(('unshare', '-rm') if real else ()), 'bash', '-c', DISK if real else LIMIT, 'bash',
                       str(size), str(self.path), str(self.kept)]

    def start(self, *command: object, **settings: object) -> subprocess.Popen[str]:
        """Start a command on this disk, in a session of its own."""
        return subprocess.Popen(
            [*self._words, *map(str, command)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, start_new_session=True, **settings)


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Fill `amount` disks."""
    tally, choose, before = Tally(), random.Random(seed), largest_child()
    session = write_session(folder / 'session', session_messages(bag_types(), 2), SMALL)
    real = subprocess.run(['unshare', '-rm', 'true'], capture_output=True, check=False).returncode == 0
    for turn in range(amount):
        size = round(SIZES[0] * (SIZES[1] / SIZES[0]) ** choose.random())
        act = (on_node, on_fit, on_experiment)[turn % 3]
        lost, died, refused = act(Disk(folder / str(turn), size, real), session)
        tally.tried += 1
        tally.refused += refused
        tally.lost += len(lost)
        tally.died += len(died)
        for text in (*lost, *died):
            print(f'{act.__name__}, {size} kB: {text}', file=sys.stderr, flush=True)
    largest = largest_child()
    tally.remember(peak=largest if largest > before else 0)  # else it was a child of somebody else
    return tally


def largest_child() -> int:
    """Return the largest resident memory of any child of this process that has ended [bytes]."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024


def on_fit(disk: Disk, session: Path) -> tuple[list[str], list[str], bool]:
    """Let `fit` write to a disk; return what was lost, what died, and whether it began at all."""
    return _on_verb(disk, FIT, 'fit', session, '--workers', 1, '--json', '--output', disk.path / 'out')


def on_experiment(disk: Disk, session: Path) -> tuple[list[str], list[str], bool]:
    """Let `experiment` write to a disk, as `on_fit` does."""
    return _on_verb(disk, EXPERIMENT, 'experiment', session, '--runs', 1, '--search', 'random',
                    '--held-back', 1, '--workers', 1, '--json', '--output', disk.path / 'out')


def _on_verb(disk: Disk, names: tuple[str, ...], *words: object) -> tuple[list[str], list[str], bool]:
    process = disk.start(sys.executable, '-m', 'dlo_calibration', *words)
    out, err = process.communicate(timeout=PATIENCE)
    last = (err.splitlines() or [''])[-1]
    folder = disk.kept / 'out'
    there = {path.name for path in folder.iterdir()} if folder.exists() else set()
    missing = [name for name in names if name not in there]
    refused = not out and ('; expected a place that' in last or 'the end of calibrations.jsonl' in last)
    lost = [text for text in unfinished(folder) if not text.startswith('calibrations.jsonl')]
    if not refused:
        try:
            json.loads(out)
        except ValueError as error:
            lost.append(f'the result is not told ({error}): {err[-500:]}')
        lost += [f'{name} is missing, and not named: {last}' for name in missing if name not in last]
    died = [] if process.returncode == (2 if missing or 'could not be written' in last else 0) else [
        f'exit code {process.returncode}, though {missing} are missing: {err[-500:]}']
    if 'Traceback' in err or 'Exception ignored' in err:
        died.append(err[-2000:])
    return lost, died, bool(refused)


def on_node(disk: Disk, session: Path) -> tuple[list[str], list[str], bool]:
    """Let the node, with the toy, record to a disk and write its result there."""
    from ros_robot import CHILD, robot_of, TYPES

    lost: list[str] = []
    graph = {'ROS_DOMAIN_ID': str(1 + os.getpid() % 101), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
             'ROS_LOG_DIR': str(disk.kept.parent / 'ros_log')}
    with mock.patch.dict(os.environ, graph), robot_of(graph) as robot:
        process = disk.start(
            sys.executable, CHILD, '0.0', '--ros-args', '-p', f'output_directory:={disk.path}',
            '-p', 'workers:=1', '-p', 'evaluations:=20',
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
        try:
            for k in range(2):
                robot.send(session_messages(TYPES, 1, first=k))
                robot.until_status(trials=str(k + 1))
            if not robot.call('start').success:
                lost.append('no start')
            robot.until_result()
        except AssertionError as error:
            lost.append(f'the result is not told: {error}')
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE)
    for folder in disk.kept.glob('dlo_session_*'):
        lost += _of_session(folder, err)
    died = [err[-2000:]] if process.returncode or 'Traceback' in err else []
    return lost, died, not list(disk.kept.glob('dlo_session_*'))


def _of_session(folder: Path, err: str) -> list[str]:
    """List what a session's folder lacks that the log of the node does not name in the end."""
    last = next((line for line in reversed(err.splitlines()) if 'is incomplete' in line), '')
    lost = [f'{folder.name}: {text}' for text in unfinished(folder) if '.mcap: ' not in text]
    lost += [f'{name} is missing, and not named: {last}' for name in FIT
             if name != 'session.mcap' and name not in last and not (folder / name).exists()]
    try:
        whole = not read_session(folder).warnings
    except DloCalibrationError as error:  # it has no input message yet
        whole = 'expected at least one of initial_chain' not in str(error)
    if not whole and 'messages from' not in last:
        lost.append(f'the session is cut, which is not told: {last}')
    return lost
