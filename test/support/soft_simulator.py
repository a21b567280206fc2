# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""An analytic simulator for plans: points near a grip follow the hand, and no point springs back."""

from typing import Mapping

import numpy as np

from dlo_calibration import Trial
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.simulation.protocol import Rollout

USUAL = BY_NAME['friction'].physical(70.0)  # at which a dragged point stays where it is left
JITTER = 0.002  # m that a lifted DLO moves further, wherever it is put down


def follow(points, grip, shift, width=0.2):
    """Return (n, 3) points [m] after a grip was moved by (2,) [m], with a width relative to the length."""
    along = (np.arange(len(points)) - grip) / (len(points) - 1)
    moved = np.array(points)
    moved[:, :2] += np.exp(-(along / width)**2)[:, None] * np.asarray(shift)
    return moved


class SoftSimulator:
    """
    Each hand takes the points near its grip along; a dragged one goes further, the more the friction.

    :param width: of the part that follows, relative to the length.
    :param unsure: a lifted DLO moves by JITTER more, and a dragged one by the square of its friction.
    """

    name = 'soft'

    def __init__(self, width: float = 0.2, unsure: bool = False) -> None:
        self.width = width
        self.unsure = unsure

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Return the points at each goal."""
        chains = [self._at(trial, goal.time, physical) for goal in trial.goals]
        return Rollout(np.array(chains), (True,) * len(chains), 1.0, 100)

    def _at(self, trial: Trial, time: float, physical: Mapping[str, float]) -> Floats:
        points = np.array(trial.initial.points)
        for hand in trial.hands:
            if hand.start < time:
                shift = (hand.positions_at([time])[0] - hand.positions[0])[:2]
                lifted = np.ptp(hand.positions[:, 2]) > 0.01
                if self.unsure:
                    shift = shift + JITTER if lifted else shift * (physical['friction'] / USUAL)**2
                points = follow(points, hand.grips[0], shift, self.width)
        return points

    def refined(self) -> None:
        """Be as fine as it gets."""

    def close(self) -> None:
        """Hold nothing."""


def new_soft(_):
    """Return a soft simulator, whatever the options are."""
    return SoftSimulator()
