# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Evaluation: one parameter set tried on all trials, here or wherever an executor says.

A simulator lives in the process and the thread that uses it.
"""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
import copy
from dataclasses import dataclass, replace
import pickle
import threading
from typing import Callable, Iterator, Mapping, Sequence
import uuid
import weakref

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.score import PointErrors, residuals, TrialScore
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Rollout, Simulator


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
    :param skipped: number of trials that were not simulated any more, as one before them failed.
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
    def score(self) -> float:
        """Average difference score over the trials [cm]; infinite where it failed."""
        return float(np.mean(self.scores)) if self.scores else float('inf')


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

    def evaluate(self, index: int, point: Floats,
                 should_stop: Callable[[], bool] = lambda: False) -> Evaluation:
        """
        Try a (d,) point of the unit cube on every trial.

        :raises CancelledError: as soon as `should_stop` says so, between trials.
        """
        point = frozen_array(point)
        evaluation = Evaluation(index, point, self.space.values(point))
        physical = self.space.physical(evaluation.values, self._length)
        rollouts: list[Rollout] = []
        for trial in self.trials:
            if should_stop():
                raise CancelledError
            try:
                rollouts.append(self.simulator.simulate(trial, physical))
            except SimulationError as error:
                return replace(evaluation, failure=str(error), skipped=len(self.trials) - len(rollouts) - 1)
        evaluation = replace(
            evaluation, scores=tuple(float(score(rollout.chains))
                                     for score, rollout in zip(self._scores, rollouts, strict=True)),
            unsettled=tuple(trial.name for trial, rollout in zip(self.trials, rollouts, strict=True)
                            if not all(rollout.settled)))
        residual = np.concatenate([residuals(trial, rollout.chains)
                                   for trial, rollout in zip(self.trials, rollouts, strict=True)])
        return replace(evaluation, errors=PointErrors.of(residual), residuals=frozen_array(residual))


class Everywhere:
    """Evaluates points in order, wherever the executor says; ends early, without a word, when stopped."""

    def __init__(self, evaluator: Evaluator, should_stop: Callable[[], bool],
                 executor: Executor | None) -> None:
        self.evaluator = evaluator
        self._should_stop = should_stop
        self._executor = executor
        self._parcel = _Parcel(evaluator)
        self._key = uuid.uuid4().hex  # of this calibration, on whichever machines

    def __call__(self, points: Floats, first: int) -> Iterator[Evaluation]:
        """Evaluate (k, d) points, the first with the index `first`."""
        if self._executor is None:
            for k, point in enumerate(points):
                try:
                    yield self.evaluator.evaluate(first + k, point, self._should_stop)
                except CancelledError:
                    return
            return
        futures: list[Future[Evaluation]] = [
            self._executor.submit(_evaluate_elsewhere, self._key, self._parcel, first + k, point)
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


class _Parcel:
    """
    An evaluator on its way to workers.

    It is pickled once, and unpickled where it is opened: trials with thousands of
    chains take as long for that as to be simulated.
    """

    def __init__(self, evaluator: Evaluator | None, packed: bytes = b'') -> None:
        self._evaluator, self._packed = evaluator, packed

    def open(self) -> Evaluator:
        """Return the evaluator; here it is the same one, elsewhere a new one."""
        if self._evaluator is None:
            self._evaluator = pickle.loads(self._packed)  # noqa: S301  # from the process that began this one
        assert self._evaluator is not None
        return self._evaluator

    def __reduce__(self) -> tuple[type[_Parcel], tuple[None, bytes]]:
        self._packed = self._packed or pickle.dumps(self._evaluator, pickle.HIGHEST_PROTOCOL)
        return _Parcel, (None, self._packed)


class _Here(threading.local):
    """
    What a worker's thread keeps: the evaluator of the calibration under way.

    Its simulator is closed when another calibration begins, or the thread ends.
    """

    key = ''
    evaluator: Evaluator
    forget: Callable[[], object] = staticmethod(lambda: None)

    def of(self, key: str, parcel: _Parcel) -> Evaluator:
        if key != self.key:
            self.forget()
            self.key, self.evaluator = key, copy.copy(parcel.open())
            self.forget = weakref.finalize(self.evaluator, self.evaluator.simulator.close)
        return self.evaluator


_here = _Here()


def _evaluate_elsewhere(key: str, parcel: _Parcel, index: int, point: Floats) -> Evaluation:
    """Evaluate in a worker, with an evaluator that stays as long as the calibration is the same."""
    return _here.of(key, parcel).evaluate(index, point)
