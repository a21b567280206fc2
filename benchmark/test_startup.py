# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure how long commands take to start, what they load, and when `fit` shows what: `make bench`."""

from importlib.util import find_spec
import os
import signal
import subprocess
import sys
import time

from figures import HERE, SAMPLES, table, write
import pytest

ROUNDS = 5
SLOW = ('numpy', 'scipy', 'scipy.spatial', 'scipy.optimize', 'matplotlib', 'pybullet', 'rclpy')
COMMANDS = {
    'dlo-calibration --help': ('dlo_calibration', '--help'),
    'dlo-calibration info SESSION': ('dlo_calibration', 'info', str(SAMPLES / 'object1')),
    'calibrator --help': ('dlo_calibration.ros.executable', 'calibrator', '--help'),
    'calibrator, until it is ready': ('dlo_calibration.ros.executable', 'calibrator'),
}
FIT = ('first simulation begins', 'first evaluation kept', 'result printed', 'page and all files written')
#: executes the command, and notes when its threads get the first evaluation to simulate
NOTING = """
import sys, time
from dlo_calibration.__main__ import main
from dlo_calibration.evaluation.pool import Threads

submit, note = Threads.submit, sys.argv.pop()

def noting(*words, **more):
    Threads.submit = submit
    with open(note, 'w') as file:
        file.write(repr(time.time()))
    return submit(*words, **more)

Threads.submit = noting
sys.exit(main())
"""
READY = 'collecting trials'  # says the node
ENVIRONMENT = {**os.environ, 'PYTHONPATH': str(HERE.parent)}
PATIENCE = 60  # s


def finish(words, *options):
    """Return the stderr of a command when it has ended; the node is stopped when it is ready."""
    process = subprocess.Popen([sys.executable, *options, '-m', *words], env=ENVIRONMENT, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said = []
    for line in process.stdout:
        said.append(line)
        if READY in line:
            process.send_signal(signal.SIGINT)
            said.append(time.perf_counter())
            break
    else:
        said.append(time.perf_counter())
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, said
    return said


def fit(folder):
    """Return the seconds after which `fit` of the sample has done what FIT lists."""
    log, note, begun = folder / 'unfinished/evaluations.log', folder.with_suffix('.note'), time.time()
    process = subprocess.Popen(
        [sys.executable, '-c', NOTING, 'fit', str(SAMPLES / 'object1'), '--output', str(folder), str(note)],
        env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    while process.poll() is None and not (log.exists() and b'evaluation-' in log.read_bytes()):
        time.sleep(0.005)
    times = [time.time()]
    process.stdout.readline()
    times.append(time.time())
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    return [instant - begun for instant in (float(note.read_text()), *times, time.time())]


@pytest.fixture(scope='module')
def rows():
    """Collect the rows, and write the table."""
    lines = []
    yield lines
    if lines:
        write('startup', 'make bench', f'Wall clock from the start of the process; shortest of {ROUNDS} '
              f'repetitions. Loaded of '
              f'{", ".join(SLOW)}, as `python -X importtime` says.',
              table(['command', 'seconds', 'loads'], lines))


@pytest.mark.parametrize('name', COMMANDS)
def test_startup(benchmark, name, rows, tmp_path, monkeypatch):
    words = COMMANDS[name]
    if name.endswith('ready') and find_spec('rclpy') is None:
        pytest.skip('rclpy is not installed')
    monkeypatch.chdir(tmp_path)
    times = []

    def take():
        begun = time.perf_counter()
        times.append(finish(words)[-1] - begun)

    benchmark.pedantic(take, rounds=ROUNDS, warmup_rounds=1)
    *lines, _ = finish(words, '-X', 'importtime')
    loaded = {line.rpartition('|')[2].strip() for line in lines}
    slow = ', '.join(library for library in SLOW if library in loaded)
    rows.append([name, f'{min(times[1:]):.2f}', slow or 'none'])


def test_fit(benchmark, rows, tmp_path):
    times = []
    benchmark.pedantic(lambda: times.append(fit(tmp_path / f'{len(times)}')), rounds=ROUNDS, warmup_rounds=1)
    for name, seconds in zip(FIT, zip(*times[1:], strict=True), strict=True):
        rows.append([f'dlo-calibration fit SESSION, {name}', f'{min(seconds):.2f}', ''])


def test_random_search(benchmark, rows):
    words, times = '--search random --evaluations 600', []

    def take():
        begun = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, '-m', 'dlo_calibration', 'fit', str(SAMPLES / 'object1'), *words.split()],
            env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        process.stdout.readline()
        times.append(time.perf_counter() - begun)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == 0

    benchmark.pedantic(take, rounds=ROUNDS, warmup_rounds=1)
    rows.append([f'dlo-calibration fit SESSION {words}, result printed', f'{min(times[1:]):.2f}', ''])
