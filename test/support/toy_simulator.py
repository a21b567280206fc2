# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""An analytic simulator: the points of a goal move linearly with the parameters on their 0..100 scale."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import threading
import time
from typing import Mapping, Sequence

import numpy as np

from dlo_calibration import Action, Chain, Goal, Hand, SimulationError, Trial
from dlo_calibration.evaluation.evaluation import mean_length
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.simulation.protocol import Job, Rollout, Stop

REACH = 0.2  # m that a parameter moves the points that it moves most, from 0 to 100


class ToySimulator:
    """
    Each parameter lifts the chain into another sine arch.

    :param seconds: that one simulation lasts.
    :param fail_below: a rollout diverges where flexibility is less than this (0..100).
    :param crash: raise something that nobody expects.
    """

    name = 'toy'

    def __init__(self, seconds: float = 0.0, fail_below: float = -1.0, crash: bool = False) -> None:
        self.seconds = seconds
        self.fail_below = fail_below
        self.crash = crash

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Return the goal chains of a trial, analytically."""
        if self.seconds:
            time.sleep(self.seconds)
        if self.crash:
            raise RuntimeError('the toy\nis broken')
        if BY_NAME['flexibility'].value(physical['flexibility']) < self.fail_below:
            raise SimulationError(f'{trial.name}: diverged')
        chain = toy_goal(trial.initial.points, trial.hands, physical)
        return Rollout(np.stack([chain] * len(trial.goals)), (True,) * len(trial.goals), 1.0, 200)

    def refined(self) -> None:
        """Be as fine as it gets."""

    def close(self) -> None:
        """Hold nothing."""


class Stoppable(ToySimulator):
    """Its rollouts last until they are stopped."""

    at_a_time = 1

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Event()

    def simulate_together(self, jobs: Sequence[Job], stop: Stop) -> list[Rollout | SimulationError]:
        """Wait for the stop."""
        self.begun.set()
        while not stop.is_set():
            time.sleep(0.001)
        return []


class Deadly(ToySimulator):
    """
    It kills its process where flexibility is more than 90 (0..100).

    :param file: once it exists, nothing is killed any more; the first death makes it.
    """

    def __init__(self, file: Path | None = None) -> None:
        super().__init__()
        self.file = file

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Die, or do what the toy does."""
        if BY_NAME['flexibility'].value(physical['flexibility']) > 90 and (
                self.file is None or not self.file.exists()):
            if self.file is not None:
                self.file.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().simulate(trial, physical)


class CountingToy(ToySimulator):
    """
    A toy that counts its simulations, and may end at one of them.

    :param name: of the engine.
    :param last: number of the simulation at which, and from which on, `die` is called.
    :param counted: has one item for each simulation; engines may share it.
    """

    def __init__(self, name='toy', last=None, die=None, counted=None):
        super().__init__(fail_below=20.0)
        self.name, self.last, self.die = name, last, die
        self.counted = [] if counted is None else counted

    @property
    def count(self):
        """Number of simulations so far."""
        return len(self.counted)

    def simulate(self, trial, physical):
        """Count, and do what the toy does; it trembles, so that the residuals need an explanation."""
        if self.last is not None and len(self.counted) >= self.last - 1:
            self.die()
        self.counted.append(trial.name)
        return super().simulate(trial, {**physical, 'friction': physical['friction'] * 1.1})


def toy_goal(points: Floats, hands: Sequence[Hand], physical: Mapping[str, float]) -> Floats:
    """Return where `points`, (n, 3) [m], go: with the hands, and into one arch per parameter."""
    along = np.linspace(0, np.pi, len(points))
    moved = points + np.mean([hand.positions[-1] - hand.positions[0] for hand in hands], axis=0)
    for k, name in enumerate(('flexibility', 'elasticity', 'friction', 'self_collision')):
        share = BY_NAME[name].value(physical[name]) / 100
        moved[:, (2, 0, 1, 2)[k]] += REACH * share * np.sin((k + 1) * along)
    return moved


def toy_trial(values: Mapping[str, float], name: str = 'trial 1', n: int = 11, turn: float = 0.0) -> Trial:
    """Return a trial whose goal is what the toy gives for `values`, all four on 0..100."""
    along = np.linspace(0, 1, n)
    initial = np.stack([along * np.cos(turn), along * np.sin(turn), np.zeros(n)], axis=1)
    hand = Hand('left_hand', (0,), np.array([0.5, 1.5]), initial[0] + np.array([[0, 0, 0], [0, 0.1, 0.05]]))
    draft = Trial(name, Chain(initial), (Action((hand,)),), (Goal(Chain(initial), 2.0),))
    physical = ParameterSpace().physical(values, mean_length([draft]))
    return Trial(name, draft.initial, draft.actions,
                 (Goal(Chain(toy_goal(initial, draft.hands, physical)), 2.0),))


def new_toy(_):
    """Return a toy, whatever the options are."""
    return ToySimulator()
