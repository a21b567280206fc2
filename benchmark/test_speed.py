# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Rounds per second and core: `make bench`."""

from pathlib import Path

import pytest

from dlo_calibration.bullet import BulletSimulator
from dlo_calibration.config import Options
from dlo_calibration.session import read_session, session_trials

SAMPLES = Path(__file__).resolve().parent.parent / 'msg_samples'
RESULTS = Path(__file__).resolve().parent / 'results' / 'speed.md'


@pytest.fixture(scope='module')
def rows():
    """Collect the rows of a table, and write it to results/speed.md."""
    found = []
    yield found
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text('# speed\n\n`make bench`: object 1, four trials, one core\n\n'
                       '| nodes | settled rounds per second | microseconds per step |\n|---|---|---|\n'
                       + '\n'.join(found) + '\n')


@pytest.mark.parametrize('nodes', [30, 60, 120])
def test_settled_rounds(benchmark, nodes, rows):
    """A round: one trial of object 1 simulated until it has settled; the four trials in turn."""
    session = read_session(SAMPLES / 'object1')
    options = Options.of(session.options)
    trials, _ = session_trials(session, options)
    simulator = BulletSimulator(nodes=nodes)
    physical = options.space.physical({'flexibility': 66.7, 'friction': 69.7}, trials[0].initial.length)
    steps = sum(simulator.simulate(trial, physical).steps for trial in trials)
    benchmark.pedantic(lambda: [simulator.simulate(trial, physical) for trial in trials], rounds=5)
    seconds = benchmark.stats.stats.median
    benchmark.extra_info['rounds per second'] = round(len(trials) / seconds, 1)
    benchmark.extra_info['microseconds per step'] = round(1e6 * seconds / steps, 1)
    rows.append(f'| {nodes} | {len(trials) / seconds:.1f} | {1e6 * seconds / steps:.0f} |')
    print(f'\n{rows[-1]}')
    simulator.close()
