# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Parts: a DLO of as many parts, each with a bending stiffness of its own, as the trials support."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
import math
import time
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.calibration.calibrate import calibrate, examined
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.model.chain import frozen_array
from dlo_calibration.model.parameters import MOST_PARTS, ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, LeastSquares, Search
from dlo_calibration.simulation.protocol import Simulator

FIRST_SHARE = 0.4  # of the budget, that may go into the DLO that is even
FEWEST_LEFT = 3  # evaluations for each parameter, without which no more parts are tried
EVEN_HALVES = 2  # parts that need not be better: what is stiff in the middle alone needs four to show it
EXACT = 1e-6  # m; errors below it are none
WORTHWHILE = 0.02  # share by which more parts lower the error of trials that are left out


def calibrate_parts(trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator, search: Search, *,
                    budget: int,
                    on_evaluation: Callable[[Evaluation], None] | None = None,
                    should_stop: Callable[[], bool] = lambda: False,
                    executor: Executor | None = None,
                    seed: int | None = None) -> CalibrationResult:
    """
    Calibrate an even DLO, then cut every part in two as long as that predicts better.

    What it must predict is each trial from the others (the cross-validated error of
    `examination`; Stone, Cross-validatory choice, 1974), so that parts which only fit
    noise are not kept.  More parts begin where fewer ended, by least squares.  All
    evaluations count in the budget; `CalibrationResult.evaluations` has those of what
    was tried and not kept, too.

    The parameters are those of `calibration.calibrate`.
    """
    started = time.monotonic()
    taken: list[tuple[ParameterSpace, Evaluation]] = []
    divisible = len(trials) > 1 and 'flexibility' in space.free

    def fitted(space: ParameterSpace, search: Search, budget: int) -> CalibrationResult:
        def take(evaluation: Evaluation) -> None:
            evaluation = replace(evaluation, index=len(taken))
            taken.append((space, replace(evaluation, residuals=None)))
            if on_evaluation is not None:
                on_evaluation(evaluation)

        first = len(taken)
        found = calibrate(trials, space, simulator, search, budget=budget, on_evaluation=take, seed=seed,
                          should_stop=should_stop, executor=executor, thorough=not divisible)
        return replace(found, best=replace(found.best, index=first + found.best.index))

    if not divisible:
        return fitted(space, search, budget)
    even = fitted(space, search, max(1, math.ceil(FIRST_SHARE * budget)))
    best, count, why = _divided(even, lambda finer, search: fitted(finer, search, budget - len(taken)),
                                lambda: budget - len(taken))
    before = _examined(best)
    if before:
        best = examined(best, simulator, should_stop=should_stop, executor=executor)
        count += max(0, _examined(best) - before)
    parts = best.space.parts
    reason = f'{best.stop_reason}; {parts} part{"s" * (parts > 1)}' + f': {why}' * bool(why)
    evaluations = tuple(_restated(evaluation, tried, best.space) for tried, evaluation in taken)
    return replace(best, evaluations=evaluations, seconds=time.monotonic() - started, stop_reason=reason,
                   examination=best.examination and replace(best.examination, evaluations=count))


def _divided(even: CalibrationResult, fitted: Callable[[ParameterSpace, Search], CalibrationResult],
             left: Callable[[], int]) -> tuple[CalibrationResult, int, str]:
    """
    Cut every part in two as long as that predicts better.

    :param left: evaluations of the budget.
    :returns: the best result, how many parameter sets were examined in all, and why it has no more parts.
    """
    best = latest = even
    count, why = _examined(even), ''
    while _examined(latest) and 2 * latest.space.parts <= MOST_PARTS:
        finer, start = latest.space.halved(latest.best.point)
        if left() < FEWEST_LEFT * finer.dimension:
            return best, count, f'too few evaluations are left of the budget to try {finer.parts}'
        try:
            latest = fitted(finer, LeastSquares(finer.dimension, 0, Hints.at(start)))
        except SimulationError:  # those before stand
            return best, count, f'{finer.parts} could not be simulated'
        count += _examined(latest)
        if not _examined(latest):
            return best, count, f'stopped before {finer.parts} were fitted'
        if _better(latest, best):
            best, why = latest, ''
        else:
            why = f'{finer.parts} would not predict left-out trials better'
            if finer.parts > EVEN_HALVES * even.space.parts:
                break
    return best, count, why


def _restated(evaluation: Evaluation, tried: ParameterSpace, space: ParameterSpace) -> Evaluation:
    """Return an evaluation in another space: the same DLO where that has more parts, else what both name."""
    point = evaluation.point
    while tried.parts < space.parts:
        tried, point = tried.halved(point)
    values = tried.values(point)
    return replace(evaluation, point=frozen_array(space.point(values)),
                   values={name: values[name] for name in space.free})


def _examined(result: CalibrationResult) -> int:
    """Return how many parameter sets were examined; 0 where it was stopped before that."""
    return 0 if result.examination is None else result.examination.evaluations


def _better(other: CalibrationResult, best: CalibrationResult) -> bool:
    """
    Tell whether a result predicts left-out trials better, by more than they differ in that.

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
