# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Quantity: a number and its unit as text, for people, and for programs that read it back."""

from __future__ import annotations

import math
from typing import Any, Sequence

import numpy as np


def exact(value: Any) -> str:
    """Return a value as text from which a program reads it back exactly."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, (tuple, list)):
        return ' '.join(exact(one) for one in value)
    return str(value) if isinstance(value, (int, str)) else repr(float(value))


def number(value: float | None) -> str:
    """
    Return a number with three significant digits, for people; a dash where it is unknown.

    Only a very large or very small number has a power of ten.
    """
    if value is None or not math.isfinite(value):
        return '-'
    if value == 0:
        return '0'  # -0.0, too
    if 1e-5 <= abs(value) < 1e6:
        return np.format_float_positional(value, precision=3, unique=False, fractional=False, trim='-')
    return f'{value:.3g}'


def measured(value: float | None, unit: str) -> str:
    """Return a physical value (SI) with its unit, for people: lengths in mm, coefficients without unit."""
    return _with_unit([value], unit)


def interval(lower: float | None, upper: float | None, unit: str) -> str:
    """Return both ends of an interval (SI) with their unit, as `measured` writes one value."""
    return _with_unit([lower, upper], unit)


def _with_unit(values: Sequence[float | None], unit: str) -> str:
    if unit == 'm':
        values, unit = [None if value is None else 1e3 * value for value in values], 'mm'
    text = ' to '.join(map(number, values))
    return text if unit == '1' else f'{text} {unit}'
