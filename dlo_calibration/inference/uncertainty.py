# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Uncertainty: what a calibration does not know, in the unit cube of its parameters.

Where the search ended in a regular minimum, the covariance follows from the
Jacobian of the residuals there.  Four things are added to what a textbook's
formula says, because alone it is several times too small for real DLOs:

- neighbouring points err alike, so that they count as fewer;
- the initial chain of each trial is measured, too, and with it the length and the shape of the DLO;
- where the model cannot explain the residuals, the trials disagree with each
  other, and how far says more than how many points there are (the larger of what leaving one
  out and drawing as many anew tell);
- the step and the nodes of the simulation move the optimum.

Where it did not, as in a random search, the good evaluations lie apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats, frozen_array

UNKNOWN_STD = 1 / np.sqrt(12)  # of a value anywhere in 0..1
IDENTIFIABLE_STD = UNKNOWN_STD / 4
WEAK_STD = UNKNOWN_STD / 2
DEVIATIONS = 1.645  # that half an interval of 90 % has, of a normal distribution
AT_BOUND = 0.002  # of an end of the scale: what lies nearer may lie beyond
MODEL_ERROR = 1.6  # residuals larger than the noise by that factor are not noise alone
FEWEST_TRIALS = 3  # whose disagreement says something
REMAINING = 2.0  # times the change by a simulation twice as fine is missing: the error is of first order
INVOLVED = 0.3  # share of a unit vector that makes a parameter part of a combination

IDENTIFIABLE, WEAK, NOT_IDENTIFIABLE = 'identifiable', 'weak', 'not identifiable'


class Scored(Protocol):
    """A point of the unit cube with its score."""

    @property
    def point(self) -> Floats:
        """The (d,) point."""

    @property
    def score(self) -> float:
        """Lower is better."""


@dataclass(frozen=True)
class Uncertainty:
    """
    What is known of d parameters, in the unit cube.

    :param std: (d,) standard deviation.
    :param lower: (d,) lower end of the 90 % interval; `upper` (d,) its upper end.
    :param excited: (d,) False where no trial tells anything at all.
    :param at_bound: (d,) True where the best value is at an end of the scale.
    :param covariance: (d, d); None where only the spread of evaluations is known.
    :param residual: standard deviation of one coordinate's residual [m]; nan where not estimated.
    :param scale: that residual as it counts, neighbours that err alike as one [m].
    """

    std: Floats
    lower: Floats
    upper: Floats
    excited: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]
    covariance: Floats | None = None
    residual: float = float('nan')
    scale: float = float('nan')

    @property
    def verdicts(self) -> tuple[str, ...]:
        """Return one of the three verdicts for each parameter."""
        return tuple(
            NOT_IDENTIFIABLE if not excited or std >= WEAK_STD else
            IDENTIFIABLE if std < IDENTIFIABLE_STD else WEAK
            for std, excited in zip(self.std, self.excited, strict=True))

    @property
    def correlations(self) -> Floats | None:
        """(d, d) correlations of the parameters; None where not known."""
        if self.covariance is None:
            return None
        std = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(std, std))

    @property
    def undetermined(self) -> tuple[Floats, ...]:
        """Unit vectors (d,) of combinations of two or more parameters that the trials leave open."""
        if self.covariance is None:
            return ()
        values, vectors = np.linalg.eigh(self.covariance)
        combined = [vector * np.sign(vector[np.abs(vector).argmax()])
                    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
                    if np.sqrt(value) >= IDENTIFIABLE_STD and (np.abs(vector) >= INVOLVED).sum() > 1]
        return tuple(combined)


def good_count(evaluations: int) -> int:
    """Return how many of that many evaluations count as good: the best 5 %, 8 at least."""
    return max(8, round(0.05 * evaluations))


