# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement: how many knots of the rest shape and parts of different stiffness the trials support.

A finer DLO contains the coarser one. So each search starts at the result of the previous search and reuses
its Jacobian; only the columns of new parameters are added.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
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
from dlo_calibration.model.parameters import (
    BY_NAME,
    CLAMP_BENDS,
    KNOTS,
    LOCKING,
    MOST_PARTS,
    own_name,
    OWN_SHAPE,
    owner,
    ParameterSpace,
    PART_NAMES,
    REST_SHAPE,
    STIFFNESS_KNOTS,
)
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

#: Returns a finer space, and its point for the same DLO, which may lie outside the box; a linear map.
Finer = Callable[[ParameterSpace, Floats], tuple[ParameterSpace, Floats]]


@dataclass(frozen=True)
class Rung:
    """
    A step of a ladder towards a finer DLO.

    :param name: of what is tried, in words.
    :param finer: how it refines a space.
    :param aside: whether it is no failure if this rung is not kept; then the next one begins at the rung
        before.
    """

    name: str
    finer: Finer
    aside: bool = False


def refine(setting: Setting, uniform: Fit, budget: int) -> Fit:
    """
    Choose rest shape, locking, and how the stiffness varies, by cross-validation.

    Cross-validation predicts each trial from the others (Stone, Cross-validatory choice, 1974), so that
    what only fits noise is rejected. Nothing is tried if noise alone explains the residuals, in goals and
    at the start, or if the linear model shows that new parameters would explain too little. Each search is
    least squares and starts at the optimum of the coarser space. All evaluations count in the budget, and
    `Fit.evaluations` contains those of rejected spaces, too. The search in the chosen space stops early:
    among many parameters that the trials hardly determine, the last percent of the cost is noise that the
    fit would learn (Prechelt, Automatic Early Stopping Using Cross Validation, 1998).

    :param uniform: the fit of the uniform DLO.
    :param budget: largest number of evaluations of all searches, including those of `uniform`.
    :returns: `uniform` if nothing was tried; if rest shapes were asked for, it says why.
    """
    space, trials = uniform.space, setting.trials
    why = 'one rest shape: noise alone explains the residuals' if OWN_SHAPE in setting.options.own else ''
    if uniform.stopped:
        return uniform
    if uniform.explained(noise(trials)):
        return replace(uniform, parts=why)
    try:  # the best point may have no model
        model = uniform.model or _linearised(setting, space, uniform.best.point, np.arange(space.dimension))
        level = math.hypot(noise(trials), _effect_of_starts(setting, uniform))
    except CancelledError:
        return uniform
    uniform = replace(uniform, model=model, validated=uniform.validated + STARTS)
    if uniform.explained(level):
        return replace(uniform, parts=why)
    ladder = _Ladder(setting, uniform, budget, level)
    words = [_choose_rest_shape(ladder, setting), _choose_stiffness(ladder)]
    return ladder.outcome('; '.join(filter(None, words)))


def _choose_rest_shape(ladder: _Ladder, setting: Setting) -> str:
    """Climb to a rest shape, bends at the clamps and locking; return the outcome in words."""
    uniform, options = ladder.best, setting.options
    if not _shows_rest_shape(setting.trials, uniform.space):
        return 'no rest shape: only trials that all begin between two clamps show one' \
            if OWN_SHAPE in options.own else ''
    twist, sessions = clamp_twist(setting.trials), len(options.trials_of_sessions)
    rungs = [Rung(str(knots), partial(_with_knots, knots, twist))
             for knots in KNOTS if knots > uniform.space.knots]
    bends = Rung('bends', _with_bends, aside=True)
    rungs = [*rungs[:1], bends, *rungs[1:], bends]
    why = ladder.climb(rungs)
    if may_lock(uniform.space) and not ladder.explained:
        why += ladder.instead(uniform, [partial(_with_locking, radius) for radius in BEGINNINGS], rungs,
                              'locking', 'locks')
    common, in_each = ladder.best, ''
    if OWN_SHAPE in options.own and sessions > 1:
        none = ladder.climb([Rung('another one in each session', partial(_with_own_shapes, sessions, twist))])
        why += none.replace(':', ';', 1)
        in_each = '' if ladder.best is common else ', another one in each session'
    space = ladder.best.space
    at_clamps = ', bent at its clamps' if CLAMP_BENDS[0] in space.free else ''
    return (f'rest shape with {space.knots} knots' if space.knots else 'straight') + in_each + at_clamps + why


