# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Cross-validation: how well trials are predicted that are left out of the fit (Stone, 1974)."""

from __future__ import annotations

import math
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import Linearisation, WIDEST
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.uncertainty import correlation_length, jackknife, prior_information
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import distances

MOST_FOLDS = 8

#: Takes (k, d) points of the unit cube, returns their residuals (m,) [m], None for a failure.
Evaluate = Callable[[Floats], Sequence[Floats | None]]


def left_out_errors(model: Linearisation, layout: ResidualLayout, residuals_at: Evaluate) -> list[Floats]:
    """
    Return the point errors [m] of each fold, a trial or a few, predicted from the others; [] for one trial.

    Each is predicted near the optimum of the others, after a Gauss-Newton step with a prior: without it,
    combinations of parameters that the trials hardly determine would move far. The step is halved, twice
    at most, until the others really fit better; where they never do, the errors are those of the fit itself.

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
    errors = [distances(model.residuals[rows]) for rows in folds]
    unsure = list(range(len(folds)))
    for shorter in (1.0, 0.5, 0.25):
        points = np.clip(model.point + shorter * steps[unsure], 0.0, 1.0)
        worse = []
        for k, seen in zip(unsure, residuals_at(points), strict=True):
            others = np.delete(np.arange(len(model.residuals)), folds[k])
            if seen is None or loss.cost(seen[others]) > loss.cost(model.residuals[others]):
                worse.append(k)
            else:
                errors[k] = distances(seen[folds[k]])
        unsure = worse
        if not unsure:
            break
    return errors
