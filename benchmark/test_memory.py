# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure whether the memory in use stays constant over many rollouts: `make bench`."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
import os
from pathlib import Path

from figures import SAMPLES, table, write
import numpy as np
import pytest

from dlo_calibration import SimulationError
from dlo_calibration.files.session import read_session

#: engine -> rounds
ROUNDS = {'compiled': 10_000, 'bullet': 1_000}
LOOKS = 100
WARM = 0.2  # share of the rounds that fill caches and pools


def resident():
    """Return the memory of this process that is in use [kB]."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1000


def memory(name, rounds):
    """Roll out with random parameters; return the number of rounds and the memory [kB] at each look."""
    if name == 'compiled':
        from dlo_calibration.simulation.compiled import CompiledSimulator as Engine
    else:
        from dlo_calibration.simulation.bullet import BulletSimulator as Engine
    session = read_session(SAMPLES / 'object1')
    options = session.options
    trials = session.trials
    simulator, generator, looks = Engine(), np.random.default_rng(1), []
    for k in range(rounds):
        values = options.space.values(generator.uniform(size=options.space.dimension))
        try:
            physical = options.space.physical(values, trials[0].initial.length)
            simulator.simulate(trials[k % len(trials)], physical)
        except SimulationError:
            pass
        if (k + 1) % (rounds // LOOKS) == 0:
            looks.append((k + 1, resident()))
    return looks


@pytest.fixture(scope='module')
def rows():
    """Collect the rows, and write the table when it is complete."""
    lines = []
    yield lines
    if len(lines) == len(ROUNDS):
        write('memory', 'make bench', 'Rounds (one settled trial) of object 1 with random parameters, in a '
              f'process of their own; resident memory, at {LOOKS} instants. The slope is that of a line '
              f'through those after the first {WARM:.0%} of the rounds.',
              table(['engine', 'rounds', f'MB after {WARM:.0%}', 'MB at the end',
                     'slope, kB per 1000 rounds', 'all rounds, s'], lines))


@pytest.mark.parametrize('engine', ROUNDS)
def test_memory(benchmark, engine, rows):
    with ProcessPoolExecutor(1, get_context('spawn')) as executor:
        looks = np.array(benchmark.pedantic(
            lambda: executor.submit(memory, engine, ROUNDS[engine]).result(), rounds=1))
    warm = looks[looks[:, 0] > WARM * ROUNDS[engine]]
    slope = np.polyfit(warm[:, 0], warm[:, 1], 1)[0]
    rows.append([engine, ROUNDS[engine], f'{warm[0, 1] / 1000:.1f}', f'{warm[-1, 1] / 1000:.1f}',
                 f'{1000 * slope:.1f}', f'{benchmark.stats.stats.max:.0f}'])
