# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The table: at which height the DLO lies on it, as the observed chains show."""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Trial

RESTING_BAND = 0.006  # m; points of a resting chain are that near to its lowest one
RESTING_SHARE = 0.15  # of the points, at least, lie in the band of a chain that rests
RESTING_HEIGHT = 0.04  # m above the table; beyond it a chain hangs


def resting_level(trial: Trial, table_height: float) -> float | None:
    """
    Return the height [m] of the middle of the DLO where it lies on the table.

    That height is measured: the median over the lowest points of those chains
    of the trial (at its start, and at rest) of which a part lies level just
    above the table.  None where no chain does.
    """
    chains: list[Chain] = [trial.initial] if trial.velocity is None else []
    chains += [goal.chain for goal in trial.goals if goal.stable]
    levels = []
    for chain in chains:
        z = chain.points[:, 2]
        lowest = z[z < z.min() + RESTING_BAND]
        if len(lowest) >= max(3, RESTING_SHARE * len(z)):
            levels.append(float(np.median(lowest)))
    level = min(levels, default=np.inf)
    return level if level - table_height < RESTING_HEIGHT else None


def rest_on(points: Floats, level: float) -> Floats:
    """
    Return (N, 3) [m] points of which those that rest lie exactly at `level`.

    Points below the level, or above it by less than the band that noise and
    lying on the table explain, neither penetrate the table nor fall on it.
    """
    rested = np.array(points)
    resting = rested[:, 2] < level + RESTING_BAND / 2
    rested[resting, 2] = level
    return rested
