# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Examination: simulations around the found parameters, after a search has ended.

It simulates each parameter changed in both directions; finer nodes and steps; initial chains with other
noise; the default parameters; for each trial, a step towards the optimum of the others; the ends of wide
intervals; and certain parameters changed where other noise leads a trial elsewhere.  The module `uncertainty`
computes the intervals from these.  A confirmation compares the engine with a second one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Differences, Ends, Linearisation, STEP, WIDEST
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
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

#: Two engines agree if their points of a trial are no further apart on average [m]: about the
#: discretisation error of nodes and time step, 0.46 mm on the reference objects (doc/physics.md).
DISTANCE_TOLERANCE = 0.5e-3
AMONG_OBSTACLES = 6.0  # times that; PyBullet's contact with them is off by 2 mm (doc/physics.md)

#: Returns the residuals (m,) [m] of points that are being evaluated, None for a failure.
Pending = Callable[[], Sequence[Floats | None]]

#: Standard deviation, in units of a search, above which a small step is not enough: contact and friction have
#: kinks.
SUSPECT = 0.01
#: A step of so many standard deviations shows what happens there, if it is not shorter than SHORTEST.
NEARBY, SHORTEST = 4.0, 0.003
#: Standard deviations by which a certain parameter is changed where other noise leads a trial elsewhere.
ELSEWHERE = (-6.0, -3.0, -1.5, 1.5, 3.0, 6.0)


@dataclass(frozen=True)
class Examination:
    """
    The outcome of an examination.

    :param uncertainty: of the parameters.
    :param jacobian: (m, d) derivative of the residuals at the compared goals [m per unit].
    :param regular: False if the search has not reached a minimum, so that `uncertainty` is not valid.
    :param noise: noise level: standard deviation of one measured coordinate, from the roughness of the
        chains [m]; nan if they have too few points.
    :param cross_validated: mean point error of trials that were left out of the fit [m]; nan with one trial.
    :param default_error: mean point error of the default parameters [m]; nan if they cannot be simulated.
    :param evaluations: number of parameter sets that were simulated.
    :param coarse: (T,) how far a finer simulation moves the points of each trial on average [m], at the goal
        where that is most; empty: unknown.
    """

    uncertainty: Uncertainty
    jacobian: Floats
    regular: bool
    noise: float
    cross_validated: float
    default_error: float
    evaluations: int
    coarse: tuple[float, ...] = ()

    @property
    def noise_alone(self) -> bool:
        """Whether noise alone explains the residuals."""
        return noise_alone(self.uncertainty.residual, self.noise)


def examine(point: Floats, residuals: Floats, layout: ResidualLayout, evaluate: Evaluate, *,
            default: Floats, noise: float, finer: Pending | None = None,
            starts: Sequence[Pending] = (), restarted: Sequence[Evaluate] = (),
            hands: Sequence[Pending] = (), slow: Sequence[Pending] = (),
            fading: NDArray[np.bool_] | None = None, upper: Ends = 1.0) -> Examination:
    """
    Examine the (d,) `point` of the box, where the residuals are `residuals` (m,) [m].

    :param evaluate: simulates the trials.
    :param default: (d,) the default parameters.
    :param noise: noise level, see `Examination` [m].
    :param finer: returns the residuals at `point` with more nodes and a smaller step; None: not simulated.
    :param starts: each returns those with initial chains of other noise; may be empty.
    :param restarted: each simulates the trials with the initial chains of one of `starts`; may be empty.
    :param hands: each returns those with an error of the hands that is larger by its standard deviation.
    :param slow: each returns those with one slow error of one standard deviation in every trial.
    :param fading: (d,) False for parameters whose effect is much the same along their scale; None: all may
        fade or have kinks.
    :param upper: (d,) upper ends of the box, or one for all; the lower ones are 0.
    """
    count = 0

    def residuals_at(points: Floats) -> Sequence[Floats | None]:
        nonlocal count
        count += len(points)
        return evaluate(points)

    at_default, = residuals_at(default[None, :])
    fading = np.ones(len(point), bool) if fading is None else fading
    fit = _linearised(point, residuals, layout, residuals_at, noise, fading, upper)
    fold_errors = left_out_errors(fit, layout, residuals_at)
    shift: Floats | None = None
    coarse: tuple[float, ...] = ()
    if finer is not None:
        count += 1
        fine, = finer()
        shift = np.ones(len(point)) if fine is None else optimum_shift(fit, fine)
        coarse = () if fine is None else tuple(
            float(np.nanmax(np.nanmean(np.linalg.norm(moved, axis=2), axis=1)))
            for moved in layout.chains(fine - residuals))
    drawn = [residuals for start in starts for residuals in start()]
    count += len(drawn)
    others, slowly = ([residuals for each in pending for residuals in each()] for pending in (hands, slow))
    count += len(others) + len(slowly)
    uncertainty = at_minimum(fit, layout, noise=noise, shift=shift,
                             starts=[residuals for residuals in drawn if residuals is not None],
                             hands=[residuals for residuals in others if residuals is not None],
                             slow=[residuals for residuals in slowly if residuals is not None])
    uncertainty = extended(fit, uncertainty, residuals_at, fading, shift)
    elsewhere = [(there, restart) for there, restart in zip(drawn, restarted, strict=False)
                 if there is not None and np.sqrt(np.mean((there - residuals)**2)) > uncertainty.residual]
    uncertainty, simulated = scattered(fit, uncertainty, elsewhere, len(drawn))
    count += simulated
    return Examination(
        uncertainty=uncertainty, jacobian=frozen_array(fit.jacobian), noise=noise,
        regular=_converged(fit, uncertainty),
        cross_validated=float(np.concatenate(fold_errors).mean()) if fold_errors else float('nan'),
        default_error=float('nan') if at_default is None else PointErrors.of(layout.points(at_default)).mean,
        evaluations=count, coarse=coarse)


