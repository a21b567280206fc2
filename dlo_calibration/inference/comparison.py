# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison: whether two calibrations are of the same DLO, and which parameters have changed if not.

Both posteriors are normal.  If the DLO is the same, the difference of their means is normal, too, with the
sum of the covariances, and the square of its length in standard deviations has a chi-square distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.inference.uncertainty import DEVIATIONS, WEAK_WIDTH
from dlo_calibration.model.chain import Floats

CHANGED = 0.03  # probability of agreement below which the DLO has changed: a false alarm in 33 checks
KNOWN_STD = WEAK_WIDTH / (2 * DEVIATIONS)  # a direction in which both know less says nothing


@dataclass(frozen=True)
class Comparison:
    """
    The difference of d parameters between two calibrations, in units of a search.

    :param change: (d,) later minus earlier values; `std` (d,) their standard deviations.
    :param changed: (d,) True for the fewest parameters whose changes explain the difference; all but the
        first are certain by themselves.
    :param agreement: probability of a difference at least as large between calibrations of the same DLO;
        nan if they tell nothing.
    """

    change: Floats
    std: Floats
    changed: NDArray[np.bool_]
    agreement: float

    @property
    def lower(self) -> Floats:
        """(d,) lower ends of the 90 % intervals of the changes."""
        return np.asarray(self.change - DEVIATIONS * self.std)

    @property
    def upper(self) -> Floats:
        """(d,) upper ends of the 90 % intervals of the changes."""
        return np.asarray(self.change + DEVIATIONS * self.std)


def compare(change: Floats, before: Floats, after: Floats) -> Comparison:
    """
    Compare two calibrations.

    Directions of the box in which the difference is hardly known do not count, so that EI and friction
    can be compared where only both together are known.

    :param change: (d,) later minus earlier values.
    :param before: (d, d) covariance of the earlier values; `after` (d, d) of the later ones.
    """
    covariance = before + after
    variances, axes = np.linalg.eigh(covariance)
    known = variances < KNOWN_STD**2
    # Rows: the standardised effect of a change of each parameter in the directions that are known.
    effects = axes.T[known] / np.sqrt(np.maximum(variances[known], 1e-12))[:, None]
    seen = effects @ change
    std = np.sqrt(np.diag(covariance))
    certain = np.abs(change) > DEVIATIONS * std
    names: list[int] = []
    rest = seen
    while len(seen) > len(names) and _agreement(rest, len(names)) < CHANGED:
        others = [k for k in range(len(change)) if k not in names and (certain[k] or not names)]
        if not others:
            break
        left = [_remaining(effects, seen, [*names, k]) for k in others]
        best = min(range(len(others)), key=lambda n: float(left[n] @ left[n]))
        names.append(others[best])
        rest = left[best]
    changed = np.zeros(len(change), np.bool_)
    changed[names] = True
    return Comparison(change, std, changed, _agreement(seen, 0) if known.any() else float('nan'))


def _remaining(effects: Floats, seen: Floats, columns: list[int]) -> Floats:
    """Return what changes of some parameters leave of a difference."""
    explained = effects[:, columns]
    return np.asarray(seen - explained @ np.linalg.lstsq(explained, seen, rcond=None)[0])


def _agreement(seen: Floats, explained: int) -> float:
    """Return the probability that chance alone makes a standardised difference at least as long."""
    from scipy.special import chdtrc  # slow to load

    return float(chdtrc(max(len(seen) - explained, 1), seen @ seen))
