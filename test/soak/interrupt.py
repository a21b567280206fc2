# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Interrupt: SIGINT and SIGTERM at random times, to every verb, the node and the demo.

Died: a process that ended with a traceback, with another exit code, after too long, or that left a process
behind.  Lost: a file that is not whole, or an answer that is not, where the exit code is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
import json
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import time

from mcap.exceptions import McapError
from mcap.reader import make_reader
from PIL import Image
from processes import of_session
from tally import Tally
from toy_messages import session_messages, toy_trials, write_session
from toy_simulator import new_toy

from dlo_calibration import calibrate, Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import read_result, write_result
from dlo_calibration.messages.codec import bag_types

FULL = 110
PATIENCE = 60.0  # s from the signal to the end of the process
ORPHANED = 5.0  # s that a child process may outlive its parent
SMALL = {'calibrate': ['flexibility', 'damping'], 'nodes': 12, 'time_step': 0.01, 'settle_limit': 0.2,
         'evaluations': 30}
DEMO = ('-m', 'dlo_calibration.cli.demo', '--sample', '{session}', '--output', '{out}', '--evaluations', '20')
#: Each with the time that it takes to its end [s], on a machine that does other work, too.
COMMANDS = (
    (4.0, ('-m', 'dlo_calibration', 'fit', '{session}', '--workers', '2', '--json', '--output', '{out}')),
    (0.9, ('-m', 'dlo_calibration', 'info', '{session}', '--json')),
    (3.0, ('-m', 'dlo_calibration.ros.executable', 'calibrator', '--ros-args',
           '-p', 'output_directory:="{out}"')),
    (4.0, ('-m', 'dlo_calibration', 'plot', '{session}', '{result}', '--json', '--animation',
           '--output', '{out}')),
    (6.0, ('-m', 'dlo_calibration', 'experiment', '{session}', '--json', '--runs', '1', '--search', 'random',
           '--output', '{out}')),
    (2.5, ('-m', 'dlo_calibration', 'validate', '{result}', '{session}', '--json')),
    (8.0, DEMO),
)
#: Modules that are loaded before signals are handled.
BEGINNING = ('__init__.py', '__main__.py', 'signals.py', 'calibrator.py', 'demo.py')


