# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement: how many knots of the rest shape and parts of different stiffness the trials support.

A finer DLO contains the coarser one. So each search starts at the result of the previous search and reuses
its Jacobian; only the columns of new parameters are added.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import replace
from functools import partial
import math
from operator import itemgetter
from typing import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.calibration.choice import may_lock
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.linearisation import Differences, Linearisation, WIDEST
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.inference.cross_validation import (
    LEAST_GAIN,
    left_out_errors,
    log_gains,
    predicts_better,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import BY_NAME, KNOTS, LOCKING, MOST_PARTS, ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.material import clamp_twist, clamps
from dlo_calibration.observation.noise import NO_NOISE, noise, with_other_noise
from dlo_calibration.search import Hints, LeastSquares
from dlo_calibration.search.descent import Descent

STEP = 0.015  # of the finite differences by new parameters, in units of a search
MOST_COARSE = 6  # evaluations per parameter for a coarse search
STARTS = 4  # of each trial, with other noise
LEAST_SHARE = 0.04  # of the cost: new parameters that explain less cannot lower the error by 2 %
BEGINNINGS = (0.03, 0.1, 0.3)  # m; bend radii from the best of which a search of locking begins

#: Returns a finer space, and its point for the same DLO.
Finer = Callable[[ParameterSpace, Floats], tuple[ParameterSpace, Floats]]


def refine(setting: Setting, uniform: Fit, budget: int) -> Fit:
    """
    Add knots to the rest shape, also with locking, then halve all parts, while cross-validation improves.

    Cross-validation predicts each trial from the others (Stone, Cross-validatory choice, 1974), so that
    what only fits noise is rejected. Nothing is tried if noise alone explains the residuals, in goals and
    at the start, or if the linear model shows that new parameters would explain too little. Each search is
    least squares and starts at the optimum of the coarser space. All evaluations count in the budget, and
    `Fit.evaluations` contains those of rejected spaces, too. The search in the chosen space stops early:
    among many parameters that the trials hardly determine, the last percent of the cost is noise that the
    fit would learn (Prechelt, Automatic Early Stopping Using Cross Validation, 1998).

    :param uniform: the fit of the uniform DLO.
    :param budget: largest number of evaluations of all searches, including those of `uniform`.
    :returns: `uniform` if nothing was tried.
    """
    space, trials = uniform.space, setting.trials
    if uniform.stopped or uniform.explained(noise(trials)):
        return uniform
    try:  # the best point may have no model
        model = uniform.model or _linearised(setting, space, uniform.best.point, np.arange(space.dimension))
        level = math.hypot(noise(trials), _effect_of_starts(setting, uniform))
    except CancelledError:
        return uniform
    uniform = replace(uniform, validated=uniform.validated + STARTS)
    if uniform.explained(level):
        return uniform
    ladder, words = _Ladder(setting, replace(uniform, model=model), budget, level), []
    if _shows_rest_shape(trials, space):
        twist = clamp_twist(trials)
        rungs = [(knots, partial(_with_knots, knots, twist)) for knots in KNOTS if knots > space.knots]
        why = ladder.climb(rungs)
        if may_lock(space):
            why += ladder.lock(rungs)
        knots = ladder.best.space.knots
        words.append((f'rest shape with {knots} knots' if knots else 'straight') + why)
    counts = [space.parts * 2**k for k in range(1, 4) if space.parts * 2**k <= MOST_PARTS]
    why = ladder.climb([(count, partial(_with_parts, count)) for count in counts])
    parts = ladder.best.space.parts
    words.append(f'{parts} part{"s" * (parts > 1)}' + why)
    return ladder.outcome('; '.join(words))


class _Ladder:
    """
    Tries ever finer spaces, and keeps the best predictor of left-out trials.

    :ivar best: the best fit so far; every fit that is tried has its linear model.
    :param level: of noise [m], with what it does at the start; it tries nothing if that explains a fit.
    """

    def __init__(self, setting: Setting, best: Fit, budget: int, level: float) -> None:
        self.best = best
        self._best_errors: Floats | None = None  # (f,) [m] see `_left_out`; None: not known yet
        self._setting, self._budget, self._level = setting, budget, level
        self._layout = ResidualLayout.compared(setting.trials)
        self._tried = [best]
        self._simulated = best.validated  # parameter sets, beside those of the searches

    @property
    def _spent(self) -> int:
        return sum(len(tried.evaluations) for tried in self._tried)

    def climb(self, rungs: Iterable[tuple[int, Finer]]) -> str:
        """
        Try rungs, each from the previous one, until two of them predict no better than the best.

        A single one may mislead: two parts do not show that a DLO is stiff in the middle, four do.  The first
        rung that is kept must predict significantly better.  Until then, one that predicts better in the mean
        alone is not kept, but is no failure; after it, that is enough.

        :param rungs: the number of knots or parts of each, and how to refine a space.
        :returns: why it ended, in words; empty if there is no finer rung.
        """
        why, latest, missed, shown = '', self.best, 0, False
        for count, finer in rungs:
            if self.best.explained(self._level):
                break
            space, _ = finer(latest.space, latest.best.point)
            if self._budget - self._spent < 2 * space.dimension:
                return f': the rest of the budget is too small to try {count}'
            try:
                stage = self._fitted(latest, finer)
                errors = None if stage is None else self._fold_errors(stage)
            except CancelledError:
                return f': stopped before {count} were fitted'
            except SimulationError:  # the fit of the coarser space remains valid
                return f': {count} could not be simulated'
            latest, promising = stage or latest, False
            if stage is not None and errors is not None:
                if self._best_errors is None:
                    self._best_errors = self._fold_errors(self.best)
                promising = log_gains(errors, self._best_errors).mean() > LEAST_GAIN
                if shown and promising or predicts_better(errors, self._best_errors):
                    self.best, self._best_errors, why, shown = stage, errors, '', True
                    continue
            why = f': {count} would explain too little' if stage is None else \
                f': {count} would not predict left-out trials better'
            missed += not promising
            if missed == 2:
                break
        return why

    def lock(self, rungs: Sequence[tuple[int, Finer]]) -> str:
        """
        Climb a second time, with locking; keep where that leads if it predicts better than the best so far.

        A DLO that locks has another rest shape, so that only the ends of both climbs can be compared. The
        second one begins at the uniform DLO, and ends there if locking does not lower the cost.

        :returns: the outcome in words; empty if it was not tried.
        """
        if self.best.explained(self._level):
            return ''
        uniform = self._tried[0]
        if self._budget - self._spent < 2 * (uniform.space.dimension + 1):
            return '; the rest of the budget is too small to try locking'
        best, errors = self.best, self._best_errors
        try:
            locked = self._fitted(uniform, *(partial(_with_locking, radius) for radius in BEGINNINGS))
            if locked is None or _cost(locked, uniform) > (1 - LEAST_SHARE) * _cost(uniform, uniform):
                return '; locking would explain too little'
            errors = self._fold_errors(best) if errors is None else errors
            self.best, self._best_errors = locked, None
            self.climb(rungs)
            if self._best_errors is None:
                self._best_errors = self._fold_errors(self.best)
        except (CancelledError, SimulationError) as error:
            self.best, self._best_errors = best, errors
            return '; stopped before locking was fitted' if isinstance(error, CancelledError) else \
                '; locking could not be simulated'
        if predicts_better(self._best_errors, errors):
            return '; it locks'
        self.best, self._best_errors = best, errors
        return '; locking would not predict left-out trials better'

    def outcome(self, words: str) -> Fit:
        """Return the best fit with all evaluations, in its space."""
        space = self.best.space
        return replace(self.best, parts=words, validated=self._simulated, evaluations=tuple(
            _restated(evaluation, tried.space, space)
            for tried in self._tried for evaluation in tried.evaluations))

    def _fitted(self, coarse: Fit, *finers: Finer) -> Fit | None:
        """
        Return the fit in a finer space than that of `coarse`; None if it would explain too little.

        :param finers: of several beginnings in this space, the search starts at the most promising one.
        :raises SimulationError: if it cannot be simulated.
        :raises CancelledError: when stopped.
        """
        assert coarse.model is not None
        begun = [self._begun(coarse, finer) for finer in finers]
        cost, space, here = min(((here.predicted(here.step(WIDEST)), space, here) for space, here in begun),
                                key=itemgetter(0))
        if cost > (1 - LEAST_SHARE) * here.loss.cost(coarse.model.residuals):
            return None
        search = LeastSquares(space.dimension, 0, Hints.at(here.point, here.jacobian, True, space.upper))
        spent = self._spent
        finest = fit(self._setting, space, search,
                     min(self._budget - spent, MOST_COARSE * space.dimension), first=spent)
        self._tried.append(finest)
        if finest.stopped:
            raise CancelledError
        return None if finest.model is None else finest

    def _begun(self, coarse: Fit, finer: Finer) -> tuple[ParameterSpace, Descent]:
        """Return a finer space than that of `coarse`, and the beginning of a descent in it."""
        assert coarse.model is not None
        point, units = coarse.best.point, np.eye(coarse.space.dimension)
        space, start = finer(coarse.space, point)
        # The coarse model is the fine one, restricted to the points of a linear map.
        nested = np.stack([(finer(coarse.space, point + STEP * unit)[1] - start) / STEP
                           for unit in units], axis=1)
        old = [int(np.flatnonzero((np.abs(nested - unit) < 1e-9).all(axis=1))[0]) for unit in units]
        new = np.setdiff1d(np.arange(space.dimension), old)
        self._simulated += 1 + len(new)
        model = _linearised(self._setting, space, start, new)  # of new parameters only
        jacobian = model.jacobian.copy()
        jacobian[:, old] = coarse.model.jacobian - jacobian[:, new] @ nested[new]
        return space, Descent(start, model.residuals, Huber.of(coarse.model.residuals), jacobian,
                              upper=space.upper)

    def _fold_errors(self, fit: Fit) -> Floats:
        """Return the (f,) mean point error [m] of each fold of the cross-validation."""
        evaluate = self._setting.evaluate(fit.space)
        assert fit.model is not None

        def residuals_at(points: Floats) -> Sequence[Floats | None]:
            self._simulated += len(points)
            return evaluate.residuals(points)

        return frozen_array([fold.mean() for fold in left_out_errors(fit.model, self._layout, residuals_at)])


def _linearised(setting: Setting, space: ParameterSpace, point: Floats, columns: NDArray[np.intp]
                ) -> Linearisation:
    """
    Return the linear model at a (d,) point; derivatives by parameters that are not in `columns` are 0.

    :raises SimulationError: if the point cannot be simulated.
    :raises CancelledError: when stopped.
    """
    sides = Differences.one_sided(point, columns, np.where(point > space.upper / 2, -STEP, STEP))
    here, *beside = setting.evaluate(space).residuals(np.vstack([point, sides.points]))
    if here is None:
        raise SimulationError('the start of the search diverged')
    jacobian = sides.jacobian(np.zeros((len(here), len(point))), beside, here)
    return Linearisation(point, here, jacobian, space.upper)


def _with_knots(count: int, twist: float, space: ParameterSpace, point: Floats
                ) -> tuple[ParameterSpace, Floats]:
    shaped, start = space.with_knots(count, point)
    if not space.knots and not math.isnan(twist) and 'clamp_twist' in shaped.free:
        start[shaped.free.index('clamp_twist')] = BY_NAME['clamp_twist'].coordinate(twist)
    return shaped, start


def _with_locking(radius: float, space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
    fixed = {name: value for name, value in space.fixed.items() if name != LOCKING}
    return replace(space, free=(*space.free, LOCKING), fixed=fixed), \
        np.append(point, BY_NAME[LOCKING].coordinate(radius))


def _with_parts(count: int, space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
    while space.parts < count:
        space, point = space.halved(point)
    return space, np.asarray(point)


def _shows_rest_shape(trials: Sequence[Trial], space: ParameterSpace) -> bool:
    """Tell whether the trials can show a rest shape: in each, two clamps hold the DLO from the start."""
    torsion = 'torsion' in space.free or space.fixed.get('torsion', 0.0) > 0
    return torsion and 'natural_curvature' not in space.free and all(
        len(clamps(trial)) > 1 for trial in trials)


def _restated(evaluation: Evaluation, tried: ParameterSpace, space: ParameterSpace) -> Evaluation:
    """Return an evaluation in another space: the same DLO, except for parameters that the space lacks."""
    tried, point = _with_parts(space.parts, tried, evaluation.point)
    if LOCKING in space.free and LOCKING not in tried.free:
        tried, point = _with_locking(0.0, tried, point)
    if tried.knots != space.knots and space.knots:
        tried, point = tried.with_knots(space.knots, point)
    values = tried.values(point)
    return replace(evaluation, point=frozen_array(space.point(values)),
                   values={name: values[name] for name in space.free})


def _cost(fit: Fit, other: Fit) -> float:
    """Return the cost [m^2] of the residuals of a fit, by the loss of another one."""
    assert fit.model is not None and other.model is not None
    return Huber.of(other.model.residuals).cost(fit.model.residuals)


def _effect_of_starts(setting: Setting, fit: Fit) -> float:
    """
    Return what the noise of the initial chains does to the residuals of a fit: a standard deviation [m].

    A DLO that swings multiplies the noise of its start, by which no parameter is told.

    :raises CancelledError: when stopped.
    """
    trials, level = setting.trials, noise(setting.trials)
    if not level > NO_NOISE or 'length_scale' in fit.space.free:
        return 0.0
    drawn = with_other_noise(trials, level, STARTS, np.random.default_rng(0))
    seen = [residuals for others in drawn
            for residuals in setting.evaluate(fit.space, others).residuals(fit.best.point[None])]
    if any(residuals is None for residuals in seen):
        return 0.0
    chains = np.stack([residuals for residuals in seen if residuals is not None])
    away = (chains - chains.mean(axis=0)).ravel() * math.sqrt(STARTS / (STARTS - 1))
    return Huber.of(away).deviation(away, 0)
