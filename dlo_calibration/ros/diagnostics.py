# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics: builds the messages about the node's progress, result and status."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.plain import plain
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import printable
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.quantity import exact, interval, measured, number
from dlo_calibration.report import sentences

STATES = ('collecting', 'calibrating', 'done', 'failed')
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
WHOLE = 'calibration'  # name of the status about the whole result; the others have a parameter's name


def progress(types: MessageTypes, *, stamp: int, evaluation: Evaluation, best: Evaluation, evaluations: int,
             simulations_per_second: float, seconds_left: float,
             spread: Mapping[str, float] = MappingProxyType({})) -> Any:
    """
    Build the message about one finished evaluation.

    :param evaluation: the finished one; the message counts from 1.
    :param best: the best so far.
    :param evaluations: the largest number of evaluations of this search.
    :param spread: of each parameter over the best evaluations so far (0..100), see `Progress`.
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
    return diagnostic_array(types, stamp, [diagnostic_status(types, level, 'progress', message, values)])


def result(types: MessageTypes, found: CalibrationResult, stamp: int) -> Any:
    """Build the message with the final parameters: one status for each, and one about the whole result."""
    told = plain(found)
    statuses = []
    for name, row in told['parameters'].items():
        message = (f'{number(row["value"])} ({interval(row["lower"], row["upper"], "1")}), '
                   f'{measured(row["physical_value"], row["physical_unit"])}')
        if not row['identifiable']:
            message += f'; {row["verdict"] or "not identifiable from these trials"}'
        scale = {key: row.pop(key) for key in ('value', 'std', 'lower', 'upper')}
        statuses.append(diagnostic_status(types, OK if row['identifiable'] else WARN, name, message,
                                          {**scale, 'unit': '0..100', **row}))
    # These have a status or keys of their own, or are too long for a message.
    left_out = ('parameters', 'correlations', 'advice', 'explanations', 'confirmation')
    statuses.append(diagnostic_status(
        types, WARN if found.warnings or found.unusable else OK, WHOLE,
        f'{sentences.verdict(found)} Score {number(found.best.score)}, '
        f'mean error {measured(found.errors.mean, "m")}; '
        f'{found.stop_reason}',
        {**_pairs({key: told[key] for key in told if key not in left_out}),
         'findings': ' '.join(sentences.sentences(found)),
         **_pairs(told['confirmation'] or {}, 'confirmation_')}))
    return diagnostic_array(types, stamp, statuses)


def in_one_line(found: CalibrationResult) -> str:
    """Return the values, errors and end of a calibration as one line for the log."""
    values = ', '.join(f'{name} {number(one.value)} ({interval(one.lower, one.upper, "1")}), '
                       f'{measured(one.physical_value, one.physical_unit)}'
                       for name, one in found.parameters.items())
    return (f'calibrated: {values}; score {found.best.score:.1f}, mean error '
            f'{found.errors.mean * 1e3:.2f} mm; {found.stop_reason}')


def _pairs(told: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Convert plain values for a message: lengths to mm, lists of texts to one text, None to ''."""
    pairs = {}
    for key, value in told.items():
        if key.endswith('_m'):
            key, value = f'{key}m', None if value is None else value * 1e3
        if key in ('warnings', 'undetermined'):
            value = '; '.join(value)
        pairs[f'{prefix}{key}'] = '' if value is None else value
    return pairs


def status(types: MessageTypes, *, stamp: int, state: str, trials: int, last_refusal: str = '',
           incomplete: str = '', detail: str = '', information: TrialInformation | None = None,
           dropped: int = 0) -> Any:
    """
    Build the message about what the node is doing.

    :param state: one of STATES.
    :param trials: number of complete trials.
    :param last_refusal: text of the last refusal; empty if there was none.
    :param incomplete: what the newest trial lacks; empty if it is complete.
    :param detail: about the state, e.g. why the calibration failed.
    :param information: about the newest trial; None until it is known.
    :param dropped: number of messages that came faster than they can be read.
    """
    if state not in STATES:
        raise ValueError(f'{state!r} is not one of {", ".join(STATES)}')
    message = f'{state}: {detail}' if detail else state
    last_trial = '' if information is None else information.words
    if last_trial and state == 'collecting':
        message += f'; {last_trial}'
    return diagnostic_array(types, stamp, [diagnostic_status(
        types, ERROR if state == 'failed' else OK, 'status', message,
        {'state': state, 'trials': trials, 'last_refusal': last_refusal, 'incomplete': incomplete,
         'detail': detail, 'dropped': dropped, 'last_trial': last_trial,
         **({} if information is None else information.values)})])


def diagnostic_array(types: MessageTypes, stamp: int, statuses: Sequence[Any]) -> Any:
    """Build a message with statuses; `stamp` in ns."""
    return types.build('diagnostic_msgs/msg/DiagnosticArray', header=types.header(stamp),
                       status=list(statuses))


def diagnostic_status(types: MessageTypes, level: int, name: str, message: str,
                      values: Mapping[str, Any]) -> Any:
    """Build a status: a level, a text for people, and values from which programs read them back exactly."""
    pairs = [types.build('diagnostic_msgs/msg/KeyValue', key=key, value=printable(exact(value)))
             for key, value in values.items()]
    return types.build('diagnostic_msgs/msg/DiagnosticStatus', level=types.level(level), name=name,
                       message=printable(message), hardware_id='', values=pairs)
