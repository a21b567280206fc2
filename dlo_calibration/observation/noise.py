# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Noise: the level of noise of observed points, from roughness along chains and over time; its removal."""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.rest import STREAM

ORDERS = range(2, 9)  # of the differences; higher orders do not separate curve and noise any better
SMOOTHING = np.logspace(-8, 8, 161)  # candidate weights of the roughness
NO_NOISE = 1e-6  # m; removing a smaller noise moves no point visibly
KINK = 8.0  # times the median square; 99.9 % of the squares of white noise in space are below
SLOW, SLOW_SIGMAS = 0.25, -0.6745  # share of the instants that count as slow; the normal quantile of it


def noise(trials: Sequence[Trial]) -> float:
    """
    Return the standard deviation of one coordinate of the observed points [m].

    It comes from the roughness of the chains along the DLO, and for trials with a stream of goals also from
    the roughness of each point's path over time. The smaller one counts: bends make the first too large, fast
    motion the second. Means of many chains have hardly any noise left, and do not count. nan where no chain
    has five points and no trial has a stream. Noise that is correlated between neighbouring points, or from
    one instant to the next, as of a tracker that fits a smooth curve or filters, is not seen.
    """
    levels = []
    for streamed in (False, True):
        some = [trial for trial in trials if _is_stream(trial) == streamed]
        if some:
            along = noise_of([np.stack([chain.observed for chain in (
                trial.initial, *(goal.chain for goal in trial.goals if goal.count == 1))]) for trial in some])
            level = np.fmin(along, _noise_over_time(some)) if streamed else along
            levels += [float(level)] * len(some)
    finite = np.array(levels)[np.isfinite(levels)]
    if not len(finite) or (finite == finite[0]).all():
        return float(finite[0]) if len(finite) else float('nan')
    return float(np.sqrt(np.mean(finite**2)))


def _views(trial: Trial) -> tuple[Floats, Floats]:
    """
    Return when the goals of a trial were seen, (g,) [s] increasing, and their points, (g, n, 3) [m] or NaN.

    A chain that repeats the one before bit for bit is not a new view: trackers send the last one again.
    """
    times = np.array([goal.time for goal in trial.goals])
    points = np.stack([goal.chain.observed for goal in trial.goals])
    changed = (points[1:] != points[:-1]) & np.isfinite(points[1:]) & np.isfinite(points[:-1])
    new = np.append(True, (np.diff(times) > 0) & changed.any(axis=(1, 2)))
    return times[new], points[new]


def _is_stream(trial: Trial) -> bool:
    """Return whether a trial shows the DLO often enough for differences over time."""
    return len(trial.goals) >= STREAM and len(_views(trial)[0]) >= STREAM


def _noise_over_time(trials: Sequence[Trial]) -> float:
    """
    Return the noise level [m] of trials with streams, from divided differences of each point's path.

    Of each order, the lower quartile over the instants counts, when the DLO moves slowly, divided by that of
    white noise: the squares of one instant, over their mean, are chi-square over its degrees of freedom
    (quartile: Wilson and Hilferty, The Distribution of Chi-square, 1931). The smallest order counts.
    """
    rows: dict[int, list[Floats]] = {}
    for trial in trials:
        times, points = _views(trial)
        for order in ORDERS:
            windows = len(times) - order
            if windows < 1:
                break
            at = np.stack([times[k:k + windows] for k in range(order + 1)], axis=1)
            gaps = (at[:, :, None] - at[:, None, :]) / np.ptp(at, axis=1)[:, None, None]
            weights = 1 / np.prod(gaps + np.eye(order + 1), axis=2)
            weights /= np.linalg.norm(weights, axis=1, keepdims=True)
            differences = sum(weights[:, k, None, None] * points[k:k + windows] for k in range(order + 1))
            shown = np.isfinite(differences[:, :, 0]).sum(axis=1)  # points that were seen all the time
            differences, shown = differences[shown > 0], shown[shown > 0]
            spread = 2 / (9 * 3 * shown)
            lower = (1 - spread + SLOW_SIGMAS * np.sqrt(spread))**3
            rows.setdefault(order, []).append(np.nanmean(differences**2, axis=(1, 2)) / lower)
    slow = [np.quantile(squares, SLOW) for squares in map(np.concatenate, rows.values()) if len(squares)]
    return float(np.sqrt(min(slow, default=np.nan)))


def noise_of(observed: Sequence[Floats]) -> float:
    """
    Return the noise level along the DLO, from the chains of each trial: (g, n, 3) [m], same points.

    NaN is a point that was not seen; differences over it are left out.
    """
    rows: dict[int, list[Floats]] = {}
    for chains in observed:
        steps = np.linalg.norm(np.diff(chains, axis=1), axis=2)
        shown = np.isfinite(steps)
        usual = steps[shown].mean() if shown.any() else 1.0
        steps = np.where(shown.any(axis=0), np.where(shown, steps, 0.0).sum(axis=0)
                         / np.maximum(shown.sum(axis=0), 1), usual)
        # The mean noise along the DLO went into the arc lengths, so it is missing in the differences.
        seen = 3 - 1 / len(chains)
        for order, weights in _differences(np.concatenate([[0.0], np.cumsum(steps)])).items():
            rows.setdefault(order, []).append(_squared_differences(weights, chains) / seen)
    return _noise_level(rows)


