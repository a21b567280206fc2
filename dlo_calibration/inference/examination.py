# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Examination: what is looked at around the found parameters, once a search has ended.

Beside the found point, each parameter is moved both ways; a finer simulation,
other draws of the noise of the initial chains, the default parameters, the optima
without one trial after the other, and the ends of wide intervals are simulated.
What that says about uncertainty is in `uncertainty`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import both_sides, Linearisation, slope, STEP, WIDEST
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.uncertainty import (
    at_minimum,
    DEVIATIONS,
    left_out,
    noise_alone,
    optimum_shift,
    predictive_std,
    Uncertainty,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.score import distances, PointErrors

SUSPECT = 0.01  # a parameter that is known no better than that is moved further, to look over kinks:
WIDE = 0.1  # that far at least
FADED = 0.9  # of the effect that the end of an interval should have: less, and the end is further away
DOUBLINGS = 4  # of the way there; then it may be anywhere on the scale
ARRIVED = 9.0  # square of the standard deviations that the next step may go, for each parameter
MOST_FOLDS = 8  # of the cross-validation

#: Takes (k, d) points, returns their residuals (m,) [m], None for a failure.
Evaluate = Callable[[Floats], Sequence[Floats | None]]


@dataclass(frozen=True)
class Examination:
    """
    What was found around a point.

    :param uncertainty: of the parameters.
    :param jacobian: (m, d) derivative of the residuals there [m per unit cube].
    :param regular: False where the search had not arrived at a minimum, so that
        `uncertainty` does not hold.
    :param noise: standard deviation of one coordinate of the observations, from
        the roughness of the chains [m]; nan where they have too few points.
    :param cross_validated: mean point error of trials that were left out of the
        fit [m]; nan with one trial.
    :param left_out: (f,) [m] mean point error of each fold of them; empty with one trial.
    :param default_error: mean point error of the default parameters [m]; nan where they fail.
    :param band: (p,) [m] how far each simulated goal point may lie elsewhere, one standard deviation.
    :param evaluations: how many parameter sets were simulated for it.
    """

    uncertainty: Uncertainty
    jacobian: Floats
    regular: bool
    noise: float
    cross_validated: float
    left_out: Floats
    default_error: float
    band: Floats
    evaluations: int

    @property
    def noise_alone(self) -> bool:
        """Whether the residuals are noise alone."""
        return noise_alone(self.uncertainty.residual, self.noise)


def examine(point: Floats, residuals: Floats, layout: ResidualLayout, evaluate: Evaluate, *,
            default: Floats, noise: float, finer: Evaluate | None = None,
            starts: Sequence[Evaluate] = (), thorough: bool = True) -> Examination:
    """
    Examine a (d,) point of the unit cube that has `residuals` (m,) [m].

    :param default: (d,) the default parameters.
    :param noise: see `Examination`.
    :param finer: simulates with more nodes and a smaller step; None: not examined.
    :param starts: simulate with other draws of the noise of the initial chains; may be none.
    :param thorough: False: only as far as the trials that are left out ask for; intervals may be wrong.
    """
    count = 0

    def residuals_at(points: Floats) -> Sequence[Floats | None]:
        nonlocal count
        count += len(points)
        return evaluate(points)

    at_default, = residuals_at(default[None, :])
    fit = _linearised(point, residuals, layout, residuals_at, noise, 2 if thorough else 0)
    apart = _left_out_distances(fit, layout, residuals_at)
    shift = None
    if finer is not None:  # last: a worker keeps one simulator at a time
        count += 1
        fine, = finer(point[None, :])
        shift = np.ones(len(point)) if fine is None else optimum_shift(fit, fine)
    drawn = [one for start in starts for one in start(point[None, :])]
    count += len(drawn)
    found = at_minimum(fit, layout, noise=noise, shift=shift,
                       starts=[one for one in drawn if one is not None])
    if thorough:
        found = _reaching(fit, found, residuals_at)
    assert found.covariance is not None
    return Examination(
        uncertainty=found, jacobian=frozen_array(fit.jacobian), noise=noise, regular=_arrived(fit, found),
        cross_validated=float(np.concatenate(apart).mean()) if apart else float('nan'),
        left_out=frozen_array([float(fold.mean()) for fold in apart]),
        default_error=float('nan') if at_default is None else PointErrors.of(at_default).mean,
        band=frozen_array(predictive_std(fit.jacobian, found.covariance)), evaluations=count)


def _linearised(point: Floats, residuals: Floats, layout: ResidualLayout, residuals_at: Evaluate,
                noise: float, widenings: int) -> Linearisation:
    """Return the residuals with their derivatives, by steps that are as wide as a parameter is unknown."""
    dimension = len(point)

    def columns(wanted: Sequence[int], steps: Floats) -> list[Floats]:
        beside = both_sides(point, wanted, steps)
        seen = residuals_at(beside)
        found = [slope((point[k], *beside[2 * j:2 * j + 2, k]), (residuals, *seen[2 * j:2 * j + 2]))
                 for j, k in enumerate(wanted)]
        return [np.zeros_like(residuals) if one is None else one for one in found]

    steps = np.full(dimension, STEP)
    jacobian = np.stack(columns(range(dimension), steps), axis=1)
    for _ in range(widenings):
        std = at_minimum(Linearisation(point, residuals, jacobian), layout, noise=noise).std
        wider = np.where(std > SUSPECT, np.clip(std, WIDE, WIDEST), steps)
        weak = np.flatnonzero(wider > 1.5 * steps).tolist()
        if not weak:
            break
        steps[weak] = wider[weak]
        for k, column in zip(weak, columns(weak, steps), strict=True):
            # A small difference may show a kink where there is no slope: the lesser effect is believed.
            if np.linalg.norm(column) < np.linalg.norm(jacobian[:, k]):
                jacobian[:, k] = column
    return Linearisation(point, residuals, jacobian)


def _reaching(fit: Linearisation, found: Uncertainty, residuals_at: Evaluate) -> Uncertainty:
    """
    Return intervals that reach to where the residuals have really changed enough, and not less.

    The effect of a stiffness fades as it grows: what is a clear loss on one side may be none on the other.
    """
    point, ends, limits = fit.point, np.stack([found.lower, found.upper]), (0.0, 1.0)
    excited = np.flatnonzero(found.excited)
    needed = DEVIATIONS * found.std * FADED
    unsure = [(side, int(k)) for k in excited for side in (0, 1)
              if found.std[k] > SUSPECT and ends[side, k] != limits[side]]
    for _ in range(DOUBLINGS):
        if not unsure:
            break
        there = np.tile(point, (len(unsure), 1))
        for row, (side, k) in zip(there, unsure, strict=True):
            row[k] = ends[side, k]
        still = []
        for (side, k), one in zip(unsure, residuals_at(there), strict=True):
            if one is None:
                continue
            own = fit.columns(excited).own_weights(int(np.searchsorted(excited, k)))
            if abs(float(own @ (one - fit.residuals))) < needed[k]:
                ends[side, k] = np.clip(2 * ends[side, k] - point[k], *limits)
                if ends[side, k] != limits[side]:
                    still.append((side, k))
        unsure = still
    for side, k in unsure:
        ends[side, k] = limits[side]
    return replace(found, lower=frozen_array(ends[0]), upper=frozen_array(ends[1]))


def _arrived(fit: Linearisation, found: Uncertainty) -> bool:
    """Tell whether the next Gauss-Newton step stays among values that the trials cannot tell apart."""
    free = replace(fit, residuals=Huber.of(fit.residuals).clipped(fit.residuals)).columns(
        found.excited & ~found.at_bound)
    count = len(free.point)
    step = free.step(np.eye(count) * found.residual**2)
    return -float(free.gradient @ step) <= ARRIVED * count * found.scale**2


def _left_out_distances(fit: Linearisation, layout: ResidualLayout, residuals_at: Evaluate) -> list[Floats]:
    """Return the point errors [m] of each fold of the trials at the optimum of the others; none of one."""
    if len(layout.shapes) < 2:
        return []
    folds = layout.folds(MOST_FOLDS)
    moved = left_out(fit, folds, fit.ridge)
    seen = residuals_at(np.clip(fit.point + np.clip(moved, -WIDEST, WIDEST), 0.0, 1.0))
    return [distances(one[rows]) for rows, one in zip(folds, seen, strict=True) if one is not None]
