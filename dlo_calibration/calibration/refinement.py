# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement: how many knots of the rest shape and parts of different stiffness the trials support.

A finer DLO contains the coarser one, so that each search begins at the result of the one before, and
with its Jacobian, to which only the columns of new parameters are added.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
import math
from typing import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.linearisation import Linearisation, slope, WIDEST
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.cross_validation import left_out_errors
from dlo_calibration.inference.uncertainty import noise_alone
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import BY_NAME, KNOTS, MOST_PARTS, ParameterSpace, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.clamps import clamp_twist, clamps
from dlo_calibration.observation.noise import noise
from dlo_calibration.search import Hints, LeastSquares
from dlo_calibration.search.descent import Descent

STEP = 0.015  # of the finite differences by new parameters, in the unit cube
CHANCE = 0.015  # of a test, that more is taken for better though it is not
LEAST_GAIN = 0.02  # of the logarithm of the error
MOST_COARSE = 6  # evaluations per parameter for a coarse search
LEAST_SHARE = 0.04  # of the cost: new parameters that explain less cannot lower the error by 2 %

#: Returns a finer space, and its point for the same DLO.
Finer = Callable[[ParameterSpace, Floats], tuple[ParameterSpace, Floats]]


@dataclass(frozen=True)
class _Stage:
    """
    A fit with the linear model of its residuals at its best point.

    :param left_out: (f,) mean point error [m] of each fold of the cross-validation; empty: not known yet.
    """

    fit: Fit
    model: Linearisation
    left_out: Floats = field(default_factory=lambda: frozen_array([]))


def refine(setting: Setting, uniform: Fit, budget: int) -> Fit:
    """
    Add knots to the rest shape, then halve all parts, while that improves the cross-validation error.

    Cross-validation predicts each trial from the others (Stone, Cross-validatory choice, 1974), so that
    what only fits noise is rejected. Where noise alone explains the residuals, or the linear model shows that
    new parameters would explain too little, nothing is tried. The search for more is least squares, from the
    optimum of less. All evaluations count in the budget, and `Fit.evaluations` contains those of rejected
    spaces, too. The search in the chosen space is not carried further: among many parameters that the
    trials hardly determine, the last percent of the cost is noise that the fit would learn (early stopping:
    Prechelt, Automatic Early Stopping Using Cross Validation, 1998).

    :param uniform: the fit of the uniform DLO.
    :param budget: largest number of evaluations of all searches, including those of `uniform`.
    :returns: `uniform` itself where nothing was tried.
    """
    space, trials = uniform.space, setting.trials
    if uniform.stopped or _explained(trials, uniform):
        return uniform
    try:  # the search may have ended away from all its models
        model = uniform.model or _linearised(setting, space, uniform.best.point, np.arange(space.dimension))
    except CancelledError:
        return uniform
    ladder, words = _Ladder(setting, _Stage(uniform, model), budget), []
    if _shows_rest_shape(trials, space):
        twist = clamp_twist(trials)
        why = ladder.climb([(knots, _knots(knots, twist)) for knots in KNOTS if knots > space.knots])
        knots = ladder.best.fit.space.knots
        words.append((f'rest shape with {knots} knots' if knots else 'straight') + why)
    counts = [space.parts * 2**k for k in range(1, 4) if space.parts * 2**k <= MOST_PARTS]
    why = ladder.climb([(count, _parts(count)) for count in counts])
    parts = ladder.best.fit.space.parts
    words.append(f'{parts} part{"s" * (parts > 1)}' + why)
    return ladder.outcome('; '.join(words))


