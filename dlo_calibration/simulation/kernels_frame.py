# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels of the material frame: natural curvature and twist."""

from __future__ import annotations

import math
from typing import Any

from dlo_calibration.simulation.compilation import inlined, one_or_each, part
from dlo_calibration.simulation.kernels_carry import begin_to_carry, carry_along, HAIRPIN
from dlo_calibration.simulation.lanes import (
    cosine_and_sine,
    every,
    finite,
    LANES,
    numbers_of,
    some,
    where,
)
from dlo_calibration.simulation.states import COUNT, FrameState, IndexRows, Matrix, Vector

ROUNDED = 0.05  # rad; mean bend below which the energy of natural curvature is rounded off
STEADY = 0.01  # rad; where the bends are smaller than this, natural curvature turns the frame slowly
REACH = 0.2  # rad; most that the material frame turns in a step
FIRST_TURNS = 30  # iterations for the angles at the start; later, one in each step does


@part
def _angle_of(segments: Matrix, segment: int, direction: Vector, near: float) -> float:
    """Return the angle [rad] of a (3,) direction across a segment, in the turn that is next to `near`."""
    t0, t1, t2 = segments[segment, 0], segments[segment, 1], segments[segment, 2]
    u0, u1, u2 = segments[segment, 4], segments[segment, 5], segments[segment, 6]
    d0, d1, d2 = direction[0], direction[1], direction[2]
    angle = math.atan2(t0 * (u1 * d2 - u2 * d1) + t1 * (u2 * d0 - u0 * d2) + t2 * (u0 * d1 - u1 * d0),
                       u0 * d0 + u1 * d1 + u2 * d2)
    return angle + 2 * math.pi * round((near - angle) / (2 * math.pi))


@part
def _mean_direction(natural: Matrix, joints: Matrix) -> tuple[float, float]:
    """Return the bends [N m] in the directions of the natural curvature and across: sums over all joints."""
    one, two = 0.0, 0.0
    for i in range(len(natural)):
        one += natural[i, 0] * joints[i, 0] + natural[i, 1] * joints[i, 1]
        two += natural[i, 0] * joints[i, 1] - natural[i, 1] * joints[i, 0]
    return one, two


@part
def _turn_freely(natural: Matrix, joints: Matrix) -> None:
    """
    Turn the frame as a whole to the least energy, and find the twisting moments.

    With a and b of `_mean_direction`, the energy is ``-sqrt(a^2 + b^2)``.  It has a cusp where the DLO is
    straight; `ROUNDED` rounds it off.
    """
    one, two = _mean_direction(natural, joints)
    total = 0.0
    for i in range(len(natural)):
        total += natural[i, 2]
    least = ROUNDED * total / len(natural)
    size = math.sqrt(one * one + two * two + least * least)
    cosine, sine = one / size, two / size
    twist, slope = 0.0, 0.0
    for i in range(len(natural)):
        twist += slope  # no torque is left about the axis of a segment
        x, y = natural[i, 0] * cosine - natural[i, 1] * sine, natural[i, 0] * sine + natural[i, 1] * cosine
        slope = (joints[i, 0] * y - joints[i, 1] * x) / 2
        twist += slope
        joints[i, 3], joints[i, 4], joints[i, 5] = cosine, sine, twist


@part
def _first_angles_of_one(frame: FrameState) -> None:
    """Set the angles at the start: between clamps of known direction evenly twisted, else without twist."""
    angles, clamped, clamps, segments = frame.angles, frame.clamped, frame.clamps, frame.segments
    joints = frame.joints
    for i in range(len(joints)):
        carry_along(segments, joints, i)
    one, two = _mean_direction(frame.natural, joints)
    angles[:] = math.atan2(two, one)
    last = -1
    for s in range(len(clamped)):
        if not math.isfinite(clamps[s, 0]):
            continue
        j = clamped[s, 0]
        there = _angle_of(segments, j, clamps[s], angles[j] if last < 0 else angles[last])
        if last < 0:
            angles[:] = there
        else:
            for i in range(last, len(angles)):
                angles[i] = angles[last] + (there - angles[last]) * min(1.0, (i - last) / (j - last))
        last = j
    for i in range(len(joints)):
        phi = (angles[i] + angles[i + 1]) / 2
        joints[i, 3], joints[i, 4] = math.cos(phi), math.sin(phi)


