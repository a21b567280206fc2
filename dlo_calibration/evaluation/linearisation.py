# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Linearisation: how residuals change with the parameters near a point of the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterable, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

# Steps of finite differences, in the unit cube:
STEP = 0.03  # usual; over shorter ones, contacts that come and go dominate the residuals
WIDEST = 0.25  # largest, for parameters that are hardly known; the linear model holds no further
TINY = float(np.finfo(float).tiny)  # keeps a divisor above zero

Rows = Union[slice, NDArray[np.intp]]  # of a Jacobian: a trial's, or those of several trials


@dataclass(frozen=True)
class Linearisation:
    """
    A linear model of the residuals near a point.

    :param point: (d,) in the unit cube.
    :param residuals: (m,) [m] at that point.
    :param jacobian: (m, d) derivatives of the residuals by the parameters [m per unit cube].
    """

    point: Floats
    residuals: Floats
    jacobian: Floats

    @property
    def information(self) -> Floats:
        """The (d, d) information J^T J [m^2], for a unit noise level."""
        return information(self.jacobian)

    @property
    def gradient(self) -> Floats:
        """The (d,) gradient J^T r [m^2] of half the sum of squared residuals."""
        return np.asarray(self.jacobian.T @ self.residuals)

    @property
    def ridge(self) -> Floats:
        """A very weak (d, d) prior information, which keeps a parameter without effect where it is."""
        return np.eye(len(self.point)) * max(1e-9 * float(np.trace(self.information)), TINY)

    def weighted(self, weights: Floats) -> Linearisation:
        """Return the model with each residual and its derivatives multiplied by its weight, (m,)."""
        return Linearisation(self.point, weights * self.residuals, weights[:, None] * self.jacobian)

    def rows(self, rows: Rows) -> Linearisation:
        """Return the model of some of the residuals."""
        return Linearisation(self.point, self.residuals[rows], self.jacobian[rows])

    def columns(self, columns: NDArray[np.intp] | NDArray[np.bool_]) -> Linearisation:
        """Return the model in some of the parameters; the others are fixed."""
        return Linearisation(self.point[columns], self.residuals, self.jacobian[:, columns])

    def predicted(self, step: Floats) -> Floats:
        """Return the (m,) residuals [m] after a (d,) step."""
        return np.asarray(self.residuals + self.jacobian @ step)

    def at(self, point: Floats) -> Linearisation:
        """Return the model around another (d,) point, as this one predicts it."""
        return Linearisation(point, self.predicted(point - self.point), self.jacobian)

    def step(self, prior: Floats | None = None) -> Floats:
        """
        Return the (d,) Gauss-Newton step to the least sum of squared residuals.

        :param prior: (d, d) prior information that is added; None: no prior.
        """
        if prior is None:
            return np.asarray(np.linalg.lstsq(self.jacobian, -self.residuals, rcond=None)[0])
        return np.asarray(-np.linalg.solve(self.information + prior, self.gradient))

    def own_weights(self, k: int) -> Floats:
        """Return (m,) weights that turn a change of the residuals into the change of parameter k alone."""
        own = perpendicular(np.delete(self.jacobian, k, axis=1), self.jacobian[:, k])
        return np.asarray(own / max(float(own @ own), TINY))


def information(jacobian: Floats, scale: float = 1.0) -> Floats:
    """Return the (d, d) information J^T J / scale^2 of an (m, d) Jacobian; `scale` [m] is the noise level."""
    return np.asarray(jacobian.T @ jacobian / scale**2)


def standard_deviations(known: Floats) -> Floats:
    """Return the (d,) standard deviations of the posterior with a (d, d) information."""
    return np.sqrt(np.diag(np.linalg.inv(known)))


def perpendicular(columns: Floats, vector: Floats) -> Floats:
    """Return the part of an (m,) vector that is perpendicular to (m, k) columns."""
    basis, _ = np.linalg.qr(columns)
    return np.asarray(vector - basis @ (basis.T @ vector))


def inward(point: Floats, steps: Floats) -> Floats:
    """Return (d,) steps from a (d,) point, with the sign changed where they would leave the unit cube."""
    return np.where((point + steps > 1) | (point + steps < 0), -steps, steps)


def both_sides(point: Floats, columns: Iterable[int | np.intp], steps: Floats) -> Floats:
    """Return (2 k, d) points below and above a (d,) point in each of k parameters, within the unit cube."""
    beside = []
    for k in columns:
        for step in (-steps[k], steps[k]):
            beside.append(point.copy())
            beside[-1][k] = min(max(point[k] + step, 0.0), 1.0)
    return np.array(beside).reshape(-1, len(point))


def slope(values: Iterable[float], seen: Sequence[Floats | None]) -> Floats | None:
    """
    Return the (m,) difference quotient between the smallest and the largest value of a parameter.

    :param seen: the (m,) residuals at each value; None if the simulation failed, and the value is left out.
    :returns: None if fewer than two different values are left.
    """
    known = [(float(value), one) for value, one in zip(values, seen, strict=True) if one is not None]
    if not known:
        return None
    low, before = min(known, key=lambda one: one[0])
    high, after = max(known, key=lambda one: one[0])
    return np.asarray((after - before) / (high - low)) if high > low else None
