# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""calibrate(): the only loop, from trials to a parameter set."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
import copy
from dataclasses import dataclass, replace
import threading
import time
from typing import Callable, Iterator, Mapping, Sequence
import uuid
import weakref

import numpy as np

from dlo_calibration.advice import Advice, advise
from dlo_calibration.chain import Floats, frozen_array
from dlo_calibration.confirmation import Confirmation, disagreements
from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
from dlo_calibration.examination import Examination, examine
from dlo_calibration.noise import noise
from dlo_calibration.parameters import ParameterSpace, SCALE
from dlo_calibration.score import PointErrors, residuals, TrialScore
from dlo_calibration.search import Observation, Search
from dlo_calibration.simulator import Rollout, Simulator
from dlo_calibration.trial import Trial
from dlo_calibration.uncertainty import IDENTIFIABLE, INVOLVED, matters_below, spread_of_best, Uncertainty

PAPER_EVALUATIONS = 150
EXACT = 1e-9  # relative error of a length that does not matter
LENGTH_ENDS = float(np.sqrt(2.0))  # standard deviation of a length, in those of its two ends


@dataclass(frozen=True)
class Evaluation:
    """
    One parameter set tried on all trials (the paper calls it a round).

    :param index: 0, 1, ... in the order asked.
    :param point: (d,) in the unit cube.
    :param values: free parameters on the 0..100 scale.
    :param scores: difference score of each trial, NaN of one that was skipped; empty where it failed.
    :param errors: over all goal points; None where it failed or was abandoned.
    :param residuals: (m,) [m]; kept for the best evaluation only.
    :param unsettled: names of trials that never came to rest.
    :param failure: why it failed; empty where it did not.
    :param skipped: number of trials that were not simulated any more: one before
        them failed, or the evaluation was abandoned, as its score was too high already.
    """

    index: int
    point: Floats
    values: Mapping[str, float]
    scores: tuple[float, ...] = ()
    errors: PointErrors | None = None
    residuals: Floats | None = None
    unsettled: tuple[str, ...] = ()
    failure: str = ''
    skipped: int = 0

    @property
    def abandoned(self) -> bool:
        """Whether trials were skipped because the score was too high already."""
        return self.skipped > 0 and not self.failure

    @property
    def score(self) -> float:
        """
        Average difference score over the trials [cm]; infinite where it failed.

        Where it was abandoned, a lower bound: no score is less than 0.
        """
        if self.abandoned:
            return float(np.mean(np.nan_to_num(self.scores, nan=0.0)))
        return float(np.mean(self.scores)) if self.scores else float('inf')


@dataclass(frozen=True)
class ParameterEstimate:
    """
    One found parameter.

    `value`, `std`, `lower`, `upper` are on the 0..100 scale; the others are the
    same in `physical_unit`; the interval is one of 90 %.  `identifiable` is False
    where the trials could not tell its value.

    :param verdict: identifiable, weak, or not identifiable; see `uncertainty`.
    :param note: what else is to be known, in words; empty where nothing is.
    """

    name: str
    value: float
    std: float
    lower: float
    upper: float
    physical_value: float
    physical_lower: float
    physical_upper: float
    physical_unit: str
    identifiable: bool
    verdict: str = ''
    note: str = ''


@dataclass(frozen=True)
class CalibrationResult:
    """
    What a calibration found, and how.

    :param chains: (g, n, 3) [m] the simulated goals of each trial.
    :param examination: of the surroundings of what was found; None where there was no time for it.
    :param advice: which action to observe next; None where none would help, or it was not asked for.
    """

    space: ParameterSpace
    parameters: Mapping[str, ParameterEstimate]
    best: Evaluation
    trials: tuple[Trial, ...]
    chains: tuple[Floats, ...]
    evaluations: tuple[Evaluation, ...]
    seconds: float
    search: str
    engine: str
    stop_reason: str
    seed: int | None = None
    warnings: tuple[str, ...] = ()
    confirmation: Confirmation | None = None
    examination: Examination | None = None
    advice: Advice | None = None

    @property
    def values(self) -> dict[str, float]:
        """Found parameters on the 0..100 scale, by name."""
        return {name: estimate.value for name, estimate in self.parameters.items()}

    @property
    def errors(self) -> PointErrors:
        """Point errors of the best evaluation."""
        assert self.best.errors is not None
        return self.best.errors

    @property
    def length(self) -> float:
        """Mean length of the DLO over the trials [m]."""
        return mean_length(self.trials)

    @property
    def simulations(self) -> int:
        """Rollouts that were simulated, by the search and by the examination."""
        examined = 0 if self.examination is None else self.examination.evaluations
        return examined * len(self.trials) + sum(
            len(self.trials) - evaluation.skipped for evaluation in self.evaluations)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of parameters that the trials leave open, in words."""
        if self.examination is None or not self.examination.regular:
            return ()
        return tuple(combination(self.space.free, vector)
                     for vector in self.examination.uncertainty.undetermined)

    def physical(self) -> dict[str, float]:
        """Every parameter's physical value in SI units, for a rope like the observed one."""
        return self.space.physical(self.values, self.length)


