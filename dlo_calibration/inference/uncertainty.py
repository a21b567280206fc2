# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Uncertainty: the covariance and the intervals of the calibrated parameters, in units of a search.

If the search ended in a regular minimum, the covariance follows from the Jacobian of the residuals there.
The textbook's formula alone is several times too small for real DLOs.  Therefore it takes seven more effects
into account:

- the errors of neighbouring points are correlated, so that these count as fewer;
- the initial chain of each trial is measured with noise, too, and so are length and shape of the DLO;
- if noise cannot explain the residuals, the trials may disagree with each other; the jackknife and
  the bootstrap over the trials measure how much more than by chance, and the larger of both counts; an
  interval contains what the trials say without any one of them, unless that one alone tells the parameter;
- the step and the nodes of the simulation move the optimum;
- trials that look alike share the error of the model, so that repeating one averages only its noise;
- chains and hands may have errors that change slowly, as those of a film, where their size is given;
- the reported point may be beside the minimum, after a search that does not converge (`Uncertainty.at`).

After any other search, such as a random one, the spread of the best evaluations is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.linearisation import Ends, Linearisation, Rows, TINY
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.model.chain import Floats, frozen_array

UNKNOWN_STD = 1 / np.sqrt(12)  # of the uniform distribution over one unit, which is the prior
HARDLY = 0.95  # of UNKNOWN_STD; trials that leave more inform about nothing
# Widths of a 90 % interval, in units of a search.  At the ends of the first, simulated points of reference
# objects move by 4 % of the length (bending stiffness) and 2 % (friction), on average over nine actions; at
# the ends of the second by 7 and 4 %, which is most of the 10 and 6 % that a value from far away costs.
IDENTIFIABLE_WIDTH, WEAK_WIDTH = 0.2, 0.4
DEVIATIONS = 1.645  # half the width of a 90 % interval, in standard deviations of a normal distribution
DISAGREEMENT = 1.05  # from this multiple of the noise level on, trials may disagree
ALONE = 8.0  # from so many times its standard deviation on, the trials that are left hardly tell a parameter
MODEL_ERROR = 1.6  # noise alone does not explain residuals that exceed the noise level by this factor
SIMILAR = 0.8  # least cosine between the derivatives of similar trials; different actions stay below 0.5
INVOLVED = 0.3  # a parameter belongs to a combination if its share of the unit vector is at least this

IDENTIFIABLE, WEAK, NOT_IDENTIFIABLE = 'identifiable', 'weak', 'not identifiable'


def verdict(lower: float, upper: float, end: float = 1.0) -> str:
    """
    Return the verdict on a parameter, from its 90 % interval in the box: the narrower, the better.

    An interval that reaches an end of the scale is a bound on one side: its parameter is weak at best.

    :param end: the upper end of the scale.
    """
    width, cut = upper - lower, lower <= 0 or upper >= end
    if width > WEAK_WIDTH:
        return NOT_IDENTIFIABLE
    return WEAK if cut or width > IDENTIFIABLE_WIDTH else IDENTIFIABLE


