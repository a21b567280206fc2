# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""calibrate(): from trials to a parameter set, stage by stage."""

from __future__ import annotations

from collections import Counter
from contextlib import closing, ExitStack
from dataclasses import replace
import time
from typing import Callable, Sequence

from dlo_calibration.calibration.choice import budget, VALLEYS
from dlo_calibration.calibration.engines import engine_digest, SimulatorFactory
from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.forces import weighed
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.refinement import refine
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.stages import (
    advised,
    confirming,
    examined,
    second_engine,
    with_missing_parameters,
    with_outlier,
)
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.cluster import ClusterExecutor
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.log import EvaluationLog, Memory
from dlo_calibration.evaluation.pool import Threads
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import noise
from dlo_calibration.observation.plausibility import implausible_trials, observation_warnings
from dlo_calibration.search import Hints, LeastSquares, SEARCHES

AGAIN = 10  # evaluations for each parameter that must be left for another search


def calibrate(trials: Sequence[Trial], options: Options | None = None, *,
              on_evaluation: Callable[[Evaluation], None] = lambda _: None,
              on_notice: Callable[[str], None] = lambda _: None,
              should_stop: Callable[[], bool] = lambda: False,
              make_simulator: SimulatorFactory = make_chosen_simulator,
              log: EvaluationLog | None = None,
              clock: Callable[[], float] = time.monotonic) -> CalibrationResult:
    """
    Find the parameter set whose simulation fits the trials best, and how certain each parameter is.

    The body of this function lists the stages in their order. The same trials, options and seed give the same
    result, bit for bit, for any number of threads. Node, command line and page call this function, too.

    :param options: see `Options`; None: the defaults.
    :param on_evaluation: called with each finished evaluation of the search, in the order asked.
    :param on_notice: called at once, from any thread, with a warning about a failure that does not end the
        calibration, such as a lost machine; `CalibrationResult.warnings` contains it, too.
    :param should_stop: polled; once it returns True, every stage ends, and the result is the best so far.
    :param make_simulator: makes the engine that `options` name; called in this thread.
    :param log: receives each finished evaluation, and answers those that it holds already: after an
        interruption, even by `kill -9`, the same call gives the same result, except for its `seconds`. None:
        nothing is logged.
    :param clock: the time [s], for `CalibrationResult.seconds`.
    :raises InputError: if there is no trial, or an option cannot be satisfied.
    :raises SimulationError: if no evaluation could be simulated.
    """
    if not trials:
        raise InputError('calibration', 'no trials', 'at least one complete trial',
                         'record an initial chain, an action and a goal chain first')
    begun, options = clock(), options or Options()
    warnings: list[str] = []

    def warn(text: str) -> None:
        warnings.append(text)
        on_notice(text)

    with ExitStack() as stack:
        simulator = stack.enter_context(closing(make_simulator(options)))
        second = stack.enter_context(second_engine(options, make_simulator, simulator.name))
        executor = stack.enter_context(closing(
            ClusterExecutor(options.scheduler, warn, on_notice) if options.scheduler else
            Threads(options.workers)))
        memory = Memory(log, engine_digest(options) if log is not None else '', on_notice)
        setting = Setting(tuple(trials), options, simulator, executor, should_stop, on_evaluation, memory)
        stack.callback(setting.pool.stop)
        result = fitted(setting)
        setting = setting.weighing_forces(result.trials[0].force_scale)
        result = with_outlier(setting, result)
        confirm = stack.enter_context(confirming(
            result, second, should_stop, memory, obstacles=bool(options.scene)))
        result = advised(setting, result)
        result = with_missing_parameters(setting, result)
        result = confirm(result)
    implausible = implausible_trials(trials, options.table_top, bool(options.scene))
    observed = () if implausible else observation_warnings(
        trials, options.table_top, options.mass, options.time_step)
    counted = (text if count == 1 else f'{text} ({count} times)' for text, count in Counter(warnings).items())
    return replace(result, choice=setting.choice, implausible=implausible, seconds=clock() - begun,
                   warnings=(*implausible, *observed, *setting.hand_warnings,
                             *filter(None, [result.outlier_words]), *result.warnings, *counted))


def fitted(setting: Setting) -> CalibrationResult:
    """
    Search, and examine the best parameter set: the stages that every result needs.

    :raises SimulationError: if no evaluation could be simulated.
    """
    prior = Prior.of(setting.trials, setting.options, setting.evidence)
    setting, best_fit = weighed(setting, searched(setting, prior))
    best_fit = examined(setting, best_fit)
    best_fit = replace(best_fit, best=setting.judged(best_fit.space, best_fit.best))
    return CalibrationResult.of(setting, prior, best_fit)


def searched(setting: Setting, prior: Prior) -> Fit:
    """
    Find the best parameter set with the chosen search, and the number of parts if that is open.

    Least squares goes on with an even DLO until it finds nothing clearly better: along the valley of the
    minimum, and from other start points while noise does not explain the residuals.

    :raises SimulationError: if no evaluation could be simulated.
    """
    options, space, refines = setting.options, prior.space, setting.chooses_parts
    search = SEARCHES[options.search](space.dimension, options.seed, prior.hints)
    if options.search != LeastSquares.name:
        return fit(setting, space, search, options.evaluations)
    most = budget(space.dimension) if refines else options.evaluations
    best = fit(setting, space, search, min(most, options.evaluations))
    while True:
        best, former = refine(setting, best, options.evaluations) if refines else best, best
        for go_on in (_along_valley, _other_search):
            if best.space == space and (other := go_on(setting, prior, best)) is not None:
                best = best.with_search(other)
        if best.space != space or not best.clearly_better(former):
            return best


def _along_valley(setting: Setting, prior: Prior, best: Fit) -> Fit | None:
    """Search along the valley of a minimum; None: no search is possible."""
    space, spent = best.space, len(best.evaluations)
    left = min(VALLEYS, setting.options.evaluations - spent)
    if best.stopped or setting.should_stop() or left <= 0 or best.model is None:
        return None
    hints = replace(Hints.at(best.best.point, best.model.jacobian, upper=space.upper), follows_valley=True)
    return _another(setting, space, hints, left, spent)


def _other_search(setting: Setting, prior: Prior, best: Fit) -> Fit | None:
    """Search from other start points; None: noise explains the residuals, or no search is possible."""
    options, space, spent = setting.options, best.space, len(best.evaluations)
    left = min(budget(space.dimension), options.evaluations - spent)
    if best.stopped or setting.should_stop() or left < AGAIN * space.dimension or \
            best.explained(noise(setting.trials)):
        return None
    return _another(setting, space, prior.hints, left, spent)


def _another(setting: Setting, space: ParameterSpace, hints: Hints, budget: int, spent: int) -> Fit | None:
    """Return a further search, after `spent` evaluations; None: it has no evaluation that was simulated."""
    search = LeastSquares(space.dimension, setting.options.seed + spent, hints)
    try:
        return fit(setting, space, search, budget, spent)
    except SimulationError:  # stopped at its first evaluation, or none can be simulated
        return None
