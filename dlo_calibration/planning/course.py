# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Course: the motion of a DLO in a sequence of actions, frame by frame, also while it comes to rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Mapping, Sequence

import numpy as np

from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.planning.rehearsal import REST, Step
from dlo_calibration.simulation.motion import FRAME_RATE, MOST_FRAMES, Motion
from dlo_calibration.simulation.protocol import Simulator

CALM = 1.5  # s from the end of an action to the start of the next, in which a DLO that was let go calms down


def simulated_course(start: Chain, steps: Sequence[Step], simulator: Simulator,
                     physical: Mapping[str, float], *, frame_rate: float = FRAME_RATE,
                     most: int = MOST_FRAMES) -> tuple[Trial, Motion]:
    """
    Simulate actions one after the other, in one go.

    Unlike in a rehearsal, an action begins CALM after the one before, whether or not the DLO rests then.

    :param physical: parameters by name (SI units).
    :param frame_rate: [1/s], less where there would be more than `most` frames.
    :returns: a trial whose goals tell which hands hold the DLO, and whose last one is the DLO at rest at
        the end; and the motion.
    :raises SimulationError: if the rollout diverges.
    """
    events: list[Goal] = []
    placed: list[Step] = []
    held: tuple[str, ...] = ()
    for step in steps:
        placed.append(step.starting(placed[-1].action.end + CALM if placed else 0.0))
        action = placed[-1].action
        acting = tuple(hand.name for hand in action.hands)
        events += [Goal(start, action.start, stable=False, held_by=held),
                   Goal(start, action.end, stable=False, held_by=(*step.held_by, *acting)),
                   Goal(start, action.end + REST, stable=False, held_by=step.held_by)]
        held = step.held_by
    end = placed[-1].action.end + CALM
    count = min(most, max(2, round(end * frame_rate) + 1))
    frames = []
    for time in np.linspace(0.0, end, count):
        following = next((goal for goal in events if goal.time >= time), events[-1])
        frames.append(Goal(start, float(time), stable=False, held_by=following.held_by))
    actions = tuple(step.action for step in placed)
    last = Goal(start, end + REST, held_by=held)
    asked = Trial('course', start, actions, (*events, *frames, last))
    chains = simulator.simulate(asked, physical).chains
    shown = [k for k, goal in enumerate(asked.goals) if any(goal is frame for frame in frames)]
    last = replace(last, chain=Chain(chains[-1]))
    return (Trial('course', start, actions, (*events, last)),
            Motion(np.array([asked.goals[k].time for k in shown]), chains[shown], chains[-1:]))
