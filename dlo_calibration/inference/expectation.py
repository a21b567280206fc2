# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Expectation: how certain the parameters would be after actions that have not been done.

The information of an action is averaged over draws of what is known (the expected utility of Bayesian
experimental design: Chaloner and Verdinelli, Bayesian Experimental Design: A Review, 1995, section 2).  The
best values say little at the beginning: an action that tells much of a stiff DLO tells little of a limp one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.linearisation import Differences, information, STEP
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.uncertainty import Uncertainty, UNKNOWN_STD
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Floats, grip_place
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import NO_NOISE, with_other_noise
from dlo_calibration.observation.slow_errors import gripping_beside

STRIDE = 0.1  # largest step of a derivative at a draw: draws cover the rest of a wide distribution
MOST_TRIALS = 8  # that are foreseen; a target that needs more is out of reach
REACHED = 1.02  # times the target, which counts as reached in what is foreseen
GRIP_ERROR = 3e-3  # m along the DLO: standard deviation of where robots and people grip
STARTS = 1  # simulations of each trial from a start with other noise, at each draw
FAILURES = 0.5  # share of the draws of an action that may fail


def _slipped(trial: Trial) -> Iterator[Trial]:
    """Yield, for each hand but clamps, the trial in which it grips GRIP_ERROR further inwards."""
    chain = trial.initial
    places = chain.arc_lengths()
    for action in trial.actions:
        for hand in (hand for hand in action.hands if len(hand.grips) == 1):
            place = grip_place(places, hand.grips[0], hand.offset)
            other = gripping_beside(hand, chain, GRIP_ERROR if place < chain.length / 2 else -GRIP_ERROR)
            yield replace(trial, actions=tuple(Action(tuple(
                other if each is hand else each for each in one.hands)) for one in trial.actions))


def _changes(trials: Sequence[Trial], space: ParameterSpace, pool: Pool, points: Floats, steps: Floats,
             shown: NDArray[np.bool_], length: float, noise: float, finer: Pool | None
             ) -> Iterator[tuple[Floats, Floats] | None]:
    """
    Yield, for each trial at each draw, how its chains change: None if it fails.

    :returns: the derivatives by the parameters, (m, d) [m per unit], and the changes by each error that
        all residuals of the trial share, (m, e) [m]: of where a hand grips, of the noise of the start, and of
        nodes and time step.
    """
    starts = with_other_noise(trials, noise, STARTS, np.random.default_rng(0)) if noise > NO_NOISE else []
    jobs, beside, here_alone = [], [], []
    for trial, row, *noisy in zip(trials, shown, *starts, strict=True):
        versions = trial, *noisy, *_slipped(trial)
        for point in points:
            differences = Differences.central(point, np.flatnonzero(row), steps, space.upper)
            at, *away = (space.physical(space.values(each), length)
                         for each in (point, *differences.points))
            jobs += [(version, at) for version in versions] + [(trial, each) for each in away]
            here_alone.append((trial, at))
            beside.append((differences, len(versions)))
    rollouts = iter(pool.simulate(jobs))
    fine = iter(() if finer is None else finer.simulate(here_alone))
    for differences, count in beside:
        some = [*islice(rollouts, count + len(differences.points)), *islice(fine, 1)]
        chains = [rollout.chains.ravel() for rollout in some
                  if not isinstance(rollout, SimulationError) and all(rollout.settled)]
        if len(chains) < len(some):
            yield None
            continue
        refined = [chains.pop()] if finer is not None else []
        here, sides = chains[0], chains[count:]
        columns = differences.jacobian(np.zeros((len(here), space.dimension)), sides)
        for k, (low, high) in zip(differences.columns, zip(sides[::2], sides[1::2], strict=True),
                                  strict=True):
            # If sticking and slipping scatter the chains, a second difference has six times their variance,
            # and a first one over twice the step twice of it: that part of the derivative is chance (James
            # and Stein, Estimation with Quadratic Loss, 1961, positive part).
            chance = float(np.sum((low - 2 * here + high)**2)) / 3
            change = float(np.sum((high - low)**2))
            columns[:, k] *= np.sqrt(max(0.0, 1 - chance / change)) if change > 0 else 0.0
        errors = (np.array([*chains[1:count], *refined]).reshape(-1, len(here)) - here).T
        errors[:, :len(starts)] /= np.sqrt(STARTS)
        yield columns, errors


def _told(columns: Floats, errors: Floats) -> tuple[Floats, Floats]:
    """
    Return what (m, d) derivatives tell, beside white errors of 1, and (m, e) that the residuals share.

    A fit takes all errors for white ones, so that shared ones pull at the parameters.

    :returns: the (d, d) information, and the (d, d) covariance of the pulls by the shared errors.
    """
    pulls = columns.T @ errors
    return information(columns), pulls @ pulls.T


