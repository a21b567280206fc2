# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The lines that join the parts of a DLO which a picture shows, where something hides the rest of it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, permutations, product
from typing import Sequence

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.elastic import directions
from dlo_calibration.vision.middle_line import arc_lengths

TANGENT = 6  # points that tell the direction of a path where it is hidden
PLACES = np.linspace(0.0, 1.0, 22)  # on a curve between two paths
LONGEST_CURVE = 3.0  # slope at both ends of that curve, to its ends' distance
IN_AIR = 0.15  # share of the length by which a DLO may look longer in the air, or shorter under a hand
WRONG_LENGTH = 0.05  # share of the length by which a line that is found again may differ


@dataclass(frozen=True, eq=False)
class Joined:
    """
    A line along parts, and the curves between them.

    :param line: (n, d).
    :param curves: (m, d), all together.
    :param turn: by which these curves turn [rad].
    """

    line: Floats
    curves: Floats
    turn: float


def joined(parts: Sequence[Floats], length: float, whole: bool) -> list[Joined]:
    """
    Return the lines along parts, with smooth curves between them, that which turns least first.

    :param parts: (k, d) each, in any order and direction; more of them take factorially longer.
    :param length: of the whole line; longer ones, as those that are partly in the air look, come last.
    :param whole: whether the curves are all that is hidden, or an end may be, too.
    """
    hidden = max(length - sum(float(arc_lengths(part)[-1]) for part in parts), 0.0)
    found = []
    for order in permutations(range(len(parts))):
        for signs in product((1, -1), repeat=len(parts)):
            row = [parts[k][::sign] for k, sign in zip(order, signs, strict=True)]
            curves = _curves(row, hidden, IN_AIR * length, whole) if order[0] <= order[-1] else None
            if curves is not None:
                between = [curve[1:-1] for curve in curves] + [row[0][:0]]
                line = np.concatenate([piece for pair in zip(row, between, strict=True) for piece in pair])
                found.append(Joined(line, np.concatenate(between), sum(map(_turn, curves))))
    return sorted(found, key=lambda one: (arc_lengths(one.line)[-1] > (1 + WRONG_LENGTH) * length, one.turn))


def _curves(row: Sequence[Floats], length: float, longer: float, exactly: bool) -> list[Floats] | None:
    """Return the curves (n, d) between parts in a row, which have a length together, or are longer."""
    gaps = [float(np.linalg.norm(after[0] - before[-1])) for before, after in pairwise(row)]
    if sum(gaps) > length + longer:
        return None
    if not exactly or not gaps or sum(gaps) > length:
        return [_curve(*pair, 1.0) for pair in pairwise(row)]
    low, high = 0.0, LONGEST_CURVE
    for _ in range(12):
        middle = (low + high) / 2
        curves = [_curve(*pair, middle) for pair in pairwise(row)]
        excess = sum(float(arc_lengths(curve)[-1]) for curve in curves) - length
        low, high = (middle, high) if excess < 0 else (low, middle)
    return curves if abs(excess) < WRONG_LENGTH * length else None


def _curve(before: Floats, after: Floats, slope: float) -> Floats:
    """Return a smooth curve (n, d) from the end of one line to the beginning of another one."""
    gap = float(np.linalg.norm(after[0] - before[-1]))
    slopes = [slope * gap * directions(part[[0, -1]])[0] for part in (before[-TANGENT:], after[:TANGENT])]
    return np.asarray(CubicHermiteSpline((0.0, 1.0), (before[-1], after[0]), slopes)(PLACES))


def _turn(curve: Floats) -> float:
    """Return the angle by which a curve (n, d) turns [rad]."""
    steps = np.diff(curve, axis=0)
    sizes = np.linalg.norm(steps, axis=1)
    cosines = (steps[1:] * steps[:-1]).sum(axis=1) / np.maximum(sizes[1:] * sizes[:-1], 1e-12)
    return float(np.arccos(np.clip(cosines, -1.0, 1.0)).sum())
