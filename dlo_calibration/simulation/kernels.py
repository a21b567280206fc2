# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels: one step of a DLO, compiled by Numba.

They compute the rod's internal forces and a table with friction.  The frame, hysteresis and contact of the
DLO with itself are in `kernels_frame`, `kernels_slip` and `kernels_contact`.  These modules are imported only
to compile them, as loading Numba takes a second: Python calls what `entries` declares.
"""

from __future__ import annotations

import math
from typing import Any

from dlo_calibration.simulation import entries
from dlo_calibration.simulation.compilation import entry, inlined, one_or_each, part
from dlo_calibration.simulation.kernels_contact import keep_apart
from dlo_calibration.simulation.kernels_frame import add_frame, turn_clamps
from dlo_calibration.simulation.kernels_near import is_near, movement
from dlo_calibration.simulation.kernels_slip import rub
from dlo_calibration.simulation.lanes import both, finite, LANES, numbers_of, some, where
from dlo_calibration.simulation.states import (
    BAND,
    COUNT,
    Cube,
    Indices,
    Matrix,
    RodState,
    RopeState,
    Vector,
)

HELD = 1e12  # weight of the equation that gives a held node its velocity, relative to its mass


@part
def _solve(bands: Matrix, right: Vector, solution: Matrix) -> bool:
    """
    Solve a banded symmetric system, by L D L^T (Golub and Van Loan, Matrix Computations, 4.3).

    Each column is finished at once from the six before it.  The last one stays in registers, so that nothing
    that the next pivot waits for comes from memory.

    :param bands: (6 + m, 7) columns of the lower triangle after six of zeros; becomes 1 / D and L D.
    :param right: (m,) right side; becomes D^-1 L^-1 of it.
    :param solution: (m / 3, 3) gets the solution.
    :returns: False if the matrix is not positive definite or a value is not finite.
    """
    size = len(right)
    least, inverse = math.inf, 0.0  # of the pivots; of the last one
    a1, a2, a3, a4, a5, a6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # of the last column
    r1, r2, r3, r4, r5, r6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # last values
    for j in range(size):
        column, value = bands[j + 6], right[j]
        b0, b1, b2, b3 = column[0], column[1], column[2], column[3]
        b4, b5, b6 = column[4], column[5], column[6]
        one = bands[j]
        share = one[6] * one[0]
        b0, value = b0 - share * one[6], value - share * r6
        one = bands[j + 1]
        share = one[5] * one[0]
        b0, b1, value = b0 - share * one[5], b1 - share * one[6], value - share * r5
        one = bands[j + 2]
        share = one[4] * one[0]
        b0, b1, b2 = b0 - share * one[4], b1 - share * one[5], b2 - share * one[6]
        value -= share * r4
        one = bands[j + 3]
        share = one[3] * one[0]
        b0, b1, b2, b3 = b0 - share * one[3], b1 - share * one[4], b2 - share * one[5], b3 - share * one[6]
        value -= share * r3
        one = bands[j + 4]
        share = one[2] * one[0]
        b0, b1, b2, b3 = b0 - share * one[2], b1 - share * one[3], b2 - share * one[4], b3 - share * one[5]
        b4, value = b4 - share * one[6], value - share * r2
        share = a1 * inverse
        b0, b1, b2, b3 = b0 - share * a1, b1 - share * a2, b2 - share * a3, b3 - share * a4
        b4, b5, value = b4 - share * a5, b5 - share * a6, value - share * r1
        least, inverse = min(least, b0), 1.0 / b0
        a1, a2, a3, a4, a5, a6 = b1, b2, b3, b4, b5, b6
        r1, r2, r3, r4, r5, r6 = value, r1, r2, r3, r4, r5
        column[0], column[1], column[2], column[3] = inverse, b1, b2, b3
        column[4], column[5], column[6] = b4, b5, b6
        right[j] = value * inverse
    total = 0.0
    r1, r2, r3, r4, r5, r6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(solution) - 1, -1, -1):
        for c in range(2, -1, -1):
            column, value = bands[3 * i + c + 6], right[3 * i + c]
            inverse = column[0]
            value = value - column[6] * inverse * r6 - column[5] * inverse * r5 - column[4] * inverse * r4
            value = value - column[3] * inverse * r3 - column[2] * inverse * r2 - column[1] * inverse * r1
            r1, r2, r3, r4, r5, r6 = value, r1, r2, r3, r4, r5
            solution[i, c] = value
            total += value
    solved: bool = both(finite(total), least > 0.0)
    return solved


@inlined
def _hold_one(bands: Matrix, right: Vector, masses: Vector, held: Indices, follow: Matrix) -> None:
    for h in range(len(held)):
        pull = HELD * masses[held[h]]
        for c in range(3):
            j = 3 * held[h] + c
            bands[j, 0] += pull
            right[j] += pull * follow[h, c]


def _hold(bands: Matrix, right: Vector, masses: Vector, held: Indices, follow: Matrix) -> None:
    """Let held nodes follow the velocities that their hands give them."""
    raise NotImplementedError('kernels alone use this')


@one_or_each(_hold)
def _hold_in(bands: Matrix, right: Vector, masses: Vector, held: Indices, follow: Matrix) -> Any:
    if bands.dtype != LANES:
        return lambda bands, right, masses, held, follow: _hold_one(bands, right, masses, held, follow)

    def each(bands: Matrix, right: Vector, masses: Vector, held: Any, follow: Any) -> None:
        for lane in range(COUNT):
            _hold_one(numbers_of(bands)[:, :, lane], numbers_of(right)[:, lane], numbers_of(masses)[:, lane],
                      held[lane], follow[lane])
    return each


@inlined
def _let_follow_one(predicted: Matrix, held: Indices, follow: Matrix) -> None:
    for h in range(len(held)):
        for c in range(3):
            predicted[held[h], c] = follow[h, c]


def let_follow(predicted: Matrix, held: Indices, follow: Matrix) -> None:
    """Give held nodes exactly the velocities of their hands."""
    raise NotImplementedError('kernels alone use this')


@one_or_each(let_follow)
def _let_follow_in(predicted: Matrix, held: Indices, follow: Matrix) -> Any:
    if predicted.dtype != LANES:
        return lambda predicted, held, follow: _let_follow_one(predicted, held, follow)

    def each(predicted: Matrix, held: Any, follow: Any) -> None:
        for lane in range(COUNT):
            _let_follow_one(numbers_of(predicted)[:, :, lane], held[lane], follow[lane])
    return each


@part
def _find_springs(points: Matrix, rest_lengths: Vector, stiffness: Vector, implicit: float, step: float,
                  segments: Matrix, springs: Matrix) -> None:
    """
    Find what the springs of all segments do; roots and divisions take long, but not if there are many.

    :param segments: (N - 1, 7) of `FrameState`: gets unit tangents and inverse lengths; or empty.
    :param springs: (N, 3) workspace: gets stiffness across and along the segment behind each node [kg], and
        its impulse [kg/s].
    """
    n, framed = len(points), len(segments) > 0
    for i in range(n - 1):
        here, there = points[i], points[i + 1]
        x, y, z = there[0] - here[0], there[1] - here[1], there[2] - here[2]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        slack = 1.0 - rest_lengths[i] * inverse
        across = max(slack, 0.0) * stiffness[i]
        springs[i, 0], springs[i, 2] = across * implicit, stiffness[i] * slack * step
        springs[i, 1] = implicit * (stiffness[i] - across) * inverse * inverse
        if framed:
            segments[i, 0], segments[i, 1], segments[i, 2] = x * inverse, y * inverse, z * inverse
            segments[i, 3] = inverse
    for c in range(3):
        springs[n - 1, c] = 0.0


@part
def _assemble(points: Matrix, velocities: Matrix, springs: Matrix, masses: Vector, bending: Matrix,
              drag: float, implicit: float, step: float, pull: Matrix, bands: Matrix, right: Vector) -> None:
    """
    Write the equations of a step, without frame and held nodes.

    :param springs: see `_find_springs`.
    :param pull: (N, 6) of `SlipState`; or empty.
    :param bands: (3 N, 7) gets the columns of the lower triangle.
    :param right: (3 N,) gets the right side.
    """
    n, rubs = len(points), len(pull) > 0
    # What the segment before a node adds to its equations, then what the one behind it does.
    xx, yy, zz, xy, xz, yz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        here, speed, mass, share = points[i], velocities[i], masses[i], bending[0, i]
        x, y, z = 0.0, 0.0, 0.0
        fx, fy, fz = share * here[0], share * here[1], share * here[2]
        if i + 1 < n:
            there, share = points[i + 1], bending[1, i]
            x, y, z = there[0] - here[0], there[1] - here[1], there[2] - here[2]
            fx, fy, fz = fx + share * there[0], fy + share * there[1], fz + share * there[2]
        if i + 2 < n:
            there, share = points[i + 2], bending[2, i]
            fx, fy, fz = fx + share * there[0], fy + share * there[1], fz + share * there[2]
        if i > 0:
            there, share = points[i - 1], bending[1, i - 1]
            fx, fy, fz = fx + share * there[0], fy + share * there[1], fz + share * there[2]
        if i > 1:
            there, share = points[i - 2], bending[2, i - 2]
            fx, fy, fz = fx + share * there[0], fy + share * there[1], fz + share * there[2]
        rx, ry, rz = mass * speed[0] - step * fx, mass * speed[1] - step * fy, mass * speed[2] - step * fz
        diagonal = mass * (1.0 + drag * step) + implicit * bending[0, i]
        first, second = implicit * bending[1, i], implicit * bending[2, i]
        if rubs:
            diagonal, first, second = diagonal + pull[i, 0], first + pull[i, 1], second + pull[i, 2]
            rx, ry, rz = rx - pull[i, 3], ry - pull[i, 4], rz - pull[i, 5]
        one, two, three, j = bands[3 * i], bands[3 * i + 1], bands[3 * i + 2], 3 * i
        ax, ay, az, rx, ry, rz = diagonal + xx, diagonal + yy, diagonal + zz, rx - tx, ry - ty, rz - tz
        bxy, bxz, byz = xy, xz, yz
        across, along, impulse = springs[i, 0], springs[i, 1], springs[i, 2]
        xx, yy, zz = along * x * x + across, along * y * y + across, along * z * z + across
        xy, xz, yz = along * x * y, along * x * z, along * y * z
        tx, ty, tz = impulse * x, impulse * y, impulse * z
        right[j], right[j + 1], right[j + 2] = rx + tx, ry + ty, rz + tz
        one[0], one[1], one[2], one[3], one[4], one[5] = ax + xx, bxy + xy, bxz + xz, first - xx, -xy, -xz
        two[0], two[1], two[2], two[3], two[4], two[5] = ay + yy, byz + yz, -xy, first - yy, -yz, 0.0
        three[0], three[1], three[2], three[3], three[4], three[5] = az + zz, -xz, -yz, first - zz, 0.0, 0.0
        one[6], two[6], three[6] = second, second, second


@inlined
def rod_velocities(rod: RodState, points: Matrix, velocities: Matrix, predicted: Matrix) -> bool:
    """
    Write to `predicted` the (N, 3) velocities [m/s] after a step of the internal forces; see `rod`.

    :returns: False if the rollout diverges.
    """
    right, step = rod.right, rod.step
    if len(rod.friction.rows) > 0:
        rub(rod.friction, points, step)
    _find_springs(points, rod.rest_lengths, rod.stiffness, rod.implicit, step, rod.frame.segments, predicted)
    _assemble(points, velocities, predicted, rod.masses, rod.bending, rod.drag, rod.implicit, step,
              rod.friction.pull, rod.bands[BAND - 1:], right)
    if len(rod.frame.angles) > 0:
        add_frame(rod.frame, step, right)
    _hold(rod.bands[BAND - 1:], right, rod.masses, rod.held, rod.follow)
    solved = _solve(rod.bands, right, predicted)
    let_follow(predicted, rod.held, rod.follow)
    return solved


@part
def rest_on_table(points: Matrix, predicted: Matrix, velocities: Matrix, level: float, friction: float,
                  step: float) -> None:
    """
    Write to `velocities` what `predicted` becomes by contact with a table, with Coulomb friction.

    The constants are Bullet's (PyBullet 3.2.7), found by single steps of a sphere on a plane.

    :param level: height of nodes that touch the table [m].
    """
    slop = 1e-5  # m of penetration that is allowed
    margin = 0.02 * math.sqrt(3.0) * 0.005  # m; a sphere of 5 mm that is further away is not in contact
    for i in range(len(points)):
        distance = points[i, 2] - level
        depth = -(distance + slop)
        least = where(depth > 0.0, 0.08 * depth / step, depth / step)  # one step corrects 8 %
        vx, vy, vz = predicted[i, 0], predicted[i, 1], predicted[i, 2]
        push = least - vz
        touches = both(distance < margin, push > 0.0)
        if some(touches):
            speed = math.sqrt(vx * vx + vy * vy)
            share = where(speed > 0.0, 1.0 - min(1.0, friction * push / speed), 0.0)
            share = where(touches, share, 1.0)
            vx, vy, vz = share * vx, share * vy, where(touches, least, vz)
        velocities[i, 0], velocities[i, 1], velocities[i, 2] = vx, vy, vz


@part
def _start_step(points: Matrix, velocities: Matrix, gravity: Vector, targets: Matrix, held: Indices,
                follow: Matrix, step: float) -> None:
    """Add gravity to the velocities; write those of the held nodes to `follow`."""
    for h in range(len(held)):
        for c in range(3):
            follow[h, c] = (targets[h, c] - points[held[h], c]) / step
    for i in range(len(points)):
        for c in range(3):
            velocities[i, c] += step * gravity[c]


@entry(entries.predict_velocities)
def predict_velocities(rope: RopeState, targets: Matrix, turns: Matrix) -> bool:
    """
    Write to `rope.predicted` the velocities due to gravity, internal forces and self-contact.

    :param targets: (h, 3) [m] positions of the held nodes after the step.
    :param turns: see `turn_clamps`.
    :returns: False if the rollout diverges.
    """
    rod, contact = rope.rod, rope.contact
    points, velocities, predicted = rope.points, rope.velocities, rope.predicted
    _start_step(points, velocities, rope.gravity, targets, rod.held, rod.follow, rod.step)
    if not rod_velocities(rod, points, velocities, predicted):
        return False
    turn_clamps(rod.frame.clamped, rod.frame.clamps, turns)
    if is_near(contact, points, movement(velocities, rod.step), movement(predicted, rod.step)):
        keep_apart(contact, points, predicted, rod.inverse_masses, rope.support, rod.step)
    return True


@entry(entries.advance)
def advance(rope: RopeState, targets: Cube, turns: Cube, level: float, path: Cube) -> int:
    """
    Take k steps on a table.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step.
    :param turns: (k, h, 9) of `turn_clamps` in each step, or (0, 0, 0).
    :param level: height of nodes that touch the table [m].
    :param path: (k, N, 3) [m] where the positions of all nodes after each step are written; or empty.
    :returns: number of steps taken, below k if the rollout diverged.
    """
    rod, contact, gravity, inverse_masses = rope.rod, rope.contact, rope.gravity, rope.rod.inverse_masses
    points, velocities, predicted, support = rope.points, rope.velocities, rope.predicted, rope.support
    held, follow, step, friction = rod.held, rod.follow, rod.step, contact.friction
    for k in range(len(targets)):
        _start_step(points, velocities, gravity, targets[k], held, follow, step)
        if not rod_velocities(rod, points, velocities, predicted):
            return k
        if len(turns) > 0:
            turn_clamps(rod.frame.clamped, rod.frame.clamps, turns[k])
        if is_near(contact, points, movement(velocities, step), movement(predicted, step)):
            keep_apart(contact, points, predicted, inverse_masses, support, step)
        rest_on_table(points, predicted, velocities, level, friction, step)
        for h in range(len(held)):
            for c in range(3):
                velocities[held[h], c] = follow[h, c]
        for i in range(len(points)):
            for c in range(3):
                support[i, c] = velocities[i, c] - predicted[i, c]
                points[i, c] += step * velocities[i, c]
        for h in range(len(held)):
            for c in range(3):
                points[held[h], c] = targets[k, h, c]
        if len(path) > 0:
            for i in range(len(points)):
                for c in range(3):
                    path[k, i, c] = points[i, c]
    return len(targets)
