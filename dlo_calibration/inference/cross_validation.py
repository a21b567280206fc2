# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Cross-validation: how well trials are predicted that are left out of the fit (Stone, 1974)."""

from __future__ import annotations

import math
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import Linearisation, WIDEST
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.inference.uncertainty import correlation_length, jackknife, prior_information
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import distances

MOST_FOLDS = 8
CHANCE = 0.015  # false positive rate of each test
LEAST_GAIN = 0.02  # mean reduction of the logarithm of the error

#: Takes (k, d) points of the box, returns their residuals (m,) [m], None for a failure.
Evaluate = Callable[[Floats], Sequence[Floats | None]]


def left_out_errors(model: Linearisation, layout: ResidualLayout, residuals_at: Evaluate) -> list[Floats]:
    """
    Return the point errors [m] of each fold, a trial or a few, predicted from the others; [] for one trial.

    Each fold is predicted after a Gauss-Newton step towards the optimum of the others.  The step has a prior:
    without it, combinations of parameters that the trials hardly determine would move far.  It is halved,
    twice at most, until the others fit better; if they never do, the errors are those of the fit.

    :param model: of the residuals at the optimum of all trials.
    """
    if len(layout.shapes) < 2:
        return []
    dimension, loss = len(model.point), Huber.of(model.residuals)
    scale = loss.deviation(model.residuals, dimension) * math.sqrt(
        correlation_length(loss.clipped(model.residuals), layout))
    weighted = model.weighted(loss.roots(model.residuals) / scale)
    folds = layout.folds(MOST_FOLDS)
    steps = np.clip(jackknife(weighted, folds, prior_information(dimension)), -WIDEST, WIDEST)
    errors = [distances(layout.points(model.residuals, rows)) for rows in folds]
    unsure = list(range(len(folds)))
    for shorter in (1.0, 0.5, 0.25):
        points = np.clip(model.point + shorter * steps[unsure], 0.0, model.upper)
        worse = []
        for k, residuals in zip(unsure, residuals_at(points), strict=True):
            others = np.delete(np.arange(len(model.residuals)), folds[k])
            if residuals is None or loss.cost(residuals[others]) > loss.cost(model.residuals[others]):
                worse.append(k)
            else:
                errors[k] = distances(layout.points(residuals, folds[k]))
        unsure = worse
        if not unsure:
            break
    return errors


def log_gains(after: Floats, before: Floats) -> Floats:
    """Return by how much the logarithm of the error of each fold fell; see `predicts_better`."""
    return np.asarray(np.log(np.maximum(before, 1e-6) / np.maximum(after, 1e-6)))


def predicts_better(after: Floats, before: Floats) -> bool:
    """
    Tell whether the errors of left-out trials became smaller, by at least 2 % and significantly.

    One of two one-sided tests has to show it: Student's, or Wilcoxon's of signed ranks (Individual
    Comparisons by Ranking Methods, 1945), which is better where gains differ much, and needs at least seven
    folds.  They compare logarithms, so that each fold counts equally.  Errors below 1 um count as 1 um.

    :param after: (f,) mean point error [m] of each fold; `before` (f,) likewise.
    """
    from scipy import stats  # takes as long to load as a short search

    gains = log_gains(after, before)
    if len(gains) < 2 or not gains.mean() > LEAST_GAIN:
        return False
    least = stats.t.ppf(1 - CHANCE, len(gains) - 1) * stats.sem(gains)
    return bool(gains.mean() > least
                or stats.wilcoxon(gains[gains != 0], alternative='greater').pvalue < CHANCE)