def _differences(places: Floats) -> dict[int, Floats]:
    """
    Return for each order k the (n - k, n) weights of differences of unit length.

    Row i is the divided difference over places i to i + k.  It removes polynomials of
    a degree below k and keeps the size of white noise.  A smooth curve gets smaller
    with each order if its waves are longer than a few spacings.
    """
    count = len(places)
    weights = np.eye(count)
    by_order: dict[int, Floats] = {}
    if count < 5:
        return by_order
    for order in range(1, min(ORDERS.stop, count)):
        widths = places[order:] - places[:-order]
        weights = np.diff(weights, axis=0) / widths[:, None]
        if order in ORDERS:
            by_order[order] = weights / np.linalg.norm(weights, axis=1, keepdims=True)
    return by_order


def _squared_differences(weights: Floats, chains: Floats) -> Floats:
    """Return the squared lengths of all differences of (g, n, 3) chains, but those over NaN."""
    hidden = np.isnan(chains[:, :, 0])
    differences = weights @ np.nan_to_num(chains) if hidden.any() else weights @ chains
    squares = np.asarray(np.einsum('gij,gij->gi', differences, differences))
    return squares[hidden.astype(float) @ (weights != 0).T == 0] if hidden.any() else squares.ravel()


def _noise_level(squares: dict[int, list[Floats]]) -> float:
    """Return the smallest root mean square of all orders, without kinks; nan where there is none."""
    estimates = []
    for rows in squares.values():
        values = np.concatenate(rows)
        if len(values):
            estimates.append(values[values <= KINK * np.median(values)].mean())
    return float(np.sqrt(min(estimates))) if estimates else float('nan')


def smooth(points: Floats, noise: float) -> Floats:
    """
    Return the points of a chain with less noise, (n, 3) [m].

    Third differences are penalised (Whittaker, On a New Method of Graduation, 1923).  The weight of the
    penalty minimises the expected squared distance from the truth (Mallows, Some Comments on Cp, 1973):
    the squared change of the points plus twice the variance that is kept.

    :param points: (n, 3) [m].
    :param noise: standard deviation of a coordinate [m].
    """
    places = places_along(points, noise)
    weights = np.eye(len(points))
    spread = places / places[-1] * (len(points) - 1)
    for order in range(1, min(4, len(points))):
        weights = np.diff(weights, axis=0) / (spread[order:] - spread[:-order])[:, None]
    stiffness, modes = np.linalg.eigh(weights.T @ weights)
    parts = modes.T @ points
    gains = 1 / (1 + SMOOTHING[:, None] * np.maximum(stiffness, 0))
    risk = (1 - gains)**2 @ np.sum(parts**2, axis=1) + 2 * 3 * noise**2 * gains.sum(axis=1)
    return np.asarray(modes @ (gains[np.argmin(risk)][:, None] * parts))


def with_other_noise(trials: Sequence[Trial], noise: float, count: int,
                     generator: np.random.Generator) -> list[tuple[Trial, ...]]:
    """
    Return `count` copies of all trials, whose initial chains have other noise.

    New noise is added to the smoothed chains (a parametric bootstrap: Efron and Tibshirani, An
    Introduction to the Bootstrap, 1993, 6.5), the same to chains that are equal to the digit. Hands that grip
    the nearest place find it on these chains.

    :param noise: standard deviation of one coordinate [m].
    """
    smoothed = [smooth(trial.initial.points, noise) for trial in trials]

    def drawn() -> tuple[Trial, ...]:
        chains: dict[bytes, Chain] = {}
        for trial, points in zip(trials, smoothed, strict=True):
            points = points + generator.normal(0, noise, points.shape)
            chains.setdefault(trial.initial.points.tobytes(), replace(trial.initial, points=points))
        noisy = (replace(trial, initial=chains[trial.initial.points.tobytes()]) for trial in trials)
        return tuple(trial.with_shifted_hands(np.zeros(3)) for trial in noisy)

    return [drawn() for _ in range(count)]


def places_along(points: Floats, noise: float) -> Floats:
    """
    Return the arc lengths of noisy points, (n,) [m] from 0.

    The spacings shrink towards their mean as far as noise explains their scatter
    (James and Stein, Estimation with Quadratic Loss, 1961, positive part): spacings
    that differ by noise alone become even, and others stay.

    :param points: (n, 3) [m].
    :param noise: standard deviation of a coordinate [m].
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    mean, count = steps.mean(), len(steps)
    scatter = np.sum((steps - mean)**2)
    explained = 2 * noise**2 * (count - 1 / count)  # a step, like their sum, has the noise of two points
    share = max(0.0, 1 - explained / scatter) if scatter > 0 else 0.0
    return np.concatenate([[0.0], np.cumsum(mean + share * (steps - mean))])
