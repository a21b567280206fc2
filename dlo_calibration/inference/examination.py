# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Examination: simulations around the found parameters, after a search has ended.

These are simulated: each parameter changed in both directions; finer nodes and
steps; initial chains with other noise; the default parameters; a step towards the optimum of the
other trials for each trial that is left out; and the ends of wide intervals.
The module `uncertainty` computes the intervals from them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import both_sides, Linearisation, slope, STEP, WIDEST
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.cross_validation import Evaluate, left_out_errors
from dlo_calibration.inference.uncertainty import (
    at_minimum,
    DEVIATIONS,
    noise_alone,
    optimum_shift,
    Uncertainty,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.score import PointErrors

#: Gives the residuals (m,) [m] of points that are being evaluated, None for a failure.
Ended = Callable[[], Sequence[Floats | None]]

#: Standard deviation (unit cube) above which a small step is not enough: contact and friction have kinks.
SUSPECT = 0.01


@dataclass(frozen=True)
class Examination:
    """
    The outcome of an examination.

    :param uncertainty: of the parameters.
    :param jacobian: (m, d) derivative of the residuals at the compared goals [m per unit cube].
    :param regular: False if the search has not reached a minimum, so that `uncertainty` is not valid.
    :param noise: noise level: standard deviation of one measured coordinate, from the roughness of the
        chains [m]; nan if they have too few points.
    :param cross_validated: mean point error of trials that were left out of the fit [m]; nan with one trial.
    :param default_error: mean point error of the default parameters [m]; nan if they cannot be simulated.
    :param evaluations: number of parameter sets that were simulated.
    """

    uncertainty: Uncertainty
    jacobian: Floats
    regular: bool
    noise: float
    cross_validated: float
    default_error: float
    evaluations: int

    @property
    def noise_alone(self) -> bool:
        """Whether noise alone explains the residuals."""
        return noise_alone(self.uncertainty.residual, self.noise)


def examine(point: Floats, residuals: Floats, layout: ResidualLayout, evaluate: Evaluate, *,
            default: Floats, noise: float, finer: Ended | None = None,
            starts: Sequence[Ended] = (), fading: NDArray[np.bool_] | None = None) -> Examination:
    """
    Examine the (d,) `point` of the unit cube, where the residuals are `residuals` (m,) [m].

    :param evaluate: simulates the trials.
    :param default: (d,) the default parameters.
    :param noise: noise level, see `Examination` [m].
    :param finer: gives the residuals at `point` with more nodes and a smaller step; None: this is left out.
    :param starts: each gives those with initial chains of other noise; may be empty.
    :param fading: (d,) False for parameters whose effect is much the same along their scale; None: all may
        fade or have kinks.
    """
    count = 0

    def residuals_at(points: Floats) -> Sequence[Floats | None]:
        nonlocal count
        count += len(points)
        return evaluate(points)

    at_default, = residuals_at(default[None, :])
    fading = np.ones(len(point), bool) if fading is None else fading
    fit = _linearised(point, residuals, layout, residuals_at, noise, fading)
    fold_errors = left_out_errors(fit, layout, residuals_at)
    shift = None
    if finer is not None:
        count += 1
        fine, = finer()
        shift = np.ones(len(point)) if fine is None else optimum_shift(fit, fine)
    drawn = [one for start in starts for one in start()]
    count += len(drawn)
    found = at_minimum(fit, layout, noise=noise, shift=shift,
                       starts=[one for one in drawn if one is not None])
    found = extended(fit, found, residuals_at, fading)
    return Examination(
        uncertainty=found, jacobian=frozen_array(fit.jacobian), noise=noise, regular=_converged(fit, found),
        cross_validated=float(np.concatenate(fold_errors).mean()) if fold_errors else float('nan'),
        default_error=float('nan') if at_default is None else PointErrors.of(at_default).mean,
        evaluations=count)


def _linearised(point: Floats, residuals: Floats, layout: ResidualLayout, residuals_at: Evaluate,
                noise: float, fading: NDArray[np.bool_]) -> Linearisation:
    """Return the linearised residuals; uncertain parameters take steps of their standard deviations."""
    dimension = len(point)

    def columns(wanted: Sequence[int], steps: Floats) -> list[Floats]:
        sides = [both_sides(point, [k], steps) for k in wanted]
        # One side, the one towards the middle, shows an effect that is much the same along the scale.
        beside = [both if fading[k] else both[[int(point[k] < 0.5)]]
                  for k, both in zip(wanted, sides, strict=True)]
        seen = iter(residuals_at(np.concatenate(beside)))
        found = [slope((point[k], *one[:, k]), (residuals, *islice(seen, len(one))))
                 for k, one in zip(wanted, beside, strict=True)]
        return [np.zeros_like(residuals) if one is None else one for one in found]

    steps = np.full(dimension, STEP)
    jacobian = np.stack(columns(range(dimension), steps), axis=1)
    for _ in range(2):
        std = at_minimum(Linearisation(point, residuals, jacobian), layout, noise=noise).std
        wider = np.where(std > SUSPECT, np.clip(std, 0.1, WIDEST), steps)
        weak = np.flatnonzero(fading & (wider > 1.5 * steps)).tolist()
        if not weak:
            break
        steps[weak] = wider[weak]
        for k, column in zip(weak, columns(weak, steps), strict=True):
            # A small step may see a kink and no slope, so that the smaller effect counts.
            if np.linalg.norm(column) < np.linalg.norm(jacobian[:, k]):
                jacobian[:, k] = column
    return Linearisation(point, residuals, jacobian)


def extended(fit: Linearisation, found: Uncertainty, residuals_at: Evaluate,
             fading: NDArray[np.bool_]) -> Uncertainty:
    """
    Return intervals that are extended to where the residuals really change as much as the linear fit says.

    The effect of a stiffness fades as it grows: one end of an interval may fit clearly worse, the other not.
    An end whose effect is below 90 % of the expected one moves to twice its distance, four times at most;
    after that, it is the end of the scale.  The standard deviations grow with them.
    """
    point, ends, limits = fit.point, np.stack([found.lower, found.upper]), (0.0, 1.0)
    excited = np.flatnonzero(found.excited)
    needed = DEVIATIONS * found.std * 0.9
    unsure = [(side, int(k)) for k in excited for side in (0, 1)
              if found.std[k] > SUSPECT and ends[side, k] != limits[side] and fading[k]]
    for _ in range(4):
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
    return found.within(ends[0], ends[1])


def _converged(fit: Linearisation, found: Uncertainty) -> bool:
    """Tell whether the next Gauss-Newton step is small: 3 standard deviations (squared: 9) per parameter."""
    free = replace(fit, residuals=Huber.of(fit.residuals).clipped(fit.residuals)).columns(
        found.excited & ~found.at_bound)
    count = len(free.point)
    step = free.step(np.eye(count) * found.residual**2)
    return -float(free.gradient @ step) <= 9.0 * count * found.scale**2
