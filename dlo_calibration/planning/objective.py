# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Objective: how far a DLO is from its goal, which a plan minimises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.score import difference_score, difference_vector
from dlo_calibration.planning.options import SCORE

REFERENCE = 0  # focal point of the score: the first point, as no hand holds the DLO at the end of a plan


class Objective:
    """
    The distance of chains from a goal.

    It is the mean distance of the points.  With `score`, the paper's difference score for each of its terms
    is added; alone, it would forgive all differences that cancel.  Its features are the points that an
    annotator marked, else both ends, so that the place and the orientation of the DLO count.

    :param start: whose marked points are features, too.
    :param kind: `points` or `score`.
    """

    def __init__(self, start: Chain, goal: Chain, kind: str) -> None:
        self._goal = goal.points
        self._scored = kind == SCORE
        marked = np.flatnonzero(start.features | goal.features)
        self._features: NDArray[np.intp] = marked if len(marked) else np.array([0, len(goal) - 1])
        self._terms = len(goal) + len(self._features)

    @property
    def goal(self) -> Floats:
        """Points of the goal, (n, 3) [m]."""
        return self._goal

    def cost(self, points: Floats) -> float:
        """Return what is minimised [m], for an (n, 3) [m] chain."""
        return self.error(points) + (self.score(points) / 100 / self._terms if self._scored else 0.0)

    def residuals(self, points: Floats) -> Floats:
        """Return the (m,) [m] whose sum of squares is minimised in place of the cost."""
        distances: Floats = (points - self._goal).ravel() / np.sqrt(len(points))
        if not self._scored:
            return distances
        vector = difference_vector(self._goal, points, REFERENCE, self._features)
        return np.concatenate([distances, vector / self._terms])

    def error(self, points: Floats) -> float:
        """Return the mean distance [m] of the points of an (n, 3) [m] chain from those of the goal."""
        return float(np.linalg.norm(points - self._goal, axis=1).mean())

    def score(self, points: Floats) -> float:
        """Return the difference score [cm] of an (n, 3) [m] chain."""
        return difference_score(self._goal, points, REFERENCE, self._features)