@dataclass(frozen=True)
class Uncertainty:
    """
    How certain d parameters are, in units of a search.

    :param std: (d,) standard deviation.
    :param lower: (d,) lower end of the 90 % interval; `upper` (d,) its upper end.
    :param excited: (d,) False for a parameter that has no effect on any trial.
    :param at_bound: (d,) True if the best value is at an end of the scale.
    :param covariance: (d, d); None if only the spread of the evaluations is known.
    :param local: (d, d) covariance before intervals were widened to where the linear model no longer holds.
    :param residual: standard deviation of one coordinate's residual [m]; nan if it was not estimated.
    :param scale: the same, enlarged because neighbouring residuals are correlated [m].
    :param ends: (d,) upper ends of the box, or one for all; the lower ones are 0.
    """

    std: Floats
    lower: Floats
    upper: Floats
    excited: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]
    covariance: Floats | None = None
    residual: float = float('nan')
    scale: float = float('nan')
    local: Floats | None = None
    ends: Ends = 1.0

    @property
    def verdicts(self) -> tuple[str, ...]:
        """The verdict on each parameter."""
        return tuple(map(verdict, self.lower.tolist(), self.upper.tolist(),
                         np.broadcast_to(self.ends, self.upper.shape).tolist()))

    @property
    def spread(self) -> Floats:
        """The covariance, (d, d); without correlations where only the standard deviations are known."""
        return np.diag(self.std**2) if self.covariance is None else self.covariance

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Which parameters, (d,), are hardly better known than without any trial."""
        return np.asarray(self.std > HARDLY * UNKNOWN_STD)

    def of_excited(self, excited: NDArray[np.bool_]) -> Uncertainty:
        """Return the uncertainty with unknown parameters where `excited`, (d,), is False."""
        return replace(
            self, excited=excited, std=frozen_array(np.where(excited, self.std, UNKNOWN_STD)),
            lower=frozen_array(np.where(excited, self.lower, 0.0)),
            upper=frozen_array(np.where(excited, self.upper, self.ends)))

    def within(self, lower: Floats, upper: Floats) -> Uncertainty:
        """Return the uncertainty with wider intervals, (d,) each, and standard deviations to match."""
        std = np.maximum(self.std, np.minimum((upper - lower) / (2 * DEVIATIONS), UNKNOWN_STD))
        wider = std / self.std
        return replace(
            self, lower=frozen_array(lower), upper=frozen_array(upper), std=frozen_array(std),
            covariance=None if self.covariance is None else
            frozen_array(self.covariance * np.outer(wider, wider)))

    def at(self, point: Floats, there: Floats, remaining: Floats) -> Uncertainty:
        """
        Return the uncertainty at another point, which may be beside the minimum.

        A standard deviation becomes the root mean square distance of the parameter from that point.  An
        interval that reaches an end of the scale still does.

        :param point: (d,) where this uncertainty holds.
        :param there: (d,) the other point.
        :param remaining: (d,) the step from the other point to the minimum.
        """
        std = np.minimum(np.hypot(self.std, remaining), UNKNOWN_STD)
        wider, covariance = std / self.std, self.covariance
        if covariance is not None:
            covariance = covariance + np.outer(remaining, remaining)
            shrink = np.minimum(1.0, std / np.sqrt(np.diag(covariance)))
            covariance = frozen_array(covariance * np.outer(shrink, shrink))
        lower = np.maximum(there - wider * (point - self.lower), 0.0)
        upper = np.minimum(there + wider * (self.upper - point), self.ends)
        return replace(
            self, std=frozen_array(std), covariance=covariance,
            at_bound=self.excited & at_end(there, self.ends),
            lower=frozen_array(np.where(self.lower > 0, lower, 0.0)),
            upper=frozen_array(np.where(self.upper < self.ends, upper, self.ends)))

    @property
    def correlations(self) -> Floats | None:
        """(d, d) correlations of the parameters, symmetric, 1 on the diagonal; None if they are unknown."""
        if self.covariance is None:
            return None
        std = np.sqrt(np.diag(self.covariance))
        correlations = (self.covariance + self.covariance.T) / 2 / np.outer(std, std)
        np.fill_diagonal(correlations, 1.0)
        return np.asarray(np.clip(correlations, -1.0, 1.0))  # rounding may lead beyond

    @property
    def undetermined(self) -> tuple[Floats, ...]:
        """
        Unit vectors (d,) of combinations of two or more parameters that are not identifiable.

        Where all combinations of the same parameters are not, none says more than that each of them is not.
        """
        if self.covariance is None:
            return ()
        values, vectors = np.linalg.eigh(self.covariance)
        combined = [vector * np.sign(vector[np.abs(vector).argmax()])
                    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
                    if 2 * DEVIATIONS * np.sqrt(value) > IDENTIFIABLE_WIDTH
                    and (np.abs(vector) >= INVOLVED).sum() > 1]
        involved = [tuple(np.flatnonzero(np.abs(vector) >= INVOLVED)) for vector in combined]
        return tuple(vector for vector, those in zip(combined, involved, strict=True)
                     if involved.count(those) < len(those))


def good_count(evaluations: int) -> int:
    """Return how many of the evaluations count as good: the best 5 %, but at least 8."""
    return max(8, round(0.05 * evaluations))


def spread_of_best(evaluations: Sequence[Evaluation], best: Floats, ends: Ends = 1.0) -> Uncertainty:
    """
    Return the spread of the parameters of the best evaluations.

    A parameter that the trials determine has similar values in all good evaluations; the others scatter.
    `std` is the root mean square distance of the best 5 %, but at least 8, from the (d,) point `best`;
    `lower` and `upper` are their extremes.  With too few evaluations, no parameter is identifiable.  The
    spread depends on the search as much as on the trials.

    :param ends: (d,) upper ends of the box, or one for all.
    """
    good = sorted((e for e in evaluations if np.isfinite(e.score)), key=lambda e: e.score)
    count = good_count(len(evaluations))
    everywhere = np.ones(len(best), dtype=np.bool_)
    if len(good) < 2 * count:
        unknown = np.ones_like(best)
        return Uncertainty(unknown * UNKNOWN_STD, unknown * 0, unknown * ends, everywhere, ~everywhere,
                           ends=ends)
    points = np.stack([e.point for e in good[:count]])
    std = np.minimum(np.sqrt(np.mean((points - best) ** 2, axis=0)), UNKNOWN_STD)
    return Uncertainty(std, np.minimum(points.min(axis=0), best), np.maximum(points.max(axis=0), best),
                       everywhere, ~everywhere, ends=ends)


def prior_information(dimension: int) -> Floats:
    """Return the (d, d) information of the prior: a uniform distribution of d parameters over one unit."""
    return np.asarray(np.eye(dimension) / UNKNOWN_STD**2)


def noise_alone(residual: float, noise: float) -> bool:
    """Tell whether noise alone explains residuals, from both standard deviations [m]; nan: no."""
    return residual < MODEL_ERROR * noise


def at_minimum(fit: Linearisation, layout: ResidualLayout, *, noise: float = float('nan'),
               shift: Floats | None = None, starts: Sequence[Floats] | Floats = (),
               hands: Sequence[Floats] = (), slow: Sequence[Floats] = ()) -> Uncertainty:
    """
    Return the uncertainty that follows from the linearised residuals at a minimum.

    :param noise: noise level: standard deviation of one measured coordinate [m]; nan if unknown.
    :param shift: (d,) how far a finer simulation moves the optimum; None: unknown.
    :param starts: residuals (m,) [m] at the minimum, for initial chains with other noise; may be empty.
    :param hands: those for errors of the hands that are larger by one standard deviation each.
    :param slow: those for one slow error each, of one standard deviation in every trial; see `slow_errors`.
    """
    point, loss = fit.point, Huber.of(fit.residuals)
    clipped = loss.clipped(fit.residuals)
    residual = loss.deviation(fit.residuals, len(point))
    scale = residual * float(np.sqrt(correlation_length(clipped, layout)))
    weighted = fit.weighted(loss.roots(fit.residuals) / scale)
    prior = prior_information(len(point))
    groups = similar_trials(weighted, layout)
    shared = shared_error(clipped, layout, groups)
    information = shared_information(weighted, layout, shared)
    with np.errstate(divide='ignore'):
        excited = 1 / np.sqrt(np.diag(information)) < UNKNOWN_STD
    covariance = np.linalg.inv(information + prior)
    extra, without = np.zeros(len(point)), np.zeros((1, len(point)))
    # Three standard deviations of a residual that is estimated from so much white noise.
    chance = 3 / np.sqrt(2 * max(1, len(fit.residuals) - len(point)))
    if len(layout.shapes) >= 2 and not residual < (DISAGREEMENT + chance) * noise:
        parts: Sequence[Rows] = layout.rows if len(groups) < 3 else [
            np.concatenate([np.r_[layout.rows[k]] for k in group]) for group in groups]
        count = len(parts)
        without, by_chance = disagreement(weighted, parts, prior, 1 - np.eye(count))
        if count >= 3:  # two say too little of a variance
            drawn, drawn_by_chance = disagreement(weighted, parts, prior, bootstrap_counts(count))
            extra = np.maximum.reduce([
                (count - 1) * np.mean(without**2 - by_chance, axis=0),
                np.mean(drawn**2 - drawn_by_chance, axis=0), extra])
    # Trials that disagree move the optimum most in the directions that are known least.
    certain = np.sqrt(np.diag(covariance))
    moved = covariance / np.outer(certain, certain) * np.sqrt(np.outer(extra, extra))
    if shift is not None:
        moved = moved + np.outer(2 * shift, 2 * shift)  # twice as fine halves the error, of first order
    if len(starts):  # the noise of each trial's own initial chain moves the optimum by a Gauss-Newton step
        changes = np.array(starts) - fit.residuals
        # The residuals contain one such change: larger ones come from too high a noise level, or from chaos.
        size = np.sqrt(np.mean(changes**2, axis=1, keepdims=True))
        changes = changes * np.minimum(1.0, residual / np.maximum(size, TINY)) * loss.roots(fit.residuals)**2
        bias = changes.mean(axis=0)  # that noise gives to all trials in the same direction
        pulls = [(changes - bias)[:, rows] @ fit.jacobian[rows] / scale**2 for rows in layout.rows]
        step = np.linalg.inv(weighted.information + prior)
        moves = step @ weighted_products(pulls, shared) @ step / len(starts)
        biased = step @ fit.jacobian.T @ bias / scale**2
        moves = moves + np.outer(biased, biased)
        covariance = covariance + np.where(np.outer(excited, excited), moves, 0.0)
    whole: list[Rows] = [slice(None)]
    each: list[Rows] = [*layout.rows]  # all trials share an error of the hands, but not a slow one
    for residuals, parts in zip((*hands, *slow), [whole] * len(hands) + [each] * len(slow), strict=True):
        change = loss.roots(fit.residuals)**2 * (residuals - fit.residuals) / scale**2
        for rows in parts:
            move = np.linalg.solve(weighted.information + prior, fit.jacobian[rows].T @ change[rows])
            covariance = covariance + np.where(np.outer(excited, excited), np.outer(move, move), 0.0)
    covariance = covariance + np.where(np.outer(excited, excited), moved, 0.0)
    # No standard deviation is larger than that of the prior.
    shrink = np.minimum(1.0, UNKNOWN_STD / np.sqrt(np.diag(covariance)))
    covariance = covariance * np.outer(shrink, shrink)
    std = np.where(excited, np.sqrt(np.diag(covariance)), UNKNOWN_STD)
    lower = np.where(excited, np.maximum(point - DEVIATIONS * std, 0.0), 0.0)
    upper = np.where(excited, np.minimum(point + DEVIATIONS * std, fit.upper), fit.upper)
    uncertainty = Uncertainty(frozen_array(std), frozen_array(lower), frozen_array(upper), excited,
                              excited & at_end(point, fit.upper), frozen_array(covariance), residual, scale,
                              frozen_array(covariance), fit.upper)
    return uncertainty.within(np.clip(np.minimum(lower, point + without.min(axis=0)), 0.0, fit.upper),
                              np.clip(np.maximum(upper, point + without.max(axis=0)), 0.0, fit.upper))


def at_end(point: Floats, ends: Ends) -> NDArray[np.bool_]:
    """Return (d,) True where a (d,) point is at an end of the scale, 0 or `ends`."""
    return np.asarray((point < 0.002) | (point > ends - 0.002))


def similar_trials(fit: Linearisation, layout: ResidualLayout) -> list[list[int]]:
    """Group the indices of T trials whose derivatives are nearly parallel: they show the same."""
    sides = [block.ravel() for block in layout.aligned(fit.jacobian)]
    sizes = [max(float(np.linalg.norm(side)), TINY) for side in sides]
    groups: list[list[int]] = []
    for k, side in enumerate(sides):
        similar = [group for group in groups if layout.shapes[group[0]] == layout.shapes[k]
                   and len(sides[group[0]]) == len(side)
                   and float(sides[group[0]] @ side) >= SIMILAR * sizes[group[0]] * sizes[k]]
        if similar:
            similar[0].append(k)
        else:
            groups.append([k])
    return groups


def shared_error(residuals: Floats, layout: ResidualLayout, groups: Sequence[Sequence[int]]) -> Floats:
    """
    Return the (T, T) correlations of the errors of T trials; 0 between trials of different groups.

    They are the mean correlations of the residuals (m,) [m], or 0 if that is negative: 1 for an exact repeat
    of a trial, near 0 where the model is right and only the noise is new each time.
    """
    shared, blocks = np.eye(len(layout.shapes)), layout.aligned(residuals)
    for group in groups:
        each = np.stack([blocks[k] for k in group])
        power, count = float(np.square(each).sum()), len(group)
        if count > 1 and power > 0:
            both = float(np.square(each.sum(axis=0)).sum()) - power  # of all pairs, either way
            shared[np.ix_(group, group)] = np.clip(both / power / (count - 1), 0.0, 1.0)
    np.fill_diagonal(shared, 1.0)
    return shared


def shared_information(fit: Linearisation, layout: ResidualLayout, shared: Floats) -> Floats:
    """
    Return the (d, d) information of T trials whose errors have the correlations `shared`, (T, T).

    It is H V^-1 H (Godambe's information: Varin, Reid and Firth, An Overview of Composite Likelihood Methods,
    2011, 2.1) with the information H of independent trials and the variance V of the gradient.  It is H for
    independent trials, and the information of one trial for its exact repeats.
    """
    alone = fit.information
    if np.count_nonzero(shared) == len(shared):
        return alone
    gradients = weighted_products(layout.aligned(fit.jacobian), shared)
    return np.asarray(alone @ np.linalg.pinv(gradients, hermitian=True) @ alone)


def weighted_products(blocks: Sequence[Floats], shared: Floats) -> Floats:
    """Return (d, d): the products B_t^T B_s of T blocks (r, d), summed with the weights `shared`, (T, T)."""
    dimension = blocks[0].shape[1]
    return sum((shared[k, other] * blocks[k].T @ blocks[other]
                for k, other in np.argwhere(shared).tolist()), np.zeros((dimension, dimension)))


def jackknife(fit: Linearisation, groups: Sequence[Rows], prior: Floats) -> Floats:
    """
    Return (T, d): how far the optimum moves when each group of residuals in turn is left out.

    This is the jackknife (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 11), linearised.

    :param groups: the rows of T trials or folds.
    :param prior: (d, d) added to the information.
    """
    return resampled(fit, groups, prior, 1 - np.eye(len(groups)))[0]


def bootstrap_counts(groups: int, draws: int = 200) -> Floats:
    """
    Return (draws, T): how often each of T groups is drawn, when T are drawn with replacement.

    This is the bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 6); every call
    makes the same draws.
    """
    drawn = np.random.default_rng(0).multinomial(groups, np.full(groups, 1 / groups), size=draws)
    return np.asarray(drawn, dtype=np.float64)


def resampled(fit: Linearisation, groups: Sequence[Rows], prior: Floats,
              counts: Floats) -> tuple[Floats, Floats]:
    """
    Return how far the optimum moves when groups of residuals count more or less, and how far by chance.

    The first, (n, d), is a Gauss-Newton step from the common optimum; the second, (n, d), is the variance of
    that step if the groups agree.  With information H_k, H = sum H_k, S = sum c_k H_k, it is the diagonal of
    S^-1 (sum c_k^2 H_k - S H^-1 S) S^-1, as the gradients of the groups are independent, but add up to
    zero.  It is large where few groups determine a parameter, and one of them is not counted.

    :param groups: the rows of T groups.
    :param prior: (d, d) added to the information.
    :param counts: (n, T) c, how often each group counts.
    """
    parts = [fit.rows(rows) for rows in groups]
    informations = np.array([part.information for part in parts])
    gradients = np.array([part.gradient for part in parts])
    counted = np.tensordot(counts, informations, axes=1)
    inverses = np.linalg.inv(counted + prior)
    moved: Floats = -(inverses @ (counts @ gradients)[..., None])[..., 0]
    common = np.linalg.inv(fit.information + prior)
    scatter = np.tensordot(counts**2, informations, axes=1) - counted @ common @ counted
    return moved, np.asarray(np.einsum('nij,njk,nki->ni', inverses, scatter, inverses))


def disagreement(fit: Linearisation, groups: Sequence[Rows], prior: Floats,
                 counts: Floats) -> tuple[Floats, Floats]:
    """
    Return the same as `resampled`, but 0 for a parameter where those that count hardly tell it.

    What moves it there is their own error: that of a trial that alone tells it, as of the one in which a
    rope is taut, would have to be far larger than the residuals.
    """
    def variances(counted: Floats) -> Floats:
        return np.diagonal(np.linalg.inv(counted + prior), axis1=-2, axis2=-1)

    informations = np.array([fit.rows(rows).information for rows in groups])
    told = variances(np.tensordot(counts, informations, axes=1)) < ALONE**2 * variances(fit.information)
    moved, by_chance = resampled(fit, groups, prior, counts)
    return moved * told, by_chance * told


def correlation_length(residuals: Floats, layout: ResidualLayout) -> float:
    """
    Return how many neighbouring residuals count as one, >= 1: they are correlated along the DLO and in time.

    It is the product of the integrated autocorrelation lengths, 1 + 2 sum rho_k (Priestley,
    Spectral Analysis and Time Series, 1981, 5.3), along the DLO and over the goals of a trial.
    Each sum ends before the first rho_k that white noise could have.
    """
    chains = layout.chains(residuals)
    power = float(np.mean([np.nanmean(np.square(block)) for block in chains]))
    blocks = [np.nan_to_num(block) for block in chains]  # points that were not seen add nothing
    seen = [np.isfinite(block) for block in chains]
    lengths = []
    for axis in (1, 0):
        length, turned = 1.0, [np.moveaxis(block, axis, 0) for block in blocks]
        masks = [np.moveaxis(block, axis, 0) for block in seen]
        for lag in range(1, max(len(block) for block in turned) // 2 + 1):
            pairs = [(block[lag:], block[:-lag]) for block in turned if lag <= len(block) // 2]
            count = sum(int(np.sum(block[lag:] & block[:-lag])) for block in masks if lag <= len(block) // 2)
            if not count:
                break
            product = sum(float(np.vdot(later, earlier)) for later, earlier in pairs) / count
            correlation = product / power if power > 0 else 0.0
            if correlation < 2 / np.sqrt(count):
                break
            length += 2 * correlation
        lengths.append(length)
    return lengths[0] * lengths[1]


def optimum_shift(fit: Linearisation, finer: Floats) -> Floats:
    """
    Return (d,): how far the optimum moves if a finer simulation gives the residuals `finer`, (m,) [m].

    This is a Gauss-Newton step on the difference; no parameter moves further than a unit.  The residuals
    contain what the step leaves of the difference: more of it comes from chaos, so that the step is shorter
    by as much.
    """
    difference = replace(fit, residuals=finer - fit.residuals)
    step = difference.step(fit.ridge)
    left = float(np.linalg.norm(difference.predicted(step)))
    return np.clip(step * min(1.0, float(np.linalg.norm(fit.residuals)) / max(left, TINY)), -1.0, 1.0)


def predictive_std(jacobian: Floats, covariance: Floats) -> Floats:
    """Return (p,) standard deviations of p simulated points [m], from the covariance (d, d)."""
    variances = np.einsum('mi,ij,mj->m', jacobian, covariance, jacobian)
    return np.asarray(np.sqrt(variances.reshape(-1, 3).sum(axis=1)))