def _choose_stiffness(ladder: _Ladder) -> str:
    """Climb to parts of different stiffness, or one that varies smoothly; return the outcome in words."""
    even, space = ladder.best, ladder.best.space
    counts = [space.parts * 2**k for k in range(1, 4) if space.parts * 2**k <= MOST_PARTS]
    why = ladder.climb([Rung(str(count), partial(_with_parts, count)) for count in counts])
    beginnings: list[Finer] = [_with_smooth_stiffness]
    if ladder.best is not even:
        beginnings.append(partial(_as_smooth_as_parts, ladder.best, even))
    # Where parts explain all but noise, only what has fewer parameters can be better.
    fewer = space.dimension + len(STIFFNESS_KNOTS) < ladder.best.space.dimension
    if 'flexibility' in space.free and (fewer or not ladder.explained):
        why += ladder.instead(even, beginnings, (), 'a smooth stiffness', 'varies smoothly')
    parts = ladder.best.space.parts
    return f'{parts} part{"s" * (parts > 1)}' + why


class _Ladder:
    """
    Tries ever finer spaces, and keeps the best predictor of left-out trials.

    :ivar best: the best fit so far; every fit that is tried has its linear model.
    :ivar over: whether it was stopped, or its budget is too small for more; then it tries nothing else.
    :param level: of noise [m], with what it does at the start; it climbs no further if that explains a fit.
    """

    def __init__(self, setting: Setting, best: Fit, budget: int, level: float) -> None:
        self.best, self.over = best, False
        self._best_errors: Floats | None = None  # (f,) [m] see `_left_out`; None: not known yet
        self._setting, self._budget, self._level = setting, budget, level
        self._layout = ResidualLayout.compared(setting.trials)
        self._tried = [best]
        self._simulated = best.validated  # parameter sets, beside those of the searches

    @property
    def explained(self) -> bool:
        """Whether noise alone explains the best fit."""
        return self.best.explained(self._level)

    @property
    def _spent(self) -> int:
        return sum(len(tried.evaluations) for tried in self._tried)

    def climb(self, rungs: Iterable[Rung]) -> str:
        """
        Try rungs, each from the previous one, until two of them predict no better than the best.

        A single one may mislead: two parts do not show that a DLO is stiff in the middle, four do.  The first
        rung that is kept must predict significantly better.  Until then, one that predicts better in the mean
        alone is not kept, but is no failure; after it, that is enough.

        :returns: why it ended, in words; empty if there is no finer rung.
        """
        why, latest, missed, shown = '', self.best, 0, False
        for rung in rungs:
            if self.explained:
                break
            space, _ = rung.finer(latest.space, latest.best.point)
            if space == latest.space:
                continue
            if self._budget - self._spent < 2 * space.dimension:
                self.over = True
                return f': the rest of the budget is too small to try {rung.name}'
            try:
                stage = self._fitted(latest, rung.finer)
                errors = None if stage is None else self._fold_errors(stage)
            except CancelledError:
                self.over = True
                return f': stopped before {rung.name} were fitted'
            except SimulationError:  # the fit of the coarser space remains valid
                return f': {rung.name} could not be simulated'
            gain = 0.0
            if stage is not None and errors is not None:
                if self._best_errors is None:
                    self._best_errors = self._fold_errors(self.best)
                gain = log_gains(errors, self._best_errors).mean()
                if shown and gain > 0 or predicts_better(errors, self._best_errors):
                    self.best, self._best_errors, why, shown = stage, errors, '', True
                    latest = stage
                    continue
            if rung.aside:
                continue
            latest = stage or latest
            why = f': {rung.name} would explain too little' if stage is None else \
                f': {rung.name} would not predict left-out trials better'
            missed += gain <= LEAST_GAIN
            if missed == 2:
                break
        return why

    def instead(self, coarse: Fit, finers: Sequence[Finer], rungs: Sequence[Rung], name: str,
                does: str) -> str:
        """
        Climb a second time, from another beginning; keep where it leads if that predicts better.

        A DLO that locks has another rest shape, and one whose stiffness varies smoothly has no parts, so that
        only the ends of both climbs can be compared.  With fewer parameters, better in the mean is enough.

        :param coarse: the fit from which the second climb begins; it ends there if the beginnings that
            `finers` give do not lower the cost.
        :param name: what is tried, in words; `does`: what a DLO does to which it applies.
        :returns: the outcome in words; empty if it was not tried.
        """
        if self.over:
            return ''
        space, _ = finers[0](coarse.space, coarse.best.point)
        if self._budget - self._spent < 2 * space.dimension:
            return f'; the rest of the budget is too small to try {name}'
        best, errors = self.best, self._best_errors
        try:
            begun = self._fitted(coarse, *finers)
            if begun is None or _cost(begun, coarse) > (1 - LEAST_SHARE) * _cost(coarse, coarse):
                return f'; {name} would explain too little'
            errors = self._fold_errors(best) if errors is None else errors
            self.best, self._best_errors = begun, None
            self.climb(rungs)
            if self._best_errors is None:
                self._best_errors = self._fold_errors(self.best)
        except (CancelledError, SimulationError) as error:
            self.best, self._best_errors = best, errors
            return f'; stopped before {name} was fitted' if isinstance(error, CancelledError) else \
                f'; {name} could not be simulated'
        fewer = self.best.space.dimension < best.space.dimension
        if fewer and log_gains(self._best_errors, errors).mean() > 0 or \
                predicts_better(self._best_errors, errors):
            return f'; it {does}'
        self.best, self._best_errors = best, errors
        return f'; {name} would not predict left-out trials better'

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
        start = np.clip(start, 0, space.upper)
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