class _Ladder:
    """
    Tries ever finer spaces, and keeps the one that predicts left-out trials best.

    :param best: so far.
    """

    def __init__(self, setting: Setting, best: _Stage, budget: int) -> None:
        self.best = best
        self._setting, self._budget = setting, budget
        self._layout = ResidualLayout.compared(setting.trials)
        self._tried = [best.fit]
        self._simulated = 0  # beside the searches

    @property
    def _taken(self) -> int:
        return sum(len(one.evaluations) for one in self._tried)

    def climb(self, rungs: Iterable[tuple[int, Finer]]) -> str:
        """
        Try rungs, each from the one before, until a second one is not better than the best.

        One need not be: a DLO that is stiff in the middle shows it in four parts, but not in two.

        :param rungs: the number of knots or parts of each, and how to refine a space.
        :returns: why it ended, in words; empty if there is no finer rung.
        """
        why, latest, missed = '', self.best, False
        for count, finer in rungs:
            if _explained(self._setting.trials, self.best.fit):
                break
            space, start = finer(latest.fit.space, latest.fit.best.point)
            if self._budget - self._taken < 2 * space.dimension:
                return f': the rest of the budget is too small to try {count}'
            try:
                stage = self._fitted(space, start, finer, latest)
            except CancelledError:
                return f': stopped before {count} were fitted'
            except SimulationError:  # the fit of the coarser space remains valid
                return f': {count} could not be simulated'
            latest = stage or latest
            if stage is not None and better(stage.left_out, self._best_left_out()):
                self.best, why = stage, ''
                continue
            why = f': {count} would explain too little' if stage is None else \
                f': {count} would not predict left-out trials better'
            if missed:
                break
            missed = True
        return why

    def outcome(self, words: str) -> Fit:
        """Return the best fit with all evaluations, in its space."""
        space = self.best.fit.space
        return replace(self.best.fit, parts=words, validated=self._simulated, evaluations=tuple(
            _restated(evaluation, one.space, space) for one in self._tried for evaluation in one.evaluations))

    def _best_left_out(self) -> Floats:
        if not len(self.best.left_out):
            self.best = replace(self.best, left_out=self._left_out(self.best.fit.space, self.best.model))
        return self.best.left_out

    def _searched(self, space: ParameterSpace, hints: Hints) -> Fit:
        taken = self._taken
        search = LeastSquares(space.dimension, 0, hints)
        budget = min(self._budget - taken, MOST_COARSE * space.dimension)
        found = fit(self._setting, space, search, budget, first=taken)
        self._tried.append(found)
        if found.stopped:
            raise CancelledError
        return found

    def _fitted(self, space: ParameterSpace, start: Floats, finer: Finer, coarse: _Stage) -> _Stage | None:
        """
        Return the stage of a finer space than `coarse`; None if it would explain too little.

        :raises SimulationError: if it cannot be simulated.
        :raises CancelledError: when stopped.
        """
        model, before = self._extended(space, start, finer, coarse), coarse.model.residuals
        here = Descent(start, model.residuals, Huber.of(before), model.jacobian)
        if here.predicted(here.step(WIDEST)) > (1 - LEAST_SHARE) * here.loss.cost(before):
            return None
        found = self._searched(space, Hints.at(start, model.jacobian, coarse=True))
        if found.model is None:
            return None
        return _Stage(found, found.model, self._left_out(space, found.model))

    def _extended(self, space: ParameterSpace, start: Floats, finer: Finer, coarse: _Stage
                  ) -> Linearisation:
        """Return the linear model in a finer space: only columns of new parameters are measured."""
        point, units = coarse.fit.best.point, np.eye(coarse.fit.space.dimension)
        # The coarse model is the fine one, restricted to the points of a linear map.
        nested = np.stack([(finer(coarse.fit.space, point + STEP * unit)[1] - start) / STEP
                           for unit in units], axis=1)
        kept = [int(np.flatnonzero((np.abs(nested - unit) < 1e-9).all(axis=1))[0]) for unit in units]
        new = np.setdiff1d(np.arange(space.dimension), kept)
        self._simulated += 1 + len(new)
        model = _linearised(self._setting, space, start, new)
        jacobian = model.jacobian.copy()
        jacobian[:, kept] = coarse.model.jacobian - jacobian[:, new] @ nested[new]
        return replace(model, jacobian=jacobian)

    def _left_out(self, space: ParameterSpace, model: Linearisation) -> Floats:
        """Return the mean point error [m] of each fold of the cross-validation."""
        evaluate = self._setting.evaluate(space)

        def residuals_at(points: Floats) -> Sequence[Floats | None]:
            self._simulated += len(points)
            return evaluate.residuals(points)

        return frozen_array([fold.mean() for fold in left_out_errors(model, self._layout, residuals_at)])


