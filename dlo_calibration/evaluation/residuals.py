# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ResidualLayout: where the residuals of each trial, goal and point are in the vector of all trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class ResidualLayout:
    """
    The order of a residual vector (m,): by trial, goal, point and coordinate.

    The rows of its Jacobian have the same order.

    :param shapes: numbers of goals and points of each of T trials.
    """

    shapes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> ResidualLayout:
        """Return the layout of the residuals of trials."""
        return cls(tuple((len(trial.goals), len(trial.initial)) for trial in trials))

    @property
    def rows(self) -> list[slice]:
        """The rows of each trial, T slices."""
        ends = np.cumsum([0, *(3 * goals * points for goals, points in self.shapes)]).tolist()
        return [slice(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]

    def folds(self, most: int) -> list[slice]:
        """Return the rows of each fold of a cross-validation: a trial, or neighbours if they are many."""
        rows = self.rows
        groups = np.array_split(np.arange(len(rows)), min(len(rows), most))
        return [slice(rows[group[0]].start, rows[group[-1]].stop) for group in groups]

    def chains(self, residuals: Floats) -> list[Floats]:
        """Split (m,) residuals [m] into one array (goals, points, 3) [m] per trial."""
        return [residuals[rows].reshape(*shape, 3)
                for rows, shape in zip(self.rows, self.shapes, strict=True)]

    def by_point(self, values: Floats) -> list[Floats]:
        """Split (m / 3,) values, one per point, into one array (goals, points) per trial."""
        return [values[rows.start // 3:rows.stop // 3].reshape(shape)
                for rows, shape in zip(self.rows, self.shapes, strict=True)]
