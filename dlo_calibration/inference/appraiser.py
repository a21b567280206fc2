# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Appraiser: simulates each new trial, to tell how certain the parameters are before any calibration.

The derivatives of a trial's simulated chains are measured near the best values known so far, which follow the
trials by Gauss-Newton steps.  The uncertainty is computed from them as that of a result is: from the
residuals, the noise of the initial chains, a finer simulation, and the ends of wide intervals.  Only the
search for the best values is shorter, and of a stream, fewer goals are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence
import zlib

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.linearisation import Linearisation, STEP, WIDEST
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.advice import sensitivities
from dlo_calibration.inference.examination import extended
from dlo_calibration.inference.uncertainty import (
    at_minimum,
    NOT_IDENTIFIABLE,
    optimum_shift,
    prior_information,
    Uncertainty,
    UNKNOWN_STD,
)
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace, REST_SHAPE
from dlo_calibration.model.score import residuals, seen_points
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import NO_NOISE, with_other_noise

ROUNDS = 8  # Gauss-Newton steps to the best values, at most
WORTH_A_STEP = 0.02  # share of the cost that a step must promise to save
WORTH_A_MOVE = 0.1  # share of the cost that a value must save to which no derivative points
LOOKED_AT = (0.15, 0.4, 0.65, 0.9)  # values of a parameter of which nothing is known
STARTS = 4  # simulations of each trial from initial chains with other noise


@dataclass(frozen=True, eq=False)
class TrialModel:
    """
    What the simulations of one trial tell.

    :param fit: linear model of its residuals.
    :param moved: (s, m) change of the residuals [m] by other noise of the initial chain.
    :param finer: (m,) change of the residuals [m] by a finer simulation; None if there is none.
    :param complete: whether `moved` and `finer` were simulated.
    """

    fit: Linearisation
    moved: Floats
    finer: Floats | None = None
    complete: bool = False

    def near(self, point: Floats) -> bool:
        """Tell whether the model holds at a (d,) point, in the parameters that the trial shows."""
        shown = np.any(self.fit.jacobian != 0, axis=0)
        return bool((np.abs(point - self.fit.point)[shown] <= STEP).all())


@dataclass(frozen=True, eq=False)
class Knowledge:
    """
    What is known after some trials.

    :param names: of the d parameters.
    :param point: (d,) their best values.
    :param uncertainty: of them.
    :param models: of the first trials; the others are simulated when the next trial comes.
    """

    names: tuple[str, ...]
    point: Floats
    uncertainty: Uncertainty
    models: tuple[TrialModel, ...] = ()

    @classmethod
    def before(cls, names: tuple[str, ...], point: Floats) -> Knowledge:
        """Return what is known before any simulation, with a (d,) point to begin at."""
        known = np.ones(len(names))
        return cls(names, point, Uncertainty(
            UNKNOWN_STD * known, 0 * known, known, known == 0, known == 0,
            UNKNOWN_STD**2 * np.eye(len(names))))


def without_repeated_goals(trial: Trial) -> Trial:
    """
    Return a trial without the goals that add little.

    Of several goals of the same DLO at rest, the first stays; of those in motion, a few stay, evenly spread.
    The outcome does not change while a tracker continues to show a DLO at rest.
    """
    goals: list[Goal] = []
    moving = [goal for goal in trial.goals if not goal.stable]
    shown = {id(moving[k]) for k in shown_goals(len(moving))} if moving else set()
    rests = set()
    for goal in trial.goals:
        rest = (sum(hand.start <= goal.time for hand in trial.hands), goal.held_by)
        if id(goal) in shown or goal.stable and rest not in rests:
            goals.append(goal)
            if goal.stable:
                rests.add(rest)
    return replace(trial, goals=tuple(goals))


@dataclass(frozen=True, eq=False)
class _Minimum:
    """The (m,) residuals [m] of all trials at a (d,) point, the models of the trials, and the uncertainty."""

    residuals: Floats
    point: Floats
    models: tuple[TrialModel, ...]
    found: Uncertainty

    @property
    def loss(self) -> Huber:
        """The loss that suits the residuals."""
        return Huber.of(self.residuals)


