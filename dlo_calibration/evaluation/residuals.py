# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Residuals: the flat vector of all trials, seen by trial, goal, point and coordinate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class ResidualLayout:
    """
    Where in a residual vector (m,) each trial is.

    The vector goes trial by trial, goal by goal, point by point, coordinate by coordinate, and so do
    the rows of its Jacobian.

    :param shapes: (goals, points) of each of T trials.
    """

    shapes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> ResidualLayout:
        """Return the layout of the residuals of trials."""
        return cls(tuple((len(trial.goals), len(trial.initial)) for trial in trials))

    @property
    def rows(self) -> list[slice]:
        """The rows of each of the T trials."""
        ends = np.cumsum([0, *(3 * goals * points for goals, points in self.shapes)]).tolist()
        return [slice(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]

    def folds(self, most: int) -> list[slice]:
        """Return the rows of each fold of a cross-validation: a trial, or neighbours where they are many."""
        rows = self.rows
        groups = np.array_split(np.arange(len(rows)), min(len(rows), most))
        return [slice(rows[group[0]].start, rows[group[-1]].stop) for group in groups]

    def chains(self, residuals: Floats) -> list[Floats]:
        """Return (goals, points, 3) [m] of each trial, of (m,) residuals [m]."""
        return [residuals[rows].reshape(*shape, 3)
                for rows, shape in zip(self.rows, self.shapes, strict=True)]

    def by_point(self, values: Floats) -> list[Floats]:
        """Return (goals, points) of each trial, of (m / 3,) values that each point has one of."""
        return [values[rows.start // 3:rows.stop // 3].reshape(shape)
                for rows, shape in zip(self.rows, self.shapes, strict=True)]
