# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure this checkout against another one, in turns: ``python benchmark/against.py OTHER``.

OTHER is the folder of another checkout in which `make test` has made ``.venv``, e.g. of ``git worktree add``.
Both simulate the same trials, in processes that take turns; ratios are what counts.
"""

import argparse
import json
import os
from pathlib import Path
import re
import statistics
import subprocess
import sys
from tempfile import TemporaryDirectory
import time

from figures import HERE, SAMPLES, table, write

ROUNDS = 7
#: times rollouts [ms] of processor: several at a time, alone; and on the clock with one thread and with two
ROLLOUTS = """
from concurrent.futures import ThreadPoolExecutor
import inspect, json, sys, time
import numpy as np
from dlo_calibration import read_session
from dlo_calibration.errors import SimulationError
from dlo_calibration.model.parameters import BY_NAME, PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

stoppable = 'stop' in inspect.signature(CompiledSimulator.simulate_together).parameters
if stoppable:
    from dlo_calibration.simulation.protocol import Stop
else:
    from dlo_calibration.simulation.kernel_cache import compile_kernels, SIMULATION, TOGETHER
    for kernels in (SIMULATION, TOGETHER):
        compile_kernels(kernels)

def together(simulator, jobs):
    return simulator.simulate_together(jobs, Stop()) if stoppable else simulator.simulate_together(jobs)

def alone(simulator, jobs):
    for job in jobs:
        try:
            simulator.simulate(*job)
        except SimulationError:
            pass

figures = {}
trials = [trial for name in sys.argv[2:] for trial in read_session(f'{sys.argv[1]}/{name}').trials]
for physics, fixed in (('', {}), (', all cable physics', {
        'torsion': 40.0, 'natural_curvature': 20.0, 'bending_friction': 60.0, 'bending_slip': 50.0})):
    rng, jobs = np.random.default_rng(1), []
    for _ in range(6):
        values = {name: 100 * rng.random() for name in PAPER_PARAMETERS}
        # The scale of the other checkout may be another one.
        values['flexibility'] = BY_NAME['flexibility'].value(10 ** (-1 - 0.045 * values['flexibility']))
        jobs += [(trial, ParameterSpace(fixed=fixed, mass=0.03).physical(values, 1.0)) for trial in trials]
    simulator = CompiledSimulator()
    portions = [jobs[k:k + 48] for k in range(0, len(jobs), 48)]
    together(simulator, jobs[:8])
    for name, call in (('four at a time', together), ('alone', alone)):
        begun = time.thread_time()
        for portion in portions:
            call(simulator, portion)
        figures[f'rollout, {name}{physics}, ms'] = 1e3 * (time.thread_time() - begun) / len(jobs)
    if stoppable:
        for threads in (1, 2):
            with ThreadPoolExecutor(threads) as pool:
                begun = time.perf_counter()
                list(pool.map(lambda portion: together(simulator, portion), portions))
                figures[f'rollout, {threads} threads{physics}, ms'] = (
                    1e3 * (time.perf_counter() - begun) / len(jobs))
print(json.dumps(figures))
"""
FIT = ('', '--search random --evaluations 600')


def rollouts(folder):
    """Return the milliseconds of rollouts, by name."""
    words = [folder / '.venv/bin/python', '-c', ROLLOUTS, str(SAMPLES), 'object1', 'object2', 'object3',
             'object4', 'object5']
    return json.loads(subprocess.run(words, cwd=folder, env=environment(folder), check=True,
                                     capture_output=True, text=True).stdout)


def fit(folder, words):
    """Return the seconds until `fit` prints its result, and the memory [MB] of all its processes at most."""
    with TemporaryDirectory() as output:
        begun, most = time.perf_counter(), 0.0
        process = subprocess.Popen(
            [folder / '.venv/bin/python', '-m', 'dlo_calibration', 'fit', str(SAMPLES / 'object1'),
             '--workers', '2', '--output', f'{output}/fit', *words.split()],
            cwd=folder, env=environment(folder), stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL)
        os.set_blocking(process.stdout.fileno(), False)
        printed = None
        while process.poll() is None:
            if printed is None and process.stdout.read():
                printed = time.perf_counter() - begun
            most = max(most, proportional(process.pid))
            time.sleep(0.01)
        assert process.returncode == 0
        return printed, most


def proportional(parent):
    """Return the memory [MB] of a process and its descendants; what they share counts once."""
    parents = {}
    for status in Path('/proc').glob('[0-9]*/stat'):
        try:
            parents[int(status.parent.name)] = int(status.read_text().rpartition(')')[2].split()[1])
        except OSError:  # it has ended
            pass
    family, total = {parent}, 0.0
    while more := {child for child, its in parents.items() if its in family} - family:
        family |= more
    for member in family:
        try:
            rollup = Path(f'/proc/{member}/smaps_rollup').read_text()
            total += int(re.search(r'^Pss:\s+(\d+)', rollup, re.M)[1])
        except OSError:
            pass
    return total / 1024


def environment(folder):
    """Return an environment in which the checkout in a folder is imported."""
    return {**os.environ, 'PYTHONPATH': str(folder)}


def revision(folder):
    """Return the name of the commit that is checked out."""
    return subprocess.run(['git', '-C', folder, 'describe', '--always', '--dirty'], check=True,
                          capture_output=True, text=True).stdout.strip()


def main():
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('other', type=Path)
    here, other = HERE.parent, parser.parse_args().other.resolve()
    figures = {folder: {} for folder in (other, here)}
    for _ in range(ROUNDS):
        for folder, series in figures.items():
            now = rollouts(folder)
            for words in FIT:
                seconds, memory = fit(folder, words)
                now[' '.join(f'fit SESSION {words}, printed, s'.split())] = seconds
                now[' '.join(f'fit SESSION {words}, memory, MB'.split())] = memory
            for name, figure in now.items():
                series.setdefault(name, []).append(figure)
        sys.stderr.write('.')
        sys.stderr.flush()
    before, after = ({name: min(all_of) for name, all_of in figures[folder].items()} for folder in figures)
    ratios = {name: statistics.median(a / b for a, b in zip(series, figures[here][name], strict=True))
              for name, series in figures[other].items()}
    rows = [[name, f'{before[name]:.2f}' if name in before else '-', f'{figure:.2f}',
             f'{ratios[name]:.2f}' if name in ratios else '-'] for name, figure in after.items()]
    write('against', f'python benchmark/against.py OTHER, a checkout of {revision(other)}',
          f'Least of {ROUNDS} rounds, in which both take turns, and the median of their ratios. Rollouts of '
          'all trials of the five samples with random parameters, 41 nodes, 3 ms: processor time, with '
          'threads wall clock. `fit` with two workers: wall clock, and memory of all its processes at most.',
          table(['figure', revision(other), 'this checkout', 'ratio'], rows))


if __name__ == '__main__':
    main()
