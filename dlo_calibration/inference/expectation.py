# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Expectation: how certain the parameters would be after actions that have not been done.

The information of an action is averaged over draws of what is known (the expected utility of Bayesian
experimental design: Chaloner and Verdinelli, Bayesian Experimental Design: A Review, 1995, section 2).  The
best values say little at the beginning: an action that tells much of a stiff DLO tells little of a limp one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.linearisation import Differences, information, STEP
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.uncertainty import Uncertainty
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.excitation import excites

STRIDE = 0.1  # largest step of a derivative at a draw: draws cover the rest of a wide distribution
MOST_TRIALS = 8  # that are foreseen; a target that needs more is out of reach
REACHED = 1.02  # times the target, which counts as reached in what is foreseen
FAILURES = 0.5  # share of the draws of an action that may fail


def _changes(trials: Sequence[Trial], others: Sequence[Sequence[Trial]], space: ParameterSpace, pool: Pool,
             points: Floats, steps: Floats, shown: NDArray[np.bool_], length: float
             ) -> Iterator[tuple[Floats, Floats] | None]:
    """
    Yield, for each trial at each draw, how its chains change: None if it fails.

    :returns: the derivatives by the parameters, (m, d) [m per unit], and the changes by each shared
        error, (m, e) [m].
    """
    jobs, beside = [], []
    for trial, other, row in zip(trials, others or [()] * len(trials), shown, strict=True):
        for point in points:
            differences = Differences.central(point, np.flatnonzero(row), steps, space.upper)
            at, *away = (space.physical(space.values(each), length)
                         for each in (point, *differences.points))
            jobs += [(version, at) for version in (trial, *other)] + [(trial, each) for each in away]
            beside.append((differences, len(other)))
    rollouts = iter(pool.simulate(jobs))
    for differences, count in beside:
        some = list(islice(rollouts, 1 + count + len(differences.points)))
        chains = [rollout.chains.ravel() for rollout in some
                  if not isinstance(rollout, SimulationError) and all(rollout.settled)]
        if len(chains) < len(some):
            yield None
            continue
        here, slipped, sides = chains[0], chains[1:1 + count], chains[1 + count:]
        columns = differences.jacobian(np.zeros((len(here), space.dimension)), sides)
        for k, (low, high) in zip(differences.columns, zip(sides[::2], sides[1::2], strict=True),
                                  strict=True):
            # If sticking and slipping scatter the chains, a second difference has six times their variance,
            # and a first one over twice the step twice of it: that part of the derivative is chance (James
            # and Stein, Estimation with Quadratic Loss, 1961, positive part).
            chance = float(np.sum((low - 2 * here + high)**2)) / 3
            change = float(np.sum((high - low)**2))
            columns[:, k] *= np.sqrt(max(0.0, 1 - chance / change)) if change > 0 else 0.0
        yield columns, np.array(slipped).reshape(count, len(here)).T - here[:, None]


def _told(columns: Floats, errors: Floats) -> Floats:
    """
    Return the (d, d) information of (m, d) derivatives, beside white errors of 1, and (m, e) shared ones.

    The covariance of the residuals is I + E E^T; Woodbury's identity inverts it.
    """
    shared = errors.T @ columns
    within = np.eye(errors.shape[1]) + errors.T @ errors
    return np.asarray(information(columns) - shared.T @ np.linalg.solve(within, shared))


@dataclass(frozen=True, eq=False)
class Expectation:
    """
    What each of C actions would tell, at K draws of d parameters.

    :param informations: (C, K, d, d); nan where an action could not be simulated.
    :param present: (d, d) information so far.
    :param wanted: (d,) standard deviations to reach; inf: any.
    """

    informations: Floats
    present: Floats
    wanted: Floats

    @classmethod
    def of(cls, trials: Sequence[Trial], space: ParameterSpace, pool: Pool, points: Floats,
           uncertainty: Uncertainty, scale: float, length: float, wanted: Floats,
           others: Sequence[Sequence[Trial]] = (), trust: Floats | float = 1.0) -> Expectation:
        """
        Simulate the trials of the actions, whose goals are placeholders, at and beside (K, d) draws.

        :param scale: of the error of the residuals [m].
        :param others: for each trial, those with one error each, of one standard deviation, that all its
            residuals share, such as that of a grip; () for all: none.
        :param trust: (d,) how much of what linear models promised was found so far, for each parameter.
        :raises CancelledError: when stopped.
        """
        count = len(points)
        shown = excites(trials, space, np.inf) if trials else np.zeros((0, space.dimension), np.bool_)
        dimension = space.dimension
        told = np.array([np.full((dimension, dimension), np.nan) if changes is None else
                         _told(changes[0] * trust / scale, changes[1] / scale) for changes in _changes(
                             trials, others, space, pool, points, np.clip(uncertainty.std, STEP, STRIDE),
                             shown, length)]).reshape(len(trials), count, dimension, dimension)
        failed = np.isnan(told[..., 0, 0]).mean(axis=1) > FAILURES
        told[failed] = np.nan
        told[~failed] = np.nan_to_num(told[~failed])  # a draw with which the action fails tells nothing
        return cls(told, np.asarray(np.linalg.inv(uncertainty.spread), float), wanted)

    @property
    def possible(self) -> NDArray[np.bool_]:
        """Which actions can be simulated, (C,)."""
        return np.asarray(~np.isnan(self.informations).any(axis=(1, 2, 3)))

    def deviations(self, informations: Floats) -> Floats:
        """Return the standard deviations, (..., d), with information (..., d, d) besides the present one."""
        return np.sqrt(np.diagonal(np.linalg.inv(self.present + np.nan_to_num(informations)),
                                   axis1=-2, axis2=-1))

    def distances(self, informations: Floats) -> Floats:
        """Return how far the targets are, (...): the sum of the logarithms of what is too uncertain."""
        ratios = self.deviations(informations) / self.wanted
        return np.asarray(np.log(np.maximum(ratios, 1.0)).sum(axis=-1))

    @property
    def ranked(self) -> list[int]:
        """The possible actions that tell something, the one that brings the targets nearest first."""
        now = float(self.distances(np.zeros_like(self.present)))
        after = np.where(self.possible, self.distances(self.informations).mean(axis=1), np.inf)
        return [k for k in np.argsort(after, kind='stable').tolist() if after[k] < now - 1e-3]

    def expected(self, action: int) -> Floats:
        """Return the expected standard deviations, (d,), after an action."""
        return np.asarray(self.deviations(self.informations[action]).mean(axis=0))

    def foreseen(self) -> tuple[int, Floats]:
        """
        Return how many trials are left, at most MOST_TRIALS, and the (d,) standard deviations after them.

        Each trial is the action that then brings the targets nearest.
        """
        told = self.informations[self.possible]
        so_far = np.zeros(self.informations.shape[1:])
        count, best = 0, self.deviations(so_far).mean(axis=0)
        while count < MOST_TRIALS and len(told) and (best > REACHED * self.wanted).any():
            so_far = so_far + told[int(self.distances(so_far + told).mean(axis=1).argmin())]
            count, best = count + 1, self.deviations(so_far).mean(axis=0)
        return count, best
