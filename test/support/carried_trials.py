# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials of a DLO that two hands carry about: even, or stiffer in the middle."""

from dataclasses import replace

import numpy as np

from dlo_calibration.evaluation.evaluation import mean_length
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.compiled import CompiledSimulator

POINTS, LENGTH = 15, 0.8
EVEN = ParameterSpace(('flexibility', 'damping'))
TRUTH = {'flexibility': 58.5, 'damping': 50.0}
STIFF_MIDDLE = {**TRUTH, 'stiffness_2': 68.0, 'stiffness_3': 68.0, 'stiffness_4': 50.0}
NAMES = ('left_hand', 'right_hand')


def carried(turn, lift, sag=0.0):
    """
    Return a trial of a DLO held in two clamps that carry it about.

    :param sag: angle of its ends at the start [rad]; a straight DLO buckles to any side.
    """
    arc = np.linspace(0, LENGTH, POINTS)
    points = np.stack([arc, 0 * arc, 1 + 0 * arc], axis=1)
    if sag:
        angles = np.linspace(-sag, sag, POINTS)
        points[:, ::2] = LENGTH / (2 * sag) * np.stack([np.sin(angles), 2 - np.cos(angles)], axis=1)
    times = np.array([0.0, 0.6, 1.2])
    right = points[-1] + [[0, 0, 0], [-0.3, turn, lift], [-0.3, -turn, 0]]
    left = points[0] + [[0, 0, 0], [0, 0, -lift], [0, turn, 0]]
    hands = (Hand(NAMES[0], (0, 1), times, left), Hand(NAMES[1], (POINTS - 1, POINTS - 2), times, right))
    goals = tuple(Goal(Chain(points), time, stable=False, held_by=NAMES) for time in np.arange(0.1, 1.6, 0.1))
    return Trial(f'{turn:g} {lift:g}', Chain(points), (Action(hands),), goals)


def observed(space, values, sag=0.0):
    """Return four trials of a DLO with these values, with half a millimetre of noise in what follows."""
    trials = [carried(*way, sag) for way in ((0.1, 0.2), (0.25, 0.0), (-0.1, 0.3), (0.0, -0.2))]
    noise = np.random.default_rng(4)
    engine, physical = CompiledSimulator(table=False, nodes=21), space.physical(values, mean_length(trials))
    rollouts = [engine.simulate(trial, physical) for trial in trials]
    return [replace(trial, goals=tuple(
        replace(goal, chain=Chain(points + noise.normal(0, 5e-4, points.shape)))
        for goal, points in zip(trial.goals, rollout.chains, strict=True)))
        for trial, rollout in zip(trials, rollouts, strict=True)]
