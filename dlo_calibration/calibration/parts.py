# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Parts: how many parts with different bending stiffness the trials support."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.surroundings import examined
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.model.chain import frozen_array
from dlo_calibration.model.parameters import MOST_PARTS, ParameterSpace
from dlo_calibration.search import Hints, LeastSquares


def fit_parts(setting: Setting, uniform: Fit, budget: int) -> Fit:
    """
    Halve all parts repeatedly while that improves the cross-validation error, beginning with a uniform DLO.

    Cross-validation predicts each trial from the others (Stone, Cross-validatory choice, 1974), so that
    parts which only fit noise are rejected. The search for more parts is least squares, from the optimum of
    fewer parts. All evaluations count in the budget, and `Fit.evaluations` contains those of rejected
    numbers of parts, too.

    :param uniform: the fit of the uniform DLO.
    :param budget: largest number of evaluations of all searches, including those of `uniform`.
    """
    best = latest = examined(setting, uniform, thorough=False)
    tried, why = [latest], ''
    while latest.examined and 2 * latest.space.parts <= MOST_PARTS:
        finer, start = latest.space.halved(latest.best.point)
        taken = sum(len(one.evaluations) for one in tried)
        if budget - taken < 3 * finer.dimension:  # one linearisation takes d + 1
            why = f'the rest of the budget is too small to try {finer.parts}'
            break
        try:
            search = LeastSquares(finer.dimension, 0, Hints.at(start))
            found = fit(setting, finer, search, budget - taken, first=taken)
            latest = examined(setting, found, thorough=False)
        except SimulationError:  # the fit of fewer parts remains valid
            why = f'{finer.parts} could not be simulated'
            break
        tried.append(latest)
        if not latest.examined:
            why = f'stopped before {finer.parts} were fitted'
        elif _better(latest, best):
            best, why = latest, ''
        else:
            why = f'{finer.parts} would not predict left-out trials better'
            # Two parts need not be better: a DLO that is stiff in the middle shows it only with four.
            if finer.parts > 2 * uniform.space.parts:
                break
    parts = best.space.parts
    examination = best.examination and replace(
        best.examination, evaluations=sum(one.examined for one in tried))
    return replace(
        best, examination=examination, parts=f'{parts} part{"s" * (parts > 1)}' + f': {why}' * bool(why),
        evaluations=tuple(_restated(evaluation, one.space, best.space)
                          for one in tried for evaluation in one.evaluations))


def _restated(evaluation: Evaluation, tried: ParameterSpace, space: ParameterSpace) -> Evaluation:
    """Return an evaluation in a space of other parts: the same DLO if it has more, else without the rest."""
    point = evaluation.point
    while tried.parts < space.parts:
        tried, point = tried.halved(point)
    values = tried.values(point)
    return replace(evaluation, point=frozen_array(space.point(values)),
                   values={name: values[name] for name in space.free})


def _better(other: Fit, best: Fit) -> bool:
    """
    Tell whether a fit predicts left-out trials better, by more than one standard error and 2 %.

    The rule of one standard error (Breiman et al., Classification and Regression Trees, 1984, 3.4.3) is
    applied to the logarithm of the error, so that each fold counts equally; errors below 1 um count as that.
    """
    if other.examination is None or best.examination is None:
        return False
    before, after = best.examination.left_out, other.examination.left_out
    if len(before) < 2 or len(before) != len(after):
        return False
    gains = np.log(np.maximum(before, 1e-6) / np.maximum(after, 1e-6))
    return float(gains.mean()) > max(0.02, float(gains.std(ddof=1)) / math.sqrt(len(gains)))
