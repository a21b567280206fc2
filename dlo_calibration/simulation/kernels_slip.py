# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels of the friction between the strands of a cable."""

from __future__ import annotations

import math

from dlo_calibration.simulation.compilation import inlined, part
from dlo_calibration.simulation.kernels_carry import HAIRPIN
from dlo_calibration.simulation.lanes import some, where
from dlo_calibration.simulation.states import Matrix, SlipState

AHEAD = 0.6  # c of friction between strands, relative to the squared step; see `rod`


@part
def rub(friction: SlipState, points: Matrix, step: float) -> None:
    """
    Write to `friction.pull` what friction between strands adds to the equations of the nodes; see `rod`.

    The element is elastic and perfectly plastic (Iwan, A Distributed-Element Model for Hysteresis, 1966):
    where the bend is further than `slip` from the one that is kept, the latter follows.  What is kept turns
    with the DLO by the smallest rotation of the mean tangent.  Where the strands are going to slip in this
    step, the stiffness is that of the secant: a larger one would brake too much, a smaller one rattle.
    """
    rows, kept, pull = friction.rows, friction.kept, friction.pull
    begun, implicit = friction.begun[0] == 1, AHEAD * step * step
    friction.begun[0] = 1
    for i in range(len(rows)):  # loops that are short run in parallel inside a processor
        tx, ty = points[i + 2, 0] - points[i, 0], points[i + 2, 1] - points[i, 1]
        tz = points[i + 2, 2] - points[i, 2]
        share = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
        pull[i, 0], pull[i, 1], pull[i, 2], pull[i, 3] = share * tx, share * ty, share * tz, share
    d0, d1, o1 = 0.0, 0.0, 0.0  # of the next two nodes: diagonal and the entry below
    fx, fy, fz, gx, gy, gz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # and impulses
    for i in range(len(rows)):
        r0, r1, r2, stiffness, slip = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4]
        bx = r0 * points[i, 0] + r1 * points[i + 1, 0] + r2 * points[i + 2, 0]
        by = r0 * points[i, 1] + r1 * points[i + 1, 1] + r2 * points[i + 2, 1]
        bz = r0 * points[i, 2] + r1 * points[i + 1, 2] + r2 * points[i + 2, 2]
        tx, ty, tz, inverse = pull[i, 0], pull[i, 1], pull[i, 2], pull[i, 3]
        ex, ey, ez, next_x, next_y, next_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if begun:
            px, py, pz = kept[i, 0], kept[i, 1], kept[i, 2]
            sx, sy, sz = kept[i, 3], kept[i, 4], kept[i, 5]
            along = 2 * (sx * px + sy * py + sz * pz)
            sx, sy, sz = sx + tx, sy + ty, sz + tz
            share = (sx * px + sy * py + sz * pz) * _inverse(sx * sx + sy * sy + sz * sz) * 2
            ex = bx - px - along * tx + share * sx
            ey = by - py - along * ty + share * sy
            ez = bz - pz - along * tz + share * sz
            next_x = AHEAD * (ex - kept[i, 6])
            next_y = AHEAD * (ey - kept[i, 7])
            next_z = AHEAD * (ez - kept[i, 8])
            share = _limited(ex, ey, ez, slip)
            ex, ey, ez = share * ex, share * ey, share * ez
        px, py, pz = bx - ex, by - ey, bz - ez
        kept[i, 0], kept[i, 1], kept[i, 2] = px, py, pz
        kept[i, 3], kept[i, 4], kept[i, 5] = tx, ty, tz
        kept[i, 6], kept[i, 7], kept[i, 8] = ex, ey, ez
        stiffness *= _limited(ex + next_x, ey + next_y, ez + next_z, slip)
        weight, moment = implicit * stiffness, step * stiffness
        ex, ey, ez = moment * ex, moment * ey, moment * ez
        # What is kept turns with the outer nodes, so that they bear the torque on it.
        along, share = inverse * (px * tx + py * ty + pz * tz), inverse * (ex * tx + ey * ty + ez * tz)
        qx, qy, qz = along * ex - share * px, along * ey - share * py, along * ez - share * pz
        pull[i, 0], pull[i, 1], pull[i, 2] = d0 + weight * r0 * r0, o1 + weight * r0 * r1, weight * r0 * r2
        pull[i, 3], pull[i, 4], pull[i, 5] = fx + r0 * ex + qx, fy + r0 * ey + qy, fz + r0 * ez + qz
        d0, o1, d1 = d1 + weight * r1 * r1, weight * r1 * r2, weight * r2 * r2
        fx, fy, fz = gx + r1 * ex, gy + r1 * ey, gz + r1 * ez
        gx, gy, gz = r2 * ex - qx, r2 * ey - qy, r2 * ez - qz
    n = len(rows)
    pull[n, 0], pull[n, 1], pull[n, 2], pull[n, 3], pull[n, 4], pull[n, 5] = d0, o1, 0.0, fx, fy, fz
    pull[n + 1, 0], pull[n + 1, 1], pull[n + 1, 2] = d1, 0.0, 0.0
    pull[n + 1, 3], pull[n + 1, 4], pull[n + 1, 5] = gx, gy, gz


@inlined
def _limited(x: float, y: float, z: float, most: float) -> float:
    """Return by how much a vector must be multiplied so that it is not longer than `most`."""
    square = x * x + y * y + z * z
    share = 1.0
    longer = square > most * most
    if some(longer):
        share = where(longer, most / math.sqrt(square), share)
    return share


@inlined
def _inverse(square: float) -> float:
    """Return 1 / square, the squared length of the sum of two unit vectors, which are mostly parallel."""
    away = 1.0 - square / 4
    inverse = (1.0 + away * (1.0 + away * (1.0 + away))) / 4
    far = away > 1e-4
    if some(far):
        inverse = where(far, 1.0 / max(square, 4 * HAIRPIN), inverse)
    return inverse