def _with_bends(space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
    return space.freed(CLAMP_BENDS, point) if space.knots else (space, point)


def _with_own_shapes(sessions: int, twist: float, space: ParameterSpace, point: Floats
                     ) -> tuple[ParameterSpace, Floats]:
    """Begin with the same rest shape in all sessions."""
    if not space.knots:
        space, point = _with_knots(KNOTS[0], twist, space, point)
    values = space.values(point)
    own = {own_name(name, session): values[name] for session in range(2, sessions + 1)
           for name in REST_SHAPE if name in values}
    space = replace(space, free=(*space.free, *own))
    return space, space.point({**values, **own})


def _with_locking(radius: float, space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
    locking, start = space.freed((LOCKING,), point)
    start[-1] = BY_NAME[LOCKING].coordinate(radius)
    return locking, start


def _with_smooth_stiffness(space: ParameterSpace, point: Floats) -> tuple[ParameterSpace, Floats]:
    return space.freed(STIFFNESS_KNOTS, point)


def _as_smooth_as_parts(parts: Fit, even: Fit, space: ParameterSpace, point: Floats
                        ) -> tuple[ParameterSpace, Floats]:
    """Begin at the stiffness of the parts of a fit, drawn through their middles."""
    smooth, start = _with_smooth_stiffness(space, point)
    values = parts.space.physical(parts.space.values(parts.best.point), 1.0)
    logs = np.log([1.0, *(values[name] for name in PART_NAMES if name in values)])
    ends = logs[[0, -1]] + (logs[[0, -1]] - logs[[1, -2]]) / 2
    middles = (np.arange(len(logs)) + 0.5) / len(logs)
    places = np.linspace(0, 1, len(STIFFNESS_KNOTS) + 1)
    knots = np.exp(np.interp(places, [0, *middles, 1], [ends[0], *logs, ends[1]]))
    flexibility = space.free.index('flexibility')
    start[flexibility] += (BY_NAME['flexibility'].coordinate(values['flexibility'] * knots[0])
                           - even.best.point[flexibility])
    for name, ratio in zip(STIFFNESS_KNOTS, knots[1:] / knots[0], strict=True):
        start[smooth.free.index(name)] = BY_NAME[name].coordinate(ratio)
    return smooth, start


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
    for names in (CLAMP_BENDS, STIFFNESS_KNOTS):
        if names[0] in space.free:
            tried, point = tried.freed(names, point)
    values = tried.values(point)
    values = {name: values.get(name, values[owner(name)[0]]) for name in space.free}
    return replace(evaluation, point=frozen_array(space.point(values)), values=values)


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
