# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Findings: what a calibration's result says to a person, in sentences, and as plain values for files."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from dlo_calibration.calibration import CalibrationResult
from dlo_calibration.gain import silent
from dlo_calibration.parameters import SCALE
from dlo_calibration.uncertainty import IDENTIFIABLE, NOT_IDENTIFIABLE, WEAK

MEAN_DISTANCE = float(np.sqrt(8 / np.pi))  # of white noise in three coordinates, in its standard deviations


def sentences(result: CalibrationResult) -> list[str]:
    """Return what the trials could not tell, what would tell it, and how far to trust the fit."""
    return [*_verdicts(result), *_open(result), *_silent(result), *_advice(result), *_check(result)]


def values(result: CalibrationResult) -> dict[str, Any]:
    """Return what was examined as plain values, lengths in m; None where it was not."""
    found = result.examination
    names = result.space.free
    correlations = None
    if found is not None and found.regular and found.uncertainty.correlations is not None:
        correlations = {one: dict(zip(names, map(float, row), strict=True))
                        for one, row in zip(names, found.uncertainty.correlations, strict=True)}
    advice = None
    if result.advice is not None:
        advice = {**asdict(result.advice),
                  **{key: getattr(result.advice, key) * SCALE
                     for key in ('std', 'expected_std', 'lower', 'upper')}}
    return {
        'cross_validated_error_m': None if found is None else found.cross_validated,
        'default_error_m': None if found is None else found.default_error,
        'noise_m': None if found is None else found.noise,
        'residual_std_m': None if found is None else found.uncertainty.residual,
        'correlations': correlations, 'undetermined': list(result.undetermined), 'advice': advice}


def _verdicts(result: CalibrationResult) -> list[str]:
    found = []
    for verdict, words in ((NOT_IDENTIFIABLE, 'not identifiable from these trials'),
                           (WEAK, 'only roughly known from these trials')):
        names = [name + (f' ({p.note})' if p.note else '') for name, p in result.parameters.items()
                 if (p.verdict or (IDENTIFIABLE if p.identifiable else NOT_IDENTIFIABLE)) == verdict]
        if names:
            found.append(f'{words}: {", ".join(names)}')
    ends = [name for name, p in result.parameters.items() if p.verdict == IDENTIFIABLE and p.note]
    if ends:
        found.append(f'at the end of the scale, so that the best value may lie beyond: {", ".join(ends)}')
    if found and result.examination is not None and not result.examination.regular:
        found.append('the search had not arrived at a minimum; intervals are the spread of its best '
                     'evaluations, and more evaluations or another search may narrow them')
    return found


def _open(result: CalibrationResult) -> list[str]:
    return [f'the trials leave open: {words}' for words in result.undetermined]


def _silent(result: CalibrationResult) -> list[str]:
    names = silent(result) if len(result.trials) > 1 else ()
    return [f'{", ".join(names)} told nothing: all of it would have been known without'] if names else []


def _advice(result: CalibrationResult) -> list[str]:
    one = result.advice
    if one is None:
        return []
    return [f'to know {one.parameter} better, {one.words} ({one.action}): that would give it to '
            f'± {one.expected_std * SCALE:.1f} of 100, which is ± {one.std * SCALE:.1f} now']


def _check(result: CalibrationResult) -> list[str]:
    found = result.examination
    if found is None:
        return []
    words = [f'{text} {value * 1e3:.2f} mm' for text, value in (
        ('trials left out of the fit', found.cross_validated), ('default parameters', found.default_error),
        ('noise of the points alone', found.noise * MEAN_DISTANCE)) if np.isfinite(value)]
    if not words:
        return []
    return [f'mean error {result.errors.mean * 1e3:.2f} mm; for comparison: {", ".join(words)}']
