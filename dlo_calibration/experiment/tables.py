# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tables: an experiment as Markdown, CSV and plain values, and a picture of its parameters."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Iterable, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.result import with_nulls
from dlo_calibration.experiment.study import Outcome, Task
from dlo_calibration.experiment.summary import complete_runs, Findings, Spread
from dlo_calibration.model.parameters import knot_names, KNOTS, measured, number
from dlo_calibration.model.score import SIMILAR, VERY_SIMILAR
from dlo_calibration.report.figure import (
    as_text,
    blank_figure,
    BLUE,
    GREEN,
    legend_outside,
    PURPLE,
    write_figure,
    YELLOW,
)

#: Tables 1 and 2 of the paper (Alvarez, Yamazaki and Matsubara, SIMPAR 2016), by the sample that resembles
#: the object: average and standard deviation over 20 runs of each parameter (0..100), and of the score [cm].
PAPER_CONSISTENCY: Mapping[str, Mapping[str, tuple[float, float]]] = {
    'object1': {'flexibility': (68.75, 17.38), 'elasticity': (49.55, 13.88), 'friction': (33.85, 20.02),
                'self_collision': (52.35, 20.01)},
    'object2': {'flexibility': (65.15, 19.02), 'elasticity': (20.45, 13.94), 'friction': (53.65, 27.48),
                'self_collision': (38.3, 16.41)},
    'object3': {'flexibility': (75.45, 18.65), 'elasticity': (31.25, 10.82), 'friction': (37.75, 27.91),
                'self_collision': (57.8, 22.87)},
    'object4': {'flexibility': (43.8, 18.65), 'elasticity': (88.55, 1.5), 'friction': (48.05, 26.82),
                'self_collision': (37.35, 23.06)},
    'object5': {'flexibility': (48.35, 17.89), 'elasticity': (28.85, 20.09), 'friction': (52.15, 22.82),
                'self_collision': (88.35, 14.98)},
}
PAPER_VALIDITY: Mapping[str, tuple[float, float]] = {
    'object1': (24.96, 1.33), 'object2': (23.9, 2.73), 'object3': (24.34, 0.62), 'object4': (32.25, 3.46),
    'object5': (53.39, 1.12)}
COLOURS = (BLUE, YELLOW, GREEN, PURPLE)  # of searches, in turn


@dataclass(frozen=True)
class Account:
    """
    The content of the tables of an experiment.

    :param findings: one for each object and search.
    :param command: the command that repeats it.
    :param engine: name of the simulator.
    :param runs: requested number of runs of each object and search.
    :param evaluations: largest number in a calibration, by search.
    :param samples: whether the objects are the package's samples, which resemble the paper's.
    :param complete: whether all runs are done.
    """

    findings: tuple[Findings, ...]
    command: str
    engine: str
    runs: int
    evaluations: Mapping[str, int]
    samples: bool
    complete: bool

    @property
    def searches(self) -> tuple[str, ...]:
        """Names of the searches."""
        return tuple(dict.fromkeys(result.search for result in self.findings))


def document(account: Account) -> dict[str, Any]:
    """Return the account as plain values."""
    paper = {'consistency': PAPER_CONSISTENCY, 'validity': PAPER_VALIDITY} if account.samples else None
    return {'command': account.command, 'engine': account.engine, 'runs': account.runs,
            'evaluations': dict(account.evaluations), 'complete': account.complete,
            'paper': with_nulls(paper),
            'findings': with_nulls([asdict(result) for result in account.findings])}


def markdown(account: Account) -> str:
    """Return the account as Markdown."""
    parts = [
        '# Consistency and validity', f'`{account.command}`',
        f'{account.runs} runs of each object and search, each with its own random seed; engine '
        f'{account.engine}. A calibration has at most '
        f'{", ".join(f"{count} evaluations ({search})" for search, count in account.evaluations.items())}.']
    if not account.complete:
        parts.append('**Not complete**: the tables show the runs that are done; '
                     'the same command continues with the others.')
    parts += ['## Consistency', 'Average and standard deviation of each parameter over the runs, on the '
              'scale from 0 to 100, calibrated on all trials.  *Italic*: the trials do not inform about this '
              'parameter, so it keeps its default; if a number of runs is given, they do in these runs only.']
    if any(name in knot_names(KNOTS[-1]) for result in account.findings for name in result.parameters):
        parts.append('The components of rest shapes are in `consistency.csv`.')
    if account.samples:
        parts.append('The paper has figures of the objects that the samples resemble.  Its scales are those '
                     'of its own simulator: compare the standard deviations, but not the averages.')
    for search in account.searches:
        results = [result for result in account.findings if result.search == search]
        parts += [f'### {search}', _consistency(results, PAPER_CONSISTENCY if account.samples else {})]
    parts += ['## Validity', 'Average and standard deviation, over the runs, of the difference score of '
              'actions that were not calibrated on, and of their point error.  '
              f'A score below {SIMILAR:g} is similar, and below {VERY_SIMILAR:g} very similar (**bold**).  '
              'Seconds: one calibration on all trials, on one thread.', _validity(account)]
    if any(result.actions for result in account.findings):
        parts += ['Difference score of each action by itself:', _actions(account)]
    return '\n\n'.join(parts) + '\n'