def spread_of_best(evaluations: Sequence[Scored], best: Floats) -> Uncertainty:
    """
    Return how far the parameters of the best evaluations lie apart.

    A parameter that the trials determine has similar values in all good
    evaluations; one that they do not can be anything.  `std` is the root mean
    square distance of the best 5 % (8 at least) from the (d,) point `best`;
    `lower` and `upper` are their extremes.  With too few evaluations to
    choose from, nothing is identifiable.  This measures the search as much as
    the trials: it says what this calibration knows, not what the trials could tell.
    """
    good = sorted((e for e in evaluations if np.isfinite(e.score)), key=lambda e: e.score)
    count = good_count(len(evaluations))
    everywhere = np.ones(len(best), dtype=np.bool_)
    if len(good) < 2 * count:
        unknown = np.ones_like(best)
        return Uncertainty(unknown * UNKNOWN_STD, unknown * 0, unknown, everywhere, ~everywhere)
    points = np.stack([e.point for e in good[:count]])
    std = np.minimum(np.sqrt(np.mean((points - best) ** 2, axis=0)), UNKNOWN_STD)
    return Uncertainty(std, points.min(axis=0), points.max(axis=0), everywhere, ~everywhere)


def unknown(dimension: int) -> Floats:
    """Return the (d, d) information on d parameters that may have any value of their scale."""
    return np.asarray(np.eye(dimension) / UNKNOWN_STD**2)


def noise_alone(residual: float, noise: float) -> bool:
    """Tell whether residuals are noise alone, by their standard deviation and the noise's [m]; nan: no."""
    return residual < MODEL_ERROR * noise


def at_minimum(fit: Linearisation, layout: ResidualLayout, *, noise: float = float('nan'),
               shift: Floats | None = None, starts: Sequence[Floats] = ()) -> Uncertainty:
    """
    Return what the residuals and their derivatives at a minimum say.

    :param noise: standard deviation of one coordinate of the observations [m]; nan where not known.
    :param shift: (d,) how far a finer simulation moves the optimum; None: not known.
    :param starts: (m,) [m] each, residuals there with other draws of the noise of the initial chains; may be
        none.
    """
    point, loss = fit.point, Huber.of(fit.residuals)
    clipped = loss.clipped(fit.residuals)
    residual = loss.deviation(fit.residuals, len(point))
    scale = residual * float(np.sqrt(independence(clipped, layout)))
    weighted = fit.weighted(loss.roots(fit.residuals) / scale)
    prior = unknown(len(point))
    with np.errstate(divide='ignore'):
        excited = 1 / np.sqrt(np.diag(weighted.information)) < UNKNOWN_STD
    covariance = np.linalg.inv(weighted.information + prior)
    extra = np.zeros(len(point))
    if len(layout.shapes) >= FEWEST_TRIALS and not noise_alone(residual, noise):
        disagreement = np.maximum(
            np.var(left_out(weighted, layout.rows, prior), axis=0) * (len(layout.shapes) - 1),
            np.var(drawn_again(weighted, layout.rows, prior), axis=0))
        extra = np.maximum(disagreement - np.diag(covariance), 0.0)
    if shift is not None:
        extra = extra + (REMAINING * shift)**2
    if len(starts):  # the noise of each trial's own initial chain moves the optimum by a Gauss-Newton step
        pulls = [fit.jacobian[rows].T @ (loss.clipped(one) - clipped)[rows]
                 for one in starts for rows in layout.rows]
        moves = covariance @ np.array(pulls).T / scale**2
        covariance = covariance + np.where(np.outer(excited, excited), moves @ moves.T, 0.0) / len(starts)
    covariance = covariance + np.diag(np.where(excited, extra, 0.0))
    # None is known worse than a value that may be anything.
    shrink = np.minimum(1.0, UNKNOWN_STD / np.sqrt(np.diag(covariance)))
    covariance = covariance * np.outer(shrink, shrink)
    std = np.where(excited, np.sqrt(np.diag(covariance)), UNKNOWN_STD)
    lower = np.where(excited, np.maximum(point - DEVIATIONS * std, 0.0), 0.0)
    upper = np.where(excited, np.minimum(point + DEVIATIONS * std, 1.0), 1.0)
    at_bound = excited & ((point < AT_BOUND) | (point > 1 - AT_BOUND))
    return Uncertainty(frozen_array(std), frozen_array(lower), frozen_array(upper), excited, at_bound,
                       frozen_array(covariance), residual, scale)


