# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Score: the paper's difference score, residual vectors and point errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial

SIMILAR = 100.0  # cm; the paper's judges call chains with lower scores similar
VERY_SIMILAR = 50.0  # cm, likewise
#: Mean length of a vector of three normal coordinates with standard deviation 1 (Maxwell distribution).
MEAN_DISTANCE = float(np.sqrt(8 / np.pi))


def focal_points(trial: Trial) -> NDArray[np.intp]:
    """
    Return the index of the focal point of each goal, (g,), the paper's p_ref.

    It is the seen point of the goal that is nearest to a hand that holds the DLO, else the first seen point.
    """
    points, times, seen = observed(trial), np.array([goal.time for goal in trial.goals]), seen_points(trial)
    nearest, index = np.full(len(times), np.inf), np.asarray(seen.argmax(axis=1), np.intp)
    hands = trial.hands
    for name in dict.fromkeys(hand.name for hand in hands):
        paths = [hand for hand in hands if hand.name == name]
        latest = np.searchsorted([path.start for path in paths], times, side='right') - 1
        holding = np.array([name in goal.held_by for goal in trial.goals])
        for k, path in enumerate(paths):
            rows = np.flatnonzero((latest == k) & (holding | (times <= path.end)))
            away = np.linalg.norm(points[rows] - path.positions_at(times[rows])[:, None], axis=2)
            away[~seen[rows]] = np.inf
            nearer = away.min(axis=1) < nearest[rows]
            index[rows[nearer]] = away[nearer].argmin(axis=1)
            nearest[rows[nearer]] = away[nearer].min(axis=1)
    return index


def feature_points(trial: Trial) -> NDArray[np.bool_]:
    """
    Return which points of each goal are geometric features, (g, n).

    They are local maxima and minima in z, points that a hand has gripped, and
    points that an annotator marked, if they were seen.
    """
    features = np.stack([goal.chain.features for goal in trial.goals]) | trial.initial.features
    rise = np.sign(np.diff(observed(trial)[:, :, 2], axis=1))
    features[:, 1:-1] |= rise[:, :-1] * rise[:, 1:] < 0
    times = np.array([goal.time for goal in trial.goals])
    for hand in trial.hands:
        features[np.ix_(hand.start <= times, np.array(hand.grips))] = True
    return np.asarray(features & seen_points(trial))


def observed(trial: Trial) -> Floats:
    """Return the points of all goals of a trial, (g, n, 3) [m]."""
    return np.stack([goal.chain.points for goal in trial.goals])


def seen_points(trial: Trial) -> NDArray[np.bool_]:
    """Return which points of all goals of a trial were seen, (g, n)."""
    return np.stack([goal.chain.seen for goal in trial.goals])


def difference_score(goal: Floats, current: Floats, reference: int,
                     features: NDArray[np.intp] | Sequence[int]) -> float:
    """
    Return the paper's difference score, equation (1), in centimetres.

    ``D = || sum_i (|p_ref - p_i|_goal - |p_ref - p_i|_curr) + sum_f |p_f_goal - p_f_curr| ||``
    where |.| of a vector is taken component by component, i runs over all points
    and f over the features.  As in the paper, differences of opposite sign cancel
    in the first sum, so a score of 0 does not prove that two chains are equal; a
    point error of 0 does.

    :param goal: (n, 3) [m] observed points.
    :param current: (n, 3) [m] simulated points.
    :param reference: index of the focal point p_ref.
    :param features: indices of the geometric features.
    """
    return float(np.linalg.norm(difference_vector(goal, current, reference, features))) * 100


def difference_vector(goal: Floats, current: Floats, reference: int,
                      features: NDArray[np.intp] | Sequence[int]) -> Floats:
    """Return the vector whose length is the difference score, (3,) [m]; see `difference_score`."""
    shape_goal = np.abs(goal[reference] - goal)
    shape_current = np.abs(current[reference] - current)
    shape = (shape_goal - shape_current).sum(axis=0)
    place = np.abs(goal[features] - current[features]).sum(axis=0)
    return np.asarray(shape + place)


