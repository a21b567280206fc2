# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Natural curvature: the forces of a DLO that is curved where nothing bends it.

With natural curvature k the bending energy of inner node i is
``EI / (2 l) |t_i - t_(i-1) - k l d_i|^2``, l the length it stands for, d_i the
direction of the curve that the DLO has at rest: a unit vector of a frame that goes
along the DLO without twist (Bishop, There is more than one way to frame a
curve, 1975; transported from segment to segment as in Bergou et al., Discrete
Elastic Rods, 2008, 4.2).  Multiplied out, the first part is that of a straight
DLO, the last is constant, and what remains is

    -k EI g_i,    g_i = 2 sin(angle_i / 2) cos(angle from d_i to the plane of the bend)

The frame as a whole turns freely about the DLO to where its energy is least: a
DLO has next to no inertia about its axis, and how hands hold it does not
tell how it was coiled.  With a and b the sums of ``k EI g_i`` for two perpendicular
d, that is ``-sqrt(a^2 + b^2)``.  At a straight DLO that has a cusp, rounded off by
`ROUNDED`.

The forces are its exact slope.  A segment can turn about its axis without
inertia, so that the torque of its two joints about that axis vanishes, with the
moment that the joints need against twist; the rest of the torque is a couple of
forces at its ends.
"""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.chain import Floats

ROUNDED = 0.05  # rad of the bends in all below which the direction of the curvature is not settled
HAIRPIN = 0.01  # least squared cosine of half the angle between two segments


def natural_forces(segments: Floats, lengths: Floats, moments: Floats) -> Floats:
    """
    Return the forces on the nodes, (N, 3) [N].

    :param segments: (N - 1, 3) [m] from node to node.
    :param lengths: (N - 1,) [m] of them.
    :param moments: (N - 2,) [N m] EI times natural curvature at each inner node.
    """
    tangents = segments / lengths[:, None]
    first, second = tangents[:-1], tangents[1:]
    half = np.sqrt(np.maximum((1 + np.einsum('ij,ij->i', first, second)) / 2, HAIRPIN))
    directions = frame_along(tangents)
    sideways = np.cross(tangents, directions)
    bends = np.stack([np.einsum('ij,ij->i', second, axis[:-1]) for axis in (directions, sideways)]) / half
    least = bends @ moments
    least /= np.sqrt(least @ least + (ROUNDED * moments.mean())**2)
    directions = least[0] * directions + least[1] * sideways
    bend = (least @ bends) / (4 * half**2)

    joints = np.cross(second, directions[:-1]) + np.cross(first, directions[1:])
    joints = moments[:, None] * (joints / (2 * half[:, None]) + bend[:, None] * np.cross(first, second))
    torques = np.zeros_like(segments)
    torques[1:] += joints
    torques[:-1] -= joints
    against_twist = np.cumsum(-np.einsum('ij,ij->i', torques, tangents)[:-1]) / half
    axes = (against_twist / (2 * half))[:, None] * (first + second)
    torques[1:] -= axes
    torques[:-1] += axes
    couples = np.cross(torques, tangents) / lengths[:, None]
    forces = np.zeros((len(segments) + 1, 3))
    forces[1:] += couples
    forces[:-1] -= couples
    return forces


def frame_along(tangents: Floats) -> Floats:
    """Return (N - 1, 3) unit vectors perpendicular to the tangents that do not twist about them."""
    some = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=1)])
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    other = np.cross(tangents, some)
    first, second = tangents[:-1], tangents[1:]
    between = np.maximum(1 + np.einsum('ij,ij->i', first, second), 2 * HAIRPIN)
    there = some[:-1] - (np.einsum('ij,ij->i', second, some[:-1]) / between)[:, None] * (first + second)
    turned = np.arctan2(np.einsum('ij,ij->i', there, other[1:]), np.einsum('ij,ij->i', there, some[1:]))
    angles = np.concatenate([[0.0], np.cumsum(turned)])[:, None]
    # The angle from `some` of a vector that goes along without twist grows by what `some` lags behind it.
    frame: Floats = np.cos(angles) * some + np.sin(angles) * other
    return frame
