# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics: what the node tells of its progress, its result and its status, as messages."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.plain import plain
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.quantity import exact, interval, measured, number
from dlo_calibration.report import sentences

OUTPUT_TYPES: Mapping[str, str] = {
    'progress': 'diagnostic_msgs/msg/DiagnosticArray',
    'result': 'diagnostic_msgs/msg/DiagnosticArray',
    'dlo_description': 'std_msgs/msg/String',
    'status': 'diagnostic_msgs/msg/DiagnosticArray',
    'markers': 'visualization_msgs/msg/MarkerArray',
}
STATES = ('collecting', 'calibrating', 'done', 'failed')
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
VALUE_UNIT = '0..100'  # of value, std, lower and upper of a result
WHOLE = 'calibration'  # name of the status that speaks of the whole result
#: Plain values that have a status or keys of their own, or are too long for a message.
NOT_TOLD = ('parameters', 'correlations', 'advice', 'explanations', 'confirmation')


def progress(types: MessageTypes, *, stamp: int, evaluation: Evaluation, best: Evaluation, evaluations: int,
             simulations_per_second: float, seconds_left: float,
             spread: Mapping[str, float] = MappingProxyType({})) -> Any:
    """
    Build the message about one finished evaluation.

    :param evaluation: the one that has finished; counted from 1 in the message.
    :param best: the best so far.
    :param evaluations: how many there will be.
    :param spread: of each parameter over the best evaluations so far (0..100), see `worker.Progress`.
    """
    values: dict[str, Any] = {
        'evaluation': evaluation.index + 1, 'evaluations': evaluations, 'score': evaluation.score,
        'best_score': best.score, **{f'best_{name}': value for name, value in best.values.items()},
        **{f'spread_{name}': value for name, value in spread.items()},
        'simulations_per_second': simulations_per_second, 'seconds_left': seconds_left}
    if evaluation.failure:
        values['failure'] = evaluation.failure
    message = (f'evaluation {evaluation.index + 1} of {evaluations}, best score {number(best.score)}, '
               f'{number(seconds_left)} s left')
    level = WARN if evaluation.failure else OK
    return _diagnostics(types, stamp, [_status(types, level, 'progress', message, values)])


def result(types: MessageTypes, found: CalibrationResult, stamp: int) -> Any:
    """Build the message with the final parameter set: one status per parameter, one for the whole."""
    told = plain(found)
    statuses = []
    for name, row in told['parameters'].items():
        message = (f'{number(row["value"])} ({interval(row["lower"], row["upper"], "1")}), '
                   f'{measured(row["physical_value"], row["physical_unit"])}')
        if not row['identifiable']:
            message += f'; {row["verdict"] or "the trials could not tell it"}'
        scale = {key: row.pop(key) for key in ('value', 'std', 'lower', 'upper')}
        statuses.append(_status(types, OK if row['identifiable'] else WARN, name, message,
                                {**scale, 'unit': VALUE_UNIT, **row}))
    statuses.append(_status(
        types, WARN if found.warnings else OK, WHOLE,
        f'score {number(found.best.score)}, mean error {measured(found.errors.mean, "m")}; '
        f'{found.stop_reason}',
        {**_pairs({key: told[key] for key in told if key not in NOT_TOLD}),
         'findings': ' '.join(sentences.sentences(found)),
         **_pairs(told['confirmation'] or {}, 'confirmation_')}))
    return _diagnostics(types, stamp, statuses)


def _pairs(told: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return plain values as a message has them: lengths in mm, texts joined by '; ', '' for None."""
    pairs = {}
    for key, value in told.items():
        if key.endswith('_m'):
            key, value = f'{key}m', None if value is None else value * 1e3
        if key in ('warnings', 'undetermined'):
            value = '; '.join(value)
        pairs[f'{prefix}{key}'] = '' if value is None else value
    return pairs


def result_values(message: Any) -> dict[str, dict[str, float | str | bool]]:
    """Read the parameters of a `result` message: name -> key -> number, text or truth."""
    found: dict[str, dict[str, float | str | bool]] = {}
    for one in message.status:
        if one.name != WHOLE:
            values = {pair.key: pair.value for pair in one.values}
            found[one.name] = {
                key: value == 'true' if key == 'identifiable' else
                value if key.endswith(('unit', 'verdict', 'note')) else float(value)
                for key, value in values.items()}
    return found


def status(types: MessageTypes, *, stamp: int, state: str, trials: int, last_refusal: str = '',
           incomplete: str = '', detail: str = '', told: TrialInformation | None = None) -> Any:
    """
    Build the message about what the node is doing.

    :param state: one of STATES.
    :param trials: number of complete trials.
    :param last_refusal: text of the last refusal; empty where there was none.
    :param incomplete: what the newest trial lacks; empty where nothing.
    :param detail: of the state, e.g. why it failed.
    :param told: what the newest trial tells, once it is known.
    """
    if state not in STATES:
        raise ValueError(f'{state!r} is not one of {", ".join(STATES)}')
    message = f'{state}: {detail}' if detail else state
    last_trial = '' if told is None else told.words
    if last_trial and state == 'collecting':
        message += f'; {last_trial}'
    return _diagnostics(types, stamp, [_status(
        types, ERROR if state == 'failed' else OK, 'status', message,
        {'state': state, 'trials': trials, 'last_refusal': last_refusal, 'incomplete': incomplete,
         'detail': detail, 'last_trial': last_trial, **({} if told is None else told.values)})])


def _diagnostics(types: MessageTypes, stamp: int, statuses: Sequence[Any]) -> Any:
    return types.build('diagnostic_msgs/msg/DiagnosticArray', header=types.header(stamp),
                       status=list(statuses))


def _status(types: MessageTypes, level: int, name: str, message: str, values: Mapping[str, Any]) -> Any:
    pairs = [types.build('diagnostic_msgs/msg/KeyValue', key=key, value=exact(value))
             for key, value in values.items()]
    return types.build('diagnostic_msgs/msg/DiagnosticStatus', level=types.level(level), name=name,
                       message=message, hardware_id='', values=pairs)
