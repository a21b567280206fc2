# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The table: the height of a DLO that lies on it, from the observed chains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Chain, Floats, in_proportion
from dlo_calibration.model.trial import Trial

HANGING = 0.04  # m; a DLO whose lowest points are higher above the table hangs
# Of a DLO that is not short, see `in_proportion`:
RESTING_BAND = 0.006  # m; points of a resting chain are at most this much above its lowest one
STACKED = 0.0015  # m; of two strands that cross, one that is higher by this lies on the other
RISEN = 0.25  # share of its height above the other strand above which a point of the upper strand is raised


def resting_level(trial: Trial, table_height: float) -> float | None:
    """
    Return the height [m] of the centre line of the DLO where it lies on the table.

    It is the median height of the lowest points of a chain at rest (initial or stable),
    if at least 15 % of its points are that low; of several chains, the lowest counts.
    None where no chain lies, or the height is 4 cm or more above the table: then it hangs.
    """
    chains: list[Chain] = [trial.initial] if trial.velocity is None else []
    chains += [goal.chain for goal in trial.goals if goal.stable]
    level = min((lowest_level(chain) for chain in dict.fromkeys(chains)), default=np.inf)
    return level if level - table_height < HANGING else None


def lying_level(chain: Chain, table_height: float) -> float | None:
    """Return the height [m] at which one chain lies on the table, as `resting_level`; None if it hangs."""
    level = lowest_level(chain)
    return level if level - table_height < HANGING else None


def resting_band(length: float) -> float:
    """Return how far points of a resting DLO of a length [m] are above its lowest one, at most [m]."""
    return in_proportion(RESTING_BAND, length)


def lowest_level(chain: Chain) -> float:
    """Return the median height [m] of the lowest points of a chain; infinity if there are too few of them."""
    z = chain.points[chain.seen, 2]
    lowest = z[z < z.min() + resting_band(chain.length)]
    return float(np.median(lowest)) if len(lowest) >= max(3, 0.15 * len(z)) else np.inf


def rest_on(points: Floats, level: float) -> Floats:
    """
    Return the (N, 3) [m] points, with those that rest moved exactly to `level`.

    These are the points below the level, or above it by less than half of `resting_band`:
    a simulation then starts with no point inside the table, and none that falls onto it.
    A part that lies on another part of the DLO keeps its height, even if the DLO is thin: a
    simulation cannot know otherwise which part is above.
    """
    rested, length = np.array(points), float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    resting = rested[:, 2] < level + resting_band(length) / 2
    resting &= ~_stacked(points, level, in_proportion(STACKED, length)) | (rested[:, 2] < level)
    rested[resting, 2] = level
    return rested


def crossing_segments(points: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats]:
    """
    Find the pairs of segments of a chain that cross, seen from above.

    The end of a segment belongs to the next one.  Neighbours, and parallel segments, do not cross.

    :param points: (n, 3) [m].
    :returns: the indices of both segments of each pair, (c,) and (c,), the first one nearer to the first
        point; and at which share of each of them, 0 to 1, it crosses the other, (c,) and (c,).
    """
    begin, step = points[:-1], np.diff(points, axis=0)
    here, there = np.triu_indices(len(step), 2)
    u, v, between = step[here], step[there], begin[there] - begin[here]
    with np.errstate(divide='ignore', invalid='ignore'):  # parallel segments do not cross
        determinant = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        s = (between[:, 0] * v[:, 1] - between[:, 1] * v[:, 0]) / determinant
        t = (between[:, 0] * u[:, 1] - between[:, 1] * u[:, 0]) / determinant
    crossing = np.flatnonzero((s >= 0) & (s < 1) & (t >= 0) & (t < 1))
    return here[crossing], there[crossing], s[crossing], t[crossing]


def _stacked(points: Floats, level: float, higher: float) -> NDArray[np.bool_]:
    """
    Return which (N, 3) [m] points belong to a part that lies on another part of the DLO, and rises for that.

    It does where its segment is above one of the other's, and at least `higher` [m].
    """
    rise = np.diff(points[:, 2])
    stacked = np.zeros(len(points), bool)
    if np.ptp(points[:, 2]) < higher:
        return stacked
    for here, there, s, t in zip(*crossing_segments(points), strict=True):
        above = float(points[there, 2] + t * rise[there] - points[here, 2] - s * rise[here])
        if abs(above) >= higher:
            raised = points[:, 2] > level + abs(above) * RISEN
            upper = int(there if above > 0 else here)
            first, last = upper + 1, upper
            while first > 0 and raised[first - 1]:
                first -= 1
            while last < len(points) - 1 and raised[last + 1]:
                last += 1
            stacked[first:last + 1] = True
    return stacked
