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

"""
Measure how well `fit` does on known objects and on measured cables, as a user would.

    python benchmark/accuracy.py [reference] [mocap] [hanging] [--evaluations N] [--seed S]

Each figure is what `dlo-calibration fit` and `validate` print for sessions that
convert.py makes; nothing else is computed here but means.  The tables are
printed, and written to benchmark/results/NAME.md.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any

HERE = Path(__file__).resolve().parent
COMMAND = [sys.executable, '-m', 'dlo_calibration']
MOCAP_FIT = '0,1,2,3,4,5,6,7'
MOCAP_OTHER = '42,43,44,45,46,47,48,49,50,51,52,53,54,55'
MOCAP_PARAMETERS = 'flexibility,elasticity,damping,internal_damping'
HANGING_PARAMETERS = 'flexibility'


def convert(kind: str, source: str, output: Path, *arguments: str) -> Path:
    """Make a session with convert.py."""
    subprocess.run([sys.executable, str(HERE / 'convert.py'), kind, source, str(output), *arguments],
                   check=True, stdout=subprocess.DEVNULL)
    return output


def fit(session: Path, output: Path, *arguments: str) -> dict[str, Any]:
    """Return what `fit --json` prints; result.xml is in `output`."""
    return command('fit', str(session), '--output', str(output), *arguments)


def validate(result: Path, session: Path, *arguments: str) -> dict[str, Any]:
    """Return what `validate --json` prints."""
    return command('validate', str(result / 'result.xml'), str(session), *arguments)


def command(*arguments: str) -> dict[str, Any]:
    """Return the JSON document of a verb."""
    done = subprocess.run([*COMMAND, *arguments, '--json'], check=True, stdout=subprocess.PIPE,
                          env={**os.environ, 'PYTHONPATH': str(HERE.parent)})
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def estimate(fitted: dict[str, Any], name: str) -> str:
    """Return one parameter as a cell of a table."""
    found = fitted['parameters'][name]
    text = f'{found["value"]:.1f} ± {found["std"]:.1f}'
    return text if found['identifiable'] else f'({text})'


def reference(folder: Path, options: list[str]) -> str:
    """Tabulate the five reference objects: fitted on four trials, judged on five other actions."""
    from dlo_calibration.parameters import BY_NAME

    data = Path(os.environ.get('DLO_DATA', HERE.parent / '../shared/data'))
    rows = ['| object | fitted mean error, mm | score | other actions mean error, mm | score '
            '| flexibility (truth) | friction (truth) | evaluations | seconds |', '|' + '---|' * 9]
    for name in ('object1', 'object2', 'object3', 'object4', 'object5'):
        properties = json.loads((data / 'reference' / f'{name}.json').read_text())['properties']
        fitted = fit(convert('reference', name, folder / name), folder / f'{name}_fit', *options)
        other = validate(folder / f'{name}_fit',
                         convert('reference', name, folder / f'{name}_other', '--actions', 'other'))
        truth = {'flexibility': BY_NAME['flexibility'].value(properties['EI']),
                 'friction': BY_NAME['friction'].value(properties['mu'])}
        rows.append(
            f'| {name[-1]} | {fitted["mean_error_m"] * 1e3:.2f} | {fitted["score"]:.1f} '
            f'| {other["mean_error_m"] * 1e3:.2f} | {other["score"]:.1f} | '
            + ' | '.join(f'{estimate(fitted, key)} ({value:.1f})' for key, value in truth.items())
            + f' | {fitted["evaluations"]} | {fitted["seconds"]:.0f} |')
    rows += ['', 'The noise of the measured points alone gives a mean error of 1.6 mm. Estimates in '
             'parentheses are reported as not identifiable.']
    return '\n'.join(rows)


def mocap(folder: Path, options: list[str]) -> str:
    """Tabulate cable 2: fitted on 8 recordings, judged on 14 others."""
    fitted = fit(convert('mocap', 'dlo2', folder / 'dlo2', '--recordings', MOCAP_FIT), folder / 'dlo2_fit',
                 '--calibrate', MOCAP_PARAMETERS, *options)
    other = validate(folder / 'dlo2_fit',
                     convert('mocap', 'dlo2', folder / 'dlo2_other', '--recordings', MOCAP_OTHER))
    return table('recordings', fitted, other)


def hanging(folder: Path, options: list[str]) -> str:
    """Tabulate the white wire: fitted on four repeats, judged on the fifth."""
    fitted = fit(convert('hanging', 'white', folder / 'white', '--repeats', '0,1,2,3'), folder / 'white_fit',
                 '--calibrate', HANGING_PARAMETERS, *options)
    other = validate(folder / 'white_fit',
                     convert('hanging', 'white', folder / 'white_other', '--repeats', '4'))
    return table('repeats', fitted, other)


def table(what: str, fitted: dict[str, Any], other: dict[str, Any]) -> str:
    """Tabulate a fit and its validation."""
    rows = [f'| {what} | trials | mean_abs_error_m | mean_error_m | rms_error_m | max_error_m '
            '| error_percent_of_length | seconds |', '|' + '---|' * 8]
    for name, one in (('fitted', fitted), ('other', other)):
        keys = ('mean_abs_error_m', 'mean_error_m', 'rms_error_m', 'max_error_m')
        rows.append(f'| {name} | {one["trials"]} | ' + ' | '.join(f'{one[key]:.5f}' for key in keys)
                    + f' | {one["error_percent_of_length"]:.3f} | {one["seconds"]:.0f} |')
    rows.append('')
    for name, found in fitted['parameters'].items():
        rows.append(f'- {name} {estimate(fitted, name)}: {found["physical_value"]:.3g} '
                    f'{found["physical_unit"]} ({found["physical_lower"]:.3g} to '
                    f'{found["physical_upper"]:.3g})')
    return '\n'.join(rows)


TABLES = {'reference': reference, 'mocap': mocap, 'hanging': hanging}


def main() -> None:
    """Make the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('tables', nargs='*', metavar='TABLE', help=', '.join(TABLES))
    parser.add_argument('--evaluations', default='150')
    parser.add_argument('--seed', default='1')
    arguments = parser.parse_args()
    unknown = set(arguments.tables) - set(TABLES)
    if unknown:
        parser.error(f'unknown table {", ".join(sorted(unknown))}; there are {", ".join(TABLES)}')
    options = ['--search', 'random', '--evaluations', arguments.evaluations, '--seed', arguments.seed]
    for name in arguments.tables or TABLES:
        with tempfile.TemporaryDirectory() as folder:
            text = (f'# {name}\n\n`python benchmark/accuracy.py {name} --evaluations {arguments.evaluations} '
                    f'--seed {arguments.seed}`\n\n{TABLES[name](Path(folder), options)}\n')
        print(text)
        target = HERE / 'results' / f'{name}.md'
        target.parent.mkdir(exist_ok=True)
        target.write_text(text)


if __name__ == '__main__':
    main()
