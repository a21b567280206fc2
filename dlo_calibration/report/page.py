# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Report: what a calibration found, as one HTML page; and all that it tried, as a table."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
import hashlib
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
import platform
import shlex
from typing import Any, Iterable, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.options import declarations, Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError
from dlo_calibration.inference.slices import Slices
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.model.score import PointErrors, residuals, SIMILAR, VERY_SIMILAR
from dlo_calibration.report import sentences
from dlo_calibration.report.figures import (
    convergence_figure,
    correlation_table,
    line_figure,
    plane_figure,
    trial_figure,
)
from dlo_calibration.report.terminal import error_facts

MOST_TRIALS = 12  # that are drawn
VERSIONS = ('dlo_calibration', 'numpy', 'scipy', 'numba', 'pybullet')
CHUNK = 1 << 20  # octets of a file that are hashed at once
MARKS = {IDENTIFIABLE: 'good', WEAK: 'weak', NOT_IDENTIFIABLE: 'bad'}
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 66rem; margin: 1.5rem auto; padding: 0 1rem;
  color: #222; background: #fff; overflow-wrap: break-word; }
h1, h2, h3 { line-height: 1.25; }
h2 { margin-top: 2.5rem; border-bottom: 2px solid #ddd; }
h3 { margin-top: 2rem; }
.note { color: #555; max-width: 50rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; }
td, th { border-bottom: 1px solid #ddd; padding: .3rem .7rem; text-align: left; vertical-align: top; }
small { font-weight: normal; color: #555; }
thead th { border-bottom: 2px solid #999; }
td.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
.cells td, .cells th { border: 1px solid #fff; text-align: center; }
.good, .weak, .bad { padding: .05rem .5rem; border-radius: .6rem; white-space: nowrap; }
.good { background: #d7f0dc; } .weak { background: #fff0c2; } .bad { background: #f9d6d2; }
.warnings { background: #fff6dd; border-left: .3rem solid #e0a800; padding: .5rem 1rem; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); gap: .5rem; }
.chart { width: 100%; max-width: 38rem; height: auto; }
.legend { list-style: none; margin: .2rem 0 1rem; padding: 0; font-size: .85rem; line-height: 1.4; }
.legend li { display: inline-block; margin-right: 1.2rem; padding-left: 34px; text-indent: -34px; }
.legend svg { vertical-align: middle; margin-right: 2px; }
.scale { font-size: .85rem; } .scale span { display: inline-block; width: 5rem; height: .8rem; }
pre { background: #f4f4f4; padding: .7rem; overflow-x: auto; }
.hash { font-family: monospace; overflow-wrap: anywhere; font-size: .85rem; }
nav a { margin-right: 1rem; }
@media print { body { margin: 0; max-width: none; font-size: 11pt; } nav { display: none; }
  pre { white-space: pre-wrap; } .charts, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; } * { print-color-adjust: exact; } }
"""


@dataclass(frozen=True)
class Origin:
    """
    What a calibration began with, so that it can be repeated.

    :param session: name of what the trials were read from.
    :param command: that gives the same result again.
    :param digests: SHA-256 of each file that it was read from, by name.
    :param problems: of the session, in words.
    """

    session: str
    command: str
    options: Options
    digests: Mapping[str, str] = field(default_factory=dict)
    problems: Sequence[str] = ()


def repeating_command(session: str, options: Options) -> str:
    """Return the command that calibrates on a session with the same options."""
    changed = _changed(options)
    return shlex.join(['dlo-calibration', 'fit', session,
                       *(word for name, value in changed.items() for word in as_flags(name, value))])


def digests(paths: Iterable[Path]) -> dict[str, str]:
    """
    Return the SHA-256 of files, by their name without folders.

    :raises OSError: where one cannot be read.
    """
    found = {}
    for path in paths:
        digest = hashlib.sha256()
        with path.open('rb') as stream:
            while octets := stream.read(CHUNK):
                digest.update(octets)
        found[path.name] = digest.hexdigest()
    return found


def write_report(path: Path, result: CalibrationResult, origin: Origin, slices: Slices | None = None) -> None:
    """
    Write the page, which needs no other file and no network.

    :param slices: through what was found; None: left out.
    :raises InputError: where the file cannot be written.
    """
    sections = (
        ('summary', 'In short', _summary(result, origin)),
        ('parameters', 'Parameters', _parameters(result)),
        ('fit', 'How well it fits', _fit(result)),
        ('trials', 'Trials', _trials(result)),
        ('surroundings', 'Around the result', _surroundings(result, slices)),
        ('search', 'The search', _search(result)),
        ('repeat', 'To repeat it', _repeat(result, origin)))
    links = ' '.join(f'<a href="#{key}">{title}</a>' for key, title, _ in sections)
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>Calibration of {escape(origin.session)}</title><style>{STYLE}</style></head><body>'
        f'<h1>Calibration of {escape(origin.session)}</h1>'
        f'<nav aria-label="sections">{links}</nav><main>'
        + ''.join(f'<section id="{key}"><h2>{title}</h2>{body}</section>\n' for key, title, body in sections)
        + '</main></body></html>\n')
    try:
        path.write_text(page, encoding='utf-8')
    except OSError as error:
        raise _unwritable(path, error) from error


def write_evaluations(path: Path, result: CalibrationResult) -> None:
    """
    Write every evaluation as a row of a CSV file: parameters (0..100), scores [cm], error [m].

    :raises InputError: where the file cannot be written.
    """
    names = result.space.free
    trials = [trial.name for trial in result.trials]
    try:
        with path.open('w', newline='', encoding='utf-8') as stream:
            rows = csv.writer(stream)
            rows.writerow(['evaluation', *names, 'score', *(f'score of {name}' for name in trials),
                           'mean_error_m', 'failure'])
            for one in result.evaluations:
                scores = one.scores or [''] * len(trials)
                error = '' if one.errors is None else one.errors.mean
                rows.writerow([one.index + 1, *(one.values[name] for name in names), one.score, *scores,
                               error, one.failure])
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f'file {path}', str(error), 'a place that can be written to',
                      'choose another one with --output')


def _summary(result: CalibrationResult, origin: Origin) -> str:
    length = 1e3 * result.length
    warned = ''.join(f'<li>{escape(text)}</li>' for text in (*result.warnings, *origin.problems))
    return (
        _note(f"""The DLO (deformable linear object: a rope, cable, wire or hose) is {length:.0f}
              mm long. It was observed in {_count(len(result.trials), 'trial')}:
              where it was, what the hands did, and where it was then. The values below make a simulated
              DLO end where the real one did.""")
        + '<ul>' + ''.join(f'<li>{escape(_unit(text))}</li>' for text in sentences.sentences(result))
        + '</ul>'
        + (f'<div class="warnings"><h3>Warnings</h3><ul>{warned}</ul></div>' if warned else ''))


def _parameters(result: CalibrationResult) -> str:
    head = ('parameter', 'value', '90 % interval', 'verdict', 'from 0 to 100', '90 % interval')
    rows = []
    for name, p in result.parameters.items():
        value = sentences.physical_text(p.physical_value, p.physical_unit)
        interval = sentences.interval_text(p.physical_lower, p.physical_upper, p.physical_unit)
        note = f'<br><small>{escape(p.note)}</small>' if p.note else ''
        rows.append(
            f'<tr><th scope="row">{escape(name)}<br><small>{escape(BY_NAME[name].quantity)}</small></th>'
            f'<td class="number">{escape(_unit(value))}</td><td class="number">{escape(_unit(interval))}</td>'
            f'<td><span class="{MARKS.get(p.verdict, "")}">{escape(p.verdict or "-")}</span>{note}</td>'
            f'<td class="number">{p.value:.1f}</td>'
            f'<td class="number">{p.lower:.1f} to {p.upper:.1f}</td></tr>')
    return _note("""Each parameter is a physical quantity, and a place on a logarithmic scale from 0 to
                 100 that is the same for every DLO. The interval holds the true value with 90 %
                 probability. A parameter that is not identifiable could not be told from these trials:
                 do not use its value, but observe an action that shows it.""") + _table(head, rows)


def _fit(result: CalibrationResult) -> str:
    errors, found = result.errors, result.examination
    rows = [('the parameters above', errors.mean)]
    if found is not None:
        rows += [('a trial that is left out of the fit, predicted from the others', found.cross_validated),
                 ('the default parameters', found.default_error),
                 ('the noise of the measured points alone', found.noise * sentences.MEAN_DISTANCE)]
        if found.regular:
            rows.append(('how far simulated points may lie elsewhere, as the parameters are not known '
                         'exactly (one standard deviation)', float(found.band.mean())))
    return (_note('Mean distance between simulated and measured points:')
            + _table((), [f'<tr><td>{escape(words)}</td><td class="number">{1e3 * value:.2f} mm</td></tr>'
                          for words, value in rows if np.isfinite(value)])
            + _note(f"""The difference score below compares the shape and the place of two chains as a
                    whole, in cm, so that it grows with the number of points; below {SIMILAR:g} counts
                    as similar, below {VERY_SIMILAR:g} as very similar.""")
            + _table((), [_row(*fact) for fact in error_facts(result)]))


def _trials(result: CalibrationResult) -> str:
    errors = [PointErrors.of(residuals(trial, chains))
              for trial, chains in zip(result.trials, result.chains, strict=True)]
    rows = [f'<tr><th scope="row">{escape(trial.name)}</th><td class="number">{len(trial.initial)}</td>'
            f'<td class="number">{len(trial.goals)}</td><td class="number">{score:.1f}</td>'
            f'<td class="number">{1e3 * one.mean:.2f}</td><td class="number">{1e3 * one.max:.2f}</td></tr>'
            for trial, score, one in zip(result.trials, result.best.scores, errors, strict=True)]
    head = ('trial', 'points', 'goals', 'difference score [cm]', 'mean error [mm]', 'largest error [mm]')
    worst = sorted(range(len(rows)), key=lambda k: -errors[k].mean)[:MOST_TRIALS]
    left_out = '' if len(worst) == len(rows) else _note(
        f'The {len(worst)} trials with the largest errors are drawn; dlo-calibration plot draws all.')
    return (
        _note("""Dots were measured, lines are simulated with the values above. Errors that follow the
              DLO in long waves come from the model or the recorded hand; ragged ones are noise.""")
        + _table(head, rows) + left_out
        + ''.join(f'<h3>{escape(result.trials[k].name)}</h3>{trial_figure(result, k)}'
                  for k in sorted(worst)))


def _surroundings(result: CalibrationResult, slices: Slices | None) -> str:
    parts = []
    table = correlation_table(result)
    if table:
        parts.append('<h3>Which parameters depend on each other</h3>' + _note(
            """Correlations of the estimates. Near +1 or −1, two parameters do nearly the same to these
            trials: only a combination of them is known.""") + f'<div class="scroll">{table}</div>')
    parts.append('<h3>How the fit worsens away from the result</h3>')
    if slices is None or not slices.lines:
        parts.append(_note('Left out: it could not be simulated in time.'))
        return ''.join(parts)
    parts.append(_note(
        """One parameter varies, the others stay. A deep valley is a parameter that the trials
        determine; a flat line is one that they do not. The search brings the distances of the points to
        a minimum, so that the difference score may be lower elsewhere.""") + line_figure(result, slices))
    for plane in slices.planes:
        one, two = plane.names
        parts.append(f'<h3>{escape(one)} and {escape(two)}</h3>' + _note(
            'Both vary; light fits well. A long slanted valley means that they can make up for each other.')
            + plane_figure(result, plane))
    coarse = '' if slices.complete else '; it is coarse, or lacks a part, as more would have taken too long'
    parts.append(_note(f'{slices.evaluations} more parameter sets were simulated for this{coarse}.'))
    return ''.join(parts)


def _search(result: CalibrationResult) -> str:
    lowest = min(one.score for one in result.evaluations)
    chosen = '' if result.best.score <= lowest else """
        The result is the one whose points are nearest, by the sum of squares, which need not be the one
        with the lowest score."""
    return _note(f'Search {result.search or "-"}: {result.stop_reason}.{chosen}') + convergence_figure(result)


def _repeat(result: CalibrationResult, origin: Origin) -> str:
    seed = '-' if result.seed is None else str(result.seed)
    facts = [_row('seed', seed), _row('engine', result.engine),
             *(_row(name, _version(name)) for name in VERSIONS),
             _row('Python', f'{platform.python_version()}, {platform.system()} {platform.machine()}')]
    facts += [f'<tr><td>SHA-256 of {escape(name)}</td><td class="hash">{text}</td></tr>'
              for name, text in origin.digests.items()]
    changed = _changed(origin.options)
    defaults = Options().flat()
    return (
        f'<pre><code>{escape(origin.command)}</code></pre>' + _table((), facts)
        + ('' if origin.digests else _note(
            """The session is recorded in the folder of this page. It grows until the node ends or forgets its
            trials, so that no SHA-256 can be given here."""))
        + '<h3>Options that differ from the defaults</h3>'
        + (_table(('option', 'value', 'default'),
                  [_row(name, _shown(value), _shown(defaults[name])) for name, value in changed.items()])
           if changed else _note('None.'))
        + '<details><summary>All options</summary>'
        + _table(('option', 'value', 'unit', 'meaning'),
                 [_row(one.name, _shown(origin.options.flat()[one.name]), one.unit, one.description)
                  for one in declarations()]) + '</details>')


def _changed(options: Options) -> dict[str, Any]:
    """Return the options that differ from the defaults."""
    defaults = Options().flat()
    return {name: value for name, value in options.flat().items() if value != defaults[name]}


def as_flags(name: str, value: Any) -> list[str]:
    """Return the words of a command that give an option that value."""
    flag = f'--{name.replace("_", "-")}'
    if isinstance(value, bool):
        return [flag if value else f'--no-{flag[2:]}']
    return [flag, ','.join(value) if isinstance(value, list) else str(value)]


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return 'true' if value else 'false'
    return ' '.join(value) if isinstance(value, list) else str(value)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return 'not installed'


def _unit(text: str) -> str:
    return text.replace('m^2', 'm²')


def _count(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'


def _note(text: str) -> str:
    return f'<p class="note">{escape(" ".join(text.split()))}</p>'


def _row(*cells: str) -> str:
    return f'<tr>{"".join(f"<td>{escape(text)}</td>" for text in cells)}</tr>'


def _table(head: Sequence[str], rows: Iterable[str]) -> str:
    """Return a table of rows that are HTML already; on a narrow page it scrolls."""
    top = ''.join(f'<th scope="col">{escape(text)}</th>' for text in head)
    return (f'<div class="scroll"><table>{f"<thead><tr>{top}</tr></thead>" if top else ""}'
            f'<tbody>{"".join(rows)}</tbody></table></div>')
