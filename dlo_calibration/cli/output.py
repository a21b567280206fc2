# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Output: what verbs print, JSON or a table on stdout, and everything else on stderr."""

from __future__ import annotations

from dataclasses import asdict
import json
import math
import sys
from typing import Any, Mapping, Sequence, TextIO

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.inference.confirmation import Confirmation

INTERRUPTED = 130  # exit code of a program that Ctrl-C ended, by the shells' convention


def tell(text: str) -> None:
    """Tell the user something, in a line on stderr."""
    sys.stderr.write(f'{text}\n')


def document(result: CalibrationResult) -> dict[str, Any]:
    """Return what `fit` and `validate` print as JSON."""
    from dlo_calibration.report import sentences

    errors = result.errors
    return {
        'parameters': {
            name: {key: value for key, value in asdict(estimate).items() if key != 'name'}
            for name, estimate in result.parameters.items()},
        'score': result.best.score, 'scores': list(result.best.scores),
        'mean_error_m': errors.mean, 'rms_error_m': errors.rms, 'max_error_m': errors.max,
        'mean_abs_error_m': errors.mean_abs, 'error_percent_of_length': 100 * errors.mean / result.length,
        'trials': len(result.trials), 'evaluations': len(result.evaluations),
        'simulations': result.simulations, 'seconds': result.seconds, 'engine': result.engine,
        'search': result.search, 'seed': result.seed, 'stop_reason': result.stop_reason,
        'warnings': list(result.warnings), **sentences.values(result),
        'confirmation': None if result.confirmation is None else _confirmation(result.confirmation)}


def _confirmation(confirmation: Confirmation) -> dict[str, Any]:
    """Return what a second engine gave, with the keys of the whole document."""
    errors = confirmation.errors
    return {
        'engine': confirmation.engine, 'score': confirmation.score, 'scores': list(confirmation.scores),
        'mean_error_m': errors.mean, 'rms_error_m': errors.rms, 'max_error_m': errors.max,
        'mean_abs_error_m': errors.mean_abs, 'mean_distance_m': confirmation.mean_distance,
        'max_distance_m': confirmation.max_distance}


def print_json(value: Mapping[str, Any], stream: TextIO) -> None:
    """Print one JSON document, in which null stands for a number that is not finite."""
    json.dump(_finite(value), stream, indent=2, allow_nan=False)
    stream.write('\n')
    stream.flush()


def _finite(value: Any) -> Any:
    """Return `value` with None in place of numbers that JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_result(result: CalibrationResult, as_json: bool, told: Sequence[str] = ()) -> None:
    """
    Print a result on stdout, and its warnings on stderr.

    :param told: warnings that the user has seen already.
    """
    from dlo_calibration.report import terminal

    for warning in result.warnings:
        if warning not in told:
            tell(f'warning: {warning}')
    found = document(result)
    if as_json:
        print_json(found, sys.stdout)
        return
    terminal.print_result(result, found['parameters'], sys.stdout)