def mean_length(trials: Sequence[Trial]) -> float:
    """Return the mean length of the DLO as the trials begin [m]."""
    return float(np.mean([trial.initial.length for trial in trials]))


class Evaluator:
    """
    Tries parameter sets on trials.

    It is pickled to worker processes and copied for worker threads: see `Simulator`.
    """

    def __init__(self, trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator) -> None:
        self.trials = tuple(trials)
        self.space = space
        self.simulator = simulator
        self._length = mean_length(trials)
        self._scores = tuple(TrialScore(trial) for trial in trials)

    def __copy__(self) -> Evaluator:
        """Return one with a simulator of its own."""
        return Evaluator(self.trials, self.space, copy.copy(self.simulator))

    def simulate(self, values: Mapping[str, float]) -> list[Rollout]:
        """Simulate every trial with free parameters on the 0..100 scale."""
        physical = self.space.physical(values, self._length)
        return [self.simulator.simulate(trial, physical) for trial in self.trials]

    def evaluate(self, index: int, point: Floats, should_stop: Callable[[], bool] = lambda: False,
                 limits: Limits | None = None) -> Evaluation:
        """
        Try a (d,) point of the unit cube on every trial.

        :param limits: None: every trial is simulated, whatever the others gave.
        :raises CancelledError: as soon as `should_stop` says so, between trials.
        """
        point = frozen_array(point)
        evaluation = Evaluation(index, point, self.space.values(point))
        physical = self.space.physical(evaluation.values, self._length)
        scores = np.full(len(self.trials), np.nan)
        rollouts: dict[int, Rollout] = {}
        for k in range(len(self.trials)) if limits is None else limits.order:
            if should_stop():
                raise CancelledError
            left = len(self.trials) - len(rollouts) - 1
            try:
                rollouts[k] = self.simulator.simulate(self.trials[k], physical)
            except SimulationError as error:
                return replace(evaluation, failure=str(error), skipped=left)
            scores[k] = self._scores[k](rollouts[k].chains)
            evaluation = replace(
                evaluation, scores=tuple(float(score) for score in scores), skipped=left,
                unsettled=tuple(trial.name for j, trial in enumerate(self.trials)
                                if j in rollouts and not all(rollouts[j].settled)))
            if left and limits is not None and evaluation.score > limits.score:
                return evaluation
        residual = np.concatenate([residuals(trial, rollouts[j].chains)
                                   for j, trial in enumerate(self.trials)])
        return replace(evaluation, errors=PointErrors.of(residual), residuals=frozen_array(residual))


@dataclass(frozen=True)
class Limits:
    """
    When evaluations are abandoned.

    :param score: as soon as the score cannot be this low [cm] any more.
    :param order: indices of the trials in the order to simulate them.
    """

    score: float
    order: tuple[int, ...]

    @classmethod
    def of(cls, search: Search, evaluations: Sequence[Evaluation], budget: int) -> Limits | None:
        """
        Return what neither the search nor the result can tell from no limits; None: nothing is.

        Trials that scored high so far come first, as they decide soonest.
        """
        complete = [one for one in evaluations if one.scores and not one.skipped]
        score = max(search.limit, matters_below([one.score for one in complete], budget))
        if not np.isfinite(score):
            return None
        mean = np.mean([one.scores for one in complete], axis=0)
        return cls(score, tuple(int(k) for k in np.argsort(-mean, kind='stable')))


