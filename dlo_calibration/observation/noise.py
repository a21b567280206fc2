# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Noise of observed points, from how rough the chains are."""

from __future__ import annotations

from typing import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial

ORDERS = range(2, 9)  # of the differences; more do not separate curve and noise any better
FEWEST_POINTS = 5  # of a chain that tells bending from noise
SMOOTHING = np.logspace(-8, 8, 161)  # weights of the roughness of a curve that are tried
NO_NOISE = 1e-6  # m; less moves nothing
KINK = 8.0  # times the median square: more than noise; 99.9 % of white noise in space is below


def noise(trials: Sequence[Trial]) -> float:
    """
    Return the standard deviation of one coordinate of the observed points [m].

    nan where no chain has five points.  Noise that is alike at neighbouring
    points (of a tracker that fits a smooth curve) is not seen.
    """
    rows: dict[int, list[Floats]] = {}
    for trial in trials:
        chains = np.stack([trial.initial.points, *(goal.chain.points for goal in trial.goals)])
        steps = np.linalg.norm(np.diff(chains, axis=1), axis=2).mean(axis=0)
        # The places take up the mean of the chains' noise along the DLO; the differences lack that share.
        seen = 3 - 1 / len(chains)
        for order, weights in _differences(np.concatenate([[0.0], np.cumsum(steps)])).items():
            rows.setdefault(order, []).append(_squares(weights, chains) / seen)
    return _smallest(rows)


def noise_of(residuals: ArrayLike, places: Floats | None = None) -> float:
    """
    Return the standard deviation of one coordinate of residual chains that is rough, not smooth.

    :param residuals: (g, n, 3) [m] of g chains, or (n, 3) of one.
    :param places: (n,) of the points along the DLO, any unit; None: evenly spaced.
    :returns: [m]; nan with fewer than five points.
    """
    chains = np.asarray(residuals, dtype=float)
    chains = chains.reshape(-1, *chains.shape[-2:])
    at = np.arange(chains.shape[1], dtype=float) if places is None else np.asarray(places, dtype=float)
    return _smallest({order: [_squares(weights, chains) / 3] for order, weights in _differences(at).items()})


def _differences(places: Floats) -> dict[int, Floats]:
    """
    Return for each order k the (n - k, n) weights of differences of unit length.

    Row i is the divided difference at places i to i + k: polynomials of a degree
    below k vanish, white noise keeps its size.  A smooth curve shrinks with each
    order as long as its waves are longer than a few spacings.
    """
    count = len(places)
    weights = np.eye(count)
    found: dict[int, Floats] = {}
    if count < FEWEST_POINTS:
        return found
    for order in range(1, min(ORDERS.stop, count)):
        widths = places[order:] - places[:-order]
        weights = np.diff(weights, axis=0) / widths[:, None]
        if order in ORDERS:
            found[order] = weights / np.linalg.norm(weights, axis=1, keepdims=True)
    return found


def _squares(weights: Floats, chains: Floats) -> Floats:
    """Return the squared lengths of all differences of (g, n, 3) chains."""
    differences = weights @ chains
    return np.asarray(np.einsum('gij,gij->gi', differences, differences).ravel())


def _smallest(squares: dict[int, list[Floats]]) -> float:
    """Return the smallest root mean square of all orders, without single kinks; nan where there is none."""
    estimates = []
    for rows in squares.values():
        values = np.concatenate(rows)
        values = values[values <= KINK * np.median(values)]
        if len(values):
            estimates.append(values.mean())
    return float(np.sqrt(min(estimates))) if estimates else float('nan')


def smooth(points: Floats, noise: float) -> Floats:
    """
    Return points with as much of their noise taken away as the curve allows, (n, 3) [m].

    Third differences are made small (Whittaker, On a New Method of Graduation, 1923), with the weight
    that makes the expected distance from the truth smallest (Mallows, Some Comments on Cp, 1973):
    what is missed of the points, and twice the noise that is kept.

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
    Return where points lie along their DLO, without what noise does to their spacing, (n,) [m] from 0.

    Distances of neighbours go towards their mean as far as noise explains how they scatter
    (James and Stein, Estimation with Quadratic Loss, 1961, no further than the mean itself):
    points that differ from even ones by noise become even, and others stay.

    :param points: (n, 3) [m].
    :param noise: standard deviation of a coordinate [m].
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    mean, count = steps.mean(), len(steps)
    scatter = np.sum((steps - mean)**2)
    explained = 2 * noise**2 * (count - 1 / count)  # a step has the noise of two points, and so has their sum
    share = max(0.0, 1 - explained / scatter) if scatter > 0 else 0.0
    return np.concatenate([[0.0], np.cumsum(mean + share * (steps - mean))])
