# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tables of what calibration is worth: Markdown, CSV, and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from plan_executions import (
    DEFAULT,
    Execution,
    FITTED,
    OPEN_LOOP,
    PlanOutcome,
    PlanTask,
    REPLANNED,
    TRUE,
)

from dlo_calibration.experiment.tables import csv_text, markdown_table
from dlo_calibration.model.parameters import number
from dlo_calibration.model.score import VERY_SIMILAR
from dlo_calibration.report.figure import (
    as_text,
    blank_figure,
    BLUE,
    GREEN,
    legend_outside,
    settings,
    write_figure,
    YELLOW,
)

Done = Sequence[tuple[PlanTask, PlanOutcome]]

KINDS = (FITTED, DEFAULT, TRUE)
COLOURS = {FITTED: BLUE, DEFAULT: YELLOW, TRUE: GREEN}
STYLES = {FITTED: '-', DEFAULT: '-', TRUE: (0, (4, 2))}  # dashed, as true and fitted often coincide
TICKS = (0.1, 0.3, 1, 3, 10, 30)  # %
WAYS = {OPEN_LOOP: 'open loop', REPLANNED: 'replanned'}
NEAR = 3.0  # % of the length
ALL = 'all'


@dataclass(frozen=True)
class TableRow:
    """
    The outcome of plans with one kind of parameters; errors are in % of the length, after all actions.

    :param subject: name of the object, or ALL.
    :param pairs: number of them; the following are over all.
    :param median: error; `most` is above 90 % of them, `worst` the largest.
    :param near: share of the errors that are at most NEAR, 0 to 1.
    :param similar: share of the difference scores below VERY_SIMILAR, 0 to 1.
    :param actions: mean number of actions.
    :param seconds: mean time of all plans of an execution, on one thread [s].
    :param ratio: median error divided by that with true parameters; None where these are missing.
    :param missed: number of actions in which a hand closed on nothing.
    """

    subject: str
    kind: str
    pairs: int
    before: float
    median: float
    most: float
    worst: float
    near: float
    similar: float
    actions: float
    seconds: float
    ratio: float | None
    missed: int


def table_rows(done: Done, way: str) -> list[TableRow]:
    """Return a row for each object and kind of parameters, then one of all objects for each kind."""
    subjects = list(dict.fromkeys(task.dlo.name for task, _ in done))
    rows = []
    for subject in (*subjects, *([ALL] if len(subjects) > 1 else [])):
        groups = {kind: executions(done, way, subject, kind) for kind in KINDS}
        rows += [_row(subject, kind, group, groups[TRUE]) for kind, group in groups.items() if group]
    return rows


def executions(done: Done, way: str, subject: str, kind: str) -> list[Execution]:
    """Return the executions for an object, or for ALL, with one kind of parameters."""
    return [execution for task, outcome in done
            if task.belief.kind == kind and subject in (ALL, task.dlo.name)
            and (execution := getattr(outcome, way)) is not None]


def _row(subject: str, kind: str, group: Sequence[Execution], true: Sequence[Execution]) -> TableRow:
    errors = np.array([execution.errors[-1] for execution in group])
    median = float(np.median(errors))
    return TableRow(
        subject, kind, len(group), float(np.median([execution.errors[0] for execution in group])), median,
        float(np.percentile(errors, 90)), float(errors.max()), float((errors <= NEAR).mean()),
        float(np.mean([execution.scores[-1] < VERY_SIMILAR for execution in group])),
        float(np.mean([execution.actions for execution in group])),
        float(np.mean([execution.seconds for execution in group])),
        median / float(np.median([execution.errors[-1] for execution in true])) if true else None,
        sum(execution.missed for execution in group))