class TrialScore:
    """
    The difference score of one trial; the terms of its goals are computed once.

    No sum contains unseen points of goals.
    """

    def __init__(self, trial: Trial) -> None:
        self._points = observed(trial)
        seen = seen_points(trial)
        self._seen = None if seen.all() else seen
        self._reference = focal_points(trial)
        self._features = feature_points(trial).astype(float)
        self._shape = self._extent(self._points)

    def _extent(self, chains: Floats) -> Floats:
        """Return the sums over the points of |p_ref - p_i| by coordinate, (g, 3) [m]."""
        references = chains[np.arange(len(chains)), self._reference]
        away = np.abs(references[:, None, :] - chains)
        return np.asarray((away if self._seen is None else away * self._seen[:, :, None]).sum(axis=1))

    def __call__(self, chains: Floats) -> float:
        """Return the score [cm] of simulated (g, n, 3) [m] chains, averaged over the g goals."""
        if chains.shape != self._points.shape:
            raise ValueError(f'chains of shape {chains.shape}, expected {self._points.shape}')
        place = np.einsum('gi,gij->gj', self._features, np.abs(self._points - chains))
        difference = self._shape - self._extent(chains) + place
        return float(np.linalg.norm(difference, axis=1).mean()) * 100


def differences(trial: Trial, chains: Floats) -> Floats:
    """Return simulated minus observed points, (g, n, 3) [m]; NaN where a point was not seen."""
    return np.asarray(chains - np.stack([goal.chain.observed for goal in trial.goals]))


def residuals(trial: Trial, chains: Floats) -> Floats:
    """Return simulated minus observed coordinates of the p seen points, (3 p,) [m], goal by goal."""
    return differences(trial, chains)[seen_points(trial)].ravel()


def force_residuals(trial: Trial, forces: Floats) -> Floats:
    """
    Return simulated minus measured forces, (3 f,) [m] by the `force_scale`, in the order of `Trial.forces`.

    :param forces: (f, 3) [N] simulated.
    """
    if not trial.forces:
        return np.zeros(0)
    off = without_offsets(trial, forces - np.stack([force.vector for _, _, force in trial.forces]))
    return np.asarray((off * trial.force_scale).ravel())


def without_offsets(trial: Trial, forces: Floats) -> Floats:
    """
    Return forces, (f, 3) [N] in the order of `Trial.forces`, without unknown offsets of sensors.

    Those of a hand whose sensor has an unknown offset have no mean over the trial.
    """
    forces = forces.copy()
    for name in {hand.name for _, hand, force in trial.forces if not force.tared}:
        rows = [k for k, (_, hand, _) in enumerate(trial.forces) if hand.name == name]
        forces[rows] -= forces[rows].mean(axis=0)
    return forces


def distances(residual: Floats) -> Floats:
    """Return the distances of simulated from observed points, (p,) [m], of a residual vector, (3 p,) [m]."""
    return np.asarray(np.linalg.norm(residual.reshape(-1, 3), axis=1))


@dataclass(frozen=True)
class PointErrors:
    """
    Errors over all seen goal points, including those that a hand holds.

    :param mean: mean Euclidean distance [m].
    :param rms: root of the mean squared distance [m].
    :param max: largest distance [m].
    :param mean_abs: mean absolute difference over points and coordinates [m].
    """

    mean: float
    rms: float
    max: float
    mean_abs: float

    @classmethod
    def of(cls, residual: Floats) -> PointErrors:
        """Return the errors of a residual vector, (3 p,) [m] of p points."""
        sizes = distances(residual)
        return cls(mean=float(sizes.mean()), rms=float(np.sqrt(np.mean(sizes**2))),
                   max=float(sizes.max()), mean_abs=float(np.abs(residual).mean()))
