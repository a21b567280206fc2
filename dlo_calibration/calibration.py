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
from dataclasses import dataclass, replace
import time
from typing import Callable, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.chain import Floats, frozen_array
from dlo_calibration.confirmation import Confirmation, disagreements
from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
from dlo_calibration.parameters import ParameterSpace, SCALE
from dlo_calibration.score import PointErrors, residuals, TrialScore
from dlo_calibration.search import Observation, Search
from dlo_calibration.simulator import Rollout, Simulator
from dlo_calibration.trial import Trial
from dlo_calibration.uncertainty import spread_of_best, Uncertainty

PAPER_EVALUATIONS = 150


@dataclass(frozen=True)
class Evaluation:
    """
    One parameter set tried on all trials (the paper calls it a round).

    :param index: 0, 1, ... in the order asked.
    :param point: (d,) in the unit cube.
    :param values: free parameters on the 0..100 scale.
    :param scores: difference score of each trial; empty where it failed.
    :param errors: over all goal points; None where it failed.
    :param residuals: (m,) [m]; kept for the best evaluation only.
    :param unsettled: names of trials that never came to rest.
    :param failure: why it failed; empty where it did not.
    """

    index: int
    point: Floats
    values: Mapping[str, float]
    scores: tuple[float, ...] = ()
    errors: PointErrors | None = None
    residuals: Floats | None = None
    unsettled: tuple[str, ...] = ()
    failure: str = ''

    @property
    def score(self) -> float:
        """Average difference score over the trials [cm]; infinite where it failed."""
        return float(np.mean(self.scores)) if self.scores else float('inf')


@dataclass(frozen=True)
class ParameterEstimate:
    """
    One found parameter.

    `value`, `std`, `lower`, `upper` are on the 0..100 scale; the others are the
    same in `physical_unit`.  `identifiable` is False where the trials could
    not tell its value.
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


@dataclass(frozen=True)
class CalibrationResult:
    """What a calibration found, and how."""

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
        """Rollouts that were simulated."""
        return len(self.evaluations) * len(self.trials)

    def physical(self) -> dict[str, float]:
        """Every parameter's physical value in SI units, for a rope like the observed one."""
        return self.space.physical(self.values, self.length)


def mean_length(trials: Sequence[Trial]) -> float:
    """Return the mean length of the DLO as the trials begin [m]."""
    return float(np.mean([trial.initial.length for trial in trials]))


class Evaluator:
    """
    Tries parameter sets on trials.

    It is pickled to worker processes: see `Simulator`.
    """

    def __init__(self, trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator) -> None:
        self.trials = tuple(trials)
        self.space = space
        self.simulator = simulator
        self._length = mean_length(trials)
        self._scores = tuple(TrialScore(trial) for trial in trials)

    def simulate(self, values: Mapping[str, float],
                 should_stop: Callable[[], bool] = lambda: False) -> list[Rollout]:
        """Simulate every trial with free parameters on the 0..100 scale."""
        physical = self.space.physical(values, self._length)
        rollouts = []
        for trial in self.trials:
            if should_stop():
                raise CancelledError
            rollouts.append(self.simulator.simulate(trial, physical))
        return rollouts

    def evaluate(self, index: int, point: Floats,
                 should_stop: Callable[[], bool] = lambda: False) -> Evaluation:
        """
        Try a (d,) point of the unit cube on every trial.

        :raises CancelledError: as soon as `should_stop` says so, between trials.
        """
        point = frozen_array(point)
        blank = Evaluation(index, point, self.space.values(point))
        try:
            rollouts = self.simulate(blank.values, should_stop)
        except SimulationError as error:
            return replace(blank, failure=str(error))
        residual = np.concatenate([residuals(trial, rollout.chains)
                                   for trial, rollout in zip(self.trials, rollouts, strict=True)])
        return replace(
            blank,
            scores=tuple(score(rollout.chains)
                         for score, rollout in zip(self._scores, rollouts, strict=True)),
            errors=PointErrors.of(residual), residuals=frozen_array(residual),
            unsettled=tuple(trial.name for trial, rollout in zip(self.trials, rollouts, strict=True)
                            if not all(rollout.settled)))


