# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The stages after the fit: advice, missing parameters, confirmation. None of them changes what was found."""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
import time
from typing import Callable, Iterator, Sequence

import numpy as np

from dlo_calibration.calibration.engines import NoPyBullet, SimulatorFactory
from dlo_calibration.calibration.options import AUTO, CONFIRMING, Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import DloCalibrationError, SimulationError
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.memory import Memory
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.evaluation.process_simulator import ProcessSimulator
from dlo_calibration.evaluation.residuals import compared_rows
from dlo_calibration.inference.advice import advise
from dlo_calibration.inference.confirmation import Confirmation, disagreements
from dlo_calibration.inference.missing_parameters import missing_parameters
from dlo_calibration.inference.slices import simulate_slices, Slices
from dlo_calibration.simulation.protocol import Rollout, Simulator

STOPPED_PATIENCE = 5.0  # s that a confirmation may take after a request to stop, which users wait for

#: Adds the confirmation by a second engine to a result.
Confirm = Callable[[CalibrationResult], CalibrationResult]


def advised(setting: Setting, result: CalibrationResult) -> CalibrationResult:
    """Return a result with the action to observe next, if its covariance is valid."""
    if result.examination is None or not result.examination.regular:
        return result
    try:
        return replace(result, advice=advise(
            result.trials, result.space, setting.pool, result.best.point,
            result.examination.uncertainty, result.length))
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


@contextmanager
def second_engine(options: Options, make_simulator: SimulatorFactory, first: str
                  ) -> Iterator[Simulator | Exception | None]:
    """
    Make the engine that confirms the result; its process starts while others search.

    :param first: name of the engine that is used; it does not confirm itself.
    :return: None if `options` name an engine (not auto); why there is none, if it cannot be made.
    """
    simulator: Simulator | Exception | None = None
    if options.engine == AUTO and first != CONFIRMING:
        try:
            simulator = make_simulator(replace(options, engine=CONFIRMING))
        except Exception as error:
            simulator = error
    if simulator is None or isinstance(simulator, Exception):
        yield simulator
        return
    with closing(simulator):
        if isinstance(simulator, ProcessSimulator):
            simulator.start()
        yield simulator


@contextmanager
def confirming(result: CalibrationResult, second: Simulator | Exception | None,
               should_stop: Callable[[], bool] = lambda: False, memory: Memory | None = None
               ) -> Iterator[Confirm]:
    """
    Simulate the best parameter set with the second engine beside this block.

    This costs one evaluation. If the engines disagree, or the second one fails, the result only gets a
    warning.

    :param second: see `second_engine`.
    :param memory: what was simulated before an interruption; None: nothing.
    :return: what waits for the second engine; other stages may add to the result before.
    """
    begun = time.monotonic()

    def late() -> bool:
        return should_stop() and time.monotonic() - begun > STOPPED_PATIENCE

    if second is None or isinstance(second, Exception):
        yield _as_it_is if second is None else partial(_unconfirmed, second)
    elif second.name == result.engine:
        yield _as_it_is
    else:
        evaluator = Evaluator(result.trials, result.space, second)
        with closing(Threads(1)) as thread:
            pool = Pool(second, thread, late, memory)
            try:
                yield partial(_confirmed, evaluator, pool.begin(evaluator.jobs(result.best.point)))
            finally:
                pool.stop()


def confirmed(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory
              ) -> CalibrationResult:
    """Return a result with the confirmation by a second engine; see `confirming`."""
    with second_engine(options, make_simulator, result.engine) as second, \
            confirming(result, second) as confirm:
        return confirm(result)


def _as_it_is(result: CalibrationResult) -> CalibrationResult:
    return result


def _unconfirmed(error: Exception, result: CalibrationResult) -> CalibrationResult:
    """Return a result with a warning that says why no second engine confirmed it."""
    words = str(error) if isinstance(error, DloCalibrationError) else f'{type(error).__name__}: {error}'
    words = f'not confirmed by engine {CONFIRMING}: {" ".join(words.split())}'
    if isinstance(error, CancelledError):
        words = f'not confirmed by engine {CONFIRMING}: stopped on request'
    elif isinstance(error, NoPyBullet):
        words = 'PyBullet is not installed, so no second engine confirmed the result; pip install pybullet'
    return replace(result, warnings=(*result.warnings, words))


def _confirmed(evaluator: Evaluator, rollouts: Callable[[], Sequence[Rollout | SimulationError]],
               result: CalibrationResult) -> CalibrationResult:
    """Return a result with what the second engine found; it is waited for."""
    best, engine = result.best, evaluator.simulator.name
    try:
        other = evaluator.evaluated(best.index, best.point, rollouts())
        if other.errors is None:
            raise SimulationError(other.failure)
    except Exception as error:
        return _unconfirmed(error, result)
    chains = simulated_chains(result.trials, other)
    apart = np.concatenate([np.linalg.norm(one - two, axis=2).ravel()
                            for one, two in zip(result.chains, chains, strict=True)])
    confirmation = Confirmation(engine, other.score, other.scores, other.errors,
                                float(apart.mean()), float(apart.max()))
    found = disagreements([trial.name for trial in result.trials], result.chains, chains, best.scores,
                          other.scores)
    warnings = result.warnings
    if found:
        warnings += f'engine {engine} disagrees with engine {result.engine}: {"; ".join(found)}',
    return replace(result, confirmation=confirmation, warnings=warnings)


def sliced(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
           should_stop: Callable[[], bool] = lambda: False) -> Slices | None:
    """
    Simulate slices around a result, on as many threads as `options` say; None if the engine fails.

    The time for them is limited, so that they may be coarse: see `slices.simulate_slices`.
    """
    try:
        with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
            return simulate_slices(Evaluator(result.trials, result.space, simulator), result.best, result.std,
                                   result.examination, executor=threads, should_stop=should_stop)
    except Exception:  # the page is written even if the engine fails
        return None
