# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The robust loss of residuals: quadratic for most of them, linear for the few that lie far out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.model.chain import Floats

MEDIAN_OF_NORMAL = 0.6745  # median of |x| for a standard normal x
EFFICIENT = 1.345  # standard deviations where Huber's loss keeps 95 % of the efficiency of least squares
CLIPPED_SQUARE = 0.7102  # mean square of a standard normal value that is clipped at EFFICIENT
SMALLEST_SHARE = 0.1  # of the root mean square: most residuals may be nearly zero without being the measure
SMALLEST_RESIDUAL = 1e-9  # m; of a model that explains everything


@dataclass(frozen=True, order=True)
class Huber:
    """
    Huber's loss (Huber 1964, Annals of Mathematical Statistics 35, 73-101); the narrower one is the lesser.

    :param threshold: [m] where it turns from quadratic to linear.
    """

    threshold: float

    @classmethod
    def of(cls, residuals: Floats) -> Huber:
        """Return the loss whose threshold suits the spread of (m,) residuals [m]."""
        if not residuals.size:
            return cls(1.0)
        spread = float(np.median(np.abs(residuals))) / MEDIAN_OF_NORMAL
        floor = SMALLEST_SHARE * float(np.sqrt(np.mean(residuals ** 2)))
        return cls(max(EFFICIENT * spread, floor, SMALLEST_RESIDUAL))

    def cost(self, residuals: Floats | None) -> float:
        """Return the cost [m^2] of (m,) residuals [m]; infinite where there are none."""
        if residuals is None:
            return float('inf')
        size = np.abs(residuals)
        inside = np.minimum(size, self.threshold)
        return float(np.sum(inside * (size - inside / 2)))

    def roots(self, residuals: Floats) -> Floats:
        """Return the square roots (m,) of the weights with which least squares has the same gradient."""
        return np.sqrt(self.threshold / np.maximum(np.abs(residuals), self.threshold))

    def clipped(self, residuals: Floats) -> Floats:
        """Return the (m,) derivative [m] of the cost by (m,) residuals: outliers are cut off."""
        return np.clip(residuals, -self.threshold, self.threshold)

    def deviation(self, residuals: Floats, parameters: int) -> float:
        """Return the standard deviation [m] of (m,) residuals that a fit of so many parameters left."""
        square = float(np.sum(self.clipped(residuals)**2)) / CLIPPED_SQUARE
        return max(float(np.sqrt(square / max(1, len(residuals) - parameters))), SMALLEST_RESIDUAL)
