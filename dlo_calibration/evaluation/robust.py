# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Huber: a robust loss of residuals, quadratic for most of them and linear for outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.model.chain import Floats

EFFICIENT = 1.345  # standard deviations; as the threshold it has 95 % of the efficiency of least squares
CLIPPED_SQUARE = 0.7102  # mean square of a standard normal value that is clipped at EFFICIENT
SMALLEST_RESIDUAL = 1e-9  # m; keeps the scale above zero where a model fits exactly


@dataclass(frozen=True, order=True)
class Huber:
    """
    Huber's loss (Huber 1964, Annals of Mathematical Statistics 35, 73-101), ordered by its threshold.

    :param threshold: residual [m] at which it turns from quadratic to linear.
    """

    threshold: float

    @classmethod
    def of(cls, residuals: Floats) -> Huber:
        """Return the loss whose threshold suits the spread of (m,) residuals [m]."""
        if not residuals.size:
            return cls(1.0)
        # The median of |x| is 0.6745 for a standard normal x.  If most residuals are nearly zero, that spread
        # is too small: a tenth of the root mean square is the least.
        spread = float(np.median(np.abs(residuals))) / 0.6745
        floor = 0.1 * float(np.sqrt(np.mean(residuals ** 2)))
        return cls(max(EFFICIENT * spread, floor, SMALLEST_RESIDUAL))

    def cost(self, residuals: Floats | None) -> float:
        """Return the cost [m^2] of (m,) residuals [m]; infinite for None."""
        if residuals is None:
            return float('inf')
        size = np.abs(residuals)
        inside = np.minimum(size, self.threshold)
        return float(np.sum(inside * (size - inside / 2)))

    def roots(self, residuals: Floats) -> Floats:
        """Return the square roots (m,) of the weights that give least squares the gradient of this loss."""
        return np.sqrt(self.threshold / np.maximum(np.abs(residuals), self.threshold))

    def clipped(self, residuals: Floats) -> Floats:
        """Return the (m,) derivative [m] of the cost: the (m,) residuals [m] clipped at the threshold."""
        return np.clip(residuals, -self.threshold, self.threshold)

    def deviation(self, residuals: Floats, parameters: int) -> float:
        """Return the noise level [m] estimated from the (m,) residuals [m] of a fit of some parameters."""
        square = float(np.sum(self.clipped(residuals)**2)) / CLIPPED_SQUARE
        return max(float(np.sqrt(square / max(1, len(residuals) - parameters))), SMALLEST_RESIDUAL)
