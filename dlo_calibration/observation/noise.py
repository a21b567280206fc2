# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Noise: the noise level of observed points, from the roughness of the chains, and its removal."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial

ORDERS = range(2, 9)  # of the differences; higher orders do not separate curve and noise any better
SMOOTHING = np.logspace(-8, 8, 161)  # candidate weights of the roughness
NO_NOISE = 1e-6  # m; removing a smaller noise moves no point visibly
KINK = 8.0  # times the median square; 99.9 % of the squares of white noise in space are below


def noise(trials: Sequence[Trial]) -> float:
    """
    Return the standard deviation of one coordinate of the observed points [m].

    nan where no chain has five points.  Noise that is correlated between neighbouring
    points, as of a tracker that fits a smooth curve, is not seen.
    """
    return noise_of([np.stack([trial.initial.points, *(goal.chain.points for goal in trial.goals)])
                     for trial in trials])


def noise_of(observed: Sequence[Floats]) -> float:
    """Return what `noise` does, from the chains of each trial: (g, n, 3) [m], same material points."""
    rows: dict[int, list[Floats]] = {}
    for chains in observed:
        steps = np.linalg.norm(np.diff(chains, axis=1), axis=2).mean(axis=0)
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
    found: dict[int, Floats] = {}
    if count < 5:
        return found
    for order in range(1, min(ORDERS.stop, count)):
        widths = places[order:] - places[:-order]
        weights = np.diff(weights, axis=0) / widths[:, None]
        if order in ORDERS:
            found[order] = weights / np.linalg.norm(weights, axis=1, keepdims=True)
    return found


def _squared_differences(weights: Floats, chains: Floats) -> Floats:
    """Return the squared lengths of all differences of (g, n, 3) chains."""
    differences = weights @ chains
    return np.asarray(np.einsum('gij,gij->gi', differences, differences).ravel())


def _noise_level(squares: dict[int, list[Floats]]) -> float:
    """Return the smallest root mean square of all orders, without kinks; nan where there is none."""
    estimates = []
    for rows in squares.values():
        values = np.concatenate(rows)
        values = values[values <= KINK * np.median(values)]
        if len(values):
            estimates.append(values.mean())
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
    kept = 1 / (1 + SMOOTHING[:, None] * np.maximum(stiffness, 0))
    risk = (1 - kept)**2 @ np.sum(parts**2, axis=1) + 2 * 3 * noise**2 * kept.sum(axis=1)
    return np.asarray(modes @ (kept[np.argmin(risk)][:, None] * parts))


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
