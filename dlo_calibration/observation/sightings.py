# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sightings: what a tracker saw of a DLO, and of the hands that move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats, frozen_array, interpolate_unseen

SPAN = 0.1  # s to either side over which a motion is measured


@dataclass(frozen=True, eq=False)
class Sightings:
    """
    What a tracker saw of a DLO.

    :param times: (n,) of the pictures, increasing [s].
    :param points: (n, m, 3) evenly spaced material points in the table's frame [m], at the level of a DLO on
        the table; NaN where they were not seen.
    :param cameras: (n, 3) where the camera was [m]; None: the points were measured in space.
    :param radius: of the DLO [m].
    """

    times: Floats
    points: Floats
    cameras: Floats | None = None
    radius: float = 0.0

    def __post_init__(self) -> None:
        for name in ('times', 'points', 'cameras'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen_array(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class HandSightings:
    """
    What was seen of a hand: the poses of its tag, or where the point is that it holds.

    :param positions: (n, 3) [m], at the times of the DLO's sightings; NaN where unknown.
    :param orientations: (n, 4) quaternions x y z w; None: it does not turn.
    :param place: share of the length at which it holds the DLO, where a person said so; the positions are
        then those of this point.
    """

    name: str
    positions: Floats
    orientations: Floats | None = None
    place: float | None = None


def usable(points: Floats) -> bool:
    """Return whether a chain shows enough points, see `Chain`."""
    return bool(np.isfinite(points[:, 0]).sum() >= max(3, -(-len(points) // 2)))


def complete(points: Floats) -> Floats | None:
    """Return a chain (m, 3) with its unseen points interpolated; None if too few are seen."""
    shown = np.isfinite(points[:, 0])
    if shown.all():
        return points
    return interpolate_unseen(points, shown, np.arange(float(len(points)))) if usable(points) else None


def points_at(points: Floats, places: Floats) -> Floats:
    """Return the points (p, 3) of a chain (m, 3) at shares (p,) of its length."""
    at = places * (len(points) - 1)
    below = np.minimum(np.floor(at + 1e-9).astype(int), len(points) - 1)
    beyond = np.minimum(below + 1, len(points) - 1)
    weight = np.clip(at - below, 0.0, 1.0)[:, None]
    between = (1.0 - weight) * points[below] + weight * points[beyond]
    return np.asarray(np.where(weight < 1e-6, points[below], between))  # not NaN for one beside it


def pictures_between(times: Floats, begin: float, end: float) -> NDArray[np.intp]:
    """Return the pictures of times (n,) from `begin` to `end` [s], both included."""
    return np.flatnonzero((times >= begin - 1e-9) & (times <= end + 1e-9))
