# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rehearsal: a sequence of actions, simulated one after the other from a start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.action import Action, PATHS
from dlo_calibration.model.chain import Chain, Floats, in_proportion
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.loads import Loads
from dlo_calibration.simulation.motion import FRAME_RATE, MOST_FRAMES, Motion
from dlo_calibration.simulation.protocol import Rollout, Simulator

PAUSE = 1.0  # s from the end of an action to the start of the next; the DLO rests then, however long it takes
CALM = 1.5  # s of the same in a motion, which does not wait for rest: a released DLO nearly rests by then
REST = 0.01  # s from the end of an action to the goal at rest
TRAJECTORY_STEP = 0.01  # m that a hand moves at most between two chains; less if the DLO is short


@dataclass(frozen=True)
class ActionStep:
    """
    An action of a sequence.

    :param held_by: names of the hands that hold the DLO after it; the others open where they arrive.
    """

    action: Action
    held_by: tuple[str, ...] = ()

    name: ClassVar[str] = PATHS

    def starting(self, time: float) -> ActionStep:
        """Return the same step with an action that starts at a time [s]."""
        shift = time - self.action.start
        return self if shift == 0 else replace(self, action=Action(tuple(
            replace(hand, times=hand.times + shift) for hand in self.action.hands)))


@dataclass(frozen=True)
class Rehearsal:
    """
    The simulated outcome of a sequence of actions.

    :param chains: (k, n, 3) [m] the DLO at rest after each of the k actions; nan after a failure.
    :param settled: (k,) False where it did not come to rest within the time limit.
    :param trajectories: of each action, (m, n, 3) [m] the DLO while the hands move, at every TRAJECTORY_STEP;
        empty if they were not requested.
    :param loads: the largest ones in each of the k actions, until the DLO rests; None if they were not
        requested, after a failure, or if the engine does not know them.
    :param failure: why it could not be simulated, in words; empty if it could.
    """

    chains: Floats
    settled: tuple[bool, ...]
    trajectories: tuple[Floats, ...] = ()
    failure: str = ''
    loads: Loads | None = None


@dataclass(frozen=True)
class RehearsalJob:
    """
    A sequence of actions to rehearse.

    :param physical: parameters by name (SI units).
    :param trajectories: whether the trajectory of the DLO in each action is wanted, too; `loads` whether the
        loads are.
    """

    start: Chain
    steps: tuple[ActionStep, ...]
    physical: Mapping[str, float]
    trajectories: bool = False
    loads: bool = False


def in_turn(steps: Sequence[ActionStep], pause: float = PAUSE) -> tuple[ActionStep, ...]:
    """Return steps whose actions follow one another from time 0 on, with a pause [s] after each."""
    placed: list[ActionStep] = []
    for step in steps:
        placed.append(step.starting(placed[-1].action.end + pause if placed else 0.0))
    return tuple(placed)


def rehearsed_trial(start: Chain, steps: Sequence[ActionStep], trajectories: bool = False,
                    loads: bool = False) -> Trial:
    """Return a trial with the actions in turn; its goals are the DLO at rest after each."""
    steps, goals = in_turn(steps), []
    for step in steps:
        action = step.action
        if trajectories:
            times = _instants(action, in_proportion(TRAJECTORY_STEP, start.length))
            names = (*step.held_by, *(hand.name for hand in action.hands))
            goals += [Goal(start, float(time), stable=False, held_by=names) for time in times]
        goals.append(Goal(start, action.end + REST, held_by=step.held_by))
    return Trial('rehearsal', start, tuple(step.action for step in steps), tuple(goals), loads=loads)


def _instants(action: Action, longest: float) -> Floats:
    """Return instants [s] within an action, between which no hand moves further than `longest` [m]."""
    speeds = [np.linalg.norm(np.diff(hand.positions, axis=0), axis=1) / np.diff(hand.times)
              for hand in action.hands]
    fastest = np.concatenate(speeds).max(initial=0.0)
    pieces = int(np.ceil((action.end - action.start) * fastest / longest))
    return np.linspace(action.start, action.end, pieces + 1)[1:-1]


