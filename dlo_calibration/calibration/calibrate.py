# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""calibrate(): the only loop, from trials to a parameter set."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from dataclasses import replace
from functools import partial
import time
from typing import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.calibration.result import (
    CalibrationResult,
    estimates,
    ParameterEstimate,
    simulated_chains,
)
from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator, Everywhere
from dlo_calibration.inference.advice import advise
from dlo_calibration.inference.confirmation import Confirmation, disagreements
from dlo_calibration.inference.examination import Examination, examine
from dlo_calibration.inference.missing_parameters import explanations
from dlo_calibration.inference.uncertainty import (
    MODEL_ERROR,
    spread_of_best,
)
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import NO_NOISE, noise, smooth
from dlo_calibration.search import Observation, Search
from dlo_calibration.search.huber import Huber
from dlo_calibration.simulation.protocol import Simulator

PAPER_EVALUATIONS = 150
STOPPED = 'stopped on request'
UNLIKELY = 2.71  # chi-square, one degree of freedom, that 10 % exceed
FURTHEST = 0.1  # that excited parameters follow those that are set to their default, in the unit cube
STARTS = 16  # initial chains that are simulated with other noise, over all trials


def calibrate(trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator, search: Search, *,
              budget: int = PAPER_EVALUATIONS,
              on_evaluation: Callable[[Evaluation], None] | None = None,
              should_stop: Callable[[], bool] = lambda: False,
              executor: Executor | None = None,
              clock: Callable[[], float] = time.monotonic,
              seed: int | None = None, thorough: bool = True) -> CalibrationResult:
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
    :param thorough: False: the result is to be compared with others only, see `examined`.
    :raises InputError: where there is nothing to calibrate on.
    :raises SimulationError: where no evaluation could be simulated.
    """
    if not trials:
        raise InputError('calibration', 'no trials', 'at least one complete trial',
                         'record an initial chain, an action and a goal chain first')
    started = clock()

    everywhere = partial(Everywhere, should_stop=should_stop, executor=executor)
    evaluate = everywhere(Evaluator(trials, space, simulator))
    kept, best, stopped = _searched(evaluate, search, budget, on_evaluation)
    if best is None or not best.scores:
        raise SimulationError('stopped before the first evaluation had finished' if best is None else
                              f'none of {len(kept)} evaluations could be simulated: {best.failure}')
    examination = None
    if not stopped:
        try:
            examination, best = _examined(evaluate, everywhere, best, thorough)
        except CancelledError:
            stopped = True
    reason = STOPPED if stopped else \
        search.stop_reason or f'budget of {budget} evaluations spent'
    return CalibrationResult(
        space=space, parameters=_estimates_of(space, best, kept, examination), best=best,
        trials=tuple(trials), chains=simulated_chains(trials, best), evaluations=tuple(kept),
        seconds=clock() - started,
        search=search.name, engine=simulator.name, stop_reason=reason, seed=seed,
        warnings=_warnings(best, kept), examination=examination)


def examined(result: CalibrationResult, simulator: Simulator, *,
             should_stop: Callable[[], bool] = lambda: False,
             executor: Executor | None = None,
             clock: Callable[[], float] = time.monotonic) -> CalibrationResult:
    """
    Return a result that was not examined thoroughly with all that is around it.

    If stopped, with nothing of that but the spread of its evaluations.
    """
    begun, before = clock(), result.examination
    everywhere = partial(Everywhere, should_stop=should_stop, executor=executor)
    try:
        examination, best = _examined(everywhere(Evaluator(result.trials, result.space, simulator)),
                                      everywhere, result.best, thorough=True)
    except CancelledError:
        return replace(result, examination=None, stop_reason=STOPPED, parameters=_estimates_of(
            result.space, result.best, result.evaluations, None))
    count = examination.evaluations + (before.evaluations if before else 0)
    examination = replace(examination, evaluations=count)
    return replace(
        result, best=best, chains=simulated_chains(result.trials, best), examination=examination,
        parameters=_estimates_of(result.space, best, result.evaluations, examination),
        seconds=result.seconds + clock() - begun)


def _estimates_of(space: ParameterSpace, best: Evaluation, evaluations: Sequence[Evaluation],
                  examination: Examination | None) -> dict[str, ParameterEstimate]:
    """Return the parameters with what the examination says, else with the spread of the good evaluations."""
    found = spread_of_best(evaluations, best.point)
    if examination is not None:
        found = examination.uncertainty if examination.regular else replace(
            found, excited=examination.uncertainty.excited)
    return estimates(space, best, found)


def _searched(evaluate: Everywhere, search: Search, budget: int,
              on_evaluation: Callable[[Evaluation], None] | None
              ) -> tuple[list[Evaluation], Evaluation | None, bool]:
    """Return all evaluations of a search, the one it calls the best, and whether it was stopped."""
    kept: list[Evaluation] = []
    best: Evaluation | None = None
    stopped = False
    while len(kept) < budget and not stopped:
        points = search.ask(budget - len(kept))
        if not len(points):
            break
        batch: list[Evaluation] = []
        for evaluation in evaluate(points, len(kept)):
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


def _examined(evaluate: Everywhere, everywhere: Callable[[Evaluator], Everywhere],
              best: Evaluation, thorough: bool) -> tuple[Examination, Evaluation]:
    """
    Return what is around the best evaluation, and that evaluation as it is reported.

    A parameter that no trial tells anything about gets its default, not what it had by chance,
    unless the trials refute the default.

    :raises CancelledError: when stopped.
    """
    evaluator = evaluate.evaluator
    trials, space, simulator = evaluator.trials, evaluator.space, evaluator.simulator
    assert best.residuals is not None
    default, sigma = space.default_point(), noise(trials)
    finer = simulator.refined() if thorough else None
    noisy = thorough and sigma > NO_NOISE and 'length_scale' not in space.free
    try:
        examination = examine(
            best.point, best.residuals, [(len(trial.goals), len(trial.initial)) for trial in trials],
            evaluate.residuals, default=default, noise=sigma,
            finer=None if finer is None else everywhere(Evaluator(trials, space, finer)).residuals,
            starts=[everywhere(Evaluator(others, space, simulator)).residuals
                    for others in _other_starts(trials, sigma)] if noisy else [], thorough=thorough)
    finally:
        if finer is not None:
            finer.close()
    excited = examination.uncertainty.excited
    point = np.where(excited, best.point, default)
    if np.array_equal(point, best.point):
        return examination, best
    points = np.stack([point, _moved_along(point, best, examination.jacobian, excited)])
    seen = list(evaluate(points, best.index))
    if len(seen) < len(points):
        raise CancelledError
    loss = Huber.of(best.residuals)
    again = replace(min(seen, key=lambda one: loss.cost(one.residuals)), index=best.index)
    examination = replace(examination, evaluations=examination.evaluations + len(points))
    found = examination.uncertainty
    # The cost is half the sum of squares.
    worse = 2 * (loss.cost(again.residuals) - loss.cost(best.residuals)) / found.scale**2
    if worse > UNLIKELY * int((point != best.point).sum()):  # what was found stays, unknown as it is
        found = replace(found, excited=excited | (point != best.point))
        return replace(examination, uncertainty=found), best
    return examination, again


def _moved_along(point: Floats, best: Evaluation, jacobian: Floats, excited: NDArray[np.bool_]) -> Floats:
    """Return the (d,) point where the excited parameters have followed the others, by a Gauss-Newton step."""
    assert best.residuals is not None
    roots = Huber.of(best.residuals).roots(best.residuals)
    after = roots * (best.residuals + jacobian @ (point - best.point))
    step = np.linalg.lstsq(roots[:, None] * jacobian[:, excited], -after, rcond=None)[0]
    moved = np.array(point)
    moved[excited] = np.clip(point[excited] + np.clip(step, -FURTHEST, FURTHEST), 0.0, 1.0)
    return moved


def _other_starts(trials: Sequence[Trial], sigma: float) -> list[list[Trial]]:
    """
    Return copies of the trials whose initial chains have other noise, a few if there are many trials.

    It is drawn anew onto the smoothed chains (a parametric bootstrap: Efron and Tibshirani, An
    Introduction to the Bootstrap, 1993, 6.5); the same draws each time.

    :param sigma: standard deviation of a coordinate [m].
    """
    generator = np.random.default_rng(0)

    def drawn(initial: Chain) -> Chain:
        points = smooth(initial.points, sigma)
        return replace(initial, points=points + generator.normal(0, sigma, points.shape))

    return [[replace(trial, initial=drawn(trial.initial)) for trial in trials]
            for _ in range(-(-STARTS // len(trials)))]


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


def explained(result: CalibrationResult, simulator: Simulator,
              should_stop: Callable[[], bool] = lambda: False,
              clock: Callable[[], float] = time.monotonic) -> CalibrationResult:
    """
    Return a result with what more of the object would explain, where it leaves more than noise.

    Each parameter that was held fixed is simulated once for that, which counts in `seconds` only.
    """
    found, best = result.examination, result.best
    if found is None or not found.regular or best.residuals is None or (
            found.uncertainty.residual < MODEL_ERROR * found.noise):
        return result
    begun = clock()
    try:
        words = explanations(result.trials, result.space, simulator, best.point, best.residuals,
                             found.jacobian, should_stop)
    except CancelledError:
        return result
    return replace(result, explanations=words, seconds=result.seconds + clock() - begun)


def _warnings(best: Evaluation, kept: Sequence[Evaluation]) -> tuple[str, ...]:
    warnings = []
    if best.unsettled:
        warnings.append(f'never came to rest: {", ".join(best.unsettled)}; compared as it was at the limit')
    failed = [evaluation for evaluation in kept if evaluation.failure]
    if failed:
        warnings.append(f'{len(failed)} of {len(kept)} evaluations could not be simulated: '
                        f'{failed[0].failure}')
    return tuple(warnings)