def calibrate(trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator, search: Search, *,
              budget: int = PAPER_EVALUATIONS,
              on_evaluation: Callable[[Evaluation], None] | None = None,
              should_stop: Callable[[], bool] = lambda: False,
              executor: Executor | None = None,
              clock: Callable[[], float] = time.monotonic,
              seed: int | None = None) -> CalibrationResult:
    """
    Find the parameter set that fits the trials best, and how sure it is.

    What fits best is the search's word: the lowest average difference score, or the
    lowest sum of squares.  The result does not depend on `executor`: evaluations are
    told to the search and to `on_evaluation` in the order asked.

    :param budget: number of evaluations of the search; what is examined afterwards
        (see `examination`) counts in `CalibrationResult.simulations` only.
    :param on_evaluation: called with each finished one of the search, in order.
    :param should_stop: asked often; once True, the best so far is the result.
    :param executor: where evaluations run; None: here, one after the other.
    :param clock: seconds, for `CalibrationResult.seconds` only.
    :param seed: of the search, for the record.
    :raises InputError: where there is nothing to calibrate on.
    :raises SimulationError: where no evaluation could be simulated.
    """
    if not trials:
        raise InputError('calibration', 'no trials', 'at least one complete trial',
                         'record an initial chain, an action and a goal chain first')
    started = clock()

    def everywhere(evaluator: Evaluator) -> _Everywhere:
        return _Everywhere(evaluator, should_stop, executor)

    evaluate = everywhere(Evaluator(trials, space, simulator))
    kept, best, stopped = _searched(evaluate, search, budget, on_evaluation)
    if best is None or not best.scores:
        raise SimulationError('stopped before the first evaluation had finished' if best is None else
                              f'none of {len(kept)} evaluations could be simulated: {best.failure}')
    examination = None
    if not stopped:
        try:
            examination, best = _examined(evaluate, everywhere, best)
        except CancelledError:
            stopped = True
    reason = 'stopped on request' if stopped else \
        search.stop_reason or f'budget of {budget} evaluations spent'
    found = spread_of_best(kept, best.point)
    if examination is not None:
        found = examination.uncertainty if examination.regular else replace(
            found, excited=examination.uncertainty.excited)
    return CalibrationResult(
        space=space, parameters=estimates(space, best, found), best=best, trials=tuple(trials),
        chains=simulated_chains(trials, best), evaluations=tuple(kept), seconds=clock() - started,
        search=search.name, engine=simulator.name, stop_reason=reason, seed=seed,
        warnings=_warnings(best, kept), examination=examination)


def _searched(evaluate: _Everywhere, search: Search, budget: int,
              on_evaluation: Callable[[Evaluation], None] | None
              ) -> tuple[list[Evaluation], Evaluation | None, bool]:
    """Return all evaluations of a search, the one it calls the best, and whether it was stopped."""
    kept: list[Evaluation] = []
    best: Evaluation | None = None
    stopped = False
    while len(kept) < budget and not stopped:
        limits = Limits.of(search, kept, budget)  # known before it is asked: the same for any executor
        points = search.ask(budget - len(kept))
        if not len(points):
            break
        batch: list[Evaluation] = []
        for evaluation in evaluate(points, len(kept), limits):
            batch.append(evaluation)
            if on_evaluation is not None:
                on_evaluation(evaluation)
        stopped = len(batch) < len(points)
        search.tell([Observation(e.point, e.score, e.residuals) for e in batch])
        chosen = search.best
        for evaluation in batch:
            if best is None or best.residuals is None and evaluation.score < best.score or (
                    evaluation.residuals is not None and chosen is not None
                    and np.array_equal(evaluation.point, chosen)):
                best = evaluation
        kept.extend(replace(evaluation, residuals=None) for evaluation in batch)
    return kept, best, stopped


