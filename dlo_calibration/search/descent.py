# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A descent: where it stands, what its linear model of the residuals says, and the step that follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import Observation

FIRST_RADIUS = 0.25  # of a step, in each parameter
DAMPING = 1e-4  # of the largest column's length: enough that a parameter without effect stays
NEAR = 0.03  # so near a Jacobian counts as measured here, and another minimum as the same
RIVAL = 3.0  # times the cost where a slow descent stands: a start that costs less is as promising


@dataclass
class Descent:
    """Where a descent stands; the Jacobian was measured at `origin`, and updated since by some steps."""

    point: Floats
    residuals: Floats
    loss: Huber
    jacobian: Floats
    radius: float = FIRST_RADIUS
    roughness: float = 0.0  # [m] root mean square of what the last step's model did not predict
    origin: Floats | None = None
    updates: int = 0  # moves since the Jacobian was measured
    ended: str = ''

    @property
    def cost(self) -> float:
        """By its loss [m^2]."""
        return self.loss.cost(self.residuals)

    @property
    def model(self) -> Linearisation:
        """Linear model of the residuals around it."""
        return Linearisation(self.point, self.residuals, self.jacobian)

    @property
    def known_here(self) -> bool:
        """Whether the Jacobian was measured no further away than its own differences reach."""
        return self.origin is not None and bool(np.abs(self.point - self.origin).max() <= NEAR)

    def rivals(self, starts: Sequence[Observation]) -> bool:
        """Whether one of the starts costs hardly more than it does here."""
        return any(self.loss.cost(one.residuals) < RIVAL * self.cost for one in starts)

    def move(self, observation: Observation) -> None:
        """Go on from an observation; the Jacobian stays."""
        assert observation.residuals is not None
        self.point, self.residuals = observation.point, observation.residuals
        loss = Huber.of(self.residuals)
        if loss.threshold < self.loss.threshold:  # never larger again, so that costs of one descent compare
            self.loss = loss

    def measured(self) -> NDArray[np.bool_]:
        """(d,) True where going from 0 to 1 changes the residuals by more than their spread."""
        size = np.linalg.norm(self.jacobian, axis=0)
        measured: NDArray[np.bool_] = size > max(self.loss.threshold, 1e-9 * float(size.max(initial=0.0)))
        return measured

    def step(self, radius: float) -> Floats:
        """Return the (d,) step to the lowest point of the model within the cube and the radius."""
        from scipy.optimize import lsq_linear

        free = self.measured()
        step = np.zeros(len(self.point))
        least = np.maximum(-self.point, -radius)[free]
        most = np.minimum(1 - self.point, radius)[free]
        movable = most - least > 1e-12
        columns = np.flatnonzero(free)[movable]
        if not len(columns):
            return step
        model = self.model.columns(columns).weighted(self.loss.roots(self.residuals))
        # Only the product matters to the solution: d rows in place of m.
        upper, rest = _reduced(model.jacobian, -model.residuals)
        damping = DAMPING * np.linalg.norm(model.jacobian, axis=0).max()
        upper = np.concatenate([upper, damping * np.eye(len(columns))])
        rest = np.concatenate([rest, np.zeros(len(columns))])
        solution = lsq_linear(upper, rest, (least[movable], most[movable]), method='bvls')
        step[columns] = solution.x
        return step

    def predicted(self, step: Floats) -> float:
        """Return the cost [m^2] that the model promises after a (d,) step."""
        return self.loss.cost(self.model.predicted(step))

    def learn(self, one: Observation, base: Floats, before: Floats) -> None:
        """Update the Jacobian so that it predicts what a step gave (Broyden's rank-one update)."""
        if one.residuals is None:
            return
        step = one.point - base
        square = float(step @ step)
        if square < 1e-16:
            return
        surprise = one.residuals - before - self.jacobian @ step
        self.roughness = float(np.sqrt(np.mean(surprise ** 2)))
        self.jacobian = self.jacobian + np.outer(surprise, step / square)


def _reduced(matrix: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return (d, d) and (d,) that have the same least-squares solution as (m, d) and (m,)."""
    if len(matrix) <= matrix.shape[1]:
        return matrix, right
    q, r = np.linalg.qr(matrix)
    return r, q.T @ right
