# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials of a rope whose hands feel forces: simulated finely, then measured with noise."""

from dataclasses import replace

import numpy as np

from dlo_calibration import Action, Chain, Force, Goal, Hand, Trial
from dlo_calibration.simulation.compiled import CompiledSimulator

LENGTH = 0.6
ROPE = {'flexibility': 1e-3, 'elasticity': 300.0, 'friction': 0.5, 'self_collision': 0.004, 'mass': 0.03,
        'damping': 0.3, 'internal_damping': 2e-3}
NOISE, FORCE_NOISE = 1.5e-3, 0.02  # m, N
#: Of each trial: the gripped points of each hand, and its way [m].
LIFTS = ([((0,), (0.1, 0, 0.2))], [((10,), (0, 0.05, 0.25))],
         [((0,), (0.05, 0.02, 0.3)), ((20,), (-0.1, 0.02, 0.3))], [((0, 1), (0.1, 0.1, 0.15))])


def lying(count=21):
    """Return a straight rope that lies on the table, (n, 3) [m]."""
    along = np.linspace(0, LENGTH, count)
    return np.column_stack([along, 0 * along, np.full(count, ROPE['self_collision'])])


def felt_trials(seed, rope=ROPE, lifts=LIFTS, offset=None, noise=NOISE, force_noise=FORCE_NOISE, table=True):
    """
    Return trials in which hands lift a rope in two steps, and hold it at rest after each.

    :param offset: (3,) [N] of sensors that nobody has tared; None: they are tared.
    """
    dice, points = np.random.default_rng(seed), lying()
    fine = CompiledSimulator(nodes=81, time_step=1e-3, table=table)
    return tuple(_felt(fine, f'trial {k}', points, lift, rope, dice, offset, noise, force_noise)
                 for k, lift in enumerate(lifts, start=1))


def _felt(fine, name, points, lift, rope, dice, offset, noise, force_noise):
    ways = np.array([0, 0.5, 0.5, 1, 1])  # share of the way at each waypoint
    hands = tuple(Hand(f'hand_{k}', grips, (0.0, 1.0, 2.5, 3.5, 5.0),
                       points[grips[0]] + ways[:, None] * np.array(way))
                  for k, (grips, way) in enumerate(lift, start=1))
    names = tuple(hand.name for hand in hands)
    wanted = tuple(Force(hand, np.zeros(3), offset is None) for hand in names)
    goals = tuple(Goal(Chain(points), time, stable, names, forces=wanted)
                  for time, stable in ((2.4, False), (5.5, True)))
    truth = Trial(name, Chain(points), (Action(hands),), goals)
    rollout, count = fine.simulate(truth, rope), len(names)
    measured = []
    for k, goal in enumerate(goals):
        forces = tuple(
            replace(force, vector=vector + dice.normal(0, force_noise, 3) + (0 if offset is None else offset))
            for force, vector in zip(wanted, rollout.forces[k * count:(k + 1) * count], strict=True))
        chain = Chain(rollout.chains[k] + dice.normal(0, noise, points.shape))
        measured.append(replace(goal, chain=chain, forces=forces))
    initial = Chain(points + dice.normal(0, noise, points.shape))
    return replace(truth, initial=initial, goals=tuple(measured))
