# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Linearisation: how residuals change with the parameters near a point of the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

STEP = 0.03  # of a difference, in the unit cube; contacts that come and go change the residuals over less
WIDEST = 0.25  # of a difference, even where a parameter is known no better: a quarter of its scale
RIDGE = 1e-9  # of the trace of the information: enough that a parameter without effect stays where it is
TINY = float(np.finfo(float).tiny)  # in place of a zero that is divided by


@dataclass(frozen=True)
class Linearisation:
    """
    A linear model of the residuals.

    :param point: (d,) in the unit cube.
    :param residuals: (m,) [m] there.
    :param jacobian: (m, d) their derivative by the parameters [m per unit cube].
    """

    point: Floats
    residuals: Floats
    jacobian: Floats

    @property
    def information(self) -> Floats:
        """(d, d) J^T J."""
        return information(self.jacobian)

    @property
    def gradient(self) -> Floats:
        """(d,) J^T r, of half the sum of squares."""
        return np.asarray(self.jacobian.T @ self.residuals)

    @property
    def ridge(self) -> Floats:
        """(d, d) a prior information that is next to nothing."""
        return np.eye(len(self.point)) * max(RIDGE * float(np.trace(self.information)), TINY)

    def weighted(self, weights: Floats) -> Linearisation:
        """Return it with each residual and its derivatives times one of (m,) weights."""
        return Linearisation(self.point, weights * self.residuals, weights[:, None] * self.jacobian)

    def rows(self, rows: slice) -> Linearisation:
        """Return that of some of the residuals."""
        return Linearisation(self.point, self.residuals[rows], self.jacobian[rows])

    def columns(self, columns: NDArray[np.intp] | NDArray[np.bool_]) -> Linearisation:
        """Return that of some of the parameters; the others stay where they are."""
        return Linearisation(self.point[columns], self.residuals, self.jacobian[:, columns])

    def predicted(self, step: Floats) -> Floats:
        """Return the (m,) residuals [m] after a (d,) step."""
        return np.asarray(self.residuals + self.jacobian @ step)

    def step(self, prior: Floats | None = None) -> Floats:
        """
        Return the (d,) Gauss-Newton step to the lowest sum of squares.

        :param prior: (d, d) added to the information; None: nothing is.
        """
        if prior is None:
            return np.asarray(np.linalg.lstsq(self.jacobian, -self.residuals, rcond=None)[0])
        return np.asarray(-np.linalg.solve(self.information + prior, self.gradient))

    def own_weights(self, k: int) -> Floats:
        """Return (m,) weights that sum up a change of the residuals to how far k moved, not the others."""
        own = perpendicular(np.delete(self.jacobian, k, axis=1), self.jacobian[:, k])
        return np.asarray(own / max(float(own @ own), TINY))


def information(jacobian: Floats, scale: float = 1.0) -> Floats:
    """Return the (d, d) information J^T J / scale^2 of (m, d) derivatives; `scale` [m] is the error."""
    return np.asarray(jacobian.T @ jacobian / scale**2)


def standard_deviations(known: Floats) -> Floats:
    """Return the (d,) standard deviations that a (d, d) information leaves."""
    return np.sqrt(np.diag(np.linalg.inv(known)))


def perpendicular(columns: Floats, vector: Floats) -> Floats:
    """Return the part of an (m,) vector that no combination of (m, k) columns has."""
    basis, _ = np.linalg.qr(columns)
    return np.asarray(vector - basis @ (basis.T @ vector))


def inward(point: Floats, steps: Floats) -> Floats:
    """Return (d,) steps from a (d,) point, turned round where they would leave the unit cube."""
    return np.where((point + steps > 1) | (point + steps < 0), -steps, steps)


def both_sides(point: Floats, columns: Iterable[int | np.intp], steps: Floats) -> Floats:
    """Return the points below and above a (d,) point in each of k parameters, (2 k, d) in the unit cube."""
    beside = []
    for k in columns:
        for step in (-steps[k], steps[k]):
            beside.append(point.copy())
            beside[-1][k] = min(max(point[k] + step, 0.0), 1.0)
    return np.array(beside).reshape(-1, len(point))


def slope(values: Iterable[float], seen: Sequence[Floats | None]) -> Floats | None:
    """
    Return the (m,) derivative between the outermost of some values of a parameter.

    :param seen: (m,) what each gave, or None where it could not be simulated.
    :returns: None where fewer than two different ones could be.
    """
    known = [(float(value), one) for value, one in zip(values, seen, strict=True) if one is not None]
    if not known:
        return None
    low, before = min(known, key=lambda one: one[0])
    high, after = max(known, key=lambda one: one[0])
    return np.asarray((after - before) / (high - low)) if high > low else None
