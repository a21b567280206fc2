# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Memory: answers from an evaluation log what has been simulated before, and writes there what is new."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import astuple, fields
import threading
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.log import digest, Entry, EVALUATION, EvaluationLog, ROLLOUT
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.score import PointErrors
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.protocol import Job, Rollout

ERRORS = len(fields(PointErrors))


class Memory:
    """
    What a calibration simulated before it was interrupted.

    :param log: None: nothing is remembered.
    :param engine: digest of the engine's settings.
    :param on_failure: called once, with a sentence, if the log can no longer be written.
    """

    def __init__(self, log: EvaluationLog | None = None, engine: str = '',
                 on_failure: Callable[[str], None] = lambda _: None) -> None:
        self._log, self._engine, self._on_failure = log, engine, on_failure
        self._full = False
        self._writing = threading.Lock()  # threads that simulate write what they find
        self._digests: dict[int, tuple[Trial | Goal, str]] = {}

    def of(self, evaluator: Evaluator, finer: bool = False) -> EvaluatorMemory:
        """
        Return the memory of an evaluator's points.

        :param finer: whether its simulator is the engine's refined one.
        """
        base = '' if self._log is None else digest(
            self._engine, evaluator.simulator.name, finer, [self.digest(trial) for trial in evaluator.trials],
            evaluator.space, evaluator.layout)
        return EvaluatorMemory(self, base, evaluator)

    def rollout(self, simulator: str, job: Job) -> Rollout | SimulationError | None:
        """Return the rollout of a job by a simulator of this name, or why it failed; None if it is new."""
        entry = None if self._log is None else self.find(self._key(simulator, job))
        if entry is None:
            return None
        if not len(entry.numbers):
            return SimulationError(entry.text)
        return _rollout(entry.numbers, len(job[0].goals), len(job[0].initial))

    def add_rollouts(self, simulator: str, jobs: Sequence[Job], found: list[Rollout | SimulationError]
                     ) -> list[Rollout | SimulationError]:
        """Remember the rollouts of jobs, and return them."""
        if self._log is not None:
            for job, one in zip(jobs, found, strict=True):
                entry = Entry(np.zeros(0), str(one)) if isinstance(one, SimulationError) else Entry(
                    np.array([one.duration, one.steps, *one.settled, *one.chains.ravel()], float))
                self.add(self._key(simulator, job), entry)
        return found

    def _key(self, simulator: str, job: Job) -> str:
        return f'{ROLLOUT}-{digest(self._engine, simulator, self.digest(job[0]), job[1])}'

    def digest(self, trial: Trial) -> str:
        """Return the digest of a trial, which is made once: it may share hundreds of goals with others."""
        if id(trial) not in self._digests:
            others = {one.name: getattr(trial, one.name) for one in fields(trial) if one.name != 'goals'}
            self._digests[id(trial)] = trial, digest(others, [self._goal(goal) for goal in trial.goals])
        return self._digests[id(trial)][1]

    def _goal(self, goal: Goal) -> str:
        if id(goal) not in self._digests:
            self._digests[id(goal)] = goal, digest(goal)  # with the goal, so that no other one gets its id
        return self._digests[id(goal)][1]

    def find(self, key: str) -> Entry | None:
        """Return the entry with a key; None if there is none."""
        with suppress(OSError):  # what cannot be read is simulated again
            return None if self._log is None else self._log.find(key)
        return None

    def add(self, key: str, entry: Entry) -> None:
        """Write an entry, unless an earlier one could not be written."""
        with self._writing:
            if self._log is None or self._full:
                return
            try:
                self._log.add(key, entry)
            except OSError as error:
                self._full = True
                self._on_failure(f'log {self._log.path}: cannot be written: {error}; the calibration goes '
                                 'on, but if it is interrupted, the evaluations from here on are lost')


class EvaluatorMemory:
    """
    The evaluations of one evaluator.

    :param base: digest of all that an evaluation depends on, except the point; empty: nothing is remembered.
    """

    def __init__(self, memory: Memory, base: str, evaluator: Evaluator) -> None:
        self._memory, self._base = memory, base
        self._trials, self._space = evaluator.trials, evaluator.space
        self._size = evaluator.layout.rows[-1].stop

    def find(self, index: int, point: Floats) -> Evaluation | None:
        """Return the evaluation of a (d,) point of the unit cube; None if there is none."""
        entry = self._memory.find(self._key(point)) if self._base else None
        if entry is None:
            return None
        count, numbers = len(self._trials), entry.numbers
        found = Evaluation(index, frozen_array(point), self._space.values(point))
        if len(numbers) == 1 and numbers[0] in range(count):
            return Evaluation(index, found.point, found.values, failure=entry.text, skipped=int(numbers[0]))
        if len(numbers) != 2 * count + ERRORS + self._size:  # a stranger's entry
            return None
        unsettled, scores, errors, residuals = np.split(numbers, np.cumsum([count, count, ERRORS]))
        return Evaluation(
            index, found.point, found.values, tuple(scores.tolist()), PointErrors(*errors.tolist()),
            frozen_array(residuals),
            tuple(trial.name for trial, one in zip(self._trials, unsettled, strict=True) if one))

    def add(self, evaluation: Evaluation) -> None:
        """Remember a finished evaluation."""
        if not self._base:
            return
        if evaluation.residuals is None or evaluation.errors is None:
            entry = Entry(np.array([float(evaluation.skipped)]), evaluation.failure)
        else:
            entry = Entry(np.concatenate([
                _flags(self._trials, evaluation.unsettled), evaluation.scores, astuple(evaluation.errors),
                evaluation.residuals]))
        self._memory.add(self._key(evaluation.point), entry)

    def _key(self, point: Floats) -> str:
        return f'{EVALUATION}-{digest(self._base, np.asarray(point, float))}'


def _flags(trials: Sequence[Trial], names: Sequence[str]) -> list[float]:
    """Return 1 for each trial that `names` contain, in the same order, and 0 for the others."""
    flags, left = [], list(names)
    for trial in trials:
        flags.append(float(left[:1] == [trial.name]))
        left = left[int(flags[-1]):]
    return flags


def _rollout(numbers: Floats, goals: int, points: int) -> Rollout | None:
    """Return the rollout of a log's numbers; None if they are too many or too few."""
    if len(numbers) != 2 + goals + 3 * goals * points:
        return None
    settled = tuple(bool(one) for one in numbers[2:2 + goals])
    return Rollout(np.reshape(numbers[2 + goals:], (goals, points, 3)), settled, float(numbers[0]),
                   int(numbers[1]))
