# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The table: the height of a DLO that lies on it, from the observed chains."""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Trial

RESTING_BAND = 0.006  # m; points of a resting chain are at most this much above its lowest one


def resting_level(trial: Trial, table_height: float) -> float | None:
    """
    Return the height [m] of the centre line of the DLO where it lies on the table.

    It is the median height of the lowest points of a chain at rest (initial or stable),
    if at least 15 % of its points are that low; of several chains, the lowest counts.
    None where no chain lies, or the height is 4 cm or more above the table: then it hangs.
    """
    chains: list[Chain] = [trial.initial] if trial.velocity is None else []
    chains += [goal.chain for goal in trial.goals if goal.stable]
    levels = []
    for chain in chains:
        z = chain.points[:, 2]
        lowest = z[z < z.min() + RESTING_BAND]
        if len(lowest) >= max(3, 0.15 * len(z)):
            levels.append(float(np.median(lowest)))
    level = min(levels, default=np.inf)
    return level if level - table_height < 0.04 else None


def rest_on(points: Floats, level: float) -> Floats:
    """
    Return the (N, 3) [m] points, with those that rest moved exactly to `level`.

    These are the points below the level, or above it by less than half of RESTING_BAND:
    a simulation then starts with no point inside the table, and none that falls onto it.
    """
    rested = np.array(points)
    resting = rested[:, 2] < level + RESTING_BAND / 2
    rested[resting, 2] = level
    return rested
