# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rehearsal: a sequence of actions, simulated one after the other from a start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.protocol import Rollout

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


def rehearse(pool: Pool, jobs: Sequence[Job]) -> list[Rehearsal]:
    """
    Simulate sequences of actions; a simulation that diverges gives a rehearsal with a failure.

    :raises CancelledError: when the pool stops.
    """
    trials: list[Trial] = []
    for job, before in zip(jobs, [None, *jobs], strict=False):
        # Draws of the same actions share their trial, as a simulator lays out each trial anew.
        trials.append(trials[-1] if before is not None and job.same_actions(before) else
                      rehearsed_trial(job.start, job.steps, job.courses))
    rollouts = pool.simulate([(trial, job.physical) for trial, job in zip(trials, jobs, strict=True)])
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
    """Rehearses jobs, and counts the simulated actions."""

    def __init__(self, pool: Pool) -> None:
        self.count = 0  # simulated actions so far
        self._pool = pool

    def __call__(self, jobs: Sequence[Job]) -> list[Rehearsal]:
        """
        Return the rehearsals of jobs, in their order.

        :raises CancelledError: when the pool stops.
        """
        found = rehearse(self._pool, jobs)
        self.count += sum(len(job.steps) for job in jobs)
        return found
