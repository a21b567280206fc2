# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A tracker's stream of a known rope that a robot moves, with errors of its hands."""

from dataclasses import replace
from functools import cache

import numpy as np

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.messages.codec import ActionMessage, ChainMessage, GOAL, INITIAL, NANOSECONDS
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

MASS, LENGTH, RADIUS = 0.03, 0.6, 0.004  # kg, m, m
TRUTH = {'flexibility': 72.3, 'elasticity': 40.0, 'friction': 65.0, 'self_collision': 25.6, 'damping': 50.0}
NODES, RATE, NOISE = 21, 20.0, 0.7e-3  # points of a chain; chains per second; m
WAYS = ((0, (0.10, 0.20), 0.0), (10, (0.15, -0.18), 1.3), (20, (-0.25, 0.12), 2.6))  # grip, way [m], heading


@cache
def takes():
    """Return what happens in each action: the chain before, the path of the hand, instants, and chains."""
    along = np.linspace(-0.5, 0.5, NODES) * LENGTH
    done = []
    for grip, (x, y), heading in WAYS:
        shape = np.stack([along, 0.04 * np.sin(10 * along), 0 * along + RADIUS], axis=1)
        c, s = np.cos(heading), np.sin(heading)
        points = shape @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        way = points[grip] + np.array([(0, 0, 0), (0, 0, 0.06), (x, y, 0.06), (x, y, 0)])
        hand = Hand('hand', (grip,), np.array([0.0, 0.4, 1.4, 1.8]), way)
        instants = np.arange(1, round((hand.end + 1.5) * RATE)) / RATE
        goals = tuple(Goal(Chain(points), float(t), stable=False, held_by=('hand',) if t < hand.end else ())
                      for t in instants)
        physical = ParameterSpace(fixed=TRUTH, mass=MASS).physical({}, Chain(points).length)
        trial = Trial('take', Chain(points), (Action((hand,)),), goals)
        chains = np.asarray(CompiledSimulator().simulate(trial, physical).chains)
        done.append((points, hand, instants, chains))
    return done


def messages(late=0.0, shift=(0.0, 0.0, 0.0), seed=1):
    """
    Return the messages of the tracker and of the robot.

    :param late: [s] by which the stamps of the hands are late.
    :param shift: [m] by which hands are off.
    """
    generator = np.random.default_rng(seed)
    sent, zero = [], 1_700_000_000.0

    def chain(kind, time, points):
        seen = points + generator.normal(0, NOISE, points.shape)
        return ChainMessage(kind, round(time * NANOSECONDS), 'world', Chain(seen))

    for points, hand, instants, chains in takes():
        sent.append(chain(INITIAL, zero - 0.5, points))
        sent.append(ActionMessage(round((zero + late) * NANOSECONDS), 'world', ('hand',), hand.times,
                                  (hand.positions + shift)[:, None], hand.orientations[:, None]))
        sent += [chain(GOAL, zero + t, seen) for t, seen in zip(instants, chains, strict=True)]
        zero += instants[-1] + 5.0
    return sorted(sent, key=lambda message: message.key)


def reversed_trial(sent, number):
    """Return messages in which all goal chains of a trial, counted from 0, run from the other end."""
    turned, trial = [], -1
    for message in sent:
        trial += message.kind == INITIAL
        if trial == number and message.kind == GOAL:
            message = replace(message, chain=Chain(message.chain.points[::-1]))
        turned.append(message)
    return turned
