# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Trial information: how much more certain one trial makes the parameters.

Before a calibration, an appraiser simulates each new trial.  It measures the derivatives of the chains near
the best values known so far, which follow the trials by Gauss-Newton steps.  It computes the uncertainty as a
calibration does: from the residuals, the noise of the initial chains, a finer simulation, and the ends of
wide intervals.  Only the search for the best values is shorter, and fewer goals of a stream are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Iterator, Sequence
import zlib

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import with_hands
from dlo_calibration.evaluation.linearisation import (
    Differences,
    information,
    Linearisation,
    standard_deviations,
    WIDEST,
)
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout
from dlo_calibration.inference.draws import drawn_points
from dlo_calibration.inference.examination import Examination, extended, SHORTEST
from dlo_calibration.inference.outlier import candidate, is_outlier, SOMETHING_ELSE
from dlo_calibration.inference.uncertainty import (
    at_minimum,
    DEVIATIONS,
    HARDLY,
    IDENTIFIABLE,
    MODEL_ERROR,
    NOT_IDENTIFIABLE,
    optimum_shift,
    prior_information,
    Uncertainty,
    UNKNOWN_STD,
    WEAK,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import (
    extents,
    knot_names,
    KNOTS,
    measured,
    owner,
    ParameterSpace,
    REST_STATE,
    SCALE,
)
from dlo_calibration.model.score import distances, force_residuals, residuals
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import NO_NOISE, with_other_noise

ROUNDS = 12  # Gauss-Newton steps to the best values, at most
# Logarithms of the likelihood: a parameter that is off by a standard deviation costs 0.5.
WORTH_A_STEP = 0.1  # that a step must promise to save
WORTH_A_MOVE = 0.5  # that one of the values TRIED must save
TRIED = 0.15, 0.25  # the first value, and from one to the next, where a derivative may not point to the best
SCATTERED = 24  # points there
STARTS = 8  # simulations of each trial from initial chains with other noise
#: A trial is informative if it reduces a standard deviation below this share; repeating one leaves 0.71.
NEW = 0.6


@dataclass(frozen=True, eq=False)
class TrialInformation:
    """
    How one trial changes the standard deviations of the parameters.

    :param trial: its name.
    :param names: of the d parameters.
    :param before: (d,) standard deviations without the trial, in the box.
    :param after: (d,) standard deviations with the trial.
    :param verdicts: on each parameter, with the trial.
    :param failure: why they are unknown (nan); empty if they are known.
    :param outlier: which of the trials so far does not fit the others, in words; empty: all do.
    """

    trial: str
    names: tuple[str, ...]
    before: Floats
    after: Floats
    verdicts: tuple[str, ...] = ()
    failure: str = ''
    outlier: str = ''

    def __post_init__(self) -> None:
        for name in ('before', 'after'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @classmethod
    def unknown(cls, trial: str, names: tuple[str, ...], failure: str) -> TrialInformation:
        """Return the information of a trial that could not be simulated: unknown."""
        nothing = np.full(len(names), np.nan)
        return cls(trial, names, nothing, nothing, failure=failure)

    @property
    def improved(self) -> tuple[str, ...]:
        """Names of the parameters that the trial makes more certain."""
        return tuple(name for name, before, after in zip(self.names, self.before, self.after, strict=True)
                     if after < NEW * before)

    @property
    def words(self) -> str:
        """One sentence for the user."""
        if self.failure:
            return f'the information of {self.trial} is unknown: {self.failure}'
        improved = self.improved
        if self.outlier:
            return self.outlier
        if not improved:
            return f'{self.trial} adds nothing new: repeat it only to average noise{self._so_far}'
        knots = [name for name in self.names if name in knot_names(KNOTS[-1])]
        scale = SCALE / extents(self.names)
        certain = [f'{name} (± {before:.1f} -> ± {after:.1f} of 100)'
                   for name, before, after in zip(self.names, scale * self.before, scale * self.after,
                                                  strict=True)
                   if name in improved and name not in knots]
        rest = [name for name in self.names if name not in improved and name not in knots]
        if knots:  # up to 18 of them
            bent = sum(name in improved for name in knots)
            where = certain if bent else rest
            where.append(f'{bent} of {len(knots)} components of the rest shape' if bent else 'the rest shape')
        first, _, values = certain[0].partition(' (')
        certain[0] = f'{first} more certain' + (f' ({values}' if values else '')
        nothing = f'; it adds nothing about {", ".join(rest)}' if rest else ''
        return f'{self.trial} makes {", ".join(certain)}{nothing}{self._so_far}'

    @property
    def _so_far(self) -> str:
        """The verdicts in words, without those on knots of a rest shape."""
        words = []
        for verdict in (IDENTIFIABLE, WEAK, NOT_IDENTIFIABLE):
            names = [name for name, own in zip(self.names, self.verdicts, strict=False) if own == verdict
                     and name not in knot_names(KNOTS[-1])]
            words += [f'{verdict}: {", ".join(names)}'] * bool(names)
        return f'; so far {"; ".join(words)}' if words else ''

    @property
    def values(self) -> dict[str, Any]:
        """Standard deviations (0..100) and verdicts, under the keys of a status; empty if unknown."""
        if self.failure:
            return {}
        return {f'{key}_{name}': float(std) for key, column in (
            ('std_before', self.before), ('std_after', self.after))
            for name, std in zip(self.names, column / extents(self.names) * SCALE, strict=True)} | {
                f'verdict_{name}': verdict for name, verdict in zip(self.names, self.verdicts, strict=False)}


def std_of_each_alone(trials: Sequence[Trial], examination: Examination) -> Floats:
    """Return (T, d): the standard deviations, in units of a search, that each trial would give alone."""
    scale, prior = examination.uncertainty.scale, prior_information(examination.jacobian.shape[1])
    return np.array([standard_deviations(information(examination.jacobian[rows], scale) + prior)
                     for rows in ResidualLayout.compared(trials).rows])


def uninformative(trials: Sequence[Trial], examination: Examination | None) -> tuple[str, ...]:
    """
    Return the names of the calibrated trials that inform about no parameter; () if that is unknown.

    Each of them alone would leave every standard deviation above HARDLY of that of the prior.
    """
    if examination is None or not examination.regular:
        return ()
    return tuple(trial.name for trial, std in zip(trials, std_of_each_alone(trials, examination), strict=True)
                 if (std > HARDLY * UNKNOWN_STD).all())


@dataclass(frozen=True, eq=False)
class TrialModel:
    """
    The simulations of one trial.

    :param fit: linear model of its residuals.
    :param steps: (d,) of its derivatives.
    :param moved: (STARTS, m) change of the residuals [m] by other noise of the initial chain.
    :param finer: (m,) change of the residuals [m] by a finer simulation.
    :param complete: False: `moved` and `finer` are not simulated yet; until then, and where they cannot be
        simulated, they are 0.
    """

    fit: Linearisation
    steps: Floats
    moved: Floats
    finer: Floats
    complete: bool = False

    def holds(self, point: Floats, steps: Floats) -> bool:
        """Tell whether the model suits a (d,) point and steps there, in the parameters that it shows."""
        away = np.abs(point - self.fit.point) > self.steps / 2
        shown = np.any(self.fit.jacobian != 0, axis=0)
        return not np.any((away | (self.steps > 2 * steps)) & shown)


@dataclass(frozen=True, eq=False)
class Appraisal:
    """
    The information of some trials before any calibration.

    :param names: of the d parameters.
    :param point: (d,) their best values.
    :param uncertainty: of them.
    :param models: of the first trials; the others are simulated when the next trial comes.
    """

    names: tuple[str, ...]
    point: Floats
    uncertainty: Uncertainty
    models: tuple[TrialModel, ...] = ()

    def outlier(self, trials: Sequence[Trial]) -> str:
        """Say which of the appraised trials does not fit the others; '' if all do."""
        errors = np.array([
            distances(ResidualLayout.of([without_repeated_goals(trial)]).points(
                model.fit.predicted(self.point - model.fit.point))).mean()
            for trial, model in zip(trials, self.models, strict=False)])
        k = candidate(errors)
        if k is None or not is_outlier(k, errors):
            return ''
        usual = float(np.delete(errors, k).mean())
        return (f'{trials[k].name} does not fit the others: {measured(float(errors[k]), "m")} from what they '
                f'predict, where they miss {measured(usual, "m")}; {SOMETHING_ELSE}: repeat it')

    @property
    def promised(self) -> Floats:
        """The standard deviations, (d,), if the models were linear, and the only errors white ones."""
        if not self.models:
            return self.uncertainty.std
        told = sum((model.fit.information for model in self.models), np.zeros(2 * (len(self.point),)))
        return standard_deviations(told / self.uncertainty.scale**2 + prior_information(len(self.point)))

    @classmethod
    def before(cls, names: tuple[str, ...], point: Floats) -> Appraisal:
        """Return the appraisal before any simulation, at a (d,) point to begin from."""
        ones, ends = np.ones(len(names)), extents(names)
        return cls(names, point, Uncertainty(
            UNKNOWN_STD * ones, 0 * ones, ends, ones == 0, ones == 0, UNKNOWN_STD**2 * np.eye(len(names)),
            ends=ends))


def without_repeated_goals(trial: Trial) -> Trial:
    """
    Return a trial without the goals that add little.

    Among goals at the same rest, the first stays; among goals in motion, a few stay, evenly spread.  So a
    tracker that continues to show a DLO at rest changes nothing.
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
    uncertainty: Uncertainty

    @property
    def loss(self) -> Huber:
        """The loss that suits the residuals."""
        return Huber.of(self.residuals)


@dataclass(frozen=True)
class Appraiser:
    """
    Estimates from simulations of trials how certain they make the parameters.

    :param length: of the DLO [m].
    :param table_height: [m]; None if there is no table.
    :param noise: noise level: standard deviation of one measured coordinate [m]; nan if unknown.
    :param guessed: names of the parameters that cannot be estimated from the observed chains alone.
    """

    space: ParameterSpace
    pool: Pool
    length: float
    table_height: float | None
    noise: float
    guessed: tuple[str, ...] = ()

    def after(self, before: Appraisal, trials: Sequence[Trial]) -> Appraisal:
        """
        Return the appraisal of all trials; `before` is that of all but the last.

        A trial is simulated again if the best values have moved away from its model.

        :raises SimulationError: if a trial cannot be simulated.
        :raises CancelledError: when the pool stops.
        """
        trials = [without_repeated_goals(trial) for trial in trials]
        models = [*before.models, *[None] * (len(trials) - len(before.models))]
        best = self._minimum(trials, models, before.point, before.promised)
        for better_start in (self._better_start, self._scattered_start):
            elsewhere = better_start(trials, best)
            if elsewhere is not None:
                other = self._minimum(trials, [None] * len(trials), elsewhere, before.promised)
                best = min(best, other, key=lambda minimum: best.loss.cost(minimum.residuals))
        return self._examined(before.names, trials, best.point, tuple(
            model if model.complete else self._completed(model, trial)
            for model, trial in zip(best.models, trials, strict=True)))

    def _minimum(self, trials: Sequence[Trial], models: Sequence[TrialModel | None], point: Floats,
                 std: Floats) -> _Minimum:
        """
        Return the minimum that Gauss-Newton steps from a (d,) point reach.

        Unlike a search, it simulates a trial only where its model among `models` does not hold, and halves
        steps that lead too far.
        """
        best: _Minimum | None = None
        for _ in range(ROUNDS):
            try:
                steps = steps_within(std)
                now = tuple(model if model is not None and model.holds(point, steps) else
                            self._model(trial, point, steps)
                            for model, trial in zip(models, trials, strict=True))
            except SimulationError:
                if best is None:
                    raise
                point = (point + best.point) / 2
                continue
            models = now
            fit, layout = _joint_model(now, trials, point)
            loss = Huber.of(fit.residuals)
            if best is not None and not np.array_equal(point, best.point):
                same = min(loss, best.loss)
                if same.cost(fit.residuals) > same.cost(best.residuals):  # too far
                    point = (point + best.point) / 2
                    continue
            uncertainty = at_minimum(fit, layout, noise=self.noise)
            best = _Minimum(fit.residuals, point, now, uncertainty)
            weighted = fit.weighted(loss.roots(fit.residuals) / uncertainty.scale)
            prior = prior_information(len(point))
            step, std = weighted.step(prior), standard_deviations(weighted.information + prior)
            there = np.clip(point + np.clip(step, -WIDEST, WIDEST), 0.0, self.space.upper)
            saved = loss.cost(fit.residuals) - loss.cost(fit.predicted(there - point))
            if saved > WORTH_A_STEP * uncertainty.scale**2:
                point = there
            elif all(model.holds(point, steps_within(std)) for model in now):
                break
        assert best is not None
        return best

    def _better_start(self, trials: Sequence[Trial], best: _Minimum) -> Floats | None:
        """
        Return a (d,) point that fits clearly better than a minimum; None if there is none.

        A parameter may be so far from its default that no derivative there points to it, such as the
        elasticity of a DLO that is much more elastic than a rope.
        """
        shown = np.logical_or.reduce(excites(trials, self.space, self.table_height))
        start, cost = best.point, best.loss.cost(best.residuals)
        worth = WORTH_A_MOVE * best.uncertainty.scale**2
        for k, name in enumerate(self.space.free):
            if name not in self.guessed or not shown[k] or best.uncertainty.verdicts[k] != NOT_IDENTIFIABLE:
                continue
            values = np.arange(TRIED[0], self.space.upper[k], TRIED[1])
            points = [np.where(np.arange(len(start)) == k, value, start) for value in values]
            costs = self._costs(trials, points, best.loss)
            if min(costs) < cost - worth:
                start, cost = points[int(np.argmin(costs))], min(costs)
        return None if start is best.point else start

    def _scattered_start(self, trials: Sequence[Trial], best: _Minimum) -> Floats | None:
        """Return the best of (d,) points all over the scales if a minimum misses the trials by far."""
        if not best.uncertainty.residual > MODEL_ERROR * self.noise:
            return None
        points = drawn_points(best.point, Appraisal.before(self.space.free, best.point).uncertainty,
                              SCATTERED, 0)
        costs = self._costs(trials, points, best.loss)
        # A Gauss-Newton step moves a parameter by WIDEST: a point that fits worse may still lead further.
        return points[int(np.argmin(costs))] if np.isfinite(min(costs)) else None

    def _examined(self, names: tuple[str, ...], trials: Sequence[Trial], point: Floats,
                  models: tuple[TrialModel, ...]) -> Appraisal:
        fit, layout = _joint_model(models, trials, point)
        here, = self._residuals(trials, [point])  # where a trial is nonlinear, its model is off
        fit = fit if here is None else replace(fit, residuals=here)
        shift = optimum_shift(fit, fit.residuals + np.concatenate([model.finer for model in models]))
        starts = fit.residuals + np.hstack([model.moved for model in models])
        uncertainty = at_minimum(fit, layout, noise=self.noise, shift=shift, starts=starts)
        fading = np.array([owner(name)[0] not in REST_STATE for name in self.space.free])
        return Appraisal(names, point, extended(
            fit, uncertainty, lambda points: self._residuals(trials, points), fading, shift), models)

    def _costs(self, trials: Sequence[Trial], points: Sequence[Floats] | Floats, loss: Huber) -> list[float]:
        """Return the cost [m^2] of all trials at each of the points; inf where one cannot be simulated."""
        return [np.inf if each is None else loss.cost(each) for each in self._residuals(trials, points)]

    def _residuals(self, trials: Sequence[Trial], points: Sequence[Floats] | Floats) -> list[Floats | None]:
        """Return the residuals (m,) [m] of all trials at each point; None where one cannot be simulated."""
        outcomes = self._outcomes([(trial, point) for point in points for trial in trials])
        each = [[one for one in islice(outcomes, len(trials)) if not isinstance(one, SimulationError)]
                for _ in points]
        return [np.concatenate(some) if len(some) == len(trials) else None for some in each]

    def _simulated(self, jobs: Sequence[tuple[Trial, Floats]], pool: Pool | None = None) -> list[Floats]:
        """
        Return the residuals (m,) [m] of each trial at its (d,) point.

        :raises SimulationError: if one cannot be simulated.
        """
        simulated = []
        for outcome in self._outcomes(jobs, pool):
            if isinstance(outcome, SimulationError):
                raise outcome
            simulated.append(outcome)
        return simulated

    def _outcomes(self, jobs: Sequence[tuple[Trial, Floats]], pool: Pool | None = None
                  ) -> Iterator[Floats | SimulationError]:
        """Yield the residuals (m,) [m] of each trial at its (d,) point, or why it cannot be simulated."""
        values = [self.space.physical(self.space.values(point), self.length) for _, point in jobs]
        rollouts = (pool or self.pool).simulate([
            (with_hands(trial, each), each) for (trial, _), each in zip(jobs, values, strict=True)])
        for (trial, _), rollout in zip(jobs, rollouts, strict=True):
            yield rollout if isinstance(rollout, SimulationError) else np.append(
                residuals(trial, rollout.chains), force_residuals(trial, rollout.forces))

    def _model(self, trial: Trial, point: Floats, steps: Floats) -> TrialModel:
        """Simulate a trial around a (d,) point; a parameter that it certainly cannot show is not varied."""
        shown = excites([trial], self.space, self.table_height)[0]
        sides = Differences.central(point, np.flatnonzero(shown), steps, self.space.upper)
        here, *beside = self._simulated([(trial, each) for each in (point, *sides.points)])
        jacobian = sides.jacobian(np.zeros((len(here), len(point))), beside)
        return TrialModel(Linearisation(point, here, jacobian, self.space.upper), steps,
                          np.zeros((STARTS, len(here))), np.zeros(len(here)))

    def _completed(self, model: TrialModel, trial: Trial) -> TrialModel:
        """Return a model with the effects of other noise of the initial chain and of a finer simulation."""
        point, moved, finer, fine = model.fit.point, model.moved, model.finer, self.pool.refined()
        generator = np.random.default_rng(zlib.crc32(trial.initial.points.tobytes()))  # the same each time
        try:
            if self.noise > NO_NOISE and 'length_scale' not in self.space.free:
                others = with_other_noise([trial], self.noise, STARTS, generator)
                moved = np.array(self._simulated([(noisy, point) for noisy, in others])) - model.fit.residuals
            if fine is not None:
                finer = self._simulated([(trial, point)], fine)[0] - model.fit.residuals
        except SimulationError:
            pass
        finally:
            if fine is not None:
                fine.simulator.close()
        return replace(model, moved=moved, finer=finer, complete=True)


def steps_within(std: Floats) -> Floats:
    """Return the steps (d,) of derivatives, to the ends of 90 % intervals: the chains may be nonlinear."""
    return np.clip(DEVIATIONS * std, SHORTEST, WIDEST)


def _joint_model(models: Sequence[TrialModel], trials: Sequence[Trial], point: Floats
           ) -> tuple[Linearisation, ResidualLayout]:
    """Return the linear model of all trials at a (d,) point, and the layout of its residuals."""
    fits = [model.fit for model in models]
    residuals = np.concatenate([fit.predicted(point - fit.point) for fit in fits])
    jacobian = np.concatenate([fit.jacobian for fit in fits])
    return Linearisation(point, residuals, jacobian, fits[0].upper), ResidualLayout.of(trials)
