# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure the speed-up by several threads, and the time of each stage of `fit`: `make bench`."""

from contextlib import closing
from itertools import pairwise
import json
import os
import subprocess
import sys
import time

from figures import HERE, SAMPLES, side_by_side, table, write
import pytest

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation import Threads
from dlo_calibration.evaluation.pool import cores
from dlo_calibration.files.session import read_session
from dlo_calibration.search import RandomSearch

ROUNDS = 3
EVALUATIONS = 150
WORKERS = (1, 2)
MEASURED = {'compiled': 150, 'bullet': 6}  # engine -> evaluations
STAGES = {'imports': 'interpreter and imports', 'reading': 'session',
          'first': 'until the first evaluation', 'rounds': 'the other evaluations',
          'closing': 'end of the calibration', 'writing': 'report, pictures, files',
          'end': 'end of the interpreter'}


@pytest.fixture(scope='module')
def rows():
    """Collect the rows, and write the table when it is complete."""
    lines = []
    yield lines
    if len(lines) == len(MEASURED) * len(WORKERS):
        write('threads', 'make bench', '`calibrate` on the four trials of object 1, random search; '
              f'shortest wall clock of {ROUNDS} repetitions, in which the numbers of threads take turns. '
              f'{cores()} cores may be used.',
              table(['engine', 'evaluations', 'threads', 'seconds', 'speed-up', 'efficiency'], lines))


@pytest.mark.benchmark(timer=time.perf_counter)
@pytest.mark.parametrize('engine', MEASURED)
def test_threads(benchmark, engine, rows):
    session = read_session(SAMPLES / 'object1')
    space = session.options.space

    def search(workers, budget=MEASURED[engine]):
        with closing(Threads(workers)) as threads:
            setting = Setting(tuple(session.trials), Options(), simulator, threads)
            fit(setting, space, RandomSearch(space.dimension, seed=1), budget)

    with closing(make_simulator(Options(engine=engine))) as simulator:
        search(WORKERS[-1], 4)  # PyBullet's processes start
        calls = {f'{workers}': lambda workers=workers: search(workers) for workers in WORKERS}
        seconds = side_by_side(benchmark, calls, ROUNDS, time.perf_counter)
    for workers in WORKERS:
        faster = seconds[f'{WORKERS[0]}'] / seconds[f'{workers}']
        rows.append([engine, MEASURED[engine], workers, f'{seconds[f"{workers}"]:.2f}', f'{faster:.2f}',
                     f'{faster / workers:.0%}'])


PROGRAM = """
import json, sys, time
from dlo_calibration.cli import fit, main as cli
marks = {'imports': time.time()}
calibrate = fit.calibrate
def watched(trials, options, *, on_evaluation, **rest):
    marks['reading'] = time.time()
    def take(evaluation):
        marks.setdefault('first', time.time())
        marks['rounds'] = time.time()
        on_evaluation(evaluation)
    try:
        return calibrate(trials, options, on_evaluation=take, **rest)
    finally:
        marks['closing'] = time.time()
fit.calibrate = watched
code = cli.main(sys.argv[1:])
marks['writing'] = time.time()
sys.stderr.write(json.dumps(marks))
sys.exit(code)
"""


def fit_of(folder, engine, workers):
    """Return the duration of each stage of `fit` in a new process [s]."""
    begun = time.time()
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM, 'fit', str(SAMPLES / 'object1'), '--output', str(folder), '--json',
         '--engine', engine, '--search', 'random', '--evaluations', str(EVALUATIONS),
         '--workers', str(workers), '--seed', '1'],
        env={**os.environ, 'PYTHONPATH': str(HERE.parent)}, capture_output=True, text=True)
    ended = time.time()
    assert done.returncode == 0, done.stderr
    marks = {**json.loads(done.stderr.splitlines()[-1]), 'end': ended}
    times = [begun, *(marks[stage] for stage in STAGES)]
    return {**{stage: after - before for stage, (before, after) in zip(STAGES, pairwise(times), strict=True)},
            'whole': ended - begun}


def test_fit(benchmark, tmp_path, fits):
    engine = next(iter(MEASURED))
    stages_of = {workers: [] for workers in WORKERS}
    fit_of(tmp_path / 'warm', engine, WORKERS[-1])  # fills the caches

    def take():
        for workers, stages in stages_of.items():
            stages.append(fit_of(tmp_path / f'{workers}', engine, workers))

    benchmark.pedantic(take, rounds=ROUNDS)
    for workers, repetitions in stages_of.items():
        best = min(repetitions, key=lambda stages: stages['whole'])
        fits.append([engine, workers, *(f'{best[stage]:.2f}' for stage in ('whole', *STAGES))])


@pytest.fixture(scope='module')
def fits():
    """Collect the rows, and write the table."""
    rows = []
    yield rows
    if rows:
        write('fit', 'make bench', '`dlo-calibration fit msg_samples/object1 --search random --evaluations '
              f'{EVALUATIONS} --output DIR`, a process of its own each time, caches warm; seconds of wall '
              f'clock, of the fastest of {ROUNDS} repetitions.',
              table(['engine', 'threads', 'whole', *STAGES.values()], rows))
