# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Linearisation: how residuals change with the parameters near a point of the box of a search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from operator import itemgetter
from typing import Iterable, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

# Steps of finite differences, in units of a search:
STEP = 0.03  # usual; over shorter ones, contacts that come and go dominate the residuals
WIDEST = 0.25  # largest, for parameters of large uncertainty; beyond it, the linear model does not hold
TINY = float(np.finfo(float).tiny)  # keeps a divisor above zero

Ends = Union[Floats, float]  # of the box in each parameter, or of all
Rows = Union[slice, NDArray[np.intp]]  # of a Jacobian: those of one or several trials
Columns = Union[Sequence[int], NDArray[np.intp]]  # of a Jacobian: indices


@dataclass(frozen=True)
class Linearisation:
    """
    A linear model of the residuals near a point.

    :param point: (d,) in the box.
    :param residuals: (m,) [m] at that point.
    :param jacobian: (m, d) derivatives of the residuals by the parameters [m per unit].
    :param upper: (d,) upper ends of the box, or one for all; the lower ones are 0.
    """

    point: Floats
    residuals: Floats
    jacobian: Floats
    upper: Ends = 1.0

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
        """A very weak (d, d) prior information, so that a parameter without effect keeps its value."""
        return np.eye(len(self.point)) * max(1e-9 * float(np.trace(self.information)), TINY)

    def weighted(self, weights: Floats) -> Linearisation:
        """Return the model with each residual and its derivatives multiplied by its weight, (m,)."""
        return replace(self, residuals=weights * self.residuals, jacobian=weights[:, None] * self.jacobian)

    def rows(self, rows: Rows) -> Linearisation:
        """Return the model of the residuals in some rows."""
        return replace(self, residuals=self.residuals[rows], jacobian=self.jacobian[rows])

    def columns(self, columns: NDArray[np.intp] | NDArray[np.bool_]) -> Linearisation:
        """Return the model in some of the parameters; the others are fixed."""
        upper = np.broadcast_to(self.upper, self.point.shape)[columns]
        return Linearisation(self.point[columns], self.residuals, self.jacobian[:, columns], upper)

    def predicted(self, step: Floats) -> Floats:
        """Return the (m,) residuals [m] after a (d,) step."""
        return np.asarray(self.residuals + self.jacobian @ step)

    def at(self, point: Floats) -> Linearisation:
        """Return the model around another (d,) point, with the residuals that this model predicts there."""
        return replace(self, point=point, residuals=self.predicted(point - self.point))

    def step(self, prior: Floats | None = None) -> Floats:
        """
        Return the (d,) Gauss-Newton step to the least sum of squared residuals.

        :param prior: (d, d) prior information, added to that of the residuals; None: no prior.
        """
        if prior is None:
            return np.asarray(np.linalg.lstsq(self.jacobian, -self.residuals, rcond=None)[0])
        return np.asarray(-np.linalg.solve(self.information + prior, self.gradient))

    def own_weights(self, k: int) -> Floats:
        """Return (m,) weights whose product with a change of the residuals is the change of parameter k."""
        own = perpendicular(np.delete(self.jacobian, k, axis=1), self.jacobian[:, k])
        return np.asarray(own / max(float(own @ own), TINY))


def information(jacobian: Floats, scale: float = 1.0) -> Floats:
    """Return the (d, d) information J^T J / scale^2 of an (m, d) Jacobian; `scale` [m] is the noise level."""
    return np.asarray(jacobian.T @ jacobian / scale**2)


def standard_deviations(posterior: Floats) -> Floats:
    """Return the (d,) standard deviations of a posterior, given its (d, d) information."""
    return np.sqrt(np.diag(np.linalg.inv(posterior)))


def perpendicular(columns: Floats, vector: Floats) -> Floats:
    """Return the part of an (m,) vector that is perpendicular to (m, k) columns."""
    basis, _ = np.linalg.qr(columns)
    return np.asarray(vector - basis @ (basis.T @ vector))


def broyden(jacobian: Floats, step: Floats, surprise: Floats) -> Floats:
    """
    Return an (m, d) Jacobian updated after a (d,) step (Broyden's rank-one update).

    Nocedal and Wright, Numerical Optimization, 2nd ed., 11.1.

    :param surprise: (m,) [m] observed minus predicted residuals after the step.
    """
    return np.asarray(jacobian + np.outer(surprise, step / (step @ step)))


@dataclass(frozen=True)
class Differences:
    """
    Finite differences near a point: the points to evaluate, and the derivatives from their residuals.

    :param point: (d,).
    :param columns: indices of the k parameters that are varied.
    :param beside: for each of them, (p, d) points that differ from `point` in this parameter only.
    """

    point: Floats
    columns: Columns
    beside: Sequence[Floats]

    @classmethod
    def one_sided(cls, point: Floats, columns: Columns, steps: Floats) -> Differences:
        """Return one-sided differences: one point for each of k parameters, at its signed step of (d,)."""
        beside = np.tile(point, (len(columns), 1))
        beside[np.arange(len(columns)), columns] += steps[columns]
        return cls(point, columns, [row[None] for row in beside])

    @classmethod
    def central(cls, point: Floats, columns: Columns, steps: Floats, upper: Ends = 1.0) -> Differences:
        """Return central differences: two points for each of k parameters, within the box up to `upper`."""
        pairs, ends = [], np.broadcast_to(upper, point.shape)
        for k in columns:
            pairs.append(np.stack([point, point]))
            pairs[-1][:, k] = np.clip(point[k] + np.array([-steps[k], steps[k]]), 0.0, ends[k])
        return cls(point, columns, pairs)

    @property
    def points(self) -> Floats:
        """The (n, d) points to evaluate, parameter by parameter."""
        return np.concatenate([np.zeros((0, len(self.point))), *self.beside])

    def jacobian(self, before: Floats, residuals: Iterable[Floats | None], here: Floats | None = None
                 ) -> Floats:
        """
        Return the (m, d) Jacobian `before` with the columns of the varied parameters replaced.

        A column is the difference quotient between the smallest and the largest value of its parameter; it is
        that of `before` if there are not two values.

        :param residuals: the (m,) residuals at each of `points`; None where the simulation failed.
        :param here: the (m,) residuals at `point`, which replace those of a failed side; None: unused.
        """
        jacobian, remaining = before.copy(), iter(residuals)
        for k, beside in zip(self.columns, self.beside, strict=True):
            values = (self.point[k], *beside[:, k])
            samples = [(value, sample) for value, sample in zip(
                values, (here, *islice(remaining, len(beside))), strict=True) if sample is not None]
            low, at_low = min(samples, key=itemgetter(0), default=(0.0, np.nan))
            high, at_high = max(samples, key=itemgetter(0), default=(0.0, np.nan))
            if high > low:
                jacobian[:, k] = (at_high - at_low) / (high - low)
        return jacobian
