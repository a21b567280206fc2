# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Terminal: progress bars and tables, which are written to a given stream."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, Iterable, Mapping, Self, Sequence, TextIO, TYPE_CHECKING

from rich import markup
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, plain
from dlo_calibration.errors import safe_line, shortened
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.model.parameters import measured, number
from dlo_calibration.report import sentences
from dlo_calibration.report.sentences import fit_facts, parameter_rows

if TYPE_CHECKING:
    from dlo_calibration.planning.planner import PlanProgress


def escape(text: str) -> str:
    """Return a text for a console, which obeys nothing in it; names of a session can be anything."""
    return markup.escape(safe_line(text))


def console(stream: TextIO) -> Console:
    """Return a console on `stream`; in a file or a pipe, it is 110 columns wide, so that tables fit."""
    return Console(file=stream, width=None if stream.isatty() else 110, highlight=False)


class _Bar:
    """
    A progress bar on a terminal; elsewhere nothing is shown.

    :param label: its first column; `columns` come after the count.
    :param shown: False: nothing is shown on a terminal, either.
    :param fields: of its only task, see `rich.progress.Progress.add_task`.
    """

    def __init__(self, label: str, columns: Sequence[ProgressColumn], stream: TextIO, shown: bool,
                 **fields: Any) -> None:
        self.shown = shown and stream.isatty()
        self._progress = Progress(TextColumn(label), BarColumn(), MofNCompleteColumn(), *columns,
                                  console=console(stream))
        self._task = self._progress.add_task('', **fields)

    def __enter__(self) -> Self:
        """Show it, unless it shall not be."""
        if self.shown:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop updating; the bar stays visible."""
        if self.shown:  # of one that was not, rich 13 ends the line
            self._progress.stop()


class SearchBar(_Bar):
    """
    A progress bar of a search.

    :param total: largest number of evaluations.
    :param shown: False: nothing is shown on a terminal, either.
    :param logged: number of evaluations that come from a log: they do not count for the time left.
    """

    def __init__(self, total: int, stream: TextIO, shown: bool = True, logged: int = 0) -> None:
        super().__init__('calibrating', [TextColumn('best score {task.fields[best]}'), TimeRemainingColumn()],
                         stream, shown, total=total, best='-')
        self._best = float('inf')
        self._logged = logged

    def take(self, evaluation: Evaluation) -> None:
        """Advance by one evaluation."""
        self.move(evaluation.index + 1, min(self._best, evaluation.score))

    def move(self, count: int, best: float) -> None:
        """Show that `count` evaluations were made, and their best score."""
        self._best = best
        if count <= self._logged:  # the speed is that of the others
            self._progress.reset(self._task, completed=count, best=number(best))
        else:
            self._progress.update(self._task, completed=count, best=number(best))


class TaskBar(_Bar):
    """
    A progress bar with the time left.

    :param what: the label of the bar.
    :param done: how many of the `total` are done already.
    """

    def __init__(self, what: str, total: int, done: int, stream: TextIO) -> None:
        super().__init__(escape(what), [TimeRemainingColumn()], stream, True, total=total, completed=done)

    def advance(self) -> None:
        """Count one more."""
        self._progress.advance(self._task)


class PlanBar(_Bar):
    """
    A progress bar of a plan, with the time left.

    :param shown: False: nothing is shown on a terminal, either.
    """

    def __init__(self, stream: TextIO, shown: bool = True) -> None:
        super().__init__('planning action {task.fields[action]}', [TextColumn('{task.fields[how]}')], stream,
                         shown, total=None, action=1, how='starting')

    def take(self, progress: PlanProgress) -> None:
        """Show how far the plan is."""
        how = f'best error {measured(progress.best_error, "m")}, at most {progress.seconds_left:.0f} s left'
        self._progress.update(self._task, completed=progress.rollouts, total=progress.expected,
                              action=progress.actions, how=how)


def _table(title: str, rows: Iterable[Sequence[str]], head: Sequence[str | Column] = ()) -> Table:
    """Return a table; without a `head`, only its rows are shown."""
    table = Table(*head, title=escape(title), show_header=bool(head))
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def print_result(result: CalibrationResult, stream: TextIO,
                 how: Mapping[str, Any] = MappingProxyType({})) -> None:
    """
    Print whether the result is usable, what was chosen, tables of parameters and fit, and the sentences.

    :param how: plain values that replace those of the result.
    """
    out, values = console(stream), {**plain(result), **how}
    out.print(escape(result.headline))
    if values['choice']:
        out.print(escape(values['choice']))
    numbers = (Column(title, justify='right') for title in (
        '0..100', '90 % interval', 'physical', '90 % interval'))
    out.print(_table('parameters', [
        (row.name, row.value, row.ends, row.physical, row.physical_ends, row.verdict)
        for row in parameter_rows(values['parameters'], result.space)], ('parameter', *numbers, 'verdict')))
    out.print(_table('fit', fit_facts(values)))
    for sentence in sentences.sentences(result):
        out.print(escape(sentence))


def print_info(about: Mapping[str, Any], stream: TextIO) -> None:
    """Print the JSON document of `info` as tables."""
    out, unknown = console(stream), {topic['topic']: topic for topic in about['unknown_topics']}
    defaults = Options().flat()
    recorded = [f'{name} {value}' for name, value in (about['options'] or {}).items()
                if name != 'calibrate' and value != defaults.get(name)]
    facts = [('trials', str(len(about['trials'])))]
    if about['messages']:  # a request has none
        facts += [('duration', f"{number(about['duration_s'])} s"),
                  ('frame', ', '.join(repr(shortened(frame)) for frame in about['frames']) or '-'),
                  *((topic, f"{count} message{'s' * (count != 1)}")
                    for topic, count in about['messages'].items() if topic not in unknown)]
    out.print(_table(about['session'], [
        *facts, ('options', ', '.join(recorded) or 'all have their defaults'),
        ('calibrate', about['choice'].removeprefix('Calibrated: ') or ', '.join(about['calibrate']))]))
    if unknown:
        keys = ('topic', 'type', 'messages')
        out.print(_table('topics that the calibrator does not know', [
            [str(topic[key]) for key in keys] for topic in unknown.values()], keys))
    for topic in filter(lambda topic: topic['hint'], unknown.values()):
        out.print(escape(f'hint: {topic["hint"]}'), soft_wrap=True)
    if about['trials']:
        head = ('number', 'name', 'points', 'length', 'hands', 'goals', 'duration', 'remarks')
        out.print(_table('trials', [
            (str(trial['number']), trial['name'], str(trial['points']), measured(trial['length_m'], 'm'),
             ', '.join(f"{shortened(hand['name'])} ({_grips(hand)})" for hand in trial['hands']),
             f"{trial['stable_goals']} stable, {trial['timed_goals']} timed",
             f"{number(trial['duration_s'])} s",
             ', '.join(word for word, there in (
                 ('not used', not trial['used']),
                 (f"mean of {trial['averaged_chains']} chains at rest", trial['averaged_chains']),
                 ('annotated hands', trial['annotated_hands']),
                 (f"{trial['annotated_features']} annotated features", trial['annotated_features']),
                 (f"{trial['forces']} forces", trial['forces']),
                 (f"unseen points: {trial['unseen_points']}", trial['unseen_points'])) if there) or '-')
            for trial in about['trials']], head))
    for title in ('refusals', 'problems', 'notes'):
        for text in about[title]:
            out.print(escape(f'{title[:-1]}: {text}'))


def _grips(hand: Mapping[str, Any]) -> str:
    """Say where a hand grips."""
    points, offset = hand['grips'], hand['offset']
    if offset:
        return f'between points {points[0] - (offset < 0)} and {points[0] + (offset > 0)}'
    return f"point{'s' * (len(points) > 1)} {' '.join(map(str, points))}"
