# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics: builds the messages about the node's progress, result and status."""

from __future__ import annotations

from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.result import CalibrationResult, plain
from dlo_calibration.errors import printable
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.parameters import exact, interval, measured, number
from dlo_calibration.planning.plan import Plan
from dlo_calibration.planning.planner import PlanProgress
from dlo_calibration.report import sentences
from dlo_calibration.ros.node_session import FAILED
from dlo_calibration.workspace.worker import Progress

OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
WHOLE = 'calibration'  # name of the status about the whole result; the others have a parameter's name
Status = tuple[int, str, str, Mapping[str, Any]]  # a level, a name, a text for people, and values


def progress(types: MessageTypes, progress: Progress, stamp: int) -> Any:
    """Build the message about the newest evaluation of a calibration; it counts from 1."""
    newest, best, left = progress.newest, progress.best, progress.seconds_left
    assert newest is not None and best is not None
    values: dict[str, Any] = {
        'evaluation': newest.index + 1, 'evaluations': progress.evaluations, 'score': newest.score,
        'best_score': best.score, **{f'best_{name}': value for name, value in best.values.items()},
        **{f'spread_{name}': value for name, value in progress.spread.items()},
        'simulations_per_second': progress.simulations_per_second, 'seconds_left': left}
    if newest.failure:
        values['failure'] = newest.failure
    message = (f'evaluation {newest.index + 1} of {progress.evaluations}, best score {number(best.score)}, '
               f'{number(left)} s left')
    return _diagnostics(types, stamp, [(WARN if newest.failure else OK, 'progress', message, values)])


def result(types: MessageTypes, outcome: CalibrationResult, stamp: int) -> Any:
    """Build the message with the final parameters: one status for each, and one about the whole result."""
    values = plain(outcome)
    statuses: list[Status] = []
    for name, row in values['parameters'].items():
        message = (f'{number(row["value"])} ({interval(row["lower"], row["upper"], "1")}), '
                   f'{measured(row["physical_value"], row["physical_unit"])}')
        if not row['identifiable']:
            message += f'; {row["verdict"] or "not identifiable from these trials"}'
        scale = {key: row.pop(key) for key in ('value', 'std', 'lower', 'upper')}
        statuses.append((OK if row['identifiable'] else WARN, name, message,
                         {**scale, 'unit': '0..100', **row}))
    # These have a status or keys of their own, or are too long for a message.
    left_out = ('parameters', 'correlations', 'advice', 'explanations', 'confirmation')
    statuses.append((
        WARN if outcome.warnings or outcome.unusable else OK, WHOLE,
        f'{outcome.headline} Score {number(outcome.best.score)}; {outcome.stop_reason}',
        {**_pairs({key: values[key] for key in values if key not in left_out}),
         'findings': ' '.join(sentences.sentences(outcome)),
         **_pairs(values['confirmation'] or {}, 'confirmation_')}))
    return _diagnostics(types, stamp, statuses)


def in_one_line(outcome: CalibrationResult) -> str:
    """Return the values, errors and end of a calibration as one line for the log."""
    parameters = ', '.join(
        f'{name} {number(estimate.value)} ({interval(estimate.lower, estimate.upper, "1")}), '
        f'{measured(estimate.physical_value, estimate.physical_unit)}'
        for name, estimate in outcome.parameters.items())
    return (f'calibrated: {parameters}; score {outcome.best.score:.1f}, mean error '
            f'{outcome.errors.mean * 1e3:.2f} mm; {outcome.stop_reason}')


