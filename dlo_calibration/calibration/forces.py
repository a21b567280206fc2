# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Forces: how much a measured force on a hand counts beside the measured points."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.choice import budget
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, LeastSquares

USUAL_NOISE = 0.02  # N; of a force sensor in a wrist
USUAL_COUNT = 4  # numbers that this counts as: a few forces tell little of their own noise
DIFFERENT = math.log(1.25)  # of two weights; forces that count this much more or less move parameters
MOST_FITS = 3


def force_noise(trials: Sequence[Trial], residuals: Floats) -> float:
    """
    Return the noise level of one component of the forces [N]; nan where none was measured.

    It has an inverse chi-square prior at `USUAL_NOISE` (Gelman et al., Bayesian Data Analysis, 3rd ed.,
    2.6).

    :param residuals: (m,) [m] at the compared goals.
    """
    layout = ResidualLayout.compared(trials)
    each = [residuals[rows] / trial.force_scale
            for trial, rows in zip(trials, layout.force_rows, strict=True)]
    off = np.concatenate(each)
    offsets = sum(len({hand.name for _, hand, force in trial.forces if not force.tared})
                  for trial in trials)
    count = len(off) - 3 * offsets
    if not len(off):
        return float('nan')
    return float(np.sqrt((USUAL_COUNT * USUAL_NOISE**2 + np.sum(off**2)) / (USUAL_COUNT + max(count, 0))))


def weighed(setting: Setting, best: Fit) -> tuple[Setting, Fit]:
    """
    Weigh points and forces by their noise levels in the best fit, and fit again where these differ.

    :returns: the setting with the trials weighed so, and the best fit to them.
    """
    for _ in range(MOST_FITS):
        trials, residuals = setting.trials, best.best.residuals
        noise = math.nan if residuals is None else force_noise(trials, residuals)
        if math.isnan(noise) or best.stopped or best.search != LeastSquares.name:
            break
        assert residuals is not None
        points = ResidualLayout.compared(trials).points(residuals)
        scale = Huber.of(points).deviation(points, best.space.dimension) / noise
        if abs(math.log(scale / trials[0].force_scale)) < DIFFERENT:
            break
        setting = setting.weighing_forces(scale)
        dimension, spent = best.space.dimension, len(best.evaluations)
        search = LeastSquares(dimension, setting.options.seed,
                              Hints(best.best.point, np.ones(dimension, bool), refines=True))
        again = fit(setting, best.space, search, budget(dimension), first=spent)
        best = replace(again, parts=best.parts, validated=best.validated,
                       evaluations=best.evaluations + again.evaluations)
    return setting, best