@part
def _find_turn_of_one(segments: Matrix, angles: Vector, clamps: Matrix, s: int, j: int) -> None:
    t0, t1, t2 = segments[j, 0], segments[j, 1], segments[j, 2]
    u0, u1, u2 = segments[j, 4], segments[j, 5], segments[j, 6]
    v0, v1, v2 = t1 * u2 - t2 * u1, t2 * u0 - t0 * u2, t0 * u1 - t1 * u0
    d0, d1, d2 = clamps[s, 0], clamps[s, 1], clamps[s, 2]
    b0, b1, b2 = clamps[s, 3], clamps[s, 4], clamps[s, 5]
    if not math.isfinite(d0):
        cosine, sine = math.cos(angles[j]), math.sin(angles[j])
        d0, d1, d2 = cosine * u0 + sine * v0, cosine * u1 + sine * v1, cosine * u2 + sine * v2
    elif math.isfinite(b0):  # it goes with the segment, by the smallest rotation
        share = (d0 * t0 + d1 * t1 + d2 * t2) / max(1.0 + b0 * t0 + b1 * t1 + b2 * t2, 2 * HAIRPIN)
        d0, d1, d2 = d0 - share * (b0 + t0), d1 - share * (b1 + t1), d2 - share * (b2 + t2)
    clamps[s, 0], clamps[s, 1], clamps[s, 2] = d0, d1, d2
    clamps[s, 3], clamps[s, 4], clamps[s, 5] = t0, t1, t2
    turn: float = math.atan2(d0 * v0 + d1 * v1 + d2 * v2, d0 * u0 + d1 * u1 + d2 * u2) - angles[j]
    clamps[s, 6] = turn - 2 * math.pi * round(turn / (2 * math.pi))


def _find_turn(segments: Matrix, angles: Vector, clamps: Matrix, s: int, j: int) -> None:
    """Find how far [rad] segment `j` must turn in clamp `s`; one that just closed keeps what it finds."""
    raise NotImplementedError('kernels alone use this')


@one_or_each(_find_turn)
def _find_turn_in(segments: Matrix, angles: Vector, clamps: Matrix, s: int, j: int) -> Any:
    if segments.dtype != LANES:
        return lambda segments, angles, clamps, s, j: _find_turn_of_one(segments, angles, clamps, s, j)

    def each(segments: Matrix, angles: Vector, clamps: Matrix, s: int, j: int) -> None:
        for lane in range(COUNT):
            _find_turn_of_one(numbers_of(segments)[:, :, lane], numbers_of(angles)[:, lane],
                              numbers_of(clamps)[:, :, lane], s, j)
    return each


@part
def turn_clamps(clamped: IndexRows, clamps: Matrix, turns: Matrix) -> None:
    """
    Turn the clamps with their hands.

    :param turns: (h, 9) rotation matrices of the held nodes' hands in this step; (0, 0): the hands turn
        by the smallest rotation that follows the segment.
    """
    if len(turns) == 0:
        return
    for s in range(len(clamped)):
        h = clamped[s, 1]
        for k in range(0, 6, 3):  # the direction and the tangent
            x, y, z = clamps[s, k], clamps[s, k + 1], clamps[s, k + 2]
            for c in range(3):
                clamps[s, k + c] = turns[h, 3 * c] * x + turns[h, 3 * c + 1] * y + turns[h, 3 * c + 2] * z


@part
def _balance_torques(natural: Matrix, twisting: Vector, angles: Vector, clamped: IndexRows, clamps: Matrix,
                     segments: Matrix, joints: Matrix, turning: Matrix, begun: bool) -> None:
    """
    Carry the reference frame along, and turn the segments towards the balance of torques about their axes.

    The energy is that of twist plus ``-|A| cos(delta)`` of natural curvature at each joint, with delta the
    mean angle of both segments from the plane of the bend.  Where delta changes by less than `REACH`, the
    parabola with the curvature ``|A| (cos(delta) + REACH / 3)`` lies nowhere below, so that a Newton step of
    at most that size lowers the energy; where the matrix is not positive definite, its pivots are replaced
    (Nocedal and Wright, Numerical Optimization, 2006, 3.4).

    :param begun: False: clamps of unknown direction do not hold yet.
    """
    n = len(angles)
    coupling, upper, right, share, next_diagonal, next_right, s = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for i in range(n):
        diagonal, right = next_diagonal - share * upper, next_right - share * right
        coupling = 0.0
        if i < n - 1:
            x, y = carry_along(segments, joints, i)
            stiffness = twisting[i]
            one = natural[i, 0] * joints[i, 3] - natural[i, 1] * joints[i, 4]
            two = natural[i, 0] * joints[i, 4] + natural[i, 1] * joints[i, 3]
            slope = (x * two - y * one) / 2
            curved = (one * x + two * y + natural[i, 2] * (REACH / 3 * (abs(x) + abs(y)) + STEADY)) / 4
            torque = stiffness * (angles[i + 1] - angles[i])
            coupling = curved - stiffness
            next_diagonal, next_right = stiffness + curved, -torque - slope
            diagonal += next_diagonal
            right += torque - slope
        beside = twisting[max(i - 1, 0)]
        weak = diagonal < 1e-6 * beside
        if some(weak):
            diagonal = where(weak, beside, diagonal)
        upper = coupling
        if s < len(clamped) and clamped[s, 0] == i:
            if begun or every(finite(clamps[s, 0])):
                _find_turn(segments, angles, clamps, s, i)
                diagonal, right, upper = 1.0, clamps[s, 6], 0.0
            s += 1
        inverse = 1.0 / diagonal
        share = coupling * inverse
        turning[i, 0], turning[i, 1] = right * inverse, upper * inverse
    largest = 2 * REACH
    for i in range(n - 2, -1, -1):
        turning[i, 0] -= turning[i, 1] * turning[i + 1, 0]
        largest = max(largest, abs(turning[i, 0] + turning[i + 1, 0]))
    far = largest > 2 * REACH
    if some(far):
        share = where(far, 2 * REACH / largest, 1.0)
        for i in range(n):
            turning[i, 0] *= share
        for s in range(len(clamped)):
            if begun or every(finite(clamps[s, 0])):
                turning[clamped[s, 0], 0] = clamps[s, 6]
    angles[0] += turning[0, 0]
    for i in range(n - 1):
        angles[i + 1] += turning[i + 1, 0]
        cosine, sine = _turned(joints[i, 3], joints[i, 4], (turning[i, 0] + turning[i + 1, 0]) / 2)
        joints[i, 3], joints[i, 4] = cosine, sine
        joints[i, 5] = twisting[i] * (angles[i + 1] - angles[i])


