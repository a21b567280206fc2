# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Bounded: linear least squares within bounds, for a few unknowns.

`scipy.optimize.lsq_linear` finds the same; that module takes longer to load than a search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

STEEP = 1e-12  # share of the largest possible slope that counts as none


def bounded_least_squares(matrix: Floats, right: Floats, least: Floats, most: Floats) -> Floats:
    """
    Return the x (d,) with the least |matrix x - right| within bounds.

    The method is that of Stark and Parker, Bounded-variable least-squares, 1995.

    :param matrix: (m, d); `right` (m,).
    :param least: (d,) lower bounds; `most` (d,) upper ones, which are above them.
    """
    count = len(least)
    x: Floats = np.clip(np.linalg.lstsq(matrix, right, rcond=None)[0], least, most)
    free = (x > least) & (x < most)
    tolerance = STEEP * np.linalg.norm(matrix, axis=0).max(initial=0.0) * np.linalg.norm(right)
    for _ in range(3 * count + 1):
        x, free = _solved(matrix, right, least, most, x, free)
        slope = matrix.T @ (matrix @ x - right)
        gain = np.where(free, 0.0, np.where(x <= least, -slope, slope))  # by leaving the bound
        if not count or gain.max() <= tolerance:
            break
        free[gain.argmax()] = True
    return x


def _solved(matrix: Floats, right: Floats, least: Floats, most: Floats, x: Floats, free: NDArray[np.bool_]
            ) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the best x in which only those that are free change; those that come to a bound stay there."""
    x, free = x.copy(), free.copy()
    while free.any():
        there = np.linalg.lstsq(matrix[:, free], right - matrix[:, ~free] @ x[~free], rcond=None)[0]
        here, low, high = x[free], least[free], most[free]
        if np.all((there >= low) & (there <= high)):
            x[free] = there
            break
        step = there - here
        bound = np.where(step < 0, low, high)
        share = np.divide(bound - here, step, out=np.ones_like(step), where=(there < low) | (there > high))
        first = share.argmin()
        x[free] = np.clip(here + share[first] * step, low, high)
        columns = np.flatnonzero(free)
        x[columns[first]] = bound[first]
        free[columns[first]] = False
    return x, free