def _linearised(point: Floats, residuals: Floats, layout: ResidualLayout, residuals_at: Evaluate,
                noise: float, fading: NDArray[np.bool_], upper: Ends) -> Linearisation:
    """Return the linear model of the residuals; uncertain parameters take wide steps, certain ones short."""
    dimension, middle = len(point), np.broadcast_to(upper, point.shape) / 2

    def measured(columns: Sequence[int], steps: Floats) -> Floats:
        sides = Differences.central(point, columns, steps, upper)
        # One side, the one towards the middle, shows an effect that is much the same along the scale.
        beside = [both if fading[k] else both[[int(point[k] < middle[k])]]
                  for k, both in zip(columns, sides.beside, strict=True)]
        sides = replace(sides, beside=beside)
        return sides.jacobian(np.zeros((len(residuals), dimension)), residuals_at(sides.points), residuals)

    steps = np.full(dimension, STEP)
    jacobian = measured(range(dimension), steps)
    for _ in range(2):
        std = at_minimum(Linearisation(point, residuals, jacobian, upper), layout, noise=noise).std
        wanted = np.where(std > SUSPECT, np.clip(std, 0.1, WIDEST), np.clip(NEARBY * std, SHORTEST, STEP))
        other = (fading & (wanted > 1.5 * steps)) | (1.5 * wanted < steps)
        columns = np.flatnonzero(other).tolist()
        if not columns:
            break
        steps[columns] = wanted[columns]
        again = measured(columns, steps)
        for k in columns:
            # A short step may see a kink, a long one a slope that is not here: the smaller effect counts.
            if np.linalg.norm(again[:, k]) < np.linalg.norm(jacobian[:, k]):
                jacobian[:, k] = again[:, k]
    return Linearisation(point, residuals, jacobian, upper)


def extended(fit: Linearisation, uncertainty: Uncertainty, residuals_at: Evaluate,
             fading: NDArray[np.bool_], shift: Floats | None = None) -> Uncertainty:
    """
    Extend intervals to where the simulated residuals change as much as the linear model says.

    The effect of a stiffness fades as it grows: one end of an interval may fit clearly worse, the other not.
    An end whose effect is below 90 % of the expected one moves to twice its distance, four times at most;
    after that, it is the end of the scale.  From where the effect is larger than expected, it moves back.
    The standard deviations grow with the intervals.  A parameter that is uncertain because a finer simulation
    moves it, (d,) `shift`, but not by noise, has an effect that is known.
    """
    point, ends = fit.point, np.stack([uncertainty.lower, uncertainty.upper])
    limits = np.stack([np.zeros(len(point)), np.broadcast_to(fit.upper, len(point))])
    excited = np.flatnonzero(uncertainty.excited)
    expected = DEVIATIONS * uncertainty.std
    moved_by = np.zeros(len(point)) if shift is None else 2 * shift  # as `at_minimum` counts it
    noisy = uncertainty.std**2 > SUSPECT**2 + moved_by**2
    unsure = [(side, int(k)) for k in excited for side in (0, 1)
              if noisy[k] and ends[side, k] != limits[side, k] and fading[k]]
    short: dict[tuple[int, int], tuple[float, float]] = {}  # where the effect is too small, and how large
    for _ in range(4):
        if not unsure:
            break
        there = np.tile(point, (len(unsure), 1))
        for row, (side, k) in zip(there, unsure, strict=True):
            row[k] = ends[side, k]
        moved = []
        for (side, k), residuals in zip(unsure, residuals_at(there), strict=True):
            if residuals is None:
                continue
            own = fit.columns(excited).own_weights(int(np.searchsorted(excited, k)))
            end, effect = float(ends[side, k]), abs(float(own @ (residuals - fit.residuals)))
            if effect >= 0.9 * expected[k]:
                if (side, k) in short:
                    near, small = short[side, k]
                    ends[side, k] -= (end - near) * max(0.0, (effect - expected[k]) / (effect - small))
            elif end != limits[side, k]:
                short[side, k] = end, effect
                ends[side, k] = np.clip(2 * end - point[k], *limits[:, k])
                moved.append((side, k))
        unsure = moved
    for side, k in unsure:
        ends[side, k] = limits[side, k]
    return uncertainty.within(ends[0], ends[1])