@inlined
def _turned(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Return cosine and sine of an angle [rad] that has grown by `angle`."""
    q = angle * angle
    c, s = 1 - q * (0.5 - q * (1 / 24)), angle * (1 - q * (1 / 6 - q * (1 / 120)))
    large = abs(angle) > 0.01
    if some(large):
        exact_c, exact_s = cosine_and_sine(angle)
        c, s = where(large, exact_c, c), where(large, exact_s, s)
    x, y = cosine * c - sine * s, sine * c + cosine * s
    left = 1.5 - (x * x + y * y) / 2  # so that rounding does not add up
    return left * x, left * y


@part
def _begin_frame_of_one(frame: FrameState) -> None:
    _first_angles_of_one(frame)
    for _ in range(FIRST_TURNS):
        _balance_torques(frame.natural, frame.twisting, frame.angles, frame.clamped, frame.clamps,
                         frame.segments, frame.joints, frame.turning, False)


def _begin_frame(frame: FrameState) -> None:
    """Find the angles at the start."""
    raise NotImplementedError('kernels alone use this')


@one_or_each(_begin_frame)
def _begin_frame_in(frame: Any) -> Any:
    if frame.types[0].dtype != LANES:
        return lambda frame: _begin_frame_of_one(frame)
    return lambda frame: None  # several DLOs go on together from their second step on


@part
def add_frame(frame: FrameState, step: float, right: Vector) -> None:
    """
    Add to `right` (3 N,) the impulses [N s] of natural curvature and twist; see `rod`.

    The forces are the exact gradient of the energy, for segments that move without turning about their axes.
    A segment has no inertia about its axis, so that a couple of forces at its ends replaces the torque on it.
    """
    natural, twisting, angles, begun = frame.natural, frame.twisting, frame.angles, frame.begun
    segments, joints = frame.segments, frame.joints
    begin_to_carry(segments, frame.carried, begun[0] == 1)
    if len(twisting) == 0:
        for i in range(len(joints)):
            carry_along(segments, joints, i)
        _turn_freely(natural, joints)
    else:
        if begun[0] == 0:
            _begin_frame(frame)
        _balance_torques(natural, twisting, angles, frame.clamped, frame.clamps, segments, joints,
                         frame.turning, True)
    begun[0] = 1
    g0, g1, g2 = 0.0, 0.0, 0.0  # torque [N m] on the segment, turned by a right angle
    for i in range(len(joints) + 1):
        a0, a1, a2 = segments[i, 0], segments[i, 1], segments[i, 2]
        h0, h1, h2 = 0.0, 0.0, 0.0  # on the next one
        if i < len(joints):
            b0, b1, b2 = segments[i + 1, 0], segments[i + 1, 1], segments[i + 1, 2]
            u0, u1, u2 = segments[i, 4], segments[i, 5], segments[i, 6]
            inverse, half = joints[i, 2], joints[i, 6]
            one = half * (natural[i, 0] * joints[i, 3] - natural[i, 1] * joints[i, 4])
            two = half * (natural[i, 0] * joints[i, 4] + natural[i, 1] * joints[i, 3])
            d0 = one * u0 + two * (a1 * u2 - a2 * u1)
            d1 = one * u1 + two * (a2 * u0 - a0 * u2)
            d2 = one * u2 + two * (a0 * u1 - a1 * u0)
            share = (one * joints[i, 0] + two * joints[i, 1]) * (inverse / 2)
            twist = joints[i, 5] * (inverse * inverse / 2)
            n0, n1, n2 = twist * (a1 * b2 - a2 * b1), twist * (a2 * b0 - a0 * b2), twist * (a0 * b1 - a1 * b0)
            g0, g1, g2 = g0 - d0 - n0, g1 - d1 - n1, g2 - d2 - n2
            h0, h1, h2 = d0 - share * (a0 + b0) - n0, d1 - share * (a1 + b1) - n1, d2 - share * (a2 + b2) - n2
        share = step * segments[i, 3]
        j = 3 * i
        right[j] -= share * g0
        right[j + 1] -= share * g1
        right[j + 2] -= share * g2
        right[j + 3] += share * g0
        right[j + 4] += share * g1
        right[j + 5] += share * g2
        g0, g1, g2 = h0, h1, h2
