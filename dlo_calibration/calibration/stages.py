# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The stages after the search: examination, advice, missing parameters, confirmation by a second engine."""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, ExitStack
from dataclasses import replace
from functools import partial
import time
from typing import Callable, Iterator, Sequence

import numpy as np

from dlo_calibration.calibration.choice import budget
from dlo_calibration.calibration.engines import NoPyBullet, SimulatorFactory
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.options import AUTO, CONFIRMING, Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains, trial_errors
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import one_line, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.log import Memory
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.evaluation.process_simulator import ProcessSimulator
from dlo_calibration.evaluation.residuals import compared_rows, Huber, ResidualLayout
from dlo_calibration.inference.advice import advise
from dlo_calibration.inference.examination import (
    AMONG_OBSTACLES,
    Confirmation,
    disagreements,
    Examination,
    examine,
)
from dlo_calibration.inference.missing_parameters import missing_parameters
from dlo_calibration.inference.outlier import candidate, is_outlier, Outlier, spread_without
from dlo_calibration.inference.slices import simulate_slices, Slices
from dlo_calibration.inference.uncertainty import DEVIATIONS, Uncertainty
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, owner, ParameterSpace, REST_STATE
from dlo_calibration.model.score import observed
from dlo_calibration.observation.noise import NO_NOISE, noise, with_other_noise
from dlo_calibration.observation.slow_errors import with_slow_errors
from dlo_calibration.search import Hints, LeastSquares
from dlo_calibration.simulation.protocol import Rollout, Simulator

CHAINS = 32  # initial chains with other noise, over all trials
STOPPED_PATIENCE = 5.0  # s that a confirmation may take after a request to stop

#: Adds the confirmation by a second engine to a result.
Confirm = Callable[[CalibrationResult], CalibrationResult]


def examined(setting: Setting, fit: Fit, *, discretised: bool = True) -> Fit:
    """
    Return a fit with the examination around its best evaluation, and with the evaluation to report.

    A parameter that no trial excites gets its default instead of a random value, unless the fit becomes
    significantly worse. If the user stops, there is no examination.

    :param discretised: whether the uncertainty contains the error of nodes and time step.
    """
    if fit.stopped:
        return replace(fit, examination=None)
    try:
        examination, best = _examined(setting, fit, discretised)
    except CancelledError:
        return replace(fit, examination=None, stopped=True)
    count = examination.evaluations + fit.validated
    return replace(fit, best=best, validated=0, examination=replace(examination, evaluations=count))


