# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Clamps: how the DLO lies in hands that hold two of its points, and how it is twisted between them."""

from __future__ import annotations

import math
from typing import Sequence

import numpy as np

from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial


def clamps(trial: Trial) -> list[Hand]:
    """Return the hands that hold two or more points of the DLO from the start of a trial."""
    return [hand for hand in trial.hands if len(hand.grips) > 1 and hand.times[0] <= 0]


def clamp_twist(trials: Sequence[Trial]) -> float:
    """
    Return the angle [rad] of the clamp in the second half to that in the first, of a DLO without twist.

    The direction of the first clamp, see `clamp_directions`, is carried along each initial chain
    without twist (Bishop, There is more than one way to frame a curve, 1975). The angle turns the direction
    of the second clamp into it, in the mean over the trials that begin with two clamps; nan without any.
    """
    angles = []
    for trial in trials:
        points, held = trial.initial.points, clamps(trial)
        directions = clamp_directions(points, [(hand.grips, hand) for hand in held])
        segments = np.flatnonzero(np.isfinite(directions[:, 0]))
        if len(held) < 2 or len(segments) < 2:
            continue
        along = np.diff(points, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        first, last = int(segments[0]), int(segments[-1])
        carried = directions[first]
        for before, after in zip(along[first:last], along[first + 1:last + 1], strict=True):
            carried = carried - carried @ after / (1 + before @ after) * (before + after)
        there = directions[last]
        angles.append(math.atan2(np.cross(there, carried) @ along[last], there @ carried))
    return math.atan2(np.sin(angles).sum(), np.cos(angles).sum()) if angles else math.nan


def clamp_directions(points: Floats, holding: Sequence[tuple[Sequence[int], Hand]]) -> Floats:
    """
    Return unit vectors across the segments in clamps, (N - 1, 3), fixed to the hands; nan elsewhere.

    A DLO that stays in its clamps from trial to trial lies in the hand's frame always the same, so that
    any direction across it would do.  Where the orientations of hands are relative to the start of
    each trial, it does not.  So the direction is the x axis of the hand, turned by the smallest rotation from
    its -z axis to the DLO that leaves the clamp, or from its +z axis if that is nearer than 30 degrees.

    :param points: (N, 3) [m] nodes at the start.
    :param holding: the hands and the nodes that each of them holds.
    """
    directions = np.full((len(points) - 1, 3), np.nan)
    for nodes, hand in holding:
        turn = _matrix(hand.orientations[0])
        held = sorted(nodes)
        for segment in (a for a, b in zip(held[:-1], held[1:], strict=True) if b == a + 1):
            along = points[segment + 1] - points[segment]
            leaves = along if held[-1] < len(points) - 1 else -along
            there = turn.T @ (leaves / np.linalg.norm(leaves))
            axis = np.array([0.0, 0.0, 1.0 if there[2] > np.cos(np.pi / 6) else -1.0])
            across = np.array([1.0, 0.0, 0.0]) - there[0] / (1 + axis @ there) * (axis + there)
            directions[segment] = turn @ across
    return directions


def _matrix(quaternion: Floats) -> Floats:
    """Return the (3, 3) rotation matrix of a unit quaternion x y z w."""
    x, y, z, w = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