def left_out(fit: Linearisation, groups: Sequence[slice], prior: Floats) -> Floats:
    """
    Return (T, d): how far the optimum moves when one group of residuals after the other is left out.

    One Gauss-Newton step from the common optimum (the jackknife of Efron and
    Tibshirani, An Introduction to the Bootstrap, 1993, 11, linearised).

    :param groups: the rows of T trials or folds.
    :param prior: (d, d) added to the information.
    """
    information, gradient = fit.information, fit.gradient
    moved = []
    for part in (fit.rows(rows) for rows in groups):
        rest = information - part.information + prior
        moved.append(-np.linalg.solve(rest, gradient - part.gradient))
    return np.array(moved)


def drawn_again(fit: Linearisation, groups: Sequence[slice], prior: Floats, draws: int = 200) -> Floats:
    """
    Return (draws, d): how far the optimum moves where as many of the T trials are drawn, with replacement.

    The bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 6), each by one
    Gauss-Newton step from the common optimum; the same draws each time.

    :param groups: the rows of T trials.
    :param prior: (d, d) added to the information.
    """
    parts = [fit.rows(rows) for rows in groups]
    informations = np.array([part.information for part in parts])
    gradients = np.array([part.gradient for part in parts])
    counts = np.random.default_rng(0).multinomial(len(parts), np.full(len(parts), 1 / len(parts)), size=draws)
    matrices = np.tensordot(counts, informations, axes=1) + prior
    moved: Floats = -np.linalg.solve(matrices, (counts @ gradients)[..., None])[..., 0]
    return moved


def independence(residuals: Floats, layout: ResidualLayout) -> float:
    """
    Return how many residuals count as one, >= 1: neighbours along the DLO and in time err alike.

    The product of the integrated autocorrelation lengths, 1 + 2 sum rho_k (Priestley,
    Spectral Analysis and Time Series, 1981, 5.3), along the DLO and over the goals of a trial,
    each summed up to the first that white noise could show.
    """
    blocks = layout.chains(residuals)
    power = float(np.mean([np.square(block).mean() for block in blocks]))
    lengths = []
    for axis in (1, 0):
        length, turned = 1.0, [np.moveaxis(block, axis, 0) for block in blocks]
        for lag in range(1, max(len(block) for block in turned) // 2 + 1):
            pairs = [(block[lag:], block[:-lag]) for block in turned if lag <= len(block) // 2]
            count = sum(one.size for one, _ in pairs)
            product = sum(float(np.vdot(one, other)) for one, other in pairs) / count
            correlation = product / power if power > 0 else 0.0
            if correlation < 2 / np.sqrt(count):
                break
            length += 2 * correlation
        lengths.append(length)
    return lengths[0] * lengths[1]


def optimum_shift(fit: Linearisation, finer: Floats) -> Floats:
    """
    Return (d,): how far the optimum moves where a finer simulation gives residuals `finer`, (m,) [m].

    A Gauss-Newton step on the difference, each parameter no further than its whole scale.
    """
    return np.clip(replace(fit, residuals=finer - fit.residuals).step(fit.ridge), -1.0, 1.0)


def predictive_std(jacobian: Floats, covariance: Floats) -> Floats:
    """Return (p,) [m]: how far each of p simulated points may lie elsewhere, given the covariance (d, d)."""
    variances = np.einsum('mi,ij,mj->m', jacobian, covariance, jacobian)
    return np.asarray(np.sqrt(variances.reshape(-1, 3).sum(axis=1)))