def _linearised(setting: Setting, space: ParameterSpace, point: Floats, columns: NDArray[np.intp]
                ) -> Linearisation:
    """
    Return the linear model at a (d,) point; derivatives by parameters that are not in `columns` are 0.

    :raises SimulationError: if the point cannot be simulated.
    :raises CancelledError: when stopped.
    """
    points = np.tile(point, (1 + len(columns), 1))
    points[1 + np.arange(len(columns)), columns] += np.where(point[columns] > 0.5, -STEP, STEP)
    here, *seen = setting.evaluate(space).residuals(points)
    if here is None:
        raise SimulationError('the start of the search diverged')
    jacobian = np.zeros((len(here), len(point)))
    for k, there, one in zip(columns, points[1:], seen, strict=True):
        column = slope((point[k], there[k]), (here, one))
        jacobian[:, k] = 0.0 if column is None else column
    return Linearisation(np.asarray(point), here, jacobian)


def _knots(count: int, twist: float) -> Finer:
    def finer(space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
        shaped, start = space.with_knots(count, point)
        if not space.knots and not math.isnan(twist) and 'clamp_twist' in shaped.free:
            start[shaped.free.index('clamp_twist')] = BY_NAME['clamp_twist'].value(twist) / SCALE
        return shaped, start

    return finer


def _parts(count: int) -> Finer:
    def finer(space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
        while space.parts < count:
            space, point = space.halved(point)
        return space, np.asarray(point)

    return finer


def _shows_rest_shape(trials: Sequence[Trial], space: ParameterSpace) -> bool:
    """Tell whether a rest shape would show: in all trials, two clamps hold the DLO and its frame at first."""
    torsion = 'torsion' in space.free or space.fixed.get('torsion', 0.0) > 0
    return torsion and 'natural_curvature' not in space.free and all(
        len(clamps(trial)) > 1 for trial in trials)


def _restated(evaluation: Evaluation, tried: ParameterSpace, space: ParameterSpace) -> Evaluation:
    """Return an evaluation in another space: the same DLO if that is finer, else without the rest."""
    point = evaluation.point
    while tried.parts < space.parts:
        tried, point = tried.halved(point)
    if tried.knots != space.knots and space.knots:
        tried, point = tried.with_knots(space.knots, point)
    values = tried.values(point)
    return replace(evaluation, point=frozen_array(space.point(values)),
                   values={name: values[name] for name in space.free})


def _explained(trials: Sequence[Trial], found: Fit) -> bool:
    """Tell whether noise alone explains the residuals of a fit."""
    residuals = found.best.residuals
    return residuals is not None and noise_alone(
        Huber.of(residuals).deviation(residuals, found.space.dimension), noise(trials))


def better(after: Floats, before: Floats) -> bool:
    """
    Tell whether left-out trials are predicted better, by at least 2 % and significantly.

    Significant is what one of two one-sided tests says, of the logarithm of the error, so that each fold
    counts equally: Student's, or, where gains differ much, Wilcoxon's of signed ranks (Individual Comparisons
    by Ranking Methods, 1945), which needs seven folds or more. Errors below 1 um count as that.

    :param after: (f,) mean point error [m] of each fold; `before` (f,) likewise.
    """
    from scipy.special import stdtrit

    gains = np.log(np.maximum(before, 1e-6) / np.maximum(after, 1e-6))
    count = len(gains)
    if count < 2 or not gains.mean() > LEAST_GAIN:
        return False
    ranks = 1 + np.argsort(np.argsort(np.abs(gains)))
    signs = np.arange(2**count)[:, None] >> np.arange(count) & 1  # all combinations, equally likely by chance
    chance = float(np.mean(signs @ ranks <= ranks[gains <= 0].sum()))
    error = float(gains.std(ddof=1)) / math.sqrt(count)
    return chance < CHANCE or float(gains.mean()) > float(stdtrit(count - 1, 1 - CHANCE)) * error