def rehearse(pool: Pool, jobs: Sequence[RehearsalJob]) -> list[Rehearsal]:
    """
    Simulate sequences of actions; a simulation that diverges gives a rehearsal with a failure.

    :raises CancelledError: when the pool stops.
    """
    # Draws of the same actions share their trial, because a simulator scripts every trial anew.
    keys = [(id(job.start), id(job.steps), job.trajectories, job.loads) for job in jobs]
    shared = {key: rehearsed_trial(job.start, job.steps, job.trajectories, job.loads)
              for key, job in dict(zip(keys, jobs, strict=True)).items()}
    trials = [shared[key] for key in keys]
    rollouts = pool.simulate([(trial, job.physical) for trial, job in zip(trials, jobs, strict=True)])
    return [_rehearsal(job, trial, rollout) for job, trial, rollout in zip(
        jobs, trials, rollouts, strict=True)]


def _rehearsal(job: RehearsalJob, trial: Trial, rollout: Rollout | SimulationError) -> Rehearsal:
    """Return the rehearsal of a job from the rollout of its trial."""
    if isinstance(rollout, SimulationError):
        return Rehearsal(np.full((len(job.steps), len(job.start), 3), np.nan), (False,) * len(job.steps),
                         failure=str(rollout))
    rests = [k for k, goal in enumerate(trial.goals) if goal.stable]
    trajectories = [rollout.chains[before + 1:rest] for before, rest in pairwise([-1, *rests])]
    loads = None if rollout.loads is None else rollout.loads.over(
        [slice(before + 1, rest + 1) for before, rest in pairwise([-1, *rests])])
    return Rehearsal(rollout.chains[rests], tuple(rollout.settled[k] for k in rests),
                     tuple(trajectories) if job.trajectories else (), loads=loads)


class Rehearser:
    """Rehearses jobs, and counts the simulated actions."""

    def __init__(self, pool: Pool) -> None:
        self.count = 0  # simulated actions so far
        self._pool = pool

    def __call__(self, jobs: Sequence[RehearsalJob]) -> list[Rehearsal]:
        """
        Return the rehearsals of jobs, in their order.

        :raises CancelledError: when the pool stops.
        """
        rehearsals = rehearse(self._pool, jobs)
        self.count += sum(len(job.steps) for job in jobs)
        return rehearsals


def motion_of_actions(start: Chain, steps: Sequence[ActionStep], simulator: Simulator,
                      physical: Mapping[str, float], *, frame_rate: float = FRAME_RATE,
                      most: int = MOST_FRAMES) -> tuple[Trial, Motion]:
    """
    Simulate the motion of a DLO, frame by frame, in actions one after the other.

    Unlike in a rehearsal, an action begins CALM after the previous one, whether or not the DLO rests then.

    :param physical: parameters by name (SI units).
    :param frame_rate: [1/s], less where there would be more than `most` frames.
    :returns: a trial whose goals tell which hands hold the DLO, and whose last one is the DLO at rest at
        the end; and the motion.
    :raises SimulationError: if the rollout diverges.
    """
    steps, events = in_turn(steps, pause=CALM), []
    held: tuple[str, ...] = ()
    for step in steps:
        action = step.action
        acting = tuple(hand.name for hand in action.hands)
        events += [Goal(start, action.start, stable=False, held_by=held),
                   Goal(start, action.end, stable=False, held_by=(*step.held_by, *acting)),
                   Goal(start, action.end + REST, stable=False, held_by=step.held_by)]
        held = step.held_by
    end = steps[-1].action.end + CALM
    count = min(most, max(2, round(end * frame_rate) + 1))
    frames = []
    for time in np.linspace(0.0, end, count):
        following = next((goal for goal in events if goal.time >= time), events[-1])
        frames.append(Goal(start, float(time), stable=False, held_by=following.held_by))
    actions = tuple(step.action for step in steps)
    last = Goal(start, end + REST, held_by=held)
    asked = Trial('course', start, actions, (*events, *frames, last))
    chains = simulator.simulate(asked, physical).chains
    shown = [k for k, goal in enumerate(asked.goals) if any(goal is frame for frame in frames)]
    last = replace(last, chain=Chain(chains[-1]))
    return (Trial('course', start, actions, (*events, last)),
            Motion(np.array([asked.goals[k].time for k in shown]), chains[shown], chains[-1:]))
