# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Forces: how much a measured force on a hand counts beside the measured points."""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.choice import budget
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.residuals import compared_goals, Huber, ResidualLayout
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.model.score import without_offsets
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, LeastSquares

USUAL_NOISE = 0.02  # N; of a force sensor in a wrist
USUAL_COUNT = 4  # numbers that this counts as: a few forces tell little of their own noise
DIFFERENT = float(np.log(1.25))  # of two weights; forces that count this much more or less move parameters
MOST_FITS, ROUNDS = 3, 10
MOST = 100.0  # times lighter or heavier


def of_forces(trials: Sequence[Trial], residuals: Floats) -> tuple[float, Floats]:
    """
    Return by which factor measured forces exceed simulated ones, and their noise level, (3,) in x, y, z [N].

    Both together maximise the likelihood. Without the factor, a mass that is far off would seem to be noise
    of the forces, which then could not correct it. The noise level has an inverse chi-square prior at
    `USUAL_NOISE` (Gelman et al., Bayesian Data Analysis, 3rd ed., 2.6).

    :param residuals: (m,) [m] at the compared goals.
    """
    layout, measured, off = ResidualLayout.compared(trials), [], []
    for trial, rows, goals in zip(trials, layout.force_rows, map(compared_goals, trials), strict=True):
        if not trial.forces:
            continue
        compared = np.isin([k for k, *_ in trial.forces], goals)
        measured.append(without_offsets(
            trial, np.stack([force.vector for *_, force in trial.forces]))[compared])
        off.append(residuals[rows].reshape(-1, 3) / trial.force_scale)
    seen, simulated = np.concatenate(measured), np.concatenate(measured) + np.concatenate(off)
    offsets = sum(len({hand.name for _, hand, force in trial.forces if not force.tared})
                  for trial in trials)
    count = USUAL_COUNT + max(len(seen) - offsets - 1 / 3, 0.0)
    factor, levels = 1.0, np.full(3, USUAL_NOISE)
    for _ in range(ROUNDS):
        power = USUAL_COUNT * USUAL_NOISE**2 + np.sum((factor * simulated - seen)**2, axis=0)
        levels = np.sqrt(power / count)
        weighted = simulated / levels**2
        square = float(np.sum(weighted * simulated))
        factor = float(np.clip(np.sum(weighted * seen) / square, 1 / MOST, MOST)) if square > 0 else 1.0
    return factor, levels


def heavier(space: ParameterSpace, point: Floats, factor: float) -> Floats:
    """Return the (d,) point of a DLO with larger mass and stiffnesses, by a factor; it moves alike."""
    values = space.values(point)
    for name, value in values.items():
        parameter = BY_NAME[name]
        if parameter.name == 'mass' or parameter.per_weight:
            values[name] = parameter.value(factor * parameter.physical(value))
    return np.clip(space.point(values), 0.0, space.upper)


def weighed(setting: Setting, best: Fit) -> tuple[Setting, Fit]:
    """
    Weigh points and forces by their noise levels in the best fit, and fit again where these differ.

    :returns: the setting with the trials weighed so, and the best fit to them.
    """
    for _ in range(MOST_FITS):
        trials, residuals, space = setting.trials, best.best.residuals, best.space
        if residuals is None or best.stopped or best.search != LeastSquares.name \
                or not any(trial.forces for trial in trials):
            break
        factor, levels = of_forces(trials, residuals)
        factor = factor if 'mass' in space.free else 1.0
        points = ResidualLayout.compared(trials).points(residuals)
        x, y, z = (Huber.of(points).deviation(points, space.dimension) / levels).tolist()
        changes = np.log([factor, *np.array([x, y, z]) / trials[0].force_scale])
        if np.abs(changes).max() < DIFFERENT:
            break
        setting = setting.weighing_forces((x, y, z))
        dimension, spent = space.dimension, len(best.evaluations)
        search = LeastSquares(dimension, setting.options.seed, Hints(
            heavier(space, best.best.point, factor), np.ones(dimension, bool), refines=True,
            upper=space.upper))
        again = fit(setting, space, search, budget(dimension), first=spent)
        best = replace(again, parts=best.parts, validated=best.validated,
                       evaluations=best.evaluations + again.evaluations)
    return setting, best
