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

from dlo_calibration.inference.uncertainty import (
    DEVIATIONS,
    from_jacobian,
    left_out,
    optimum_shift,
    predictive_std,
    Uncertainty,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.score import PointErrors

STEP = 0.03  # of the central differences, in the unit cube; contacts that come and go are smaller
SUSPECT = 0.01  # a parameter that is known no better than that is moved further, to look over kinks:
WIDE, WIDEST = 0.1, 0.25  # as far as it is unknown, within these
WIDENINGS = 2
FADED = 0.9  # of the effect that the end of an interval should have: less, and the end is further away
DOUBLINGS = 4  # of the way there; then it may be anywhere on the scale
OUTLIER = 1.5  # standard deviations at which residuals are cut off
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


def examine(point: Floats, residuals: Floats, shapes: Sequence[tuple[int, int]], evaluate: Evaluate, *,
            default: Floats, noise: float, finer: Evaluate | None = None,
            starts: Sequence[Evaluate] = (), thorough: bool = True) -> Examination:
    """
    Examine a (d,) point of the unit cube that has `residuals` (m,) [m].

    :param shapes: (goals, points) of each trial.
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

    dimension = len(point)
    steps = np.full(dimension, STEP)
    beside = np.concatenate([_beside(point, k, steps[k]) for k in range(dimension)] + [default[None, :]])
    *seen, at_default = residuals_at(beside)
    jacobian = np.stack([_column(residuals, point[k], beside[2 * k:2 * k + 2, k], seen[2 * k:2 * k + 2])
                         for k in range(dimension)], axis=1)
    for _ in range(WIDENINGS if thorough else 0):
        std = from_jacobian(point, residuals, jacobian, shapes, noise=noise).std
        wider = np.where(std > SUSPECT, np.clip(std, WIDE, WIDEST), steps)
        weak = np.flatnonzero(wider > 1.5 * steps)
        if not len(weak):
            break
        steps[weak] = wider[weak]
        beside = np.concatenate([_beside(point, k, steps[k]) for k in weak])
        seen = list(residuals_at(beside))
        for j, k in enumerate(weak):
            column = _column(residuals, point[k], beside[2 * j:2 * j + 2, k], seen[2 * j:2 * j + 2])
            # A small difference may show a kink where there is no slope: the lesser effect is believed.
            if np.linalg.norm(column) < np.linalg.norm(jacobian[:, k]):
                jacobian[:, k] = column
    distances = _left_out_distances(point, residuals, jacobian, shapes, residuals_at)
    cross_validated = float(np.concatenate(distances).mean()) if distances else float('nan')
    shift = None
    if finer is not None:  # last: a worker keeps one simulator at a time
        count += 1
        fine, = finer(point[None, :])
        shift = np.ones(dimension) if fine is None else optimum_shift(residuals, fine, jacobian)
    drawn = [one for start in starts for one in start(point[None, :])]
    count += len(drawn)
    found = from_jacobian(point, residuals, jacobian, shapes, noise=noise, shift=shift,
                          starts=[one for one in drawn if one is not None])
    if thorough:
        found = _reaching(point, residuals, jacobian, found, residuals_at)
    assert found.covariance is not None
    return Examination(
        uncertainty=found, jacobian=frozen_array(jacobian), noise=noise,
        regular=_arrived(residuals, jacobian, found), cross_validated=cross_validated,
        left_out=frozen_array([float(fold.mean()) for fold in distances]),
        default_error=float('nan') if at_default is None else PointErrors.of(at_default).mean,
        band=frozen_array(predictive_std(jacobian, found.covariance)), evaluations=count)


def _reaching(point: Floats, residuals: Floats, jacobian: Floats, found: Uncertainty,
              residuals_at: Evaluate) -> Uncertainty:
    """
    Return intervals that reach to where the residuals have really changed enough, and not less.

    The effect of a stiffness fades as it grows: what is a clear loss on one side may be none on the other.
    """
    ends, limits = np.stack([found.lower, found.upper]), (0.0, 1.0)
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
            own = _own_part(jacobian[:, excited], int(np.searchsorted(excited, k)))
            if abs(float(own @ (one - residuals))) < needed[k]:
                ends[side, k] = np.clip(2 * ends[side, k] - point[k], *limits)
                if ends[side, k] != limits[side]:
                    still.append((side, k))
        unsure = still
    for side, k in unsure:
        ends[side, k] = limits[side]
    return replace(found, lower=frozen_array(ends[0]), upper=frozen_array(ends[1]))


def _own_part(jacobian: Floats, k: int) -> Floats:
    """Return (m,) weights of a change of the residuals that tell how far k moved, not the others."""
    others = np.delete(jacobian, k, axis=1)
    own = jacobian[:, k] - others @ np.linalg.lstsq(others, jacobian[:, k], rcond=None)[0]
    return np.asarray(own / max(float(own @ own), 1e-300))


def _beside(point: Floats, k: int | np.intp, step: float) -> Floats:
    """Return the (2, d) points beside `point` in parameter k, within the cube."""
    beside = np.tile(point, (2, 1))
    beside[:, k] = np.clip(point[k] + np.array([-step, step]), 0.0, 1.0)
    return beside


def _column(residuals: Floats, value: float, values: Floats, seen: Sequence[Floats | None]) -> Floats:
    """Return (m,) the derivative from both sides, or from the one that could be simulated."""
    known = [(float(at), one) for at, one in zip(values, seen, strict=True)
             if one is not None and at != value]
    if len(known) < 2:
        known.append((value, residuals))
    if len(known) < 2:
        return np.zeros_like(residuals)
    (low, before), (high, after) = known
    return np.asarray((after - before) / (high - low))


def _arrived(residuals: Floats, jacobian: Floats, found: Uncertainty) -> bool:
    """Tell whether the next Gauss-Newton step stays among values that the trials cannot tell apart."""
    free = np.flatnonzero(found.excited & ~found.at_bound)
    columns = jacobian[:, free]
    capped = np.clip(residuals, -OUTLIER * found.residual, OUTLIER * found.residual)
    information = columns.T @ columns + np.eye(len(free)) * found.residual**2
    gradient = columns.T @ capped
    return float(gradient @ np.linalg.solve(information, gradient)) <= ARRIVED * len(free) * found.scale**2


def _left_out_distances(point: Floats, residuals: Floats, jacobian: Floats,
                        shapes: Sequence[tuple[int, int]], residuals_at: Evaluate) -> list[Floats]:
    """Return the point errors [m] of each fold of the trials at the optimum of the others; none of one."""
    if len(shapes) < 2:
        return []
    folds = _folds(shapes)
    sizes = [sum(goals * points for goals, points in fold) for fold in folds]
    moved = left_out(residuals, jacobian, [(size, 1) for size in sizes])
    seen = residuals_at(np.clip(point + np.clip(moved, -WIDEST, WIDEST), 0.0, 1.0))
    distances, at = [], 0
    for size, one in zip(sizes, seen, strict=True):
        if one is not None:
            distances.append(np.linalg.norm(one[at:at + 3 * size].reshape(-1, 3), axis=1))
        at += 3 * size
    return distances


def _folds(shapes: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Divide the trials, in order, into as many folds as there are, but not too many."""
    parts = np.array_split(np.arange(len(shapes)), min(len(shapes), MOST_FOLDS))
    return [[shapes[k] for k in part] for part in parts]
