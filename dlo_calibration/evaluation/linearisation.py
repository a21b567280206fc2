# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Linearisation: how residuals change with the parameters near a point of the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from typing import Iterable, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

# Steps of finite differences, in the unit cube:
STEP = 0.03  # usual; over shorter ones, contacts that come and go dominate the residuals
WIDEST = 0.25  # largest, for parameters that are hardly known; the linear model holds no further
TINY = float(np.finfo(float).tiny)  # keeps a divisor above zero

Rows = Union[slice, NDArray[np.intp]]  # of a Jacobian: a trial's, or those of several trials
Columns = Union[Sequence[int], NDArray[np.intp]]  # of a Jacobian, by their indices


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


def broyden(jacobian: Floats, step: Floats, surprise: Floats) -> Floats:
    """
    Return an (m, d) Jacobian updated after a (d,) step (Broyden's rank-one update).

    Nocedal and Wright, Numerical Optimization, 2nd ed., 11.1.

    :param surprise: (m,) by how much the residuals after the step differ from those it predicted [m].
    """
    return np.asarray(jacobian + np.outer(surprise, step / (step @ step)))


@dataclass(frozen=True)
class Differences:
    """
    Finite differences near a point: the points to evaluate, and the derivatives that they give.

    :param point: (d,).
    :param columns: indices of the k parameters that are varied.
    :param beside: for each of them, (p, d) points that differ from `point` in it alone.
    """

    point: Floats
    columns: Columns
    beside: Sequence[Floats]

    @classmethod
    def one_sided(cls, point: Floats, columns: Columns, steps: Floats) -> Differences:
        """Return those with one point for each of k parameters, at its signed one of (d,) steps."""
        beside = np.tile(point, (len(columns), 1))
        beside[np.arange(len(columns)), columns] += steps[columns]
        return cls(point, columns, [row[None] for row in beside])

    @classmethod
    def central(cls, point: Floats, columns: Columns, steps: Floats) -> Differences:
        """Return those with a point below and one above in each of k parameters, within the unit cube."""
        pairs = []
        for k in columns:
            pairs.append(np.stack([point, point]))
            pairs[-1][:, k] = np.clip(point[k] + np.array([-steps[k], steps[k]]), 0.0, 1.0)
        return cls(point, columns, pairs)

    @property
    def points(self) -> Floats:
        """The (n, d) points to evaluate, those of each parameter in turn."""
        return np.concatenate([np.zeros((0, len(self.point))), *self.beside])

    def jacobian(self, before: Floats, residuals: Iterable[Floats | None], here: Floats | None = None
                 ) -> Floats:
        """
        Return an (m, d) Jacobian with the columns that the differences give, and the others of `before`.

        A column is the difference quotient between the smallest and the largest value of its parameter.

        :param residuals: the (m,) residuals at each of `points`; None where the simulation failed.
        :param here: (m,) those at `point`, which stand in for a failed side; None: they are not used.
        """
        jacobian, each = before.copy(), iter(residuals)
        for k, beside in zip(self.columns, self.beside, strict=True):
            values = (self.point[k], *beside[:, k])
            known = [(value, seen) for value, seen in zip(
                values, (here, *islice(each, len(beside))), strict=True) if seen is not None]
            low, at_low = min(known, key=itemgetter(0), default=(0.0, np.nan))
            high, at_high = max(known, key=itemgetter(0), default=(0.0, np.nan))
            if high > low:
                jacobian[:, k] = (at_high - at_low) / (high - low)
        return jacobian