def _examined(evaluate: _Everywhere, everywhere: Callable[[Evaluator], _Everywhere],
              best: Evaluation) -> tuple[Examination, Evaluation]:
    """
    Return what is around the best evaluation, and that evaluation as it is reported.

    A parameter that no trial tells anything about gets its default, not what it had by chance.

    :raises CancelledError: when stopped.
    """
    evaluator = evaluate.evaluator
    trials, space, simulator = evaluator.trials, evaluator.space, evaluator.simulator
    assert best.residuals is not None
    default, sigma = space.default_point(), noise(trials)
    finer = simulator.refined()
    error = LENGTH_ENDS * sigma / mean_length(trials)  # of the measured length, relative
    try:
        examination = examine(
            best.point, best.residuals, [(len(trial.goals), len(trial.initial)) for trial in trials],
            evaluate.residuals, default=default, noise=sigma,
            finer=None if finer is None else everywhere(Evaluator(trials, space, finer)).residuals,
            longer=None if not error > EXACT or 'length_scale' in space.free else everywhere(
                Evaluator(trials, space.lengthened(1 + error), simulator)).residuals)
    finally:
        if finer is not None:
            finer.close()
    excited = examination.uncertainty.excited
    point = np.where(excited, best.point, default)
    if np.array_equal(point, best.point):
        return examination, best
    again = next(iter(evaluate(point[None, :], best.index)), None)
    if again is None:
        raise CancelledError
    return replace(examination, evaluations=examination.evaluations + 1), best if again.failure else again


def confirmed(result: CalibrationResult, simulator: Simulator,
              should_stop: Callable[[], bool] = lambda: False,
              clock: Callable[[], float] = time.monotonic) -> CalibrationResult:
    """
    Return a result with what a second engine gives for its parameter set.

    It costs one evaluation, which counts in `seconds` and not in `evaluations`.
    Where the engines disagree, or the second one fails, the result stands, with a warning.

    :param should_stop: asked between trials; once True, the result stays unconfirmed.
    """
    begun, name, best = clock(), simulator.name, result.best
    confirmation, words = None, ''
    try:
        other = Evaluator(result.trials, result.space, simulator).evaluate(
            best.index, best.point, should_stop)
        if other.errors is None:
            raise SimulationError(other.failure)
    except CancelledError:
        words = f'not confirmed by engine {name}: stopped on request'
    except DloCalibrationError as error:
        words = f'not confirmed by engine {name}: {error}'
    else:
        chains = simulated_chains(result.trials, other)
        apart = np.concatenate([np.linalg.norm(one - two, axis=2).ravel()
                                for one, two in zip(result.chains, chains, strict=True)])
        confirmation = Confirmation(name, other.score, other.scores, other.errors,
                                    float(apart.mean()), float(apart.max()))
        found = disagreements([trial.name for trial in result.trials], result.chains, chains,
                              best.scores, other.scores)
        if found:
            words = f'engine {name} disagrees with engine {result.engine}: {"; ".join(found)}'
    return replace(result, confirmation=confirmation, seconds=result.seconds + clock() - begun,
                   warnings=(*result.warnings, words) if words else result.warnings)


def advised(result: CalibrationResult, simulator: Simulator,
            should_stop: Callable[[], bool] = lambda: False,
            clock: Callable[[], float] = time.monotonic) -> CalibrationResult:
    """
    Return a result with the action that would tell most, if its uncertainty is known.

    Actions are simulated for that, which counts in `seconds` and not in `simulations`.
    """
    if result.examination is None or not result.examination.regular:
        return result
    begun = clock()
    advice = advise(result.trials, result.space, simulator, result.best.point,
                    result.examination.uncertainty, result.length, should_stop)
    return replace(result, advice=advice, seconds=result.seconds + clock() - begun)


def estimates(space: ParameterSpace, best: Evaluation, found: Uncertainty) -> dict[str, ParameterEstimate]:
    """Return the parameters of the best evaluation with their uncertainty, in both units."""
    parameters = {}
    for k, name in enumerate(space.free):
        value, lower, upper = (float(x) * SCALE for x in (best.point[k], found.lower[k], found.upper[k]))
        (at_value, unit), (at_lower, _), (at_upper, _) = (
            space.reported(name, x) for x in (value, lower, upper))
        note = '' if found.excited[k] else 'no trial tells anything about it; it keeps its default'
        if found.at_bound[k]:
            note = 'at the end of its scale; the best value may lie beyond'
        verdict = found.verdicts[k]
        parameters[name] = ParameterEstimate(
            name, value, float(found.std[k]) * SCALE, lower, upper, at_value, min(at_lower, at_upper),
            max(at_lower, at_upper), unit, verdict == IDENTIFIABLE, verdict, note)
    return parameters