def consistency_csv(account: Account) -> str:
    """Return a row for each object, search and parameter."""
    return csv_text(('object', 'search', 'parameter', 'runs', 'mean', 'std', 'runs_that_told_anything'), (
        (result.subject, result.search, name, spread.count, spread.mean, spread.std, result.informed[name])
        for result in account.findings for name, spread in result.parameters.items()))


def validity_csv(account: Account) -> str:
    """Return a row for each object and search, then one for each of their actions."""
    rows: list[tuple[Any, ...]] = []
    for result in account.findings:
        rows.append((result.subject, result.search, 'all', result.runs, _mean(result.score),
                     _std(result.score), _mean(result.error), _std(result.error), _mean(result.share),
                     _std(result.share), result.very_similar, _mean(result.evaluations),
                     _mean(result.seconds), result.failures))
        rows += [(result.subject, result.search, name, spread.count, spread.mean, spread.std)
                 for name, spread in result.actions.items()]
    return csv_text(('object', 'search', 'action', 'runs', 'score_mean_cm', 'score_std_cm', 'error_mean_m',
                 'error_std_m', 'error_mean_percent', 'error_std_percent', 'very_similar_runs', 'evaluations',
                 'seconds', 'failures'), rows)


def runs_csv(done: Sequence[tuple[Task, Outcome]]) -> str:
    """Return a row for each calibration."""
    names = list(dict.fromkeys(name for task, _ in done for name in task.options.space.free))
    rows = []
    for task, outcome in done:
        scores = [judged.score for judged in outcome.judgements]
        rows.append((
            task.subject.name, task.search, task.seed, '' if task.left_out is None else task.left_out + 1,
            *(outcome.values.get(name) for name in names), outcome.score, outcome.error,
            ' '.join('failed' if score is None else repr(score) for score in scores),
            ' '.join('failed' if judged.error is None else repr(judged.error)
                     for judged in outcome.judgements),
            outcome.evaluations, outcome.simulations, outcome.seconds, outcome.failure))
    return csv_text(('object', 'search', 'seed', 'left_out_trial', *names, 'score_cm', 'error_m',
                 'held_back_scores_cm', 'held_back_errors_m', 'evaluations', 'simulations', 'seconds',
                 'failure'), rows)


def scatter_picture(done: Sequence[Sequence[tuple[Task, Outcome]]], path: Path) -> None:
    """
    Draw the parameters of each run, with the searches beside each other.

    :param done: one group of calibrations for each object and search.
    :raises InputError: if the file cannot be written.
    """
    subjects = list(dict.fromkeys(group[0][0].subject.name for group in done))
    searches = list(dict.fromkeys(group[0][0].search for group in done))
    names = _in_tables(name for group in done for name in group[0][0].options.space.free)
    figure = blank_figure(max(7.0, 2.0 + 2.0 * len(subjects)), 1.0 + 2.4 * len(names))
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for group in done:
        task = group[0][0]
        which = searches.index(task.search)
        whole = [outcome for run in complete_runs(group) for each, outcome in run
                 if each.left_out is None and not outcome.failure]
        middle = subjects.index(task.subject.name) + (which - (len(searches) - 1) / 2) * 0.8 / len(searches)
        places = middle + np.linspace(-0.3, 0.3, len(whole)) / len(searches)
        for name, axes in zip(names, rows, strict=True):
            for place, outcome in zip(places, whole, strict=True):
                if name in outcome.values:
                    informed = name in outcome.excited
                    axes.plot(place, outcome.values[name], 'o' if informed else 'x', markersize=4, alpha=0.8,
                              color=COLOURS[which % len(COLOURS)] if informed else '0.6')
    for name, axes in zip(names, rows, strict=True):
        axes.set(ylabel=f'{name} [0..100]', ylim=(-3, 103))
        axes.grid(axis='y', alpha=0.3)
    rows[-1].set_xticks(range(len(subjects)), [as_text(subject) for subject in subjects])
    rows[-1].set_xlim(-0.6, len(subjects) - 0.4)
    for which, search in enumerate(searches):
        rows[0].plot([], [], 'o', color=COLOURS[which % len(COLOURS)], label=search)
    rows[0].plot([], [], 'x', color='0.6', label='default, as the trials do not inform about it')
    legend_outside(figure, 'upper center', ncols=len(searches) + 1)
    write_figure(figure, path)


