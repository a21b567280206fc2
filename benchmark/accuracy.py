# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure the accuracy of `fit` on known objects and on measured cables, with the commands of a user.

    python benchmark/accuracy.py [TABLE ...] [--search NAME] [--evaluations N] [--seed S]

`dlo-calibration fit` and `validate` print each figure, for sessions that convert.py
makes; this program computes only means, and medians over trials: a few recordings are chaotic, so that
errors in them say little about a fit.  The tables are printed, and written to benchmark/results/NAME.md.
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

import numpy as np

HERE = Path(__file__).resolve().parent
COMMAND = [sys.executable, '-m', 'dlo_calibration']
MOCAP_FIT = '0,8,16,24,32,40,48,54'  # spread over the session, because the choice matters
#: Other recordings that a user might have made.
MOCAP_AGAIN = ('2,10,18,26,34,42,50,55', '5,13,21,28,37,45,51,53', '1,12,22,31,38,46,49,52')
MOCAP_OTHER = '42,43,44,45,46,47,49,50,51,52,53,55'
WIRE = 1.5  # m
CABLES = ('dlo1', 'dlo2', 'dlo3')
ENVIRONMENT = {**os.environ, 'PYTHONPATH': str(HERE.parent)}


def convert(kind: str, source: str, output: Path, *arguments: str) -> Path:
    """Make a session with convert.py."""
    subprocess.run([sys.executable, str(HERE / 'convert.py'), kind, source, str(output), *arguments],
                   check=True, stdout=subprocess.DEVNULL, env=ENVIRONMENT)
    return output


def fit(session: Path, output: Path, *arguments: str) -> dict[str, Any]:
    """Return what `fit --json` prints; result.xml is in `output`."""
    return command('fit', str(session), '--output', str(output), *arguments)


def validate(result: Path, session: Path, *arguments: str) -> dict[str, Any]:
    """Return what `validate --json` prints."""
    return command('validate', str(result / 'result.xml'), str(session), *arguments)


def command(*arguments: str) -> dict[str, Any]:
    """Return the JSON document that a verb prints."""
    done = subprocess.run([*COMMAND, *arguments, '--json'], check=True, stdout=subprocess.PIPE,
                          env=ENVIRONMENT)
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def median(result: Path, session: Path) -> float:
    """Return the median over the trials of a session of their mean absolute error [m]."""
    from dlo_calibration.evaluation.residuals import ResidualLayout
    from dlo_calibration.files.result import read_result
    from dlo_calibration.files.session import read_session, session_trials
    from dlo_calibration.workspace.validation import validated

    read = read_session(session)
    trials, _ = session_trials(read, read.options)
    simulated = validated(read_result(result / 'result.xml'), trials, read.options)
    residuals = simulated.best.residuals
    assert residuals is not None
    return float(np.median([np.abs(residuals[rows]).mean()
                            for rows in ResidualLayout.of(simulated.trials).rows]))


def estimate(fitted: dict[str, Any], name: str) -> str:
    """Return one parameter as a cell of a table."""
    parameter = fitted['parameters'][name]
    text = f'{parameter["value"]:.1f} ± {parameter["std"]:.1f}'
    return text if parameter['identifiable'] else f'({text})'


def reference(folder: Path, options: list[str]) -> str:
    """Tabulate the five reference objects: fitted on four trials, judged on five other actions."""
    from dlo_calibration.model.parameters import BY_NAME

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
    """Tabulate three cables: fitted on 8 recordings, judged on 12 others and on all 48 others."""
    parts = []
    for cable in CABLES:
        session = convert('mocap', cable, folder / cable, '--recordings', MOCAP_FIT)
        fitted = fit(session, folder / f'{cable}_fit', *options)
        judged = {'fitted': (session, fitted)}
        for name, chosen in (('12 others', MOCAP_OTHER), ('all others', all_but(MOCAP_FIT))):
            unseen = convert('mocap', cable, folder / f'{cable}_{name}', '--recordings', chosen)
            judged[name] = unseen, validate(folder / f'{cable}_fit', unseen)
        parts.append(f'## {cable}\n\n{table("recordings", folder / f"{cable}_fit", judged)}')
    return '\n\n'.join(parts)


def mocap_again(folder: Path, options: list[str]) -> str:
    """Tabulate the three cables, fitted on other choices of 8 recordings, judged on all others."""
    rows = ['| cable | recordings | fitted mean_abs_error_m | that of all others | its median over them '
            '| seconds |', '|' + '---|' * 6]
    for cable in CABLES:
        for k, chosen in enumerate(MOCAP_AGAIN):
            result = folder / f'{cable}_{k}_fit'
            session = convert('mocap', cable, folder / f'{cable}_{k}', '--recordings', chosen)
            fitted = fit(session, result, *options)
            unseen = convert('mocap', cable, folder / f'{cable}_{k}_others', '--recordings', all_but(chosen))
            errors = (fitted['mean_abs_error_m'], validate(result, unseen)['mean_abs_error_m'],
                      median(result, unseen))
            rows.append(f'| {cable} | {chosen} | ' + ' | '.join(f'{error:.5f}' for error in errors)
                        + f' | {fitted["seconds"]:.0f} |')
    return '\n'.join(rows)