def combination(names: Sequence[str], vector: Floats) -> str:
    """Return a combination of parameters in words, e.g. ``flexibility - 0.8 friction``."""
    largest = float(np.abs(vector).max())
    words = ''
    for k in np.argsort(-np.abs(vector), kind='stable'):
        share = float(vector[k]) / largest
        if abs(share) >= INVOLVED:
            sign = ('- ' if share < 0 else '+ ') if words else ('-' if share < 0 else '')
            size = '' if abs(share) > 0.95 else f'{abs(share):.1f} '
            words += f'{" " if words else ""}{sign}{size}{names[k]}'
    return words


def simulated_chains(trials: Sequence[Trial], evaluation: Evaluation) -> tuple[Floats, ...]:
    """Return the simulated (g, n, 3) [m] chains of each trial, from the residuals."""
    assert evaluation.residuals is not None
    chains, at = [], 0
    for trial in trials:
        observed = np.stack([goal.chain.points for goal in trial.goals])
        residual = evaluation.residuals[at:at + observed.size].reshape(observed.shape)
        chains.append(frozen_array(observed + residual))
        at += observed.size
    return tuple(chains)


def _warnings(best: Evaluation, kept: Sequence[Evaluation]) -> tuple[str, ...]:
    warnings = []
    if best.unsettled:
        warnings.append(f'never came to rest: {", ".join(best.unsettled)}; compared as it was at the limit')
    failed = [evaluation for evaluation in kept if evaluation.failure]
    if failed:
        warnings.append(f'{len(failed)} of {len(kept)} evaluations could not be simulated: '
                        f'{failed[0].failure}')
    return tuple(warnings)


class _Everywhere:
    """Evaluates points in order, wherever the executor says; ends early, without a word, when stopped."""

    def __init__(self, evaluator: Evaluator, should_stop: Callable[[], bool],
                 executor: Executor | None) -> None:
        self.evaluator = evaluator
        self._should_stop = should_stop
        self._executor = executor
        self._key = uuid.uuid4().hex  # of this calibration, on whichever machines

    def __call__(self, points: Floats, first: int, limits: Limits | None = None) -> Iterator[Evaluation]:
        """Evaluate (k, d) points, the first with the index `first`."""
        if self._executor is None:
            for k, point in enumerate(points):
                try:
                    yield self.evaluator.evaluate(first + k, point, self._should_stop, limits)
                except CancelledError:
                    return
            return
        futures: list[Future[Evaluation]] = [
            self._executor.submit(_evaluate_elsewhere, self._key, self.evaluator, first + k, point, limits)
            for k, point in enumerate(points)]
        try:
            for future in futures:
                while not future.done():
                    if self._should_stop():
                        return
                    _wait(future)
                if self._should_stop():
                    return
                yield future.result()
        finally:
            for future in futures:
                future.cancel()

    def residuals(self, points: Floats) -> Sequence[Floats | None]:
        """
        Return the residuals at (k, d) points; None where a simulation failed.

        :raises CancelledError: when stopped.
        """
        found = [evaluation.residuals for evaluation in self(points, 0)]
        if len(found) < len(points):
            raise CancelledError
        return found


def _wait(future: Future[Evaluation]) -> None:
    try:
        future.exception(timeout=0.05)
    except TimeoutError:
        pass


class _Here(threading.local):
    """
    What a worker's thread keeps: the evaluator of the calibration under way.

    Its simulator is closed when another calibration begins, or the thread ends.
    """

    key = ''
    evaluator: Evaluator
    forget: Callable[[], object] = staticmethod(lambda: None)

    def of(self, key: str, evaluator: Evaluator) -> Evaluator:
        if key != self.key:
            self.forget()
            self.key, self.evaluator = key, copy.copy(evaluator)
            self.forget = weakref.finalize(self.evaluator, self.evaluator.simulator.close)
        return self.evaluator


_here = _Here()


def _evaluate_elsewhere(key: str, evaluator: Evaluator, index: int, point: Floats,
                        limits: Limits | None) -> Evaluation:
    """Evaluate in a worker, with an evaluator that stays as long as the calibration is the same."""
    return _here.of(key, evaluator).evaluate(index, point, limits=limits)