def _pairs(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Convert plain values for a message: lengths to mm, lists of texts to one text, None to ''."""
    pairs = {}
    for key, value in values.items():
        if key.endswith('_m'):
            key, value = f'{key}m', None if value is None else value * 1e3
        if key in ('warnings', 'undetermined'):
            value = '; '.join(value)
        if key == 'force_error_n' and value is not None:
            value = ' '.join(map(repr, value))
        if key == 'together':
            value = ' '.join(pair['words'] for pair in value)
        pairs[f'{prefix}{key}'] = '' if value is None else value
    return pairs


def status(types: MessageTypes, stamp: int, content: Mapping[str, Any],
           information: TrialInformation | None) -> Any:
    """
    Build the message about what the node is doing.

    :param content: values, among them the state and, perhaps empty, a detail about it.
    :param information: about the newest trial; None until it is known.
    """
    state, last_trial = content['state'], '' if information is None else information.words
    message = f'{state}: {content["detail"]}' if content['detail'] else state
    if last_trial and state == 'collecting':
        message += f'; {last_trial}'
    return _diagnostics(types, stamp, [(
        ERROR if state == FAILED else OK, 'status', message,
        {**content, 'last_trial': last_trial, **({} if information is None else information.values)})])


def _diagnostics(types: MessageTypes, stamp: int, statuses: Sequence[Status]) -> Any:
    """Build a message; `stamp` in ns.  Programs read the values of its statuses back exactly."""
    return types.build('diagnostic_msgs/msg/DiagnosticArray', header=types.header(stamp), status=[
        types.build('diagnostic_msgs/msg/DiagnosticStatus', level=types.level(level), name=name,
                    message=printable(message), hardware_id='', values=[
                        types.build('diagnostic_msgs/msg/KeyValue', key=key, value=printable(exact(value)))
                        for key, value in values.items()])
        for level, name, message, values in statuses])


WAITING, PLANNING, DONE = 'waiting', 'planning', 'done'  # states of the planner, besides FAILED


def plan_progress(types: MessageTypes, progress: PlanProgress, stamp: int) -> Any:
    """Build the message about the progress of a plan."""
    message = (f'{progress.rollouts} of about {progress.expected} simulated actions, sequences of '
               f'{progress.actions}, best mean error {measured(progress.best_error, "m")}, '
               f'{number(progress.seconds_left)} s left')
    return _diagnostics(types, stamp, [(OK, 'progress', message, {
        'actions': progress.actions, 'rollouts': progress.rollouts, 'expected': progress.expected,
        'best_error_mm': 1e3 * progress.best_error, 'seconds_left': progress.seconds_left})])


def planner_status(types: MessageTypes, stamp: int, content: Mapping[str, Any], plan: Plan | None) -> Any:
    """
    Build the message about what the planner is doing.

    :param content: values that need no plan, among them the state and, perhaps empty, a detail about it.
    :param plan: the newest one; None while there is none.
    """
    state, values = content['state'], dict(content)
    level = ERROR if state == FAILED else WARN if state == DONE and plan and not plan.reached else OK
    if plan is not None:
        values.update({
            'actions': len(plan.actions), 'reached': plan.reached, 'error_before_mm': 1e3 * plan.error_before,
            'error_after_mm': 1e3 * plan.error_after,
            'error_after_percent_of_length': 100 * plan.error_after / plan.start.length,
            'score_after': plan.score_after, 'tolerance_mm': 1e3 * plan.tolerance, 'rollouts': plan.rollouts,
            'seconds': plan.seconds, 'seed': plan.seed, 'stop_reason': plan.stop_reason,
            'remarks': ' '.join(plan.warnings)})
    message = f'{state}: {content["detail"]}' if content['detail'] else state
    return _diagnostics(types, stamp, [(level, 'status', message, values)])


TRACKING, LOST, STOPPED = 'tracking', 'lost', 'stopped'  # states of the tracker, besides WAITING and FAILED


def tracker_status(types: MessageTypes, stamp: int, content: Mapping[str, Any]) -> Any:
    """
    Build the message about what the tracker sees.

    :param content: values, among them the state and, perhaps empty, a detail about it.
    """
    state = content['state']
    level = ERROR if state == FAILED else WARN if state == LOST else OK
    message = f'{state}: {content["detail"]}' if content['detail'] else state
    return _diagnostics(types, stamp, [(level, 'status', message, content)])
