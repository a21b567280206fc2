# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
ResidualLayout: where the residuals of each trial, goal and point are in the vector of all trials.

A tracker shows a DLO in motion a hundred times a second, and neighbouring frames tell the same: search and
examination compare a few of them, `compared_goals`, which saves most of their linear algebra and memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial

#: Timed goals of one trial whose residuals search and examination compare; see doc/physics.md, A trial.
MOST_TIMED = 50


def compared_goals(trial: Trial) -> list[int]:
    """
    Return the indices of the goals that search and examination compare.

    These are all stable goals, and at most MOST_TIMED timed ones, nearest to instants that are evenly spread
    from the first to the last of them.
    """
    timed = [k for k, goal in enumerate(trial.goals) if not goal.stable]
    if len(timed) <= MOST_TIMED:
        return list(range(len(trial.goals)))
    times = np.array([trial.goals[k].time for k in timed])
    instants = np.linspace(times[0], times[-1], MOST_TIMED)
    after = np.clip(np.searchsorted(times, instants), 1, len(times) - 1)
    nearest = after - (instants - times[after - 1] < times[after] - instants)
    stable = {k for k, goal in enumerate(trial.goals) if goal.stable}
    return sorted(stable | {timed[k] for k in nearest.tolist()})


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
        """Return the layout of the residuals at every goal of trials."""
        return cls(tuple((len(trial.goals), len(trial.initial)) for trial in trials))

    @classmethod
    def compared(cls, trials: Sequence[Trial]) -> ResidualLayout:
        """Return the layout of the residuals at the goals that search and examination compare."""
        return cls(tuple((len(compared_goals(trial)), len(trial.initial)) for trial in trials))

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


def compared_rows(trials: Sequence[Trial]) -> NDArray[np.intp] | None:
    """Return which residuals at every goal are compared, (m,); None: all of them."""
    chosen = [compared_goals(trial) for trial in trials]
    if all(len(goals) == len(trial.goals) for goals, trial in zip(chosen, trials, strict=True)):
        return None
    layout = ResidualLayout.of(trials)
    places = layout.chains(np.arange(layout.rows[-1].stop))
    return np.concatenate([block[goals].ravel() for block, goals in zip(places, chosen, strict=True)])


def at_every_goal(values: Floats, trials: Sequence[Trial]) -> Floats:
    """
    Return values for the points of every goal, from (p,) values for those of the compared ones.

    Between two compared goals they are interpolated linearly in time.
    """
    filled = []
    for trial, block in zip(trials, ResidualLayout.compared(trials).by_point(values), strict=True):
        goals, times = compared_goals(trial), [goal.time for goal in trial.goals]
        known = [times[k] for k in goals]
        whole = np.stack([np.interp(times, known, column) for column in block.T], axis=1)
        whole[goals] = block
        filled.append(whole.ravel())
    return np.concatenate(filled)
