# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics: what the node tells of its progress, its result and its status, as messages."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.confirmation import Confirmation
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.parameters import measured
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
    message = (f'evaluation {evaluation.index + 1} of {evaluations}, best score {best.score:.1f}, '
               f'{seconds_left:.0f} s left')
    level = WARN if evaluation.failure else OK
    return _diagnostics(types, stamp, [_status(types, level, 'progress', message, values)])


def result(types: MessageTypes, found: CalibrationResult, stamp: int) -> Any:
    """Build the message with the final parameter set: one status per parameter, one for the whole."""
    statuses = []
    for name, p in found.parameters.items():
        message = (f'{p.value:.1f} ({p.lower:.1f} to {p.upper:.1f}), '
                   f'{measured(p.physical_value, p.physical_unit)}')
        if not p.identifiable:
            message += f'; {p.verdict or "the trials could not tell it"}'
        statuses.append(_status(types, OK if p.identifiable else WARN, name, message, {
            'value': p.value, 'std': p.std, 'lower': p.lower, 'upper': p.upper, 'unit': VALUE_UNIT,
            'physical_value': p.physical_value, 'physical_lower': p.physical_lower,
            'physical_upper': p.physical_upper, 'physical_unit': p.physical_unit,
            'identifiable': p.identifiable, 'verdict': p.verdict, 'note': p.note}))
    errors = found.errors
    statuses.append(_status(
        types, WARN if found.warnings else OK, WHOLE,
        f'score {found.best.score:.1f}, mean error {errors.mean * 1e3:.2f} mm; {found.stop_reason}', {
            'score': found.best.score, 'scores': ' '.join(repr(float(s)) for s in found.best.scores),
            'mean_error_mm': errors.mean * 1e3, 'rms_error_mm': errors.rms * 1e3,
            'max_error_mm': errors.max * 1e3, 'mean_abs_error_mm': errors.mean_abs * 1e3,
            'error_percent_of_length': 100 * errors.mean / found.length,
            'trials': len(found.trials), 'evaluations': len(found.evaluations),
            'simulations': found.simulations, 'seconds': found.seconds, 'engine': found.engine,
            'search': found.search, 'seed': '' if found.seed is None else found.seed,
            'stop_reason': found.stop_reason, 'warnings': '; '.join(found.warnings),
            **_examination(found), **_confirmation(found.confirmation)}))
    return _diagnostics(types, stamp, statuses)


def _examination(found: CalibrationResult) -> dict[str, Any]:
    """Return what was found around the parameters; empty values where it was not examined."""
    examined = sentences.values(found)
    lengths = {f'{key.removesuffix("_m")}_mm': '' if examined[key] is None else 1e3 * examined[key]
               for key in ('cross_validated_error_m', 'default_error_m', 'noise_m', 'residual_std_m')}
    return {**lengths, 'undetermined': '; '.join(found.undetermined),
            'findings': ' '.join(sentences.sentences(found))}


def _confirmation(found: Confirmation | None) -> dict[str, Any]:
    """Return what a second engine gave for the same parameters; nothing where none was asked."""
    if found is None:
        return {}
    return {
        'confirmation_engine': found.engine, 'confirmation_score': found.score,
        'confirmation_scores': ' '.join(repr(float(s)) for s in found.scores),
        'confirmation_mean_error_mm': found.errors.mean * 1e3,
        'confirmation_rms_error_mm': found.errors.rms * 1e3,
        'confirmation_max_error_mm': found.errors.max * 1e3,
        'confirmation_mean_abs_error_mm': found.errors.mean_abs * 1e3,
        'confirmation_mean_distance_mm': found.mean_distance * 1e3,
        'confirmation_max_distance_mm': found.max_distance * 1e3}


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
    pairs = [types.build('diagnostic_msgs/msg/KeyValue', key=key, value=_text(value))
             for key, value in values.items()]
    return types.build('diagnostic_msgs/msg/DiagnosticStatus', level=types.level(level), name=name,
                       message=message, hardware_id='', values=pairs)


def _text(value: Any) -> str:
    """Return text that reads back exactly."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    return repr(float(value)) if isinstance(value, float) else str(value)
