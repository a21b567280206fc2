# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The stages after the fit: advice, missing parameters, confirmation. None of them changes what was found."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from contextlib import closing, ExitStack
from dataclasses import replace
import time
from typing import Callable

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import AUTO, CONFIRMING, Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import DloCalibrationError, SimulationError
from dlo_calibration.evaluation.ahead import SimulatedAhead
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.memory import Memory
from dlo_calibration.evaluation.processes import cores, ProcessExecutor
from dlo_calibration.evaluation.residuals import compared_rows
from dlo_calibration.inference.advice import advise
from dlo_calibration.inference.confirmation import Confirmation, disagreements
from dlo_calibration.inference.missing_parameters import missing_parameters
from dlo_calibration.inference.slices import simulate_slices, Slices
from dlo_calibration.simulation.protocol import Simulator

STOPPED_PATIENCE = 5.0  # s that a confirmation may take after a request to stop, which users wait for


def advised(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """Return a result with the action to observe next, if its covariance is valid."""
    if result.examination is None or not result.examination.regular:
        return result
    try:
        return replace(result, advice=advise(
            result.trials, result.space, setting.own_simulator, result.best.point,
            result.examination.uncertainty, result.length, setting.should_stop))
    except CancelledError:
        return result


def with_missing_parameters(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """
    Return a result with the fixed parameters that would explain part of its residuals.

    Each of them is simulated once, and only if noise alone does not explain the residuals.
    """
    found, best = result.examination, result.best
    if found is None or not found.regular or best.residuals is None or found.noise_alone:
        return result
    rows = compared_rows(result.trials)
    try:
        return replace(result, missing_parameters=missing_parameters(
            result.space, setting.evaluate, Linearisation(
                best.point, best.residuals if rows is None else best.residuals[rows], found.jacobian),
            parts=not setting.chooses_parts))
    except CancelledError:
        return result


def confirming(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
               executor: Executor | None) -> SimulatedAhead | None:
    """
    Begin to simulate what `confirmed` needs, while other stages keep only this thread busy.

    :param executor: processes on this machine; None: nothing is begun.
    :return: None if nothing is begun; `confirmed` then simulates, or says why it cannot.
    """
    if executor is None or options.engine != AUTO or result.engine == CONFIRMING:
        return None
    try:
        simulator = make_simulator(replace(options, engine=CONFIRMING))
        if simulator.name == result.engine:
            simulator.close()
            return None
        return SimulatedAhead(simulator, executor, result.trials,
                              result.space.physical(result.best.values, result.length))
    except Exception:
        return None


def confirmed(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
              should_stop: Callable[[], bool] = lambda: False, memory: Memory | None = None,
              ahead: SimulatedAhead | None = None) -> CalibrationResult:
    """
    Return a result with the confirmation by a second engine, if `options` name none (auto).

    This costs one evaluation. If the engines disagree, or the second one fails, the result only gets a
    warning.

    :param memory: what was simulated before an interruption; None: nothing.
    :param ahead: the second engine, already under way (`confirming`); None: it is made, and simulates here.
    """
    if options.engine != AUTO or result.engine == CONFIRMING:
        return result
    begun = time.monotonic()

    def late() -> bool:
        return should_stop() and time.monotonic() - begun > STOPPED_PATIENCE

    try:
        with closing(ahead or make_simulator(replace(options, engine=CONFIRMING))) as simulator:
            if simulator.name == result.engine:
                return result
            return _confirmed(result, (memory or Memory()).simulator(simulator), late)
    except CancelledError:
        words = 'stopped on request'
    except DloCalibrationError as error:
        words = str(error)
    except Exception as error:
        words = ' '.join(f'{type(error).__name__}: {error}'.split())
    return replace(result, warnings=(*result.warnings, f'not confirmed by engine {CONFIRMING}: {words}'))


def _confirmed(result: CalibrationResult, simulator: Simulator,
               should_stop: Callable[[], bool]) -> CalibrationResult:
    best = result.best
    other = Evaluator(result.trials, result.space, simulator).evaluate(best.index, best.point, should_stop)
    if other.errors is None:
        raise SimulationError(other.failure)
    chains = simulated_chains(result.trials, other)
    apart = np.concatenate([np.linalg.norm(one - two, axis=2).ravel()
                            for one, two in zip(result.chains, chains, strict=True)])
    confirmation = Confirmation(simulator.name, other.score, other.scores, other.errors,
                                float(apart.mean()), float(apart.max()))
    found = disagreements([trial.name for trial in result.trials], result.chains, chains, best.scores,
                          other.scores)
    warnings = result.warnings
    if found:
        warnings += f'engine {simulator.name} disagrees with engine {result.engine}: {"; ".join(found)}',
    return replace(result, confirmation=confirmation, warnings=warnings)


def sliced(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
           should_stop: Callable[[], bool] = lambda: False) -> Slices | None:
    """
    Simulate slices around a result, in as many processes as `options` say; None if the engine fails.

    The time for them is limited, so that they may be coarse: see `slices.simulate_slices`.
    """
    try:
        with ExitStack() as stack:
            simulator = stack.enter_context(closing(make_simulator(options)))
            workers, executor = options.workers or cores(), None
            if workers > 1:
                executor = stack.enter_context(closing(
                    ProcessExecutor(workers, answer_limit=options.answer_limit)))
            return simulate_slices(Evaluator(result.trials, result.space, simulator), result.best, result.std,
                                   result.examination, executor=executor, should_stop=should_stop)
    except Exception:  # the page is written even if the engine fails
        return None