@dataclass(frozen=True)
class End:
    """
    How an interrupted process ended.

    :param code: its exit code; None: it had to be killed.
    :param early: whether the signal came before it handled signals.
    """

    code: int | None
    out: str
    err: str
    early: bool
    seconds: float
    peak: int


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Interrupt `amount` processes, the commands in turn."""
    tally, choose = Tally(), random.Random(seed)
    session = write_session(folder / 'session', session_messages(bag_types(), 2), SMALL)
    result = folder / 'result.xml'
    write_result(result, calibrate(toy_trials(2), Options.of({'workers': 1, 'evaluations': 8}),
                                   make_simulator=new_toy), Options.of(SMALL).flat())
    for turn in range(amount):
        seconds, words = COMMANDS[turn % len(COMMANDS)]
        out = folder / f'out_{turn}'
        out.mkdir()
        command = [word.format(session=session, result=result, out=out) for word in words]
        number, delay = choose.choice((signal.SIGINT, signal.SIGTERM)), choose.uniform(0.0, seconds)
        end = interrupted(command, folder, number, delay, choose.choice((None, 0.0, 0.02, 0.2)))
        tally.tried += 1
        tally.refused += end.code not in (0, None)
        tally.remember(peak=end.peak, silence=end.seconds)
        for fault in faults(end, number, 'calibrator' in words[1]):
            tally.died += 1
            report(command, number, delay, fault, end)
        for fault in [*unfinished(out), *unanswered(end)]:
            tally.lost += 1
            report(command, number, delay, fault, end)
    return tally


def report(command: list[str], number: int, delay: float, fault: str, end: End) -> None:
    """Say on stderr what happened, so that it can be tried again."""
    print(f'{" ".join(command)}, {signal.Signals(number).name} after {delay:.3f} s: {fault}; '
          f'exit code {end.code}; {end.err[-800:]}', file=sys.stderr, flush=True)


def interrupted(command: list[str], folder: Path, number: int, delay: float, again: float | None) -> End:
    """Start a command, send it a signal after `delay` [s], and once more `again` [s] later."""
    graph = {'ROS_DOMAIN_ID': str(1 + os.getpid() % 101), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
             'ROS_LOG_DIR': str(folder / 'ros_log')}
    with (folder / 'out').open('w+') as out, (folder / 'err').open('w+') as err:
        process = subprocess.Popen(
            [sys.executable, *command], stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=folder,
            start_new_session=True, env={**os.environ, **graph})
        time.sleep(delay)
        early = not handles(process.pid)
        if early:  # a signal before Python has begun can be lost
            again = 1.0
        begun, sent, code, usage = time.monotonic(), False, None, None
        os.kill(process.pid, number)  # unlike send_signal, this never waits for the process
        while time.monotonic() - begun < PATIENCE:
            ended, status, usage = os.wait4(process.pid, os.WNOHANG)
            if ended:
                code = os.waitstatus_to_exitcode(status)
                break
            if again is not None and not sent and time.monotonic() - begun >= again:
                os.kill(process.pid, number)
                sent = True
            time.sleep(0.005)
        seconds = time.monotonic() - begun
        if code is None:
            process.kill()
            process.wait()
        process.returncode = -signal.SIGKILL if code is None else code
        while (orphans := of_session(process.pid)) and time.monotonic() - begun < seconds + ORPHANED:
            time.sleep(0.02)
        for orphan in orphans:
            os.kill(orphan, signal.SIGKILL)
        texts = [(stream.seek(0), stream.read())[1] for stream in (out, err)]
    texts[1] += ''.join(f'\nOrphan: {name}' for name in orphans.values())
    return End(code, *texts, early, seconds, usage.ru_maxrss * 1024 if usage else 0)


def handles(process: int) -> bool:
    """Tell whether a process handles SIGTERM, which Python itself does not."""
    try:
        lines = Path(f'/proc/{process}/status').read_text().splitlines()
    except OSError:  # it has ended
        return True
    caught = next((int(line.split()[1], 16) for line in lines if line.startswith('SigCgt')), 0)
    ignored = next((int(line.split()[1], 16) for line in lines if line.startswith('SigIgn')), 0)
    return bool((caught | ignored) >> (signal.SIGTERM - 1) & 1)


def faults(end: End, number: int, node: bool) -> list[str]:
    """List what is wrong with how a process ended."""
    found = []
    if end.early:  # Python itself was loading, and ends as it likes, unless it was in a module of ours
        frames = [line for line in end.err.splitlines() if '/dlo_calibration/' in line and 'File "' in line]
        if any(line.split('"')[1].rpartition('/')[2] not in BEGINNING for line in frames):
            found.append('modules were loading before signals were handled')
    else:
        if end.code not in ((0,) if node else (0, 128 + number)):
            found.append('another exit code than 0 and that of the signal')
        if 'Traceback' in end.err or 'Exception ignored' in end.err:
            found.append('a traceback')
        if sum(line.endswith(': interrupted') for line in end.err.splitlines()) != (end.code != 0):
            found.append('not one line that says so')
    if 'Orphan' in end.err:
        found.append('a process was left behind')
    return found


def unanswered(end: End) -> list[str]:
    """List what is wrong with the document that a verb with the exit code 0 printed."""
    if end.code != 0 or not end.out.startswith('{'):
        return []
    try:
        json.loads(end.out)
    except ValueError as error:
        return [f'no whole JSON document ({error})']
    return []


def unfinished(folder: Path) -> list[str]:
    """List the files in a folder, and in those below, that are not whole."""
    found = []
    for path in folder.rglob('*'):
        if path.is_dir() or path.suffix == '.log' or 'ros_log' in path.parts:
            continue
        octets = path.read_bytes()
        try:
            if path.name.startswith('.unfinished') or not octets:
                raise ValueError('empty or unfinished')
            if path.suffix == '.xml':
                read_result(path)
            elif path.suffix == '.mcap':
                with path.open('rb') as stream:
                    if make_reader(stream).get_summary() is None:
                        raise ValueError('no index')
            elif path.suffix in ('.png', '.gif'):
                with Image.open(path) as image:
                    image.seek(getattr(image, 'n_frames', 1) - 1)
                    image.load()
            elif path.suffix == '.json':
                json.loads(octets)
            elif not octets.endswith((b'\n', b'</svg>')):
                raise ValueError('cut')
        except (InputError, McapError, ValueError, OSError) as error:
            found.append(f'{path.relative_to(folder)}: {error}')
    return found
