# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Resume: kill -9 at random times, to `fit` and the node, which go on until they are finished.

Lost: an evaluation that was told and is not there afterwards; simulations beyond those that were under way
at a kill; a result that differs from that of a calibration that nobody killed.  Died: a process that ended
otherwise than it should.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import random
import re
import signal
import subprocess
import sys
import time
from typing import Any

import counted_command
from tally import Tally
from toy_messages import session_messages, toy_trials, write_session

from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import bag_types

FULL = 14
PATIENCE = 120.0  # s that a process may take
MOST = 4  # kills of one calibration
REPEATED = 1  # evaluation: a search that goes on begins where it was, and a log has each point once
SMALL = {'nodes': 12, 'time_step': 0.01, 'settle_limit': 0.3}
#: What is calibrated in turn; `compiled` is the toy, see `counted_command`.
CHOICES: tuple[dict[str, Any], ...] = (
    {'engine': 'compiled', 'evaluations': 30},
    {'evaluations': 60},
    {'engine': 'compiled', 'evaluations': 60, 'parts': 0, 'calibrate': ['flexibility', 'friction']},
    {'search': 'random', 'evaluations': 60},
    {'engine': 'bullet', 'evaluations': 15, 'calibrate': ['flexibility', 'friction']},
    {'search': 'cma_es', 'evaluations': 50},
)
NODE_TURN = 7  # of each so many turns, the last is for the node