def scattered(fit: Linearisation, uncertainty: Uncertainty, elsewhere: Sequence[tuple[Floats, Evaluate]],
              drawn: int) -> tuple[Uncertainty, int]:
    """
    Widen intervals where other noise of an initial chain leads a trial elsewhere, as in chaos.

    There, no linear model shows how far the optimum moves.  So each certain parameter is changed by itself,
    to where it fits best.  By how much the mean square of these moves exceeds that in the linear model is
    added to the variance.

    :param elsewhere: of the draws that lead elsewhere, the residuals (m,) [m] at the minimum, and what
        simulates others.
    :param drawn: number of all draws; those that do not lead elsewhere count as linear.
    :return: also the number of parameter sets that were simulated.
    """
    certain = np.flatnonzero(uncertainty.excited & (uncertainty.std < SUSPECT))
    if not elsewhere or not len(certain):
        return uncertainty, 0
    loss, point = Huber.of(fit.residuals), fit.point
    points, most = np.tile(point, (len(certain), len(ELSEWHERE), 1)), np.broadcast_to(fit.upper, point.shape)
    for row, k in zip(points, certain.tolist(), strict=True):
        row[:, k] = np.clip(point[k] + np.array(ELSEWHERE) * uncertainty.std[k], 0.0, most[k])
    excess = np.zeros(len(point))
    for residuals, restart in elsewhere:
        simulated = restart(points.reshape(-1, len(point)))
        for n, k in enumerate(certain.tolist()):
            moves = points[n, :, k] - point[k]
            linear = [residuals + fit.jacobian[:, k] * move for move in moves]
            for there, sign in ((simulated[n * len(moves):(n + 1) * len(moves)], 1), (linear, -1)):
                costs = [loss.cost(residuals), *map(loss.cost, there)]
                excess[k] += sign * np.append(0.0, moves)[np.argmin(costs)]**2 / drawn
    std = np.sqrt(uncertainty.std**2 + np.maximum(excess, 0.0))
    further = DEVIATIONS * (std - uncertainty.std)
    wider = uncertainty.within(np.maximum(uncertainty.lower - further, 0.0),
                               np.minimum(uncertainty.upper + further, fit.upper))
    return wider, len(elsewhere) * points.shape[0] * points.shape[1]


def _converged(fit: Linearisation, uncertainty: Uncertainty) -> bool:
    """Tell whether the next Gauss-Newton step is small: 3 standard deviations (squared: 9) per parameter."""
    free = replace(fit, residuals=Huber.of(fit.residuals).clipped(fit.residuals)).columns(
        uncertainty.excited & ~uncertainty.at_bound)
    count = len(free.point)
    step = free.step(np.eye(count) * uncertainty.residual**2)
    return -float(free.gradient @ step) <= 9.0 * count * uncertainty.scale**2


@dataclass(frozen=True)
class Confirmation:
    """
    The outcome of the best parameters in a second engine.

    :param engine: the second engine's name.
    :param score: its average difference score over the trials [cm].
    :param scores: its difference score of each trial [cm].
    :param errors: its point errors against the observed chains.
    :param mean_distance: mean distance between the points of both engines, over all goals [m].
    :param max_distance: the largest of these distances [m].
    """

    engine: str
    score: float
    scores: tuple[float, ...]
    errors: PointErrors
    mean_distance: float
    max_distance: float


def disagreements(names: Sequence[str], chains: Sequence[Floats], others: Sequence[Floats],
                  scores: Sequence[float], other_scores: Sequence[float], tolerance: float = 1.0
                  ) -> list[str]:
    """
    Return a phrase for each trial on which two engines disagree.

    :param names: of the trials.
    :param chains: (g, n, 3) [m] simulated points of each trial, by the first engine.
    :param others: the same by the second engine.
    :param scores: difference score of each trial, by the first engine.
    :param other_scores: the same by the second engine.
    :param tolerance: how many times the usual differences are no disagreement.
    """
    words = []
    for name, points, other_points, score, other_score in zip(
            names, chains, others, scores, other_scores, strict=True):
        distance = float(np.linalg.norm(points - other_points, axis=2).mean())
        # A difference of scores below 5 % or 0.1 cm is too small to prefer one parameter set to another.
        if distance > tolerance * DISTANCE_TOLERANCE or (
                abs(other_score - score) > tolerance * max(0.1, 0.05 * score)):
            words.append(f'{name}: points {distance * 1e3:.2f} mm apart on average, '
                         f'score {other_score:.2f} instead of {score:.2f}')
    return words