def all_but(chosen: str) -> str:
    """Return the recordings of a cable that are not chosen."""
    return ','.join(str(index) for index in range(56) if str(index) not in chosen.split(','))


def hanging(folder: Path, options: list[str]) -> str:
    """Tabulate two wires: fitted on four repeats, judged on the fifth; and EI fitted on each repeat alone."""
    sections = []
    for wire in ('white', 'black'):
        session = convert('hanging', wire, folder / wire, '--repeats', '0,1,2,3')
        last = convert('hanging', wire, folder / f'{wire}_other', '--repeats', '4')
        fitted = fit(session, folder / f'{wire}_fit', *options)
        other = validate(folder / f'{wire}_fit', last)
        judged = {'fitted': (session, fitted), 'other': (last, other)}
        percents = [100 * document['rms_error_m'] / WIRE for document in (fitted, other)]
        stiffness = []
        for repeat in '01234':
            session = convert('hanging', wire, folder / f'{wire}_{repeat}', '--repeats', repeat)
            single = fit(session, folder / f'{wire}_{repeat}_fit', *options)
            stiffness.append(single['parameters']['flexibility']['physical_value'])
        spread = 100 * float(np.std(stiffness) / np.mean(stiffness))
        sections.append(
            f'## {wire}\n\n{table("repeats", folder / f"{wire}_fit", judged)}\n\n'
            f'Root mean square in percent of the length, fitted and predicted: {percents[0]:.2f} and '
            f'{percents[1]:.2f}. EI of each repeat by itself: '
            + ', '.join(f'{value:.3g}' for value in stiffness)
            + f' N m^2, standard deviation {spread:.0f} %.')
    return '\n\n'.join(sections)


def table(what: str, result: Path, judged: dict[str, tuple[Path, dict[str, Any]]]) -> str:
    """
    Tabulate how a fit does on several sets of trials.

    :param result: the folder of the fit.
    :param judged: name of each set -> its session, and what `fit` or `validate` said; the fitted one first.
    """
    rows = [f'| {what} | trials | mean_abs_error_m | its median over {what} | mean_error_m | rms_error_m '
            '| max_error_m | error_percent_of_length | seconds |', '|' + '---|' * 9]
    for name, (session, document) in judged.items():
        errors = [document['mean_abs_error_m'], median(result, session),
                  *(document[key] for key in ('mean_error_m', 'rms_error_m', 'max_error_m'))]
        rows.append(f'| {name} | {document["trials"]} | ' + ' | '.join(f'{error:.5f}' for error in errors)
                    + f' | {document["error_percent_of_length"]:.3f} | {document["seconds"]:.0f} |')
    fitted = next(iter(judged.values()))[1]
    rows.append('')
    for name, parameter in fitted['parameters'].items():
        rows.append(f'- {name} {estimate(fitted, name)}: {parameter["physical_value"]:.3g} '
                    f'{parameter["physical_unit"]} ({parameter["physical_lower"]:.3g} to '
                    f'{parameter["physical_upper"]:.3g})')
    return '\n'.join(rows)


TABLES = {'reference': reference, 'mocap': mocap, 'hanging': hanging, 'mocap_again': mocap_again}


def main() -> None:
    """Make the tables that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('tables', nargs='*', metavar='TABLE', help=', '.join(TABLES))
    for name in ('--search', '--evaluations', '--seed'):
        parser.add_argument(name, help='as of fit (default: its default)')
    arguments = parser.parse_args()
    unknown = set(arguments.tables) - set(TABLES)
    if unknown:
        parser.error(f'unknown table {", ".join(sorted(unknown))}; there are {", ".join(TABLES)}')
    options = [word for name in ('search', 'evaluations', 'seed') if getattr(arguments, name) is not None
               for word in (f'--{name}', getattr(arguments, name))]
    for name in arguments.tables or TABLES:
        with tempfile.TemporaryDirectory() as folder:
            command = ' '.join(['python benchmark/accuracy.py', name, *options])
            text = f'# {name}\n\n`{command}`\n\n{TABLES[name](Path(folder), options)}\n'
        print(text)
        target = HERE / 'results' / f'{name}.md'
        target.parent.mkdir(exist_ok=True)
        target.write_text(text)


if __name__ == '__main__':
    main()