@dataclass(frozen=True)
class Appraiser:
    """
    Simulates trials, to tell how certain the parameters are after them.

    :param length: of the DLO [m].
    :param table_height: [m]; None if there is no table.
    :param noise: noise level: standard deviation of one measured coordinate [m]; nan if unknown.
    :param guessed: names of the parameters that the observed chains alone do not tell.
    """

    space: ParameterSpace
    pool: Pool
    length: float
    table_height: float | None
    noise: float
    guessed: tuple[str, ...] = ()

    def after(self, known: Knowledge, trials: Sequence[Trial]) -> Knowledge:
        """
        Return what is known after all trials; `known` is what is known after all but the last.

        Trials are simulated again where the best values have moved away.

        :raises SimulationError: if a trial cannot be simulated.
        :raises CancelledError: when the pool stops.
        """
        trials = [without_repeated_goals(one) for one in trials]
        models = [*known.models, *[None] * (len(trials) - len(known.models))]
        best = self._descended(trials, models, known.point, known.uncertainty.std)
        elsewhere = self._looked_around(trials, best)
        if elsewhere is not None:
            best = min(best, self._descended(trials, [None] * len(trials), elsewhere, known.uncertainty.std),
                       key=lambda one: best.loss.cost(one.residuals))
        return self._examined(known.names, trials, best.point, tuple(
            one if one.complete else self._completed(one, trial)
            for one, trial in zip(best.models, trials, strict=True)))

    def _descended(self, trials: Sequence[Trial], models: Sequence[TrialModel | None], point: Floats,
                   std: Floats) -> _Minimum:
        """Return where Gauss-Newton steps from a (d,) point end; `models` are used where they hold."""
        best: _Minimum | None = None
        for _ in range(ROUNDS):
            try:
                now = tuple(one if one is not None and one.near(point) else self._model(trial, point, std)
                            for one, trial in zip(models, trials, strict=True))
            except SimulationError:
                if best is None:
                    raise
                point = (point + best.point) / 2
                continue
            models = now
            fit, layout = _whole(now, trials, point)
            loss = Huber.of(fit.residuals)
            if best is not None:
                same = min(loss, best.loss)
                if same.cost(fit.residuals) > same.cost(best.residuals):  # too far
                    point = (point + best.point) / 2
                    continue
            found = at_minimum(fit, layout, noise=self.noise)
            best = _Minimum(fit.residuals, point, now, found)
            step = fit.weighted(loss.roots(fit.residuals) / found.scale).step(prior_information(len(point)))
            there = np.clip(point + np.clip(step, -WIDEST, WIDEST), 0.0, 1.0)
            saved = loss.cost(fit.residuals) - loss.cost(fit.predicted(there - point))
            if saved < WORTH_A_STEP * loss.cost(fit.residuals):
                break
            point, std = there, found.std
        assert best is not None
        return best

    def _looked_around(self, trials: Sequence[Trial], best: _Minimum) -> Floats | None:
        """
        Return a (d,) point that fits clearly better than a minimum; None if there is none.

        A parameter that the trials show may be so far away that no derivative at its default points there, as
        of a DLO that is much more elastic than a rope.
        """
        shown = np.logical_or.reduce(excites(trials, self.space, self.table_height))
        found, cost = best.point, best.loss.cost(best.residuals)
        for k, name in enumerate(self.space.free):
            if name not in self.guessed or not shown[k] or best.found.verdicts[k] != NOT_IDENTIFIABLE:
                continue
            points = [np.where(np.arange(len(found)) == k, value, found) for value in LOOKED_AT]
            costs = [best.loss.cost(self._residuals(trials, one)) for one in points]
            if min(costs) < (1 - WORTH_A_MOVE) * cost:
                found, cost = points[int(np.argmin(costs))], min(costs)
        return None if found is best.point else found

    def _examined(self, names: tuple[str, ...], trials: Sequence[Trial], point: Floats,
                  models: tuple[TrialModel, ...]) -> Knowledge:
        fit, layout = _whole(models, trials, point)
        finer = [one.finer for one in models]
        changes = [np.zeros(len(one.fit.residuals)) if one.finer is None else one.finer for one in models]
        shift = None if all(one is None for one in finer) else optimum_shift(
            fit, fit.residuals + np.concatenate(changes))
        count = max(len(one.moved) for one in models)
        starts = [fit.residuals + np.concatenate([
            one.moved[k] if k < len(one.moved) else np.zeros(one.moved.shape[1]) for one in models])
            for k in range(count)]
        found = at_minimum(fit, layout, noise=self.noise, shift=shift, starts=starts)
        fading = np.array([name not in REST_SHAPE for name in self.space.free])
        return Knowledge(names, point, extended(
            fit, found, lambda points: [self._residuals(trials, one) for one in points], fading), models)

    def _residuals(self, trials: Sequence[Trial], point: Floats) -> Floats | None:
        """Return the residuals (m,) [m] of all trials at a (d,) point; None if one cannot be simulated."""
        try:
            return np.concatenate([self._simulated(one, point) for one in trials])
        except SimulationError:
            return None

    def _simulated(self, trial: Trial, point: Floats, pool: Pool | None = None) -> Floats:
        physical = self.space.physical(self.space.values(point), self.length)
        found, = (pool or self.pool).simulate([(trial, physical)])
        if isinstance(found, SimulationError):
            raise found
        return residuals(trial, found.chains)

    def _model(self, trial: Trial, point: Floats, std: Floats) -> TrialModel:
        """Simulate a trial around a (d,) point; a parameter that it certainly cannot show is not varied."""
        shown, seen = excites([trial], self.space, self.table_height)[0], self._simulated(trial, point)
        jacobian, = sensitivities([trial], self.space, self.pool, point, std, self.length,
                                  shown=shown[None], at_rest=False)
        if isinstance(jacobian, SimulationError):
            raise jacobian
        rows = np.repeat(seen_points(trial).ravel(), 3)
        return TrialModel(Linearisation(point, seen, jacobian[rows]), np.zeros((0, len(seen))))

    def _completed(self, model: TrialModel, trial: Trial) -> TrialModel:
        """Simulate other noise of the initial chain, and finer."""
        point, moved, finer, fine = model.fit.point, model.moved, None, self.pool.refined()
        generator = np.random.default_rng(zlib.crc32(trial.initial.points.tobytes()))  # the same each time
        try:
            if self.noise > NO_NOISE and 'length_scale' not in self.space.free:
                moved = np.array([self._simulated(one, point) - model.fit.residuals
                                  for one, in with_other_noise([trial], self.noise, STARTS, generator)])
            if fine is not None:
                finer = self._simulated(trial, point, fine) - model.fit.residuals
        except SimulationError:
            pass
        finally:
            if fine is not None:
                fine.simulator.close()
        return replace(model, moved=moved, finer=finer, complete=True)


def _whole(models: Sequence[TrialModel], trials: Sequence[Trial], point: Floats
           ) -> tuple[Linearisation, ResidualLayout]:
    """Return the linear model of all trials at a (d,) point, and the layout of its residuals."""
    fits = [one.fit for one in models]
    return Linearisation(point, np.concatenate([one.predicted(point - one.point) for one in fits]),
                         np.concatenate([one.jacobian for one in fits])), ResidualLayout.of(trials)
