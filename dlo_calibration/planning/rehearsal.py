# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rehearsal: a sequence of actions, simulated one after the other from a start."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
from dataclasses import dataclass, replace
from itertools import chain, pairwise
import math
from typing import Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.batch import AT_A_TIME
from dlo_calibration.evaluation.kept import kept_simulator, packed_simulator
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.protocol import Rollout, simulate_all, Simulator, TogetherSimulator

PAUSE = 1.0  # s from the end of an action to the start of the next; the DLO rests then, however long it takes
REST = 0.01  # s from the end of an action to the instant from which on the DLO comes to rest
COURSE_STEP = 0.01  # m that a hand moves, at most, between two chains of the course of an action


@dataclass(frozen=True)
class Step:
    """
    An action of a sequence.

    :param held_by: names of the hands that hold the DLO after it; the others open where they arrive.
    """

    action: Action
    held_by: tuple[str, ...] = ()

    def starting(self, time: float) -> Step:
        """Return the same step with an action that starts at a time [s]."""
        shift = time - self.action.start
        return self if shift == 0 else replace(self, action=Action(tuple(
            replace(hand, times=hand.times + shift) for hand in self.action.hands)))


@dataclass(frozen=True)
class Rehearsal:
    """
    What happens in a sequence of actions.

    :param chains: (k, n, 3) [m] the DLO at rest after each of the k actions.
    :param settled: (k,) False where it did not come to rest within the time limit.
    :param courses: for each action, (m, n, 3) [m] the DLO while the hands move, at every COURSE_STEP; empty
        where they were not asked for.
    :param failure: why it could not be simulated, in words; empty if it could.  `chains` is nan then.
    """

    chains: Floats
    settled: tuple[bool, ...]
    courses: tuple[Floats, ...] = ()
    failure: str = ''


@dataclass(frozen=True)
class Job:
    """
    A sequence of actions to rehearse.

    :param physical: parameters by name (SI units).
    :param courses: whether the course of each action is wanted, too.
    """

    start: Chain
    steps: tuple[Step, ...]
    physical: Mapping[str, float]
    courses: bool = False

    def same_actions(self, other: Job) -> bool:
        """Tell whether another job only has other parameters."""
        return (self.start is other.start and self.steps is other.steps and self.courses == other.courses)


def in_turn(steps: Sequence[Step], start: float = 0.0) -> tuple[Step, ...]:
    """Return steps whose actions follow one another, each PAUSE after the end of the one before."""
    found: list[Step] = []
    for step in steps:
        found.append(step.starting(found[-1].action.end + PAUSE if found else start))
    return tuple(found)


def rehearsed_trial(start: Chain, steps: Sequence[Step], courses: bool = False) -> Trial:
    """Return a trial with the actions in turn; its goals are the DLO at rest after each."""
    steps, goals = in_turn(steps), []
    for step in steps:
        action = step.action
        if courses:
            times = _on_the_way(action)
            names = (*step.held_by, *(hand.name for hand in action.hands))
            goals += [Goal(start, float(time), stable=False, held_by=names) for time in times]
        goals.append(Goal(start, action.end + REST, held_by=step.held_by))
    return Trial('rehearsal', start, tuple(step.action for step in steps), tuple(goals))


def _on_the_way(action: Action) -> Floats:
    """Return instants [s] between start and end of an action; no hand moves further than COURSE_STEP."""
    speeds = [np.linalg.norm(np.diff(hand.positions, axis=0), axis=1) / np.diff(hand.times)
              for hand in action.hands]
    fastest = np.concatenate(speeds).max(initial=0.0)
    pieces = int(np.ceil((action.end - action.start) * fastest / COURSE_STEP))
    return np.linspace(action.start, action.end, pieces + 1)[1:-1]


