# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plain values of a result: numbers, texts, lists and dicts, from which every other form is made."""

from __future__ import annotations

from dataclasses import asdict
import math
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.model.parameters import SCALE
from dlo_calibration.model.score import PointErrors


def plain(result: CalibrationResult) -> dict[str, Any]:
    """
    Return a result as plain values, under the keys that `fit --json` prints.

    Units are SI; scores are in cm; `value`, `std`, `lower` and `upper` are on the scale from 0 to 100.
    None stands for an unknown value.
    """
    found, other, advice = result.examination, result.confirmation, result.advice
    values: dict[str, Any] = known({
        'unusable': result.unusable,
        'parameters': {name: _without_name(one) for name, one in result.parameters.items()},
        **_fit(result.best.score, result.best.scores, result.errors),
        'error_percent_of_length': 100 * result.errors.mean / result.length,
        'trials': len(result.trials), 'evaluations': len(result.evaluations),
        'simulations': result.simulations, 'seconds': result.seconds, 'engine': result.engine,
        'search': result.search, 'seed': result.seed, 'stop_reason': result.stop_reason,
        'choice': result.choice.words if result.choice else '',
        'warnings': result.warnings,
        'cross_validated_error_m': found and found.cross_validated,
        'default_error_m': found and found.default_error,
        'noise_m': found and found.noise,
        'residual_std_m': found and found.uncertainty.residual,
        'correlations': result.correlations, 'undetermined': result.undetermined,
        'advice': advice and {**asdict(advice), **{key: getattr(advice, key) * SCALE for key in (
            'std', 'expected_std', 'lower', 'upper')}},
        'explanations': {one.name: one.share for one in result.missing_parameters},
        'confirmation': other and {
            'engine': other.engine, **_fit(other.score, other.scores, other.errors),
            'mean_distance_m': other.mean_distance, 'max_distance_m': other.max_distance}})
    return values


def evaluation_rows(result: CalibrationResult) -> tuple[list[str], list[list[Any]]]:
    """
    Return the head and the rows of a table of all evaluations, which are numbered from 1.

    Parameters are on the scale from 0 to 100, scores in cm, the mean point error in m. Cells that a failed
    evaluation cannot fill are ''.
    """
    names, trials = result.space.free, [trial.name for trial in result.trials]
    head = ['evaluation', *names, 'score', *(f'score of {name}' for name in trials), 'mean_error_m',
            'failure']
    return head, [[one.index + 1, *(one.values[name] for name in names), one.score,
                   *(one.scores or [''] * len(trials)), '' if one.errors is None else one.errors.mean,
                   one.failure] for one in result.evaluations]


def known(value: Any) -> Any:
    """Return plain values with None in place of numbers that are not finite, which JSON cannot express."""
    if isinstance(value, Mapping):
        return {str(key): known(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [known(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _without_name(estimate: Any) -> dict[str, Any]:
    return {key: value for key, value in asdict(estimate).items() if key != 'name'}


def _fit(score: float, scores: Sequence[float], errors: PointErrors) -> dict[str, Any]:
    return {'score': score, 'scores': scores, 'mean_error_m': errors.mean, 'rms_error_m': errors.rms,
            'max_error_m': errors.max, 'mean_abs_error_m': errors.mean_abs}
