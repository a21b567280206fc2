# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A rope on a table, two hands, and a camera, played by a simulation with physics of its own.

Nodes and time steps are finer than those of a calibration, the camera sees noise and hides points, and a hand
grips beside where it thinks.
"""

from dataclasses import replace

import numpy as np

from dlo_calibration import Action, Chain, Hand, Trial
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal
from dlo_calibration.planning.rehearsal import PAUSE
from dlo_calibration.simulation.compiled import CompiledSimulator

NODES, TIME_STEP = 81, 0.0015
SEEN = 4  # the camera gives every fourth node
NOISE = 0.0015  # m, of the camera
OFF = 0.005  # m, by which a grip is off along the rope, at most
HIDDEN = 0.05  # share of the points
STEADY = 0.25  # s before the end of a pause at which the camera looks


class PlayedRope:
    """
    A rope, and what was done with it.

    :param values: its parameters on the 0..100 scale.
    :param generator: of noise, hidden points and errors of grips.
    """

    def __init__(self, values, generator, length=0.7, turn=0.6):
        self.values, self._generator = values, generator
        self.physical = ParameterSpace().physical(values, length)
        heading = turn * np.linspace(-0.5, 0.5, NODES)
        steps = length / (NODES - 1) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        places = np.cumsum(steps, axis=0)
        self.points = np.column_stack([places - places.mean(axis=0),
                                       np.full(NODES, self.physical['self_collision'])])
        self._start, self._actions, self._goals = Chain(self.points), [], []
        self._simulator = CompiledSimulator(nodes=NODES, time_step=TIME_STEP)

    def look(self):
        """Return what the camera sees of the present points, (n, 3) [m]; NaN where it sees nothing."""
        return self._seen(self.points)

    def do(self, hands, pauses=()):
        """
        Do what hands are told, and return what the camera sees at the given times.

        :param hands: names -> times [s] and positions [m] of the waypoints.
        :param pauses: times [s] at which it looks, while the hands wait.
        :returns: views, (n, 3) [m] each, one for each of `pauses`, and at rest.
        """
        now, begin = Chain(self.points), self._actions[-1].end + PAUSE if self._actions else 0.0
        done = []
        for name, (times, positions) in hands.items():
            place = now.arc_lengths()[int(np.linalg.norm(self.points - positions[0], axis=1).argmin())]
            grip, offset = now.grip(np.clip(place + self._generator.uniform(-OFF, OFF), 0.0, now.length))
            held = now.gripped([grip], offset)[0]
            way = np.array(positions) - positions[0]
            way[:, 2] = np.maximum(way[:, 2], self.physical['self_collision'] - held[2])
            done.append(Hand(name, (grip,), np.array(times) + begin, held + way, offset=offset))
        action = Action(tuple(done))
        self._actions.append(action)
        paused = [Goal(self._start, begin + time, stable=False, held_by=tuple(hands)) for time in pauses]
        end = Goal(self._start, action.end + 0.01)
        # From the very start each time, as points alone do not tell how much the rope is stretched.
        rollout = self._simulator.simulate(Trial('played', self._start, tuple(self._actions), (
            *self._goals, *paused, end)), self.physical)
        self._goals.append(end)
        chains = rollout.chains[len(self._goals) - 1:]
        self.points = chains[-1]
        return [self._seen(points) for points in chains]

    def _seen(self, points):
        seen = points[::SEEN] + self._generator.normal(0.0, NOISE, points[::SEEN].shape)
        hidden = self._generator.random(len(seen)) < HIDDEN
        hidden[[0, -1]] = False
        return np.where(hidden[:, None], np.nan, seen)


def observed_trial(name, rope, action, pause):
    """Let a rope be moved by an action, and return the trial that robot and camera have of it."""
    before = Chain(rope.look())
    pauses = () if pause is None else (pause[1] - STEADY,)
    hands = {hand.name: (hand.times, hand.positions) for hand in action.hands}
    *held, rest = rope.do(hands, pauses)
    known = []
    shown = before.interpolated(before.arc_lengths())
    for hand in action.hands:
        point, offset, _ = shown.nearest(hand.positions[0])
        known.append(replace(hand, grips=(point,), offset=offset, nearest=True))
    goals = [Goal(Chain(points), time, stable=False, held_by=tuple(hands))
             for points, time in zip(held, pauses, strict=True)]
    return Trial(name, before, (Action(tuple(known)),), (*goals, Goal(Chain(rest), action.end + 1.0)))
