# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels that carry a frame along the DLO by the smallest rotations, without twist."""

from __future__ import annotations

import math
from typing import Any

from dlo_calibration.simulation.compilation import inlined, one_or_each, part
from dlo_calibration.simulation.lanes import LANES, numbers_of, some, where
from dlo_calibration.simulation.states import COUNT, Matrix, Vector

HAIRPIN = 0.01  # least squared cosine of half the angle between two segments: limits divisions


@part
def _transport(frame: Vector, before: Vector, tangent: Vector) -> None:
    """Transport `frame` (3,) from the tangent `before` (3,) to another by the smallest rotation, in place."""
    cosine = before[0] * tangent[0] + before[1] * tangent[1] + before[2] * tangent[2]
    along = frame[0] * tangent[0] + frame[1] * tangent[1] + frame[2] * tangent[2]
    share = along / max(1.0 + cosine, 2 * HAIRPIN)
    for c in range(3):
        frame[c] -= share * (before[c] + tangent[c])
    left = frame[0] * tangent[0] + frame[1] * tangent[1] + frame[2] * tangent[2]  # zero except in a hairpin
    for c in range(3):
        frame[c] -= left * tangent[c]
    size = math.sqrt(frame[0]**2 + frame[1]**2 + frame[2]**2)
    for c in range(3):
        frame[c] /= size


@part
def _perpendicular(tangent: Vector, frame: Vector) -> None:
    """Write to `frame` (3,) a unit vector perpendicular to a (3,) tangent."""
    least = 0
    for c in range(1, 3):
        if abs(tangent[c]) < abs(tangent[least]):
            least = c
    one, two = (least + 1) % 3, (least + 2) % 3
    size = math.hypot(tangent[one], tangent[two])
    frame[least], frame[one], frame[two] = 0.0, tangent[two] / size, -tangent[one] / size


@part
def _begin_to_carry_one(segments: Matrix, carried: Matrix, begun: bool) -> None:
    for c in range(3):
        carried[2, c] = segments[0, c]
    if begun:
        _transport(carried[1], carried[0], carried[2])
    else:
        _perpendicular(carried[2], carried[1])
    for c in range(3):
        carried[0, c], segments[0, 4 + c] = carried[2, c], carried[1, c]


def begin_to_carry(segments: Matrix, carried: Matrix, begun: bool) -> None:
    """Carry the first vector of the reference frame from where it was in the last step."""
    raise NotImplementedError('kernels alone use this')


@one_or_each(begin_to_carry)
def _begin_to_carry_in(segments: Matrix, carried: Matrix, begun: bool) -> Any:
    if segments.dtype != LANES:
        return lambda segments, carried, begun: _begin_to_carry_one(segments, carried, begun)

    def each(segments: Matrix, carried: Matrix, begun: bool) -> None:
        for lane in range(COUNT):
            _begin_to_carry_one(numbers_of(segments)[:, :, lane], numbers_of(carried)[:, :, lane], begun)
    return each


@inlined
def carry_along(segments: Matrix, joints: Matrix, i: int) -> tuple[float, float]:
    """
    Carry the reference frame without twist from segment `i` to the next one.

    :returns: components of the bend between them in this frame.
    """
    a0, a1, a2 = segments[i, 0], segments[i, 1], segments[i, 2]
    b0, b1, b2 = segments[i + 1, 0], segments[i + 1, 1], segments[i + 1, 2]
    u0, u1, u2 = segments[i, 4], segments[i, 5], segments[i, 6]
    square = (1.0 + a0 * b0 + a1 * b1 + a2 * b2) / 2
    hairpin = square < HAIRPIN
    if some(hairpin):
        square = where(hairpin, HAIRPIN, square)
    inverse = 1.0 / math.sqrt(square)
    x = (b0 * u0 + b1 * u1 + b2 * u2) * inverse
    y = (u0 * (a2 * b1 - a1 * b2) + u1 * (a0 * b2 - a2 * b0) + u2 * (a1 * b0 - a0 * b1)) * inverse
    joints[i, 0], joints[i, 1], joints[i, 2], joints[i, 6] = x, y, inverse, inverse * square
    share = x * (inverse / 2)
    u0, u1, u2 = u0 - share * (a0 + b0), u1 - share * (a1 + b1), u2 - share * (a2 + b2)
    if some(hairpin):  # that was not quite a rotation
        left = u0 * b0 + u1 * b1 + u2 * b2
        v0, v1, v2 = u0 - left * b0, u1 - left * b1, u2 - left * b2
        left = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        u0, u1 = where(hairpin, left * v0, u0), where(hairpin, left * v1, u1)
        u2 = where(hairpin, left * v2, u2)
    segments[i + 1, 4], segments[i + 1, 5], segments[i + 1, 6] = u0, u1, u2
    return x, y
