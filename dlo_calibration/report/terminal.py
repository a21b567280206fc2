# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Terminal: progress bars and tables for people; everything goes to the stream that is given."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, Iterable, Mapping, Sequence, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from dlo_calibration.calibration.plain import plain
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.model.quantity import interval, measured, number
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
        self._progress.update(self._task, completed=count, best=number(best))


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


def parameter_table(parameters: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table of parameters in both units; rows as in the plain values of a result."""
    table = Table(title='parameters')
    for title in ('parameter', '0..100', '90 % interval', 'physical', '90 % interval', 'verdict'):
        table.add_column(title, justify='left' if title in ('parameter', 'verdict') else 'right')
    for name, row in parameters.items():
        unit = row['physical_unit']
        table.add_row(
            escape(name), number(row['value']), interval(row['lower'], row['upper'], '1'),
            escape(measured(row['physical_value'], unit)),
            escape(interval(row['physical_lower'], row['physical_upper'], unit)), row['verdict'])
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


def fit_facts(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return how well the simulated chains fit, and how that was found, from the plain values of a result."""
    facts = [
        ('difference score', f'{number(told["score"])} cm (below {SIMILAR:g}: similar, '
                             f'below {VERY_SIMILAR:g}: very similar)'),
        ('mean error', f'{measured(told["mean_error_m"], "m")} '
                       f'({number(told["error_percent_of_length"])} % of the length)'),
        ('rms error', measured(told['rms_error_m'], 'm')),
        ('largest error', measured(told['max_error_m'], 'm')),
        ('trials', str(told['trials'])),
        ('evaluations', f'{told["evaluations"]} ({told["simulations"]} simulations) '
                        f'in {number(told["seconds"])} s'),
        ('search', f'{told["search"] or "-"}, seed {"-" if told["seed"] is None else told["seed"]}'),
        ('engine', told['engine'])]
    other = told['confirmation']
    if other is not None:
        facts.append((
            f'confirmed by {other["engine"]}',
            f'difference score {number(other["score"])} cm, '
            f'mean error {measured(other["mean_error_m"], "m")}; '
            f'points {measured(other["mean_distance_m"], "m")} from those of {told["engine"]}, '
            f'{measured(other["max_distance_m"], "m")} at most'))
    return [*facts, ('ended', told['stop_reason'])]


def print_result(result: CalibrationResult, stream: TextIO,
                 how: Mapping[str, Any] = MappingProxyType({})) -> None:
    """
    Print tables of the parameters and of the fit, and what the result says in sentences.

    :param how: plain values that take the place of the result's own.
    """
    out, told = console(stream), {**plain(result), **how}
    out.print(parameter_table(told['parameters']))
    out.print(facts_table('fit', fit_facts(told)))
    for sentence in sentences.sentences(result):
        out.print(escape(sentence))


def print_info(about: Mapping[str, Any], stream: TextIO) -> None:
    """Print what is in a session: the JSON document of `info` as tables."""
    out = console(stream)
    out.print(facts_table(about['session'], [
        ('trials', str(len(about['trials']))),
        ('duration', f"{number(about['duration_s'])} s"),
        ('frame', ', '.join(map(repr, about['frames'])) or '-'),
        *((topic, f'{count} messages') for topic, count in about['messages'].items()),
    ]))
    if about['trials']:
        head = ('name', 'points', 'length', 'hands', 'goals', 'duration', 'annotated')
        out.print(rows_table('trials', head, [
            (trial['name'], str(trial['points']), measured(trial['length_m'], 'm'),
             ', '.join(f"{hand['name']} (points {' '.join(map(str, hand['grips']))})"
                       for hand in trial['hands']),
             f"{trial['stable_goals']} stable, {trial['timed_goals']} timed",
             f"{number(trial['duration_s'])} s",
             ', '.join(word for word, there in (
                 ('hands', trial['annotated_hands']),
                 (f"{trial['annotated_features']} features", trial['annotated_features'])) if there) or '-')
            for trial in about['trials']]))
    for title in ('refusals', 'problems'):
        for text in about[title]:
            out.print(escape(f'{title[:-1]}: {text}'))