def markdown(done: Done, command: str, engine: str, complete: bool) -> str:
    """Return all tables as a Markdown document."""
    pairs = len({task.index for task, _ in done})
    failures = [(task, outcome) for task, outcome in done if outcome.failure]
    options = done[0][0].options
    parts = [
        '# What calibration is worth for plans', f'    {command}',
        f'{pairs} random pairs of a start and a goal for each object. Plans with engine {engine}, at most '
        f'{options.actions} actions of one hand, tolerance {options.tolerance:g} % of the length. They are '
        'executed in a finer simulation (81 nodes, 1.5 ms) with the true properties. Errors are the mean '
        'distance of 21 points from the goal at the end, in % of the length. Seconds are those of all plans '
        'of a course, on one thread.']
    if not complete:
        parts.append('**Not complete**: the tables show what is done; the same command continues.')
    for way, words in ((OPEN_LOOP, 'Open loop: the plan is executed blindly'),
                       (REPLANNED, 'Replanned after each of up to 6 actions; the camera has 1 mm noise')):
        parts += [f'## {words}', _table(table_rows(done, way))]
    if failures:
        parts.append(f'{len(failures)} of {len(done)} ended early: ' + '; '.join(dict.fromkeys(
            f'{task.dlo.name}, {task.belief.kind}, pair {task.index + 1}: {outcome.failure}'
            for task, outcome in failures)))
    return '\n\n'.join(parts) + '\n'


def _table(rows: Sequence[TableRow]) -> str:
    head = ('object', 'parameters', 'before', 'median', '90 % below', 'worst', f'within {NEAR:g} %',
            f'score below {VERY_SIMILAR:g}', 'actions', 'seconds', 'median / true', 'gripped nothing')
    return markdown_table(head, (
        (row.subject, row.kind, number(row.before), f'**{number(row.median)}**', number(row.most),
         number(row.worst), _percent(row.near), _percent(row.similar), f'{row.actions:.1f}',
         f'{row.seconds:.1f}', '-' if row.ratio is None else f'{row.ratio:.2f}', str(row.missed))
        for row in rows))


def _percent(share: float) -> str:
    return f'{100 * share:.0f} %'


def executions_csv(done: Done) -> str:
    """Return a row for each execution."""
    rows: list[list[Any]] = []
    for task, outcome in done:
        for way in WAYS:
            execution = getattr(outcome, way)
            values = [None] * 7 if execution is None else [
                ' '.join(map(repr, execution.errors)), ' '.join(map(repr, execution.scores)),
                execution.predicted, execution.missed, execution.plans, execution.rollouts, execution.seconds]
            rows.append([task.dlo.name, task.belief.kind, task.index + 1, way, *values, outcome.failure])
    return csv_text(('object', 'parameters', 'pair', 'course', 'errors_percent', 'scores_cm',
                     'predicted_percent', 'gripped_nothing', 'plans', 'rollouts', 'seconds', 'failure'), rows)


def picture(done: Done, path: Path) -> None:
    """
    Draw the share of the pairs whose error is at most as large, for each object, way and kind of parameters.

    :raises InputError: if the file cannot be written.
    """
    subjects = list(dict.fromkeys(task.dlo.name for task, _ in done))
    with settings():
        figure = blank_figure(max(6.0, 2.6 * len(subjects)), 5.4)
        axes = figure.subplots(len(WAYS), len(subjects), sharex=True, sharey=True, squeeze=False)
        for row, (way, words) in zip(axes, WAYS.items(), strict=True):
            row[0].set_ylabel(f'{words}: share of pairs, %')
            for panel, subject in zip(row, subjects, strict=True):
                panel.axvline(NEAR, color='0.8', linewidth=0.8)
                for kind in KINDS:
                    errors = np.sort([each.errors[-1] for each in executions(done, way, subject, kind)])
                    shares = 100 * np.arange(1, len(errors) + 1) / max(len(errors), 1)
                    panel.step([TICKS[0] / 100, *errors, 100], [0, *shares, 100], where='post', linewidth=1.8,
                             label=f'{kind} parameters', color=COLOURS[kind], linestyle=STYLES[kind])
                panel.set(xscale='log', xlim=(0.1, 40), ylim=(0, 102))
                panel.set_xticks(TICKS, [f'{tick:g}' for tick in TICKS])
                panel.minorticks_off()
        for panel, subject in zip(axes[0], subjects, strict=True):
            panel.set_title(as_text(subject))
        for panel in axes[-1]:
            panel.set_xlabel('error at the end, % of the length')
        handles, labels = axes[0][0].get_legend_handles_labels()
        legend_outside(figure, 'upper center', handles=handles, labels=labels, ncols=len(KINDS))
        write_figure(figure, path)