def calibrate(trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator, search: Search, *,
              budget: int = PAPER_EVALUATIONS,
              on_evaluation: Callable[[Evaluation], None] | None = None,
              should_stop: Callable[[], bool] = lambda: False,
              executor: Executor | None = None,
              clock: Callable[[], float] = time.monotonic,
              seed: int | None = None) -> CalibrationResult:
    """
    Find the parameter set with the lowest average difference score.

    The result does not depend on `executor`: evaluations are told to the search
    and to `on_evaluation` in the order asked.

    :param budget: number of evaluations.
    :param on_evaluation: called with each finished one, in order.
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
    evaluator = Evaluator(trials, space, simulator)
    kept: list[Evaluation] = []
    best: Evaluation | None = None
    stopped = False
    while len(kept) < budget and not stopped:
        points = search.ask(budget - len(kept))
        if not len(points):
            break
        batch: list[Evaluation] = []
        for evaluation in _evaluations(evaluator, len(kept), points, should_stop, executor):
            batch.append(evaluation)
            if best is None or evaluation.score < best.score:
                best = evaluation
            if on_evaluation is not None:
                on_evaluation(evaluation)
        stopped = len(batch) < len(points)
        if not stopped:
            search.tell([Observation(e.point, e.score, e.residuals) for e in batch])
        kept.extend(replace(evaluation, residuals=None) for evaluation in batch)
    if best is None or not best.scores:
        raise SimulationError('stopped before the first evaluation had finished' if best is None else
                              f'none of {len(kept)} evaluations could be simulated: {best.failure}')
    reason = 'stopped on request' if stopped else \
        search.stop_reason or f'budget of {budget} evaluations spent'
    return CalibrationResult(
        space=space, parameters=estimates(space, best, spread_of_best(kept, best.point)),
        best=best, trials=tuple(trials), chains=simulated_chains(trials, best),
        evaluations=tuple(kept), seconds=clock() - started, search=search.name,
        engine=simulator.name, stop_reason=reason, seed=seed, warnings=_warnings(best, kept))


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


def estimates(space: ParameterSpace, best: Evaluation, spread: Uncertainty) -> dict[str, ParameterEstimate]:
    """Return the parameters of the best evaluation with their spread, in both units."""
    found = {}
    for k, name in enumerate(space.free):
        value, lower, upper = (float(x) * SCALE for x in (best.point[k], spread.lower[k], spread.upper[k]))
        (at_value, unit), (at_lower, _), (at_upper, _) = (
            space.reported(name, x) for x in (value, lower, upper))
        found[name] = ParameterEstimate(
            name, value, float(spread.std[k]) * SCALE, lower, upper, at_value,
            min(at_lower, at_upper), max(at_lower, at_upper), unit, spread.verdicts[k] == 'identifiable')
    return found


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


def _evaluations(evaluator: Evaluator, first: int, points: Floats, should_stop: Callable[[], bool],
                 executor: Executor | None) -> Iterator[Evaluation]:
    """Evaluate points in order; end early, without a word, when asked to stop."""
    if executor is None:
        for k, point in enumerate(points):
            try:
                yield evaluator.evaluate(first + k, point, should_stop)
            except CancelledError:
                return
        return
    key = f'{id(evaluator)}-{time.monotonic_ns()}'
    futures: list[Future[Evaluation]] = [
        executor.submit(_evaluate_elsewhere, key, evaluator, first + k, point)
        for k, point in enumerate(points)]
    try:
        for future in futures:
            while not future.done():
                if should_stop():
                    return
                _wait(future)
            if should_stop():
                return
            yield future.result()
    finally:
        for future in futures:
            future.cancel()


def _wait(future: Future[Evaluation]) -> None:
    try:
        future.exception(timeout=0.05)
    except TimeoutError:
        pass


_evaluator_here: dict[str, Evaluator] = {}  # the one of the calibration under way, in a worker


def _evaluate_elsewhere(key: str, evaluator: Evaluator, index: int, point: Floats) -> Evaluation:
    """Evaluate in a worker, whose simulator stays as long as the calibration is the same."""
    if key not in _evaluator_here:
        for old in _evaluator_here.values():
            old.simulator.close()
        _evaluator_here.clear()
        _evaluator_here[key] = evaluator
    return _evaluator_here[key].evaluate(index, point)
