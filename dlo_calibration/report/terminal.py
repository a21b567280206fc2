# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Terminal: progress bars and tables for people; everything goes to the stream that is given."""

from __future__ import annotations

from typing import Any, Iterable, Mapping, Sequence, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.model.score import SIMILAR, VERY_SIMILAR
from dlo_calibration.report import sentences

WIDTH = 110  # columns where the output is not a terminal


def console(stream: TextIO) -> Console:
    """Return a console on `stream` that wraps no line of a table in a file or a pipe."""
    return Console(file=stream, width=None if stream.isatty() else WIDTH, highlight=False)


class SearchBar:
    """
    A progress bar on a terminal; elsewhere nothing is shown.

    :param total: evaluations at most.
    :param shown: False: never, whatever the stream is.
    """

    def __init__(self, total: int, stream: TextIO, shown: bool = True) -> None:
        self._progress = Progress(
            TextColumn('calibrating'), BarColumn(), MofNCompleteColumn(),
            TextColumn('best score {task.fields[best]}'), TimeRemainingColumn(),
            console=console(stream), disable=not (shown and stream.isatty()))
        self._task = self._progress.add_task('', total=total, best='-')
        self._best = float('inf')

    def __enter__(self) -> SearchBar:
        """Show it."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave it as it is."""
        self._progress.stop()

    def take(self, evaluation: Evaluation) -> None:
        """Go on by one evaluation."""
        self.move(evaluation.index + 1, min(self._best, evaluation.score))

    def move(self, count: int, best: float) -> None:
        """Show that `count` evaluations were tried, and the best score of them."""
        self._best = best
        self._progress.update(self._task, completed=count, best=f'{best:.1f}' if best < float('inf') else '-')


class TaskBar:
    """
    A progress bar with the time left, on a terminal; elsewhere nothing is shown.

    :param what: is counted.
    :param done: how many of the `total` are done already.
    """

    def __init__(self, what: str, total: int, done: int, stream: TextIO) -> None:
        self.shown = stream.isatty()
        self._progress = Progress(
            TextColumn(escape(what)), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            console=console(stream), disable=not self.shown)
        self._task = self._progress.add_task('', total=total, completed=done)

    def __enter__(self) -> TaskBar:
        """Show it."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave it as it is."""
        self._progress.stop()

    def advance(self) -> None:
        """Count one more."""
        self._progress.advance(self._task)


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as people read it; a dash for none."""
    return '-' if value is None else f'{value:.{digits}g}'


def parameter_table(parameters: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table of parameters in both units; rows as in the JSON document."""
    table = Table(title='parameters')
    for title in ('parameter', '0..100', '90 % interval', 'physical', '90 % interval', 'unit', 'verdict'):
        table.add_column(title, justify='left' if title in ('parameter', 'unit', 'verdict') else 'right')
    for name, row in parameters.items():
        table.add_row(
            escape(name), f"{row['value']:.1f}", f"{row['lower']:.1f} .. {row['upper']:.1f}",
            number(row['physical_value']),
            f"{number(row['physical_lower'], 2)} .. {number(row['physical_upper'], 2)}",
            escape(row['physical_unit']), row['verdict'])
    return table


def facts_table(title: str, facts: Iterable[tuple[str, str]]) -> Table:
    """Return a table of two columns."""
    table = Table(title=title, show_header=False)
    for fact in facts:
        table.add_row(*(escape(text) for text in fact))
    return table


def rows_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table with a heading."""
    table = Table(title=title)
    for text in head:
        table.add_column(text)
    for row in rows:
        table.add_row(*(escape(text) for text in row))
    return table


def error_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return how well the simulated chains fit, and how that was found, in words."""
    errors = result.errors
    return [
        ('difference score', f'{result.best.score:.1f} cm (below {SIMILAR:g}: similar, '
                             f'below {VERY_SIMILAR:g}: very similar)'),
        ('mean error', f'{errors.mean * 1e3:.2f} mm '
                       f'({100 * errors.mean / result.length:.2f} % of the length)'),
        ('rms / max error', f'{errors.rms * 1e3:.2f} / {errors.max * 1e3:.2f} mm'),
        ('trials', str(len(result.trials))),
        ('evaluations', f'{len(result.evaluations)} ({result.simulations} simulations) '
                        f'in {result.seconds:.1f} s'),
        ('search', f'{result.search or "-"}, seed {"-" if result.seed is None else result.seed}'),
        ('engine', result.engine),
        *_confirmation_facts(result),
        ('ended', result.stop_reason),
    ]


def _confirmation_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return what a second engine gave for the same parameters, if one was asked."""
    other = result.confirmation
    if other is None:
        return []
    return [(f'confirmed by {other.engine}',
             f'difference score {other.score:.1f} cm, mean error {other.errors.mean * 1e3:.2f} mm; '
             f'points {other.mean_distance * 1e3:.2f} mm from those of {result.engine}, '
             f'{other.max_distance * 1e3:.2f} mm at most')]


def print_result(result: CalibrationResult, parameters: Mapping[str, Mapping[str, Any]],
                 stream: TextIO) -> None:
    """Print tables of the parameters and of the errors, and what the trials could not tell."""
    out = console(stream)
    out.print(parameter_table(parameters))
    out.print(facts_table('fit', error_facts(result)))
    for sentence in sentences.sentences(result):
        out.print(escape(sentence))


def print_info(about: Mapping[str, Any], stream: TextIO) -> None:
    """Print what is in a session: the JSON document of `info` as tables."""
    out = console(stream)
    out.print(facts_table(about['session'], [
        ('trials', str(len(about['trials']))),
        ('duration', f"{about['duration_s']:.1f} s"),
        ('frame', ', '.join(map(repr, about['frames'])) or '-'),
        *((topic, f'{count} messages') for topic, count in about['messages'].items()),
    ]))
    if about['trials']:
        head = ('name', 'points', 'length', 'hands', 'goals', 'duration', 'annotated')
        out.print(rows_table('trials', head, [
            (trial['name'], str(trial['points']), f"{trial['length_m']:.3f} m",
             ', '.join(f"{hand['name']} (points {' '.join(map(str, hand['grips']))})"
                       for hand in trial['hands']),
             f"{trial['stable_goals']} stable, {trial['timed_goals']} timed", f"{trial['duration_s']:.2f} s",
             ', '.join(word for word, there in (
                 ('hands', trial['annotated_hands']),
                 (f"{trial['annotated_features']} features", trial['annotated_features'])) if there) or '-')
            for trial in about['trials']]))
    for title in ('refusals', 'problems'):
        for text in about[title]:
            out.print(escape(f'{title[:-1]}: {text}'))
