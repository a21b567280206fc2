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


"""Report: what a calibration found, as one HTML page; and all that it tried, as a table."""

from __future__ import annotations

import base64
import csv
from html import escape
from pathlib import Path
from typing import Iterable, Sequence

import numpy as np

from dlo_calibration import findings
from dlo_calibration.calibration import CalibrationResult
from dlo_calibration.errors import InputError
from dlo_calibration.picture import trial_png
from dlo_calibration.terminal import error_facts, number

STYLE = """
body { font-family: sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { border-bottom: 1px solid #ccc; padding: .3em .8em; text-align: left; }
img { max-width: 100%; }
code { background: #f3f3f3; padding: .2em .4em; }
"""


def write_report(path: Path, result: CalibrationResult, command: str, problems: Sequence[str] = ()) -> None:
    """
    Write the page.

    :param command: that gives the same result again.
    :param problems: of the session, in words.
    :raises InputError: where the file cannot be written.
    """
    pictures = ''.join(
        f'<h3>{escape(trial.name)}, score {score:.1f}</h3><img alt="{escape(trial.name)}" '
        f'src="data:image/png;base64,{base64.b64encode(trial_png(trial, chains)).decode()}">'
        for trial, chains, score in zip(result.trials, result.chains, result.best.scores, strict=True))
    words = [*findings.sentences(result), *(f'warning: {text}' for text in result.warnings), *problems]
    page = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>calibration</title>'
        f'<style>{STYLE}</style></head><body><h1>Calibration</h1>'
        + _table(('parameter', '0..100', '90 % interval', 'physical', '90 % interval', 'unit', 'verdict'), (
            (name, f'{p.value:.1f}', f'{p.lower:.1f} to {p.upper:.1f}', number(p.physical_value),
             f'{number(p.physical_lower)} to {number(p.physical_upper)}', p.physical_unit,
             p.verdict) for name, p in result.parameters.items()))
        + ''.join(f'<p>{escape(text)}</p>' for text in words)
        + '<h2>Fit</h2>' + _table((), error_facts(result)) + '<h2>Trials</h2>' + pictures
        + f'<h2>To repeat it</h2><p><code>{escape(command)}</code></p></body></html>\n')
    try:
        path.write_text(page, encoding='utf-8')
    except OSError as error:
        raise InputError(f'file {path}', str(error), 'a place that can be written to',
                         'choose another one with --output') from error


def write_evaluations(path: Path, result: CalibrationResult) -> None:
    """
    Write every evaluation as a row of a CSV file: parameters (0..100), scores [cm], error [m].

    A trial that was skipped has no score; the score of an abandoned evaluation is a lower bound.

    :raises InputError: where the file cannot be written.
    """
    names = result.space.free
    trials = [trial.name for trial in result.trials]
    try:
        with path.open('w', newline='', encoding='utf-8') as stream:
            rows = csv.writer(stream)
            rows.writerow(['evaluation', *names, 'score', *(f'score of {name}' for name in trials),
                           'mean_error_m', 'failure', 'skipped_trials'])
            for one in result.evaluations:
                scores = ['' if np.isnan(score) else score for score in one.scores] or [''] * len(trials)
                error = '' if one.errors is None else one.errors.mean
                rows.writerow([one.index + 1, *(one.values[name] for name in names), one.score, *scores,
                               error, one.failure, one.skipped])
    except OSError as error:
        raise InputError(f'file {path}', str(error), 'a place that can be written to',
                         'choose another one with --output') from error


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    top = ''.join(f'<th>{escape(text)}</th>' for text in head)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(text)}</td>' for text in row) + '</tr>' for row in rows)
    return f'<table>{f"<tr>{top}</tr>" if top else ""}{body}</table>'