def _consistency(findings: Sequence[Findings],
                 paper: Mapping[str, Mapping[str, tuple[float, float]]]) -> str:
    names = _in_tables(name for result in findings for name in result.parameters)
    rows: list[list[str]] = []
    for result in findings:
        average, deviation = [result.subject, 'average'], ['', 'standard deviation']
        for name in names:
            spread = result.parameters.get(name)
            informed = result.informed.get(name, 0)
            mean, std = number(_mean(spread)), number(_std(spread))
            if spread and not informed:
                mean, std = f'*{mean}*', f'*{std}*'
            elif spread and informed < spread.count:
                mean = f'{mean} *(in {informed} of {spread.count} runs)*'
            average.append(mean)
            deviation.append(std)
        rows += [average, deviation]
        theirs = paper.get(result.subject)
        if theirs:
            rows += [['', f'{word} in the paper', *(
                f'{theirs[name][k]:g}' if name in theirs else '-' for name in names)]
                for k, word in enumerate(('average', 'standard deviation'))]
    return markdown_table(('object', '', *names), rows)


def _in_tables(names: Iterable[str]) -> list[str]:
    """Return each name once, without the many components of rest shapes, which the CSV has."""
    return [name for name in dict.fromkeys(names) if name not in knot_names(KNOTS[-1])]


def _validity(account: Account) -> str:
    head = ['object', 'search', 'score, average', 'standard deviation', 'very similar', 'worst action',
            'mean error', 'standard deviation', '% of length', 'fitted trials', 'evaluations',
            'seconds']
    rows = []
    for result in account.findings:
        score, count = _mean(result.score), result.score.count if result.score else 0
        shown = number(score)
        rows.append([
            result.subject, result.search,
            f'**{shown}**' if score is not None and score < VERY_SIMILAR else shown,
            number(_std(result.score)), f'{result.very_similar} of {count} runs', number(result.worst),
            measured(_mean(result.error), 'm'), measured(_std(result.error), 'm'),
            number(_mean(result.share)), measured(_mean(result.fitted), 'm'),
            number(_mean(result.evaluations)), number(_mean(result.seconds))])
    if account.samples:
        head.append('score in the paper')
        for row in rows:
            theirs = PAPER_VALIDITY.get(row[0])
            row.append(f'{theirs[0]:g} ± {theirs[1]:g}' if theirs else '-')
    if any(result.failures for result in account.findings):
        head.append('failed')
        for row, result in zip(rows, account.findings, strict=True):
            row.append(str(result.failures))
    return markdown_table(head, rows)


def _actions(account: Account) -> str:
    names = list(dict.fromkeys(name for result in account.findings for name in result.actions))
    return markdown_table(('object', 'search', *names), (
        (result.subject, result.search, *(_both(result.actions.get(name)) for name in names))
        for result in account.findings))


def _both(spread: Spread | None) -> str:
    return '-' if spread is None else f'{number(spread.mean)} ± {number(spread.std)}'


def _mean(spread: Spread | None) -> float | None:
    return None if spread is None else spread.mean


def _std(spread: Spread | None) -> float | None:
    return None if spread is None else spread.std


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = (head, ['---'] * len(head), *rows)
    return '\n'.join(f'| {" | ".join(cell.replace("|", chr(92) + "|") for cell in row)} |' for row in lines)


def csv_text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as comma-separated values; short rows end with empty cells."""
    stream = StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(head)
    writer.writerows([*row, *[''] * (len(head) - len(row))] for row in rows)
    return stream.getvalue()
