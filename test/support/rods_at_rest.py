# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Shapes at rest of known rods, for tests."""

import numpy as np
from stepping import properties, SteppedRod

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Goal, Trial

LENGTH = 0.6
GRAVITY = np.array([0.0, 0.0, -9.81])


def hung(bending, held, mass=0.03, stretching=1e4, nodes=61, length=LENGTH, seconds=6.0):
    """
    Return the (nodes, 3) shape at rest of a rod whose held nodes were moved from straight along x.

    :param held: place that each held node is moved to, by its index [m].
    """
    step = 0.004
    rod = SteppedRod(np.full(nodes - 1, length / (nodes - 1)),
                     properties(bending, stretching, mass, damping=3.0, internal_damping=0.01), step)
    points = np.stack([np.linspace(0, length, nodes), np.zeros(nodes), np.ones(nodes)], axis=1)
    velocities = np.zeros_like(points)
    indices = sorted(held)
    rod.hold(indices)
    ways = np.array([held[i] for i in indices]) - points[indices]
    for k in range(int(seconds / step)):
        moving = ways if k * step < 1.0 else 0 * ways
        velocities = rod.velocities(points, velocities, GRAVITY, moving)
        points = points + step * velocities
    return points


def observed(shape, count, noise=0.0, seed=0):
    """Return `count` of the points of a shape, with white noise [m]."""
    chosen = shape[np.linspace(0, len(shape) - 1, count).round().astype(int)]
    return chosen + np.random.default_rng(seed).normal(0, noise, chosen.shape)


def trial_of(goal, grips, initial=None, stable=True, length=LENGTH):
    """Return a trial in which hands, given by their grips, hold the goal; None in place of them: released."""
    count = len(goal)
    if initial is None:
        initial = np.stack([np.linspace(0, length, count), np.zeros(count), np.ones(count)], axis=1)
    hands = tuple(Hand(f'hand {k}', own, [0.0, 1.0], [initial[own[0]], goal[own[0]]])
                  for k, own in enumerate(grips or [(0,)]))
    held = tuple(hand.name for hand in hands) if grips else ()
    return Trial('hung', Chain(initial), (Action(hands),), (Goal(Chain(goal), 3.0, stable, held),))
