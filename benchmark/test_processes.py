# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure the speed-up by several processes, and the time of each stage of `fit`: `make bench`."""

from itertools import pairwise
import json
import os
import subprocess
import sys
import time

from figures import HERE, SAMPLES, side_by_side, table, write
import pytest

from dlo_calibration.calibration.engines import ENGINES
from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.processes import cores, ProcessExecutor
from dlo_calibration.files.session import read_session
from dlo_calibration.search import RandomSearch
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator

ROUNDS = 3
EVALUATIONS = 150
WORKERS = (1, 2)
#: engine -> class, evaluations
MEASURED = {'compiled': (CompiledSimulator, 150), 'bullet': (BulletSimulator, 6)}
STAGES = {'imports': 'interpreter and imports', 'reading': 'session',
          'first': 'processes until the first evaluation', 'rounds': 'the other evaluations',
          'closing': 'end of the calibration', 'writing': 'report, pictures, files',
          'end': 'end of the interpreter'}


@pytest.fixture(scope='module')
def processes():
    """Collect the rows, and write the table when it is complete."""
    rows = []
    yield rows
    if len(rows) == len(MEASURED) * len(WORKERS):
        write('processes', 'make bench', '`calibrate` on the four trials of object 1, random search; '
              f'shortest wall clock of {ROUNDS} repetitions, '
              'in which the numbers of processes take turns. Ready '
              f'processes have simulated before. {cores()} cores may be used.',
              table(['engine', 'evaluations', 'processes', 'seconds, ready processes', 'speed-up',
                     'efficiency', 'seconds with their start'], rows))


def sample():
    """Return trials and parameter space of object 1."""
    session = read_session(SAMPLES / 'object1')
    options = session.options
    return session.trials, options.space


@pytest.mark.benchmark(timer=time.perf_counter)
@pytest.mark.parametrize('engine', MEASURED)
def test_processes(benchmark, engine, processes):
    trials, space = sample()
    make, evaluations = MEASURED[engine]
    ready = {workers: ProcessExecutor(workers) for workers in WORKERS}

    def search(executor, budget=evaluations):
        setting = Setting(tuple(trials), Options(), make(), executor)
        fit(setting, space, RandomSearch(space.dimension, seed=1), budget)

    def with_start(workers):
        executor = ProcessExecutor(workers)
        try:
            search(executor)
        finally:
            executor.close()

    try:
        for workers, executor in ready.items():
            search(executor, 4 * workers)
        calls = {f'{workers}': lambda executor=executor: search(executor)
                 for workers, executor in ready.items()}
        calls |= {f'{workers} with start': lambda workers=workers: with_start(workers)
                  for workers in WORKERS}
        seconds = side_by_side(benchmark, calls, ROUNDS, time.perf_counter)
    finally:
        for executor in ready.values():
            executor.close()
    for workers in WORKERS:
        faster = seconds[f'{WORKERS[0]}'] / seconds[f'{workers}']
        processes.append([engine, evaluations, workers, f'{seconds[f"{workers}"]:.2f}', f'{faster:.2f}',
                          f'{faster / workers:.0%}', f'{seconds[f"{workers} with start"]:.2f}'])


PROGRAM = """
import json, sys, time
from dlo_calibration.__main__ import begin_to_load
begin_to_load()  # first of all, as the command does
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
    engine = next(name for name in MEASURED if name in ENGINES)
    found = {workers: [] for workers in WORKERS}
    fit_of(tmp_path / 'warm', engine, WORKERS[-1])  # fills the caches

    def take():
        for workers, stages in found.items():
            stages.append(fit_of(tmp_path / f'{workers}', engine, workers))

    benchmark.pedantic(take, rounds=ROUNDS)
    for workers, repetitions in found.items():
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
              table(['engine', 'processes', 'whole', *STAGES.values()], rows))