def rehearse(simulator: Simulator, jobs: Sequence[Job],
             between: Callable[[], None] = lambda: None) -> list[Rehearsal]:
    """
    Simulate sequences of actions; a simulation that diverges gives a rehearsal with a failure.

    :param between: is called again and again; what it raises ends the simulation.
    """
    trials: list[Trial] = []
    for job, before in zip(jobs, [None, *jobs], strict=False):
        # Draws of the same actions share their trial, as a simulator lays out each trial anew.
        trials.append(trials[-1] if before is not None and job.same_actions(before) else
                      rehearsed_trial(job.start, job.steps, job.courses))
    rollouts = simulate_all(simulator, [(trial, job.physical) for trial, job in zip(
        trials, jobs, strict=True)], between)
    return [_rehearsal(job, trial, rollout) for job, trial, rollout in zip(
        jobs, trials, rollouts, strict=True)]


def _rehearsal(job: Job, trial: Trial, rollout: Rollout | SimulationError) -> Rehearsal:
    """Return what happened in the rollout of a job's trial."""
    if isinstance(rollout, SimulationError):
        return Rehearsal(np.full((len(job.steps), len(job.start), 3), np.nan), (False,) * len(job.steps),
                         failure=str(rollout))
    rests = [k for k, goal in enumerate(trial.goals) if goal.stable]
    courses = [rollout.chains[before + 1:rest] for before, rest in pairwise([-1, *rests])]
    return Rehearsal(rollout.chains[rests], tuple(rollout.settled[k] for k in rests),
                     tuple(courses) if job.courses else ())


class Rehearser:
    """
    Rehearses many jobs, in this thread or by an executor; the results do not depend on that.

    :param simulator: belongs to this thread; workers use copies of it.
    :param executor: None: this thread simulates.
    :param should_stop: asked often.
    :param takes_part: this thread simulates, too, what the executor has not begun yet: its processes may
        still be starting.
    """

    def __init__(self, simulator: Simulator, executor: Executor | None = None,
                 should_stop: Callable[[], bool] = lambda: False, takes_part: bool = False) -> None:
        self.count = 0  # simulated actions so far
        self._simulator = simulator
        self._executor = executor
        self._should_stop = should_stop
        self._takes_part = takes_part
        self._packed = b'' if executor is None else packed_simulator(simulator)

    def __call__(self, jobs: Sequence[Job]) -> list[Rehearsal]:
        """
        Return the rehearsals of jobs, in their order.

        :raises CancelledError: once `should_stop` is True.
        """
        found = self._rehearsed_here(jobs) if self._executor is None else \
            self._rehearsed_by(self._executor, jobs)
        self.count += sum(len(job.steps) for job in jobs)
        return found

    def _rehearsed_here(self, jobs: Sequence[Job]) -> list[Rehearsal]:
        return rehearse(self._simulator, jobs, self._check)

    def _rehearsed_by(self, executor: Executor, jobs: Sequence[Job]) -> list[Rehearsal]:
        size = self._portion(executor, len(jobs))
        portions = [jobs[first:first + size] for first in range(0, len(jobs), size)]
        futures = [executor.submit(_rehearse_in_worker, self._packed, portion)
                   for portion in portions]
        own: list[list[Rehearsal]] = []  # of the last portions, in reverse order
        try:
            while self._takes_part and len(own) < len(portions) and futures[-1 - len(own)].cancel():
                own.append(self._rehearsed_here(portions[-1 - len(own)]))
            others = (self._awaited(future) for future in futures[:len(portions) - len(own)])
            return list(chain.from_iterable([*others, *own[::-1]]))
        finally:
            for future in futures:
                future.cancel()

    def _portion(self, executor: Executor, jobs: int) -> int:
        """Return how many of so many jobs are simulated at a time."""
        if not isinstance(self._simulator, TogetherSimulator):
            return 1
        return min(AT_A_TIME, math.ceil(jobs / getattr(executor, 'workers', 1)))

    def _check(self) -> None:
        if self._should_stop():
            raise CancelledError

    def _awaited(self, future: Future[list[Rehearsal]]) -> list[Rehearsal]:
        while True:
            self._check()
            try:
                return future.result(timeout=0.05)
            except TimeoutError:
                if future.done():
                    raise


def _rehearse_in_worker(packed: bytes, jobs: Sequence[Job]) -> list[Rehearsal]:
    """Rehearse jobs in a worker, which keeps the simulator of a plan."""
    return rehearse(kept_simulator(packed), jobs)


