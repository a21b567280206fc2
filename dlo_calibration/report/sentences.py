# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences: the result of a calibration in plain English."""

from __future__ import annotations

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.inference.missing_parameters import PARTS
from dlo_calibration.inference.trial_information import uninformative
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, MODEL_ERROR, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.parameters import BY_NAME, knot_names, PER_WEIGHT, SCALE
from dlo_calibration.model.quantity import measured, number
from dlo_calibration.report.bending_sentences import friction_sentences, rest_shape_sentences

#: Mean length of a vector of three normal coordinates with standard deviation 1 (Maxwell distribution).
MEAN_DISTANCE = float(np.sqrt(8 / np.pi))
MOST_COMBINATIONS = 3  # of parameters that the trials do not determine are told


def verdict(result: CalibrationResult) -> str:
    """Return the first sentence that a user should read: whether the parameters can be used, or why not."""
    return f'Do not use this result: {result.unusable}.' if result.unusable else 'This result is usable.'


def sentences(result: CalibrationResult) -> list[str]:
    """Return sentences on the parameters and their uncertainty, the next action, and how well the fit is."""
    return [*_known(result), *rest_shape_sentences(result), *friction_sentences(result),
            *_undetermined(result), *_uninformative(result), *_advice(result), *_fit(result),
            *filter(None, [lower_score(result)]), *_missing_parameters(result)]


def _known(result: CalibrationResult) -> list[str]:
    """Return a sentence on each parameter but the knots of the rest shape, the most certain ones first."""
    found: dict[str, list[str]] = {IDENTIFIABLE: [], WEAK: [], NOT_IDENTIFIABLE: []}
    alone = [name for name in result.parameters if name not in knot_names(result.space.knots)]
    for name in alone:
        p = result.parameters[name]
        verdict = p.verdict or (IDENTIFIABLE if p.identifiable else NOT_IDENTIFIABLE)
        quantity = BY_NAME[name].quantity
        value = measured(p.physical_value, p.physical_unit)
        ends = BY_NAME[name].interval(p.lower, p.upper, (p.physical_lower, p.physical_upper), p.physical_unit)
        bound = ends.startswith('at ')  # at least, at most
        if verdict == NOT_IDENTIFIABLE:
            words = f'{name} could not be determined'
            words += f': with these trials, {quantity} is only known to be {ends}' if bound else \
                f' ({p.note}): {quantity} {value}' if p.note else \
                f': with these trials, {quantity} may be anything from {ends}'
        elif bound:
            words = f'{name} is known on one side only: {quantity} is {ends}, with 90 % probability'
        else:
            well = 'well' if verdict == IDENTIFIABLE else 'only roughly'
            words = f'{name} is known {well}: {quantity} {value}, with 90 % probability {ends}'
        found[verdict].append(f'{words}.')
    texts = [text for group in found.values() for text in group]
    if any(p.physical_unit.endswith(PER_WEIGHT) for p in result.parameters.values()):
        texts.append('The mass was not given, so that stiffnesses are known only relative to the weight of '
                     'the DLO: multiply each by the weight per length, in N/m.')
    if result.examination is not None and not result.examination.regular:
        texts.append('The search has not reached a minimum, so that the intervals are only the spread of the '
                     'best parameter sets that it tried; more evaluations or another search may narrow them.')
    return texts


def _undetermined(result: CalibrationResult) -> list[str]:
    found = result.undetermined
    more = [f'So can {len(found) - MOST_COMBINATIONS} more combinations.'] * (len(found) > MOST_COMBINATIONS)
    return [*(f'This combination of parameters can change while the fit stays nearly the same: {words}.'
              for words in found[:MOST_COMBINATIONS]), *more]


def _uninformative(result: CalibrationResult) -> list[str]:
    names = uninformative(result.trials, result.examination) if len(result.trials) > 1 else ()
    return [f'{", ".join(names)} added no information about any parameter.'] * bool(names)


def _advice(result: CalibrationResult) -> list[str]:
    one = result.advice
    if one is None:
        return []
    return [f'To know {one.parameter} better, {one.words} (action {one.action}). On the scale from 0 to '
            f'100, that should bring its standard deviation from {number(one.std * SCALE)} to '
            f'{number(one.expected_std * SCALE)}.']


def _fit(result: CalibrationResult) -> list[str]:
    """Compare the error of the fit with other errors."""
    found, mean = result.examination, result.errors.mean
    words = [f'The simulated points are {measured(mean, "m")} from the measured ones on average '
             f'({number(100 * mean / result.length)} % of the length).']
    if found is None:
        return words
    if np.isfinite(found.default_error):
        words.append(f'With the default parameters they would be {measured(found.default_error, "m")} away.')
    if np.isfinite(found.cross_validated):
        words.append('A trial that is left out of the fit is predicted to '
                     f'{measured(found.cross_validated, "m")}.')
    noise = found.noise * MEAN_DISTANCE
    if np.isfinite(noise):
        words.append(f'The noise of the measured points alone gives {measured(noise, "m")}; ' + (
            'the fit is about as good as the measurement.' if mean < MODEL_ERROR * noise else
            'the rest comes from errors of the model or of the recorded hands.'))
    return [' '.join(words)]


def lower_score(result: CalibrationResult) -> str:
    """Say why the result is not the evaluation with the lowest difference score; empty if it is."""
    lowest, best = min(result.evaluations, key=lambda one: one.score), result.best
    if lowest.score >= best.score or number(lowest.score) == number(best.score):
        return ''
    return (f'Evaluation {lowest.index + 1} has a lower difference score than the result, '
            f'{number(lowest.score)} instead of {number(best.score)} cm: the search minimises the distances '
            'of all points, with less weight on outliers, while in the score differences of opposite sign '
            'cancel.')


def _missing_parameters(result: CalibrationResult) -> list[str]:
    """Name fixed parameters to calibrate, too."""
    shares = [f'{one.name} {number(100 * one.share)} %' for one in result.missing_parameters]
    if not shares:
        return []
    names = [one.name for one in result.missing_parameters if one.name != PARTS]
    beside = ', '.join(name for name in result.space.free if name not in knot_names(result.space.knots))
    how = [f'name {" or ".join(names)} in calibrate, beside {beside}'] * bool(names)
    how += ['set parts to 0 (bending stiffness that differs along the DLO)'] * (len(names) < len(shares))
    return [f'Parameters that were held fixed would explain these shares of the squared residuals: '
            f'{", ".join(shares)}. To calibrate them, too, {"; or ".join(how)}.']
