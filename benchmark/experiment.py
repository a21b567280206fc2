# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Repeat the paper's experiment on the reference objects, judged by five actions that the samples lack.

    python benchmark/experiment.py [--runs N] [--output DIR]

The sessions are made from the measured data, which DLO_DATA names.  Calibrations that are
already in DIR are not repeated.  The tables are written to benchmark/results/experiment_other.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import subprocess
import sys
import tempfile

from accuracy import convert, ENVIRONMENT

HERE = Path(__file__).resolve().parent
#: The trials of a session of the other actions, as convert.py orders them.
OTHER = ('place_middle', 'hold_end', 'place_three_quarters', 'drag_end', 'fold')
OBJECTS = tuple(f'object{k}' for k in range(1, 6))


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', default='20')
    parser.add_argument('--output', type=Path, default=Path('build/experiment_other'))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        fitted = [convert('reference', name, folder / name) for name in OBJECTS]
        other = [convert('reference', name, folder / f'{name}_other', '--actions', ','.join(OTHER))
                 for name in OBJECTS]
        done = subprocess.run(
            [sys.executable, '-m', 'dlo_calibration', 'experiment', *map(str, fitted), '--validate-on',
             *map(str, other), '--runs', arguments.runs, '--output', str(arguments.output)],
            check=True, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    text = done.stdout.replace(f'{folder}/', '')
    print(text)
    command = (f'Trials 1 to 5: {", ".join(OTHER)}.  Made by `python benchmark/experiment.py '
               f'--runs {arguments.runs}`, which does')
    (HERE / 'results' / 'experiment_other.md').write_text(
        text.replace('# Consistency and validity\n',
                     f'# Consistency and validity, judged by five other actions\n\n{command}\n', 1))


if __name__ == '__main__':
    main()