@dataclass(frozen=True, eq=False)
class Expectation:
    """
    What each of C actions would tell, at K draws of d parameters.

    :param informations: (C, K, d, d); nan where an action could not be simulated.
    :param pulls: (C, K, d, d) covariances of how errors that the residuals share pull at the parameters.
    :param present: (d, d) information so far.
    :param wanted: (d,) standard deviations to reach; inf: any.
    """

    informations: Floats
    pulls: Floats
    present: Floats
    wanted: Floats

    @classmethod
    def of(cls, trials: Sequence[Trial], space: ParameterSpace, pool: Pool, points: Floats,
           uncertainty: Uncertainty, scale: float, length: float, wanted: Floats, noise: float = 0.0,
           varied: NDArray[np.bool_] | bool = True, trust: Floats | float = 1.0,
           finer: Pool | None = None) -> Expectation:
        """
        Simulate the trials of the actions, whose goals are placeholders, at and beside (K, d) draws.

        :param scale: of the error of the residuals [m].
        :param noise: standard deviation of one coordinate of the chains that they start from [m].
        :param varied: (d,) False for parameters of which actions count as telling nothing, to save time.
        :param trust: (d,) how much of what linear models promised was found so far, for each parameter.
        :param finer: with twice the nodes and half the time step, which shows the error of those; None: that
            is not simulated.
        :raises CancelledError: when stopped.
        """
        count = len(points)
        shown = excites(trials, space, np.inf) if trials else np.zeros((0, space.dimension), np.bool_)
        dimension = space.dimension
        told = np.array([
            np.full((2, dimension, dimension), np.nan) if changes is None else
            _told(changes[0] * trust / scale, changes[1] / scale) for changes in _changes(
                trials, space, pool, points, np.clip(uncertainty.std, STEP, STRIDE), shown & varied, length,
                noise, finer)]).reshape(len(trials), count, 2, dimension, dimension)
        failed = np.isnan(told[:, :, 0, 0, 0]).mean(axis=1) > FAILURES
        told[failed] = np.nan
        told[~failed] = np.nan_to_num(told[~failed])  # a draw with which the action fails tells nothing
        return cls(told[:, :, 0], told[:, :, 1], np.asarray(np.linalg.inv(uncertainty.spread), float), wanted)

    @property
    def possible(self) -> NDArray[np.bool_]:
        """Which actions can be simulated, (C,)."""
        return np.asarray(~np.isnan(self.informations).any(axis=(1, 2, 3)))

    def with_others(self, other: Expectation) -> Expectation:
        """Return the expectation of these and other actions, at the same draws."""
        return replace(self, informations=np.concatenate([self.informations, other.informations]),
                       pulls=np.concatenate([self.pulls, other.pulls]))

    def deviations(self, informations: Floats, pulls: Floats) -> Floats:
        """Return the standard deviations, (..., d), with more information and pulls, (..., d, d) each."""
        known = self.present + np.nan_to_num(informations)
        step = np.linalg.inv(known)
        covariances = step @ (known + np.nan_to_num(pulls)) @ step
        return np.asarray(np.minimum(np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1)), UNKNOWN_STD))

    def distances(self, informations: Floats, pulls: Floats) -> Floats:
        """Return how far the targets are, (...): the sum of the logarithms of what is too uncertain."""
        ratios = self.deviations(informations, pulls) / self.wanted
        return np.asarray(np.log(np.maximum(ratios, 1.0)).sum(axis=-1))

    @property
    def ranked(self) -> list[int]:
        """The possible actions that tell something, the one that brings the targets nearest first."""
        nothing = np.zeros_like(self.present)
        now = float(self.distances(nothing, nothing))
        after = np.where(self.possible, self.distances(self.informations, self.pulls).mean(axis=1), np.inf)
        return [k for k in np.argsort(after, kind='stable').tolist() if after[k] < now - 1e-3]

    def expected(self, action: int) -> Floats:
        """Return the expected standard deviations, (d,), after an action."""
        return np.asarray(self.deviations(self.informations[action], self.pulls[action]).mean(axis=0))

    def foreseen(self) -> tuple[int, Floats]:
        """
        Return how many trials are left, at most MOST_TRIALS, and the (d,) standard deviations after them.

        Each trial is the action that then brings the targets nearest.
        """
        told, pulls = self.informations[self.possible], self.pulls[self.possible]
        so_far = pulled = np.zeros(self.informations.shape[1:])
        count, best = 0, self.deviations(so_far, pulled).mean(axis=0)
        while count < MOST_TRIALS and len(told) and (best > REACHED * self.wanted).any():
            nearest = int(self.distances(so_far + told, pulled + pulls).mean(axis=1).argmin())
            so_far, pulled = so_far + told[nearest], pulled + pulls[nearest]
            count, best = count + 1, self.deviations(so_far, pulled).mean(axis=0)
        return count, best