@dataclass(frozen=True)
class Life:
    """
    One process of a calibration.

    :param code: its exit code; None: it had to be killed at the limit.
    :param simulations: that it began.
    :param told: evaluations that it told its user.
    :param peak: its largest resident memory [bytes].
    """

    code: int | None
    err: str
    simulations: int
    told: int
    seconds: float
    peak: int

    @property
    def found(self) -> int:
        """Number of evaluations that it found finished."""
        words = re.search('goes on after ([0-9]+) evaluations', self.err)
        return int(words[1]) if words else 0


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Kill `amount` calibrations, each several times."""
    tally, choose = Tally(), random.Random(seed)
    for turn in range(amount):
        place = folder / f'turn_{turn}'
        place.mkdir()
        if turn % NODE_TURN == NODE_TURN - 1:
            of_node(place, tally, choose)
        else:
            choice = CHOICES[turn % NODE_TURN % len(CHOICES)]
            of_fit(place, tally, choose, choice, *((MOST, 2) if amount > 1 else (1, 1)))
    return tally


def of_fit(folder: Path, tally: Tally, choose: random.Random, choice: dict[str, Any], most: int,
           workers: int) -> None:
    """
    Kill `fit` and its resumptions, `most` times, and compare what it writes with one that nobody kills.

    :param workers: of that one, and at most of the others.
    """
    session = write_session(folder / 'session', session_messages(bag_types(), 3), {**SMALL, **choice})
    words = ('fit', session, '--seed', choose.randrange(1000), '--json', '--workers')
    out = folder / 'out'
    # Two threads also simulate points twice that are twice in one batch.
    whole = live(folder, *words, workers, '--output', folder / 'whole')
    expected, kills, told, simulations, slack = contents(folder / 'whole'), 0, 0, 0, 0
    while True:
        here = choose.choice((1, 1, workers))
        limit = choose.uniform(0.2, 1.0) * whole.seconds if kills < most else None
        # What is killed before it has written anything begins anew.
        begun = any((out / name).exists() and (out / name).stat().st_size
                    for name in ('unfinished/evaluations.log', 'result.xml'))
        again = ('fit', '--resume', out, '--json', '--workers', here)
        life = live(folder, *(again if begun else (*words, here, '--output', out)), limit=limit)
        tally.tried += 1
        tally.remember(peak=life.peak, silence=0.0)
        finished = 'nothing to resume' in life.err  # the kill before hit a process that had done all
        if told > life.found + REPEATED and (life.told or life.code == 0) and not finished:
            report(tally, f'{choice}: {told} evaluations were told, and {life.found} found')
        told, simulations = max(told, life.told), simulations + life.simulations
        if life.code != -signal.SIGKILL or limit is None:
            break
        # Each thread was simulating an evaluation, and had perhaps finished another just now.
        kills, slack = kills + 1, slack + 2 * here * len(toy_trials(3))
    if life.code != 0:
        tally.died += 1
        print(f'{choice}: exit code {life.code}: {life.err[-800:]}', file=sys.stderr)
    elif contents(out) != expected:
        report(tally, f'{choice}: another result after {kills} kills')
    if simulations > whole.simulations + slack:
        report(tally, f'{choice}: {simulations} simulations with {kills} kills, {whole.simulations} without')


def report(tally: Tally, text: str) -> None:
    """Count something as lost, and say what it was."""
    tally.lost += 1
    print(text, file=sys.stderr, flush=True)


def live(folder: Path, *words: object, limit: float | None = None) -> Life:
    """Execute a verb in a process of its own, and kill it after `limit` [s]."""
    seen = folder / 'seen'
    seen.write_bytes(b'')
    begun = time.monotonic()
    with (folder / 'err').open('w+') as err:
        process = subprocess.Popen(
            [sys.executable, counted_command.__file__, str(seen), *map(str, words)], stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=err, cwd=folder,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
        end, code, usage = begun + min(limit or PATIENCE, PATIENCE), None, None
        while code is None and time.monotonic() < end:
            ended, status, usage = os.wait4(process.pid, os.WNOHANG)
            code = os.waitstatus_to_exitcode(status) if ended else None
            time.sleep(0.005)
        if code is None:
            process.send_signal(signal.SIGKILL)
            _, _, usage = os.wait4(process.pid, 0)
            code = None if limit is None else -signal.SIGKILL
        process.returncode = -signal.SIGKILL if code is None else code
        time.sleep(0.1)  # until its child processes have ended, too
        err.seek(0)
        letters = seen.read_bytes()
        return Life(code, err.read(), letters.count(b'S'), letters.count(b'E'), time.monotonic() - begun,
                    usage.ru_maxrss * 1024 if usage else 0)


def contents(folder: Path) -> tuple[str, bytes] | None:
    """Return what a folder tells, without the time that it took and the options of the machine."""
    if not (folder / 'result.xml').exists():
        return None
    text = (folder / 'result.xml').read_text(encoding='utf-8')
    text = text.replace(f'seconds="{read_result(folder / "result.xml").seconds!r}"', '')
    return re.sub('<option name="workers".*/>', '', text), (folder / 'evaluations.csv').read_bytes()


def of_node(folder: Path, tally: Tally, choose: random.Random) -> None:
    """Kill the node in a calibration; another one, which gets the same trials, must go on."""
    import functools

    from ros_robot import child, robot_of, TYPES, values, whole
    from wire import result_values

    environment = {**os.environ, 'ROS_DOMAIN_ID': str(1 + os.getpid() % 101), 'ROS_LOG_DIR': str(folder),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    given = ('-p', 'workers:=1', '-p', 'evaluations:=60', '-p', f'seed:={choose.randrange(1000)}')
    results, told = [], 0
    for out, wanted in (('out', choose.randrange(2, 50)), ('out', None), ('whole', None)):
        with robot_of(environment) as robot, child(environment, folder / out, *given, seconds=0.02) as node:
            robot.send(session_messages(TYPES, 2))
            robot.until_status(trials='2')
            assert robot.call('start').success
            tally.tried += 1

            def seen(robot=robot):
                counts = [values(one.status[0])['evaluation'] for one in robot.heard['progress']]
                return max(map(int, counts), default=0)

            if wanted is not None:
                robot.until(lambda robot=robot, wanted=wanted, seen=seen: seen() >= wanted
                            or robot.status['state'] == 'done')
                node.kill()
                finished = robot.heard['result'] or robot.status['state'] == 'done'
                told = 0 if finished else seen()  # a finished calibration keeps no log
                continue
            details = functools.partial(map, lambda one: values(one.status[0])['detail'])
            results.append(robot.until_result())
            found = max((int(number) for detail in details(robot.heard['status']) for number in
                         re.findall('goes on after ([0-9]+) evaluations', detail)), default=0)
            if told > found + REPEATED:
                report(tally, f'node: {told} evaluations were told, and {found} found')
            told = 0
            if list((folder / out).glob('dlo_unfinished_*')):
                report(tally, 'node: a log was left after the result')
    if len({repr(result_values(one)) + whole(one)['scores'] for one in results}) != 1:
        report(tally, 'node: another result after a kill')
