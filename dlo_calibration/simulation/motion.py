# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Motion: the simulated motion of a trial, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Mapping

import numpy as np

from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.protocol import Simulator

FRAME_RATE = 10  # 1/s; a GIF stores times in units of 0.01 s
MOST_FRAMES = 120  # of an animation, for its size: a longer motion is shown faster


@dataclass(frozen=True)
class Motion:
    """
    The simulated motion of a trial.

    :param times: (k,) times in the trial [s], increasing.
    :param chains: (k, n, 3) simulated chains at these times [m].
    :param ends: (g, n, 3) simulated chains at the goals of the trial [m].
    """

    times: Floats
    chains: Floats
    ends: Floats


def hands_at(trial: Trial, time: float) -> dict[str, tuple[Floats, bool]]:
    """Return by name where each hand of a trial is at a time [s], (3,) [m], and whether it is closed."""
    following = next((goal for goal in trial.goals if goal.time >= time), trial.goals[-1])
    holding = {hand.name for hand in trial.holding(
        Goal(trial.initial, time, stable=False, held_by=following.held_by))}
    current: dict[str, Hand] = {}  # by name, the hand that closed last, or else the first
    for hand in trial.hands:
        if hand.name not in current or hand.start <= time:
            current[hand.name] = hand
    return {name: (hand.positions_at(time)[0], name in holding) for name, hand in current.items()}


def densely(trial: Trial) -> Trial:
    """Return a trial with additional timed goals, one for each frame; their chains are placeholders."""
    times = {goal.time for goal in trial.goals}
    added = []
    for time in _frame_times(trial):
        if time not in times:
            # Between two goals, the hands that hold are those of the later goal, as in the trial itself.
            following = next((goal for goal in trial.goals if goal.time > time), trial.goals[-1])
            added.append(Goal(trial.initial, time, stable=False, held_by=following.held_by))
    return replace(trial, goals=(*trial.goals, *added))


def _frame_times(trial: Trial) -> list[float]:
    """Return the times in a trial at which its motion is shown [s]."""
    last = max(max(hand.end for hand in trial.hands) + 1.0, trial.goals[-1].time)
    count = min(MOST_FRAMES, max(2, round(last * FRAME_RATE) + 1))
    return [float(time) for time in np.linspace(0.0, last, count)]


def simulated_motion(trial: Trial, simulator: Simulator, physical: Mapping[str, float]) -> Motion:
    """
    Simulate a trial, and return the motion of the DLO.

    :param physical: parameters by name (SI units).
    :raises SimulationError: if the rollout diverges.
    """
    dense = densely(trial)
    chains = simulator.simulate(dense, physical).chains
    observed = {id(goal.chain) for goal in trial.goals}
    ends = [k for k, goal in enumerate(dense.goals) if id(goal.chain) in observed]
    # A stable goal is simulated until the DLO rests, which is later than its time.
    times = _frame_times(trial)
    frames = [k for k, goal in enumerate(dense.goals) if not goal.stable and goal.time in times]
    return Motion(np.array([dense.goals[k].time for k in frames]), chains[frames], chains[ends])
