# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Refinement of displacements by damped least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Generator, Generic, Sequence, TypeVar

import numpy as np

from dlo_calibration.model.chain import Floats

DIFFERENCE = 0.012  # m, step of a finite difference; friction makes smaller ones misleading
SHARES = (0.3, 1.0, 1.5)  # of the Gauss-Newton step that are tried together
LONGEST = 0.15  # m, of a step of one displacement
DAMPING = 0.02  # of the mean curvature
WORTH = 0.97  # of the squares; a step that leaves more of them ends the refinement

Seen = TypeVar('Seen')

#: It yields points, (d,) [m] each, receives what is seen there (None: impossible), and returns the best.
Refinement = Generator[list[Floats], Sequence['Seen | None'], 'Best[Seen]']


@dataclass(frozen=True)
class Best(Generic[Seen]):
    """A point, (d,) [m], and what was seen there."""

    point: Floats
    seen: Seen


def refine(start: Best[Seen], residuals: Callable[[Seen], Floats], iterations: int) -> Refinement[Seen]:
    """
    Minimise the squares of residuals by Gauss-Newton steps.

    The method is that of Nocedal and Wright, Numerical Optimization, 2nd ed., 10.3.  Finite
    differences give the Jacobian, and Broyden's update (ibid., 11.1) corrects it after each step.

    :param start: where it begins.
    :param residuals: of what was seen, (m,) [m].
    :param iterations: at most.
    """
    best, here = start, residuals(start.seen)
    jacobian: Floats | None = None
    for _ in range(iterations):
        tried: list[Best[Seen]] = []
        if jacobian is None:
            outward = np.where(best.point < 0, -DIFFERENCE, DIFFERENCE)
            points = [best.point + step for step in np.diag(outward)]
            seen = yield points
            jacobian = np.zeros((len(here), len(best.point)))
            for k, (point, one) in enumerate(zip(points, seen, strict=True)):
                if one is not None:
                    jacobian[:, k] = (residuals(one) - here) / (point[k] - best.point[k])
                    tried.append(Best(point, one))
        step = _step(jacobian, here)
        points = [best.point + share * step for share in SHARES]
        seen = yield points
        tried += [Best(point, one) for point, one in zip(points, seen, strict=True) if one is not None]
        costs = [float(np.sum(residuals(one.seen)**2)) for one in tried]
        if not tried or min(costs) >= WORTH * float(here @ here):
            break
        moved = tried[int(np.argmin(costs))]
        change = moved.point - best.point
        there = residuals(moved.seen)
        jacobian += np.outer(there - here - jacobian @ change, change) / (change @ change)
        best, here = moved, there
    return best


def _step(jacobian: Floats, residual: Floats) -> Floats:
    """Return the damped Gauss-Newton step, (d,) [m]."""
    curvature = jacobian.T @ jacobian
    damping = DAMPING * np.trace(curvature) / len(curvature) + 1e-9
    step = -np.linalg.solve(curvature + damping * np.eye(len(curvature)), jacobian.T @ residual)
    return np.asarray(step * min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-12)))
