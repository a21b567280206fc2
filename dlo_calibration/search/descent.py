# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Descent: the state of one Gauss-Newton descent, its linear model of the residuals and its next step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import broyden, Ends, Linearisation, TINY
from dlo_calibration.evaluation.residuals import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import Observation

#: Largest distance, in each parameter, at which a Jacobian is still valid and two minima count as the same.
NEAR = 0.03
#: How far points along a valley are on both sides: basins of stick and slip are 0.03 to 0.1 wide.
ALONG = np.concatenate([np.arange(0.02, 0.11, 0.02), np.arange(0.12, 0.38, 0.04)])
MIXED = 0.2  # second largest component of the direction of a valley, at least
STEEP = 1e-12  # share of the largest possible slope that counts as none


def bounded_least_squares(matrix: Floats, right: Floats, least: Floats, most: Floats) -> Floats:
    """
    Return the x (d,) with the least |matrix x - right| within bounds.

    The method is that of Stark and Parker, Bounded-variable least-squares, 1995.  `scipy.optimize.lsq_linear`
    finds the same up to rounding, but takes longer to load than a short search.

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
    """Return the best x that changes only free unknowns; those that reach a bound stay there."""
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


@dataclass
class Descent:
    """
    State of one descent in the box of d parameters.

    :param point: (d,) current point.
    :param residuals: (m,) [m] at that point.
    :param loss: robust loss; its threshold never grows during the descent.
    :param jacobian: (m, d) [m per unit], measured at `origin` and updated by later steps.
    :param radius: largest step in each parameter.
    :param roughness: [m] root mean square of the residuals' change that the model missed in the last step.
    :param origin: (d,) where the Jacobian was measured by finite differences; None: it was not.
    :param moves: number of moves since then.
    :param ended: why the descent ended, in words; empty while it goes on.
    :param upper: (d,) upper ends of the box, or one for all; the lower ones are 0.
    """

    point: Floats
    residuals: Floats
    loss: Huber
    jacobian: Floats
    radius: float = 0.25
    roughness: float = 0.0
    origin: Floats | None = None
    moves: int = 0
    ended: str = ''
    upper: Ends = 1.0

    @property
    def cost(self) -> float:
        """Robust cost [m^2] of the current residuals."""
        return self.loss.cost(self.residuals)

    @property
    def model(self) -> Linearisation:
        """Linear model of the residuals around the current point."""
        return Linearisation(self.point, self.residuals, self.jacobian, self.upper)

    @property
    def jacobian_is_fresh(self) -> bool:
        """Whether the Jacobian was measured at a point near the current one."""
        return self.origin is not None and bool(np.abs(self.point - self.origin).max() <= NEAR)

    def has_rival(self, starts: Sequence[Observation]) -> bool:
        """Tell whether a start point is as promising: it costs less than three times the current point."""
        return any(self.loss.cost(start.residuals) < 3 * self.cost for start in starts)

    def move(self, observation: Observation) -> None:
        """Move to an observed point; keep the Jacobian."""
        assert observation.residuals is not None
        self.point, self.residuals = observation.point, observation.residuals
        loss = Huber.of(self.residuals)
        if loss.threshold < self.loss.threshold:  # it only falls: costs of one descent stay comparable
            self.loss = loss

    def visible(self) -> NDArray[np.bool_]:
        """Return (d,) True where a unit of a parameter changes the residuals visibly."""
        size = np.linalg.norm(self.jacobian, axis=0)
        return np.asarray(size > max(self.loss.threshold, 1e-9 * float(size.max(initial=0.0))))

    def step(self, radius: float) -> Floats:
        """Return the (d,) step that minimises the model within the box and the radius."""
        free = self.visible()
        step = np.zeros(len(self.point))
        least = np.maximum(-self.point, -radius)[free]
        most = np.minimum(self.upper - self.point, radius)[free]
        movable = most - least > 1e-12
        columns = np.flatnonzero(free)[movable]
        if not len(columns):
            return step
        model = self.model.columns(columns).weighted(self.loss.roots(self.residuals))
        # A QR decomposition reduces m rows to d with the same solution; damping, relative to the largest
        # column, keeps parameters without effect where they are.
        upper, rest = _reduced(model.jacobian, -model.residuals)
        damping = 1e-4 * np.linalg.norm(model.jacobian, axis=0).max()
        upper = np.concatenate([upper, damping * np.eye(len(columns))])
        rest = np.concatenate([rest, np.zeros(len(columns))])
        step[columns] = bounded_least_squares(upper, rest, least[movable], most[movable])
        return step

    def axis_steps(self, radius: float) -> list[Floats]:
        """Return the (d,) step along each principal axis of the model, within box and radius."""
        columns = np.flatnonzero(self.visible())
        model = self.model.columns(columns).weighted(self.loss.roots(self.residuals))
        curvatures, axes = np.linalg.eigh(model.information)
        steps = []
        for curvature, axis in zip(curvatures, axes.T, strict=True):
            step = np.zeros(len(self.point))
            step[columns] = -axis * (axis @ model.gradient) / max(float(curvature), TINY)
            share = min(1.0, radius / max(float(np.abs(step).max()), TINY))
            steps.append(np.clip(self.point + share * step, 0.0, self.upper) - self.point)
        return steps

    def valley(self) -> Floats:
        """
        Return points (n, d), on both sides, along the valley in which parameters make up for each other.

        It is the flattest principal axis of the model that changes two parameters or more; without, n is 0.
        """
        columns = np.flatnonzero(self.visible())
        model = self.model.columns(columns).weighted(self.loss.roots(self.residuals))
        for axis in np.linalg.eigh(model.information)[1].T:
            if len(axis) > 1 and np.sort(np.abs(axis))[-2] > MIXED:
                points = np.tile(self.point, (2 * len(ALONG), 1))
                points[:, columns] += np.concatenate([-ALONG, ALONG])[:, None] * axis
                return points[((points >= 0.0) & (points <= self.upper)).all(axis=1)]
        return np.zeros((0, len(self.point)))

    def predicted(self, step: Floats) -> float:
        """Return the cost [m^2] that the model predicts after a (d,) step."""
        return self.loss.cost(self.model.predicted(step))

    def update_jacobian(self, observation: Observation, base: Floats, before: Floats) -> None:
        """
        Update the Jacobian so that it predicts the observed residuals.

        :param base: (d,) where the step began; `before` (m,) the residuals there [m].
        """
        if observation.residuals is None:
            return
        step = observation.point - base
        if float(step @ step) < 1e-16:
            return
        surprise = observation.residuals - before - self.jacobian @ step
        self.roughness = float(np.sqrt(np.mean(surprise ** 2)))
        self.jacobian = broyden(self.jacobian, step, surprise)


def _reduced(matrix: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Reduce an (m, d) matrix and its right side to (d, d) and (d,) with the same least-squares solution."""
    if len(matrix) <= matrix.shape[1]:
        return matrix, right
    q, r = np.linalg.qr(matrix)
    return r, q.T @ right
