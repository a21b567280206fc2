# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Parts: a DLO of as many parts, each with a bending stiffness of its own, as the trials support."""

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

FIRST_SHARE = 0.4  # of the budget, that may go into the DLO that is even
FEWEST_LEFT = 3  # evaluations for each parameter, without which no more parts are tried
EVEN_HALVES = 2  # parts that need not be better: what is stiff in the middle alone needs four to show it
EXACT = 1e-6  # m; errors below it are none
WORTHWHILE = 0.02  # share by which more parts lower the error of trials that are left out


def fit_parts(setting: Setting, even: Fit, budget: int) -> Fit:
    """
    Cut every part in two as long as that predicts the trials better, beginning with an even DLO.

    What must be predicted is each trial from the others (the cross-validation of the
    examination; Stone, Cross-validatory choice, 1974), so that parts which only fit
    noise are not kept. More parts begin where fewer ended, by least squares. All
    evaluations count in the budget; `Fit.evaluations` has those of what was tried and
    not kept, too.

    :param even: what a search found of the even DLO.
    :param budget: evaluations of all searches, `even` included.
    """
    best = latest = examined(setting, even, thorough=False)
    tried, why = [latest], ''
    while latest.examined and 2 * latest.space.parts <= MOST_PARTS:
        finer, start = latest.space.halved(latest.best.point)
        taken = sum(len(one.evaluations) for one in tried)
        if budget - taken < FEWEST_LEFT * finer.dimension:
            why = f'too few evaluations are left of the budget to try {finer.parts}'
            break
        try:
            search = LeastSquares(finer.dimension, 0, Hints.at(start))
            found = fit(setting, finer, search, budget - taken, first=taken)
            latest = examined(setting, found, thorough=False)
        except SimulationError:  # those before stand
            why = f'{finer.parts} could not be simulated'
            break
        tried.append(latest)
        if not latest.examined:
            why = f'stopped before {finer.parts} were fitted'
        elif _better(latest, best):
            best, why = latest, ''
        else:
            why = f'{finer.parts} would not predict left-out trials better'
            if finer.parts > EVEN_HALVES * even.space.parts:
                break
    parts = best.space.parts
    examination = best.examination and replace(
        best.examination, evaluations=sum(one.examined for one in tried))
    return replace(
        best, examination=examination, parts=f'{parts} part{"s" * (parts > 1)}' + f': {why}' * bool(why),
        evaluations=tuple(_restated(evaluation, one.space, best.space)
                          for one in tried for evaluation in one.evaluations))


def _restated(evaluation: Evaluation, tried: ParameterSpace, space: ParameterSpace) -> Evaluation:
    """Return an evaluation in another space: the same DLO where that has more parts, else what both name."""
    point = evaluation.point
    while tried.parts < space.parts:
        tried, point = tried.halved(point)
    values = tried.values(point)
    return replace(evaluation, point=frozen_array(space.point(values)),
                   values={name: values[name] for name in space.free})


def _better(other: Fit, best: Fit) -> bool:
    """
    Tell whether a fit predicts left-out trials better, by more than they differ in that.

    That is the rule of one standard error (Breiman et al., Classification and Regression
    Trees, 1984, 3.4.3), for the logarithm of the error: a trial that is hard to predict counts as one.
    """
    if other.examination is None or best.examination is None:
        return False
    before, after = best.examination.left_out, other.examination.left_out
    if len(before) < 2 or len(before) != len(after):
        return False
    gains = np.log(np.maximum(before, EXACT) / np.maximum(after, EXACT))
    return float(gains.mean()) > max(WORTHWHILE, float(gains.std(ddof=1)) / math.sqrt(len(gains)))
