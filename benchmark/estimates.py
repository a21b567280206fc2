# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Tabulate the parameters that are estimated from the chains alone, for known objects and hanging wires.

    python benchmark/estimates.py

Nothing is simulated.  The table is printed, and written to benchmark/results/estimates.md.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import sys
import tempfile
import time

from accuracy import convert
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from dlo_calibration.files.session import read_session  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace  # noqa: E402
from dlo_calibration.observation.estimate import prior_estimates  # noqa: E402

DATA = Path(os.environ.get('DLO_DATA', HERE.parent / '../shared/data'))
PROPERTIES = {'flexibility': 'EI', 'elasticity': 'EA', 'friction': 'mu', 'self_collision': 'radius'}


def rows(name: str, path: Path, truth: dict[str, float]) -> list[str]:
    """Return the rows of one session; `truth` has physical values by parameter."""
    session = read_session(path)
    options, trials = session.options, session.trials
    space = ParameterSpace(free=tuple(truth), mass=options.mass)
    start = time.perf_counter()
    estimates = prior_estimates(trials, space, options.table_top)
    seconds = time.perf_counter() - start
    table = []
    for key, estimate in estimates.items():
        value = '-' if np.isnan(estimate.value) else f'{estimate.value:.1f}'
        table.append(f'| {name} | {key} | {BY_NAME[key].value(truth[key]):.1f} | {value} '
                     f'| {estimate.lower:.1f} to {estimate.upper:.1f} |')
    print(f'{name}: {seconds * 1e3:.0f} ms')
    return table


def main() -> None:
    """Make the table."""
    table = ['| object | parameter | truth | estimate | range |', '|' + '---|' * 5]
    for k in range(1, 6):
        own = json.loads((DATA / 'reference' / f'object{k}.json').read_text())['properties']
        table += rows(f'object{k}', HERE.parent / 'msg_samples' / f'object{k}',
                      {key: own[letter] for key, letter in PROPERTIES.items()})
    with tempfile.TemporaryDirectory() as folder:
        for name in ('white', 'black'):
            session = Path(folder) / name
            convert('hanging', name, session)
            with np.load(DATA / 'hanging' / f'{name}.npz') as wire:
                published = float(np.median(wire['published_EI']))
            table += rows(f'{name} wire', session, {'flexibility': published})
    text = '\n'.join(['# estimates', '', '`python benchmark/estimates.py`', '',
                      'On the 0..100 scale; truth beyond it counts as its end. Of the wires, the truth is '
                      'the median of the published stiffnesses.', '', *table, ''])
    print(text)
    (HERE / 'results' / 'estimates.md').write_text(text)


if __name__ == '__main__':
    main()