def _examined(setting: Setting, fit: Fit, discretised: bool) -> tuple[Examination, Evaluation]:
    """
    Return the examination, and the evaluation to report as the best.

    :raises CancelledError: when stopped.
    """
    trials, space, best = setting.trials, fit.space, fit.best
    assert best.residuals is not None
    default, sigma = space.default_point(), noise(trials)
    finer = setting.pool.refined() if discretised else None
    noisy = sigma > NO_NOISE and 'length_scale' not in space.free
    evaluate = setting.evaluate(space)
    drawn = with_other_noise(
        trials, sigma, -(-CHAINS // len(trials)), np.random.default_rng(0)) if noisy else []
    here = best.point[None, :]
    try:
        # These begin first: they need no later outcome, and occupy threads that would be idle.
        fine = None if finer is None else setting.evaluate(space, finer=finer).begin(here)
        restarts = [setting.evaluate(space, others) for others in drawn]
        starts = [restart.begin(here) for restart in restarts]
        hands = [setting.evaluate(_with_hand(space, setting, name)).begin(here)
                 for name in setting.choice.corrected]
        slow = [setting.evaluate(space, others).begin(here) for others in with_slow_errors(
            trials, setting.options.slow_chain_error, setting.options.slow_hand_error)]
        examination = examine(
            best.point, best.residuals, ResidualLayout.compared(trials), evaluate.residuals,
            default=default, noise=sigma, finer=fine, starts=starts, hands=hands, slow=slow,
            restarted=[restart.residuals for restart in restarts],
            fading=np.array([owner(name)[0] not in REST_STATE for name in space.free]), upper=space.upper)
    finally:
        if finer is not None:
            finer.simulator.close()
    uncertainty, jacobian = _with_rivals(examination.uncertainty, fit), examination.jacobian
    point, again = np.where(uncertainty.excited, best.point, default), best
    if not np.array_equal(point, best.point):
        model = Linearisation(best.point, best.residuals, jacobian, space.upper).at(point)
        step = np.clip(_step(model, uncertainty), -0.1, 0.1)
        points = np.stack([point, np.clip(point + step, 0.0, space.upper)])
        seen = list(evaluate(points, best.index))
        if len(seen) < len(points):
            raise CancelledError
        loss = Huber.of(best.residuals)
        again = replace(min(seen, key=lambda evaluation: loss.cost(evaluation.residuals)), index=best.index)
        examination = replace(examination, evaluations=examination.evaluations + len(points))
        # The cost is half the sum of squares; 10 % exceed a chi-square of 2.71 with one degree of freedom.
        worse = 2 * (loss.cost(again.residuals) - loss.cost(best.residuals)) / uncertainty.scale**2
        if worse > 2.71 * int((point != best.point).sum()):  # the defaults fit worse: keep the best values
            again = best
            uncertainty = replace(uncertainty, excited=uncertainty.excited | (point != best.point))
    assert again.residuals is not None
    remaining = _step(Linearisation(again.point, again.residuals, jacobian, space.upper),
                      examination.uncertainty)
    return replace(examination, uncertainty=uncertainty.at(best.point, again.point, remaining)), again


def _with_rivals(uncertainty: Uncertainty, fit: Fit) -> Uncertainty:
    """
    Return the uncertainty whose intervals contain every simulated point that fits as well as the best one.

    Where a valley has several minima, the linear model knows the best one alone.  A point whose cost exceeds
    the lowest by less than the chi-square of an interval lies in the intervals of the profile likelihood
    (Venzon and Moolgavkar, A Method for Computing Profile-Likelihood-Based Confidence Intervals, 1988).
    """
    assert fit.best.residuals is not None
    loss = Huber.of(fit.best.residuals)
    most = loss.cost(fit.best.residuals) + DEVIATIONS**2 / 2 * uncertainty.scale**2
    points = np.array([fit.best.point, *(
        rival.point for rival in fit.rivals if loss.cost(rival.residuals) < most)])
    points = np.where(uncertainty.excited, points, fit.best.point)
    return uncertainty.within(np.minimum(uncertainty.lower, points.min(axis=0)),
                              np.maximum(uncertainty.upper, points.max(axis=0)))


def _with_hand(space: ParameterSpace, setting: Setting, name: str) -> ParameterSpace:
    """Return the space in which an error of the hands is larger by its standard deviation."""
    other = getattr(setting.options, name) + setting.evidence.deviations[name]
    return replace(space, fixed={**space.fixed, name: BY_NAME[name].value(other)})


def _step(fit: Linearisation, uncertainty: Uncertainty) -> Floats:
    """Return the (d,) Gauss-Newton step of the excited parameters, within the box."""
    step = np.zeros(len(fit.point))
    free = fit.columns(uncertainty.excited).weighted(Huber.of(fit.residuals).roots(fit.residuals))
    step[uncertainty.excited] = free.step(np.eye(len(free.point)) * uncertainty.residual**2)
    return np.asarray(np.clip(fit.point + step, 0.0, fit.upper) - fit.point)


def with_outlier(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """Return a result with the trial that does not fit the others, if there is one: see `outlier`."""
    trials, space, point = setting.trials, result.space, result.best.point
    k = candidate(np.array([errors.mean() for errors in result.trial_errors]))
    if k is None or result.examination is None:
        return result
    others = replace(setting, trials=(*trials[:k], *trials[k + 1:]), on_evaluation=lambda _: None)
    # A DLO with knots or parts was found from coarser ones; its search begins only where that ended.
    fine = space.knots > 0 or space.parts > 1
    search = LeastSquares(space.dimension, setting.options.seed, Hints(
        point, result.examination.uncertainty.excited, refines=fine, coarse=fine, upper=space.upper))
    try:
        without = fit(others, space, search, budget(space.dimension)).best
        evaluation = setting.simulated(space, without)
    except (CancelledError, SimulationError):
        return result
    errors = np.array([errors.mean() for errors in trial_errors(trials, evaluation)])
    if not is_outlier(k, errors):
        return result
    values = space.values(without.point)
    decided = tuple(name for name, value in values.items() if result.estimates[name].identifiable
                    and not result.estimates[name].lower <= value <= result.estimates[name].upper)
    apart = np.linalg.norm(simulated_chains(trials, evaluation)[k] - observed(trials[k])[:, ::-1], axis=2)
    assert without.residuals is not None
    outlier = Outlier(
        trials[k].name, k + 1, float(errors[k]), float(np.delete(errors, k).mean()), values,
        turned=bool(np.nanmean(apart) < 0.5 * errors[k]), decided=decided,
        spread=spread_without(k, ResidualLayout.compared(trials), without.point, without.residuals,
                              result.examination.jacobian, result.examination.noise))
    if outlier.sensitive and result.examination.regular:
        result = result.including(without.point)
    return replace(result, outlier=outlier)


def advised(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """Return a result with the action to observe next, if its covariance is valid."""
    if result.examination is None or not result.examination.regular:
        return result
    try:
        return replace(result, advice=advise(
            result.trials, result.space, setting.pool, result.best.point, result.examination.uncertainty,
            result.length, result.examination.noise))
    except CancelledError:
        return result


def with_missing_parameters(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """
    Return a result with the fixed parameters that would explain part of its residuals.

    Each of them is simulated once, and only if noise alone does not explain the residuals.
    """
    examination, best = result.examination, result.best
    if examination is None or not examination.regular or best.residuals is None or examination.noise_alone:
        return result
    rows = compared_rows(result.trials)
    try:
        return replace(result, missing_parameters=missing_parameters(
            result.space, setting.evaluate, Linearisation(
                best.point, best.residuals if rows is None else best.residuals[rows], examination.jacobian),
            parts=not setting.chooses_parts))
    except CancelledError:
        return result


@contextmanager
def second_engine(options: Options, make_simulator: SimulatorFactory, first: str
                  ) -> Iterator[Simulator | Exception | None]:
    """
    Make the engine that confirms the result; its process starts during the search.

    :param first: name of the engine that searches; it does not confirm itself.
    :return: None if no confirmation is wanted; an exception if the engine cannot be made.
    """
    simulator: Simulator | Exception | None = None
    with ExitStack() as stack:
        if options.engine == AUTO and first != CONFIRMING:
            try:
                simulator = stack.enter_context(closing(make_simulator(replace(options, engine=CONFIRMING))))
            except Exception as error:
                simulator = error
        if isinstance(simulator, ProcessSimulator):
            simulator.start()
        yield simulator


@contextmanager
def confirming(result: CalibrationResult, second: Simulator | Exception | None,
               should_stop: Callable[[], bool] = lambda: False, memory: Memory | None = None,
               obstacles: bool = False) -> Iterator[Confirm]:
    """
    Simulate the best parameter set with the second engine while this block executes.

    This costs one evaluation. If the engines disagree or the second one fails, the result gets a warning.

    :param second: see `second_engine`.
    :param memory: what was simulated before an interruption; None: nothing.
    :param obstacles: whether there are any; then the engines may differ by more.
    :return: adds the confirmation to a result; it waits for the second engine.
    """
    begun = time.monotonic()

    def late() -> bool:
        return should_stop() and time.monotonic() - begun > STOPPED_PATIENCE

    if isinstance(second, Exception):
        yield partial(_unconfirmed, second)
    elif second is None or second.name == result.engine:
        yield lambda unconfirmed: unconfirmed
    else:
        evaluator = Evaluator(result.trials, result.space, second)
        with closing(Threads(1)) as threads:  # one process: each takes 50 MB
            pool = Pool(second, threads, late, memory)
            try:
                yield partial(_confirmed, evaluator, pool.begin(evaluator.jobs(result.best.point)),
                              AMONG_OBSTACLES if obstacles else 1.0)
            finally:
                pool.stop()


def confirmed(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory
              ) -> CalibrationResult:
    """Return a result with the confirmation by a second engine; see `confirming`."""
    with second_engine(options, make_simulator, result.engine) as second, \
            confirming(result, second, obstacles=bool(options.scene)) as confirm:
        return confirm(result)


def _unconfirmed(error: Exception, result: CalibrationResult) -> CalibrationResult:
    """Return a result with a warning that says why no second engine confirmed it."""
    words = f'not confirmed by engine {CONFIRMING}: {one_line(error)}'
    if isinstance(error, CancelledError):
        words = f'not confirmed by engine {CONFIRMING}: stopped on request'
    elif isinstance(error, NoPyBullet):
        words = 'PyBullet is not installed, so no second engine confirmed the result; pip install pybullet'
    return replace(result, warnings=(*result.warnings, words))


def _confirmed(evaluator: Evaluator, rollouts: Callable[[], Sequence[Rollout | SimulationError]],
               tolerance: float, result: CalibrationResult) -> CalibrationResult:
    """Wait for the second engine, and return a result with its confirmation."""
    best, engine = result.best, evaluator.simulator.name
    try:
        other = evaluator.evaluated(best.index, best.point, rollouts())
        if other.errors is None:
            raise SimulationError(other.failure)
    except Exception as error:
        return _unconfirmed(error, result)
    chains = simulated_chains(result.trials, other)
    distances = np.concatenate([np.linalg.norm(first - second, axis=2).ravel()
                            for first, second in zip(result.chains, chains, strict=True)])
    confirmation = Confirmation(engine, other.score, other.scores, other.errors,
                                float(distances.mean()), float(distances.max()))
    differences = disagreements([trial.name for trial in result.trials], result.chains, chains,
                                best.scores, other.scores, tolerance)
    warnings = result.warnings
    if differences:
        warnings += f'engine {engine} disagrees with engine {result.engine}: {"; ".join(differences)}',
    return replace(result, confirmation=confirmation, warnings=warnings)


def sliced(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
           should_stop: Callable[[], bool] = lambda: False) -> Slices | None:
    """
    Simulate slices around a result; return None if the engine fails.

    Their time is limited, so they may be coarse: see `slices.simulate_slices`.
    """
    try:
        with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
            return simulate_slices(Evaluator(result.trials, result.space, simulator), result.best, result.std,
                                   result.examination, executor=threads, should_stop=should_stop)
    except Exception:  # the page is written even if the engine fails
        return None
