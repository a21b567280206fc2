# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Objective: how far a DLO is from its goal, which a plan minimises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.score import difference_score, difference_vector, VERY_SIMILAR
from dlo_calibration.planning.options import POINTS

REFERENCE = 0  # focal point of the score: the first point, as no hand holds the DLO at the end of a plan


class Objective:
    """
    The distance of chains from a goal.

    The features of the difference score are the points that an annotator marked, else both ends, so
    that the place and the orientation of the DLO count.

    :param start: whose marked points are features, too.
    :param kind: `points` (the mean distance of points) or `score` (the paper's difference score).
    :param tolerance: mean distance of points [m] that counts as reached.
    """

    def __init__(self, start: Chain, goal: Chain, kind: str, tolerance: float) -> None:
        self._goal = goal.points
        self._kind = kind
        self._tolerance = tolerance
        marked = np.flatnonzero(start.features | goal.features)
        self._features: NDArray[np.intp] = marked if len(marked) else np.array([0, len(goal) - 1])

    @property
    def goal(self) -> Floats:
        """Points of the goal, (n, 3) [m]."""
        return self._goal

    @property
    def enough(self) -> float:
        """The `cost` that counts as reached: the tolerance, or a score of chains that are very similar."""
        return self._tolerance if self._kind == POINTS else VERY_SIMILAR

    def cost(self, points: Floats) -> float:
        """Return what is minimised, for an (n, 3) [m] chain: `error` [m] or `score` [cm]."""
        return self.error(points) if self._kind == POINTS else self.score(points)

    def residuals(self, points: Floats) -> Floats:
        """Return the (m,) [m] whose squares are minimised where the cost is."""
        if self._kind == POINTS:
            return (points - self._goal).ravel()
        return difference_vector(self._goal, points, REFERENCE, self._features)

    def error(self, points: Floats) -> float:
        """Return the mean distance [m] of the points of an (n, 3) [m] chain from those of the goal."""
        return float(np.linalg.norm(points - self._goal, axis=1).mean())

    def score(self, points: Floats) -> float:
        """Return the difference score [cm] of an (n, 3) [m] chain."""
        return difference_score(self._goal, points, REFERENCE, self._features)
