# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
ResidualLayout: the place of each trial, goal and point in the residual vector; Huber: a robust loss.

A tracker observes a moving DLO a hundred times a second, and neighbouring frames carry the same
information.  So search and examination use only the residuals at the `compared_goals`, which saves most of
their linear algebra and memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import seen_points
from dlo_calibration.model.trial import Trial

#: Timed goals of one trial whose residuals search and examination compare; see doc/physics.md, A trial.
MOST_TIMED = 50


def compared_goals(trial: Trial) -> list[int]:
    """
    Return the indices of the goals that search and examination compare.

    These are all stable goals and at most MOST_TIMED timed goals, those nearest to evenly spaced instants.
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
    The order of a residual vector (m,): by trial, goal, point and coordinate; last in each trial, its forces.

    Points that were not seen have no residuals. The rows of its Jacobian have the same order.

    :param shapes: numbers of goals and points of each of T trials.
    :param unseen: for each trial, the indices of unseen points: goal times the number of points, plus point;
        empty: all points of all trials were seen.
    :param forces: numbers of measured forces of the trials; empty: none.
    """

    shapes: tuple[tuple[int, int], ...]
    unseen: tuple[tuple[int, ...], ...] = ()
    forces: tuple[int, ...] = ()

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> ResidualLayout:
        """Return the layout of the residuals at every goal of trials."""
        return cls._at(trials, [list(range(len(trial.goals))) for trial in trials])

    @classmethod
    def compared(cls, trials: Sequence[Trial]) -> ResidualLayout:
        """Return the layout of the residuals at the goals that search and examination compare."""
        return cls._at(trials, [compared_goals(trial) for trial in trials])

    @classmethod
    def _at(cls, trials: Sequence[Trial], chosen: Sequence[Sequence[int]]) -> ResidualLayout:
        unseen = tuple(tuple(np.flatnonzero(~seen_points(trial)[goals]).tolist())
                       for trial, goals in zip(trials, chosen, strict=True))
        shapes = ((len(goals), len(trial.initial)) for trial, goals in zip(trials, chosen, strict=True))
        forces = tuple(sum(k in goals for k, *_ in trial.forces)
                       for trial, goals in zip(trials, map(set, chosen), strict=True))
        return cls(tuple(shapes), unseen if any(unseen) else (), forces if any(forces) else ())

    @property
    def rows(self) -> list[slice]:
        """The rows of each trial, T slices."""
        unseen = [len(indices) for indices in self.unseen] or [0] * len(self.shapes)
        ends = np.cumsum([0, *(3 * (goals * points - count + forces) for (goals, points), count, forces
                               in zip(self.shapes, unseen, self._forces, strict=True))]).tolist()
        return [slice(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]

    @property
    def point_rows(self) -> list[slice]:
        """The rows of the points of each trial, T slices."""
        return [slice(rows.start, rows.stop - 3 * forces)
                for rows, forces in zip(self.rows, self._forces, strict=True)]

    @property
    def force_rows(self) -> list[slice]:
        """The rows of the forces of each trial, T slices."""
        return [slice(rows.stop - 3 * forces, rows.stop)
                for rows, forces in zip(self.rows, self._forces, strict=True)]

    @property
    def _forces(self) -> tuple[int, ...]:
        return self.forces or (0,) * len(self.shapes)

    def points(self, residuals: Floats, within: slice = slice(None)) -> Floats:
        """Return those of (m,) residuals that are of points, and within some rows."""
        end = self.rows[-1].stop
        begin, stop, _ = within.indices(end)
        return np.concatenate([residuals[max(rows.start, begin):min(rows.stop, stop)] for rows
                               in self.point_rows if rows.start < stop and rows.stop > begin])

    def without(self, k: int) -> ResidualLayout:
        """Return the layout of the residuals of all trials but the one with the index k."""
        return ResidualLayout(self.shapes[:k] + self.shapes[k + 1:], self.unseen[:k] + self.unseen[k + 1:],
                              self.forces[:k] + self.forces[k + 1:])

    def folds(self, most: int) -> list[slice]:
        """Return the rows of at most `most` folds of a cross-validation, each of neighbouring trials."""
        rows = self.rows
        groups = np.array_split(np.arange(len(rows)), min(len(rows), most))
        return [slice(rows[group[0]].start, rows[group[-1]].stop) for group in groups]

    def aligned(self, values: Floats) -> list[Floats]:
        """Split (m, ...) values by trial: a row per goal, point and coordinate, 0 if unseen; then forces."""
        return [np.concatenate([np.nan_to_num(self._spread(k, values[rows].reshape(
            -1, 3, *values.shape[1:]))).reshape(-1, *values.shape[1:]), values[forces]])
            for k, (rows, forces) in enumerate(zip(self.point_rows, self.force_rows, strict=True))]

    def chains(self, residuals: Floats) -> list[Floats]:
        """Split (m,) residuals [m] into one array (goals, points, 3) [m] per trial; NaN at unseen points."""
        return [self._spread(k, residuals[rows].reshape(-1, 3)).reshape(*shape, 3)
                for k, (rows, shape) in enumerate(zip(self.point_rows, self.shapes, strict=True))]

    def by_point(self, values: Floats) -> list[Floats]:
        """Split (m / 3,) values, one per seen point or force, into (goals, points) per trial; else NaN."""
        return [self._spread(k, values[rows.start // 3:rows.stop // 3]).reshape(shape)
                for k, (rows, shape) in enumerate(zip(self.point_rows, self.shapes, strict=True))]

    def _spread(self, k: int, seen: NDArray[Any]) -> NDArray[Any]:
        """Return values of all points of trial k, from those of its seen points; NaN at unseen points."""
        if not self.unseen or not self.unseen[k]:
            return seen
        goals, points = self.shapes[k]
        whole = np.full((goals * points, *seen.shape[1:]), np.nan)
        whole[np.delete(np.arange(len(whole)), self.unseen[k])] = seen
        return whole


def compared_rows(trials: Sequence[Trial]) -> NDArray[np.intp] | None:
    """Return the (m,) indices of the compared residuals among those at every goal; None: all of them."""
    chosen = [compared_goals(trial) for trial in trials]
    if all(len(goals) == len(trial.goals) for goals, trial in zip(chosen, trials, strict=True)):
        return None
    layout = ResidualLayout.of(trials)
    places = layout.chains(np.arange(layout.rows[-1].stop))
    rows = []
    for trial, block, goals, forces in zip(trials, places, chosen, layout.force_rows, strict=True):
        compared = np.isin([k for k, *_ in trial.forces], goals)
        rows += [block[goals].ravel(), np.arange(forces.start, forces.stop)[np.repeat(compared, 3)]]
    every = np.concatenate(rows)
    return np.asarray(every[np.isfinite(every)], np.intp)


def at_every_goal(values: Floats, trials: Sequence[Trial]) -> Floats:
    """
    Return values for the points of every goal, from (p,) values for the points of the compared goals.

    Values of a point are interpolated linearly in time between the compared goals that show it; at the places
    of forces, there is NaN.
    """
    filled = []
    for trial, block in zip(trials, ResidualLayout.compared(trials).by_point(values), strict=True):
        goals, times = compared_goals(trial), [goal.time for goal in trial.goals]
        compared, mean = np.array(times)[goals], np.nanmean(block)
        whole = np.stack([np.interp(times, compared[seen], column[seen]) if seen.any() else
                          np.full(len(times), mean)
                          for seen, column in zip(np.isfinite(block.T), block.T, strict=True)], axis=1)
        whole[goals] = np.where(np.isfinite(block), block, whole[goals])
        filled += [whole[seen_points(trial)], np.full(len(trial.forces), np.nan)]
    return np.concatenate(filled)


EFFICIENT = 1.345  # standard deviations; a threshold with 95 % of the efficiency of least squares
CLIPPED_SQUARE = 0.7102  # mean square of a standard normal value that is clipped at EFFICIENT
SMALLEST_RESIDUAL = 1e-9  # m; keeps the scale above zero where a model fits exactly


@dataclass(frozen=True, order=True)
class Huber:
    """
    Huber's loss (Huber 1964, Annals of Mathematical Statistics 35, 73-101), ordered by its threshold.

    :param threshold: residual [m] at which it turns from quadratic to linear.
    """

    threshold: float

    @classmethod
    def of(cls, residuals: Floats) -> Huber:
        """Return the loss with the threshold for the spread of (m,) residuals [m]."""
        if not residuals.size:
            return cls(1.0)
        # The median of |x| is 0.6745 for a standard normal x.  If most residuals are nearly zero, that spread
        # is too small; then a tenth of the root mean square is used.
        spread = float(np.median(np.abs(residuals))) / 0.6745
        floor = 0.1 * float(np.sqrt(np.mean(residuals ** 2)))
        return cls(max(EFFICIENT * spread, floor, SMALLEST_RESIDUAL))

    def cost(self, residuals: Floats | None) -> float:
        """Return the cost [m^2] of (m,) residuals [m]; infinite for None."""
        if residuals is None:
            return float('inf')
        size = np.abs(residuals)
        inside = np.minimum(size, self.threshold)
        return float(np.sum(inside * (size - inside / 2)))

    def roots(self, residuals: Floats) -> Floats:
        """Return the square roots (m,) of the weights that give least squares the gradient of this loss."""
        return np.sqrt(self.threshold / np.maximum(np.abs(residuals), self.threshold))

    def clipped(self, residuals: Floats) -> Floats:
        """Return the (m,) derivative [m] of the cost: the (m,) residuals [m] clipped at the threshold."""
        return np.clip(residuals, -self.threshold, self.threshold)

    def deviation(self, residuals: Floats, parameters: int) -> float:
        """Return the noise level [m] estimated from the (m,) residuals [m] of a fit of some parameters."""
        square = float(np.sum(self.clipped(residuals)**2)) / CLIPPED_SQUARE
        return max(float(np.sqrt(square / max(1, len(residuals) - parameters))), SMALLEST_RESIDUAL)
