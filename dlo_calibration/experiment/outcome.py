# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Outcome: the parameters that a calibration finds, and how well they explain the trials that judge it."""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass, replace
import time
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.experiment.study import Observed, Task
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.rest_lengths import with_shared_places


@dataclass(frozen=True)
class Judgement:
    """
    How well the found parameters explain a trial that was not calibrated on.

    :param score: difference score [cm]; None if the trial could not be simulated.
    :param error: mean point error [m]; None likewise.
    :param share: mean point error [% of the DLO's length]; None likewise.
    """

    trial: str
    score: float | None
    error: float | None
    share: float | None


@dataclass(frozen=True)
class Outcome:
    """
    What one calibration found.

    :param values: of the parameters, 0..100; empty if it failed.
    :param excited: names of the parameters that the trials inform about; the others keep their default.
    :param score: average difference score of the trials calibrated on [cm].
    :param error: mean point error of the same trials [m].
    :param evaluations: number of evaluations of the search.
    :param simulations: number of rollouts in all.
    :param seconds: its duration on one thread [s].
    :param judgements: one for each trial that judges it.
    :param failure: why it failed; empty if it did not.
    """

    values: Mapping[str, float]
    excited: tuple[str, ...] = ()
    score: float | None = None
    error: float | None = None
    evaluations: int = 0
    simulations: int = 0
    seconds: float = 0.0
    judgements: tuple[Judgement, ...] = ()
    failure: str = ''

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Outcome:
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        return cls(**{**entry, 'excited': tuple(entry['excited']), 'values': dict(entry['values']),
                      'judgements': tuple(Judgement(**one) for one in entry['judgements'])})


def perform(task: Task, make_simulator: SimulatorFactory,
            should_stop: Callable[[], bool] = lambda: False) -> Outcome:
    """
    Calibrate once, on one thread, and judge the parameters found.

    :raises CancelledError: if stopped.
    """
    options, trials, begun = task.options, task.trials, time.monotonic()
    with closing(make_simulator(options)) as simulator:
        try:
            result = fitted(Setting(trials, options, simulator, should_stop=should_stop))
        except SimulationError as error:
            if should_stop():
                raise CancelledError from error
            return Outcome({}, failure=str(error))
    if should_stop():
        raise CancelledError
    examined = result.examination
    excited = result.space.free if examined is None else tuple(
        name for name, there in zip(result.space.free, examined.uncertainty.excited, strict=True) if there)
    return Outcome(
        values=result.values, excited=excited, score=result.best.score, error=result.errors.mean,
        evaluations=len(result.evaluations), simulations=result.simulations, seconds=time.monotonic() - begun,
        judgements=_judgements(task.judges, result, make_simulator))


def judged_chains(task: Task, outcome: Outcome, make_simulator: SimulatorFactory
                  ) -> list[tuple[Trial, Floats]]:
    """Return the trials that judge a task, each with its simulated chains at the goals, (g, n, 3) [m]."""
    judges, found = task.judges, []
    space = replace(task.options.space, free=tuple(outcome.values))  # with the parts that the search found
    with closing(make_simulator(judges.options)) as simulator:
        for trial in with_shared_places(judges.trials):
            physical = space.physical(outcome.values, trial.initial.length)
            try:
                found.append((trial, simulator.simulate(trial, physical).chains))
            except SimulationError:
                continue
    return found


def _judgements(judges: Observed, result: CalibrationResult,
                make_simulator: SimulatorFactory) -> tuple[Judgement, ...]:
    if not judges.trials:
        return ()
    found = []
    point = result.space.point(result.values)
    with closing(make_simulator(judges.options)) as simulator:
        for trial in with_shared_places(judges.trials):
            one = Evaluator([trial], result.space, simulator).evaluate(0, point)
            found.append(Judgement(trial.name, None, None, None) if one.errors is None else
                         Judgement(trial.name, one.score, one.errors.mean,
                                   100 * one.errors.mean / trial.initial.length))
    return tuple(found)
