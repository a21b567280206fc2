# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels: the steps of `rod`, `natural`, `contact` and a table with friction, compiled by Numba.

They compute what `rod.Rod.velocities`, `natural.natural_forces` and `contact.SelfContact.velocities` do, and
what Bullet does with spheres on a plane, for many steps in one call.  The machine
code is kept in Numba's cache, so that it is compiled once a machine.  They are all in
one file, because a change of this file is all that the cache looks at.
"""

from __future__ import annotations

import math
from typing import Any, Callable, TypeVar

import numba
import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.natural import HAIRPIN, ROUNDED
from dlo_calibration.simulation.rod import HELD
from dlo_calibration.simulation.self_contact import (
    FASTEST_PUSH_OUT,
    ITERATIONS,
    PUSH_OUT,
    SUPPORTED,
    TINY,
    UNSUPPORTED,
    WEDGED,
)
from dlo_calibration.simulation.twist import ANGLE, BEGUN, COLUMNS, END, FIRST, LAST, START, STIFFNESS

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

# Bullet's treatment of a contact, as found by single steps of a sphere on a plane (PyBullet 3.2.7):
SLOP = 1e-5  # m that it lets a contact penetrate
PUSHED_OUT = 0.08  # share of a deeper penetration that one step removes
CONTACT = 0.02 * math.sqrt(3.0) * 0.005  # m; a sphere of 5 mm that is further away is not in contact

VECTOR, MATRIX, INDICES, PAIRS = 'f8[::1]', 'f8[:,::1]', 'i8[::1]', 'i8[:,::1]'  # in signatures
BAND = 7  # entries of a column of the matrix: the diagonal and six below it
CONTACT_COLUMNS = 24  # numbers that describe a contact, see `resolve`
SKIN = 0.004  # m; pairs that near are watched until the nodes may have moved that far


def _compiled(signature: str) -> Callable[[Kernel], Kernel]:
    """Compile at import, or take it from the cache: a rollout never waits for the compiler."""
    compile_: Any = numba.njit(signature, cache=True, nogil=True, error_model='numpy')
    return compile_  # type: ignore[no-any-return]


@_compiled(f'boolean({MATRIX}, {VECTOR})')
def _solve(bands: Floats, right: Floats) -> bool:
    """
    Solve a banded symmetric system in place, by L D L^T (Golub and Van Loan, Matrix Computations, 4.3).

    :param bands: (m + 6, 7) columns of the lower triangle, the last six rows unused; destroyed.
    :param right: (m + 6,) right side, becomes the solution.
    :returns: False where the matrix is not positive definite or anything is not finite.
    """
    size = len(right) - BAND + 1
    for j in range(size):
        pivot = bands[j, 0]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / pivot
        for k in range(1, BAND):
            factor = bands[j, k] * inverse
            for i in range(BAND - k):
                bands[j + k, i] -= factor * bands[j, k + i]
        for k in range(1, BAND):
            bands[j, k] *= inverse
            right[j + k] -= bands[j, k] * right[j]
        right[j] *= inverse
    total = 0.0
    for j in range(size - 1, -1, -1):
        value = right[j]
        for k in range(1, BAND):
            value -= bands[j, k] * right[j + k]
        right[j] = value
        total += value
    return math.isfinite(total)


@_compiled(f'void({VECTOR}, {VECTOR}, {VECTOR})')
def _carry(frame: Floats, before: Floats, tangent: Floats) -> None:
    """Turn `frame` (3,), perpendicular to `before` (3,), by the smallest rotation to another tangent (3,)."""
    cosine = before[0] * tangent[0] + before[1] * tangent[1] + before[2] * tangent[2]
    along = frame[0] * tangent[0] + frame[1] * tangent[1] + frame[2] * tangent[2]
    share = along / max(1.0 + cosine, 2 * HAIRPIN)
    for c in range(3):
        frame[c] -= share * (before[c] + tangent[c])
    left = frame[0] * tangent[0] + frame[1] * tangent[1] + frame[2] * tangent[2]  # nothing but in a hairpin
    for c in range(3):
        frame[c] -= left * tangent[c]
    size = math.sqrt(frame[0]**2 + frame[1]**2 + frame[2]**2)
    for c in range(3):
        frame[c] /= size


@_compiled(f'void({MATRIX}, {VECTOR}, f8, {VECTOR})')
def add_natural(points: Floats, moments: Floats, step: float, right: Floats) -> None:
    """Add to `right` (3 N,) the impulses [N s] of the natural curvature; see `natural.natural_forces`."""
    n = len(points) - 1
    # columns: tangent, frame, torque; then length, and of the joint at its end half, both bends
    tangent, frame, torque, length, half, bend = 0, 3, 6, 9, 10, 11
    segments = np.zeros((n, 13))
    for i in range(n):
        segment = segments[i]
        for c in range(3):
            segment[tangent + c] = points[i + 1, c] - points[i, c]
        segment[length] = math.sqrt(segment[0]**2 + segment[1]**2 + segment[2]**2)
        for c in range(3):
            segment[tangent + c] /= segment[length]
    start = segments[0]
    least = 0
    for c in range(1, 3):
        if abs(start[c]) < abs(start[least]):
            least = c
    one, two = (least + 1) % 3, (least + 2) % 3
    size = math.hypot(start[one], start[two])
    start[frame + one], start[frame + two] = start[two] / size, -start[one] / size
    total_x, total_y, total_moment = 0.0, 0.0, 0.0
    for i in range(n - 1):
        a, b = segments[i], segments[i + 1]
        cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        a[half] = math.sqrt(max((1.0 + cosine) / 2, HAIRPIN))
        x = b[0] * a[3] + b[1] * a[4] + b[2] * a[5]
        y = (b[0] * (a[1] * a[5] - a[2] * a[4]) + b[1] * (a[2] * a[3] - a[0] * a[5])
             + b[2] * (a[0] * a[4] - a[1] * a[3]))
        b[frame:frame + 3] = a[frame:frame + 3]
        _carry(b[frame:frame + 3], a[:3], b[:3])
        a[bend], a[bend + 1] = x / a[half], y / a[half]
        total_x += moments[i] * a[bend]
        total_y += moments[i] * a[bend + 1]
        total_moment += moments[i]
    size = math.sqrt(total_x**2 + total_y**2 + (ROUNDED * total_moment / (n - 1))**2)
    total_x /= size
    total_y /= size
    for i in range(n):
        a = segments[i]
        x = total_x * a[3] + total_y * (a[1] * a[5] - a[2] * a[4])
        y = total_x * a[4] + total_y * (a[2] * a[3] - a[0] * a[5])
        z = total_x * a[5] + total_y * (a[0] * a[4] - a[1] * a[3])
        a[3], a[4], a[5] = x, y, z
    against_twist = 0.0
    for i in range(n - 1):
        a, b = segments[i], segments[i + 1]
        both = (total_x * a[bend] + total_y * a[bend + 1]) / (4 * a[half]**2)
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            joint = moments[i] * (
                (b[d] * a[frame + e] - b[e] * a[frame + d] + a[d] * b[frame + e] - a[e] * b[frame + d])
                / (2 * a[half]) + both * (a[d] * b[e] - a[e] * b[d]))
            b[torque + c] += joint
            a[torque + c] -= joint
        against_twist -= a[0] * a[6] + a[1] * a[7] + a[2] * a[8]
        a[length + 3] = against_twist
    for i in range(n - 1):
        a, b = segments[i], segments[i + 1]
        share = a[length + 3] / (2 * a[half]**2)
        for c in range(3):
            axis = share * (a[c] + b[c])
            b[torque + c] -= axis
            a[torque + c] += axis
    for i in range(n):
        a = segments[i]
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            impulse = step * (a[torque + d] * a[e] - a[torque + e] * a[d]) / a[length]
            right[3 * i + 3 + c] += impulse
            right[3 * i + c] -= impulse


@_compiled(f'void({MATRIX}, {MATRIX}, f8, {VECTOR})')
def add_twist(points: Floats, spans: Floats, step: float, right: Floats) -> None:
    """Add to `right` (3 N,) the impulses [N s] of twist between clamps; see `twist.twist_forces`."""
    n = len(points) - 1
    tangents, torques = np.empty((n, 3)), np.zeros((n, 3))
    lengths = np.empty(n)
    for i in range(n):
        for c in range(3):
            tangents[i, c] = points[i + 1, c] - points[i, c]
        lengths[i] = math.sqrt(tangents[i, 0]**2 + tangents[i, 1]**2 + tangents[i, 2]**2)
        for c in range(3):
            tangents[i, c] /= lengths[i]
    frame, there = np.empty(3), np.empty(3)
    for k in range(len(spans)):
        span = spans[k]
        a, b = int(span[FIRST]), int(span[LAST])
        if span[BEGUN] == 0.0:
            span[START:START + 3] = tangents[a]
            least = 0
            for c in range(1, 3):
                if abs(tangents[a, c]) < abs(tangents[a, least]):
                    least = c
            one, two = (least + 1) % 3, (least + 2) % 3
            size = math.hypot(tangents[a, one], tangents[a, two])
            span[START + 3 + one], span[START + 3 + two] = tangents[a, two] / size, -tangents[a, one] / size
        frame[:] = span[START + 3:END]
        _carry(frame, span[START:START + 3], tangents[a])
        for i in range(a, b):
            _carry(frame, tangents[i], tangents[i + 1])
        if span[BEGUN] == 0.0:
            span[BEGUN] = 1.0
            span[END:END + 3] = tangents[b]
            span[END + 3:COLUMNS] = frame
        there[:] = span[END + 3:COLUMNS]
        _carry(there, span[END:END + 3], tangents[b])
        x, y = 0.0, 0.0
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            x += frame[c] * there[c]
            y += tangents[b, c] * (frame[d] * there[e] - frame[e] * there[d])
        angle = math.atan2(y, x)
        angle += 2 * math.pi * round((span[ANGLE] - angle) / (2 * math.pi))
        span[ANGLE] = angle
        for i in range(a, b):
            square = 0.0
            for c in range(3):
                square += (tangents[i, c] + tangents[i + 1, c])**2
            share = span[STIFFNESS] * angle / max(square / 2, 2 * HAIRPIN)
            for c in range(3):
                joint = share * (tangents[i, c] + tangents[i + 1, c])
                torques[i + 1, c] -= joint
                torques[i, c] += joint
    for i in range(n):
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            impulse = step * (torques[i, d] * tangents[i, e] - torques[i, e] * tangents[i, d]) / lengths[i]
            right[3 * i + 3 + c] += impulse
            right[3 * i + c] -= impulse


@_compiled(f'boolean({MATRIX}, {MATRIX}, {MATRIX}, {INDICES}, {MATRIX}, {VECTOR}, {VECTOR}, {VECTOR},'
           f' {MATRIX}, {VECTOR}, {MATRIX}, f8, f8, f8, {MATRIX}, {VECTOR})')
def rod_velocities(points: Floats, velocities: Floats, wanted: Floats, held: Any, follow: Floats,
                   rest: Floats, stiffness: Floats, masses: Floats, bending: Floats, natural: Floats,
                   spans: Floats, drag: float, implicit: float, step: float, bands: Floats,
                   right: Floats) -> bool:
    """
    Put the velocities after one step into `wanted`; see `rod.Rod.velocities`.

    Gravity is added by the caller, in `velocities`.

    :param natural: (N - 2,) [N m] as `rod.Rod.natural`; (0,): straight at rest.
    :param spans: (s, COLUMNS) as `rod.Rod.spans`.
    :param bands: (3 N + 6, 7), workspace.
    :param right: (3 N + 6,), workspace.
    :returns: False where the rollout diverges.
    """
    n = len(points)
    size = 3 * n
    for j in range(size):
        for k in range(BAND):
            bands[j, k] = 0.0
    right[size:] = 0.0
    bands[size:] = 0.0
    for i in range(n):
        diagonal = masses[i] * (1.0 + drag * step) + implicit * bending[0, i]
        for c in range(3):
            j = 3 * i + c
            bands[j, 0] = diagonal
            bands[j, 3] = implicit * bending[1, i]
            bands[j, 6] = implicit * bending[2, i]
            force = bending[0, i] * points[i, c]
            if i + 1 < n:
                force += bending[1, i] * points[i + 1, c]
            if i + 2 < n:
                force += bending[2, i] * points[i + 2, c]
            if i > 0:
                force += bending[1, i - 1] * points[i - 1, c]
            if i > 1:
                force += bending[2, i - 2] * points[i - 2, c]
            right[j] = masses[i] * velocities[i, c] - step * force
    for i in range(n - 1):
        x = points[i + 1, 0] - points[i, 0]
        y = points[i + 1, 1] - points[i, 1]
        z = points[i + 1, 2] - points[i, 2]
        square = x * x + y * y + z * z
        slack = 1.0 - rest[i] / math.sqrt(square)
        tension = stiffness[i] * slack * step
        across = max(slack, 0.0) * stiffness[i]
        along = implicit * (stiffness[i] - across) / square
        across *= implicit
        xx, yy, zz = along * x * x + across, along * y * y + across, along * z * z + across
        xy, xz, yz = along * x * y, along * x * z, along * y * z
        j = 3 * i
        right[j] += tension * x
        right[j + 1] += tension * y
        right[j + 2] += tension * z
        right[j + 3] -= tension * x
        right[j + 4] -= tension * y
        right[j + 5] -= tension * z
        for start in (j, j + 3):
            bands[start, 0] += xx
            bands[start, 1] += xy
            bands[start, 2] += xz
            bands[start + 1, 0] += yy
            bands[start + 1, 1] += yz
            bands[start + 2, 0] += zz
        bands[j, 3] -= xx
        bands[j, 4] -= xy
        bands[j, 5] -= xz
        bands[j + 1, 2] -= xy
        bands[j + 1, 3] -= yy
        bands[j + 1, 4] -= yz
        bands[j + 2, 1] -= xz
        bands[j + 2, 2] -= yz
        bands[j + 2, 3] -= zz
    if len(natural) > 0:
        add_natural(points, natural, step, right)
    if len(spans) > 0:
        add_twist(points, spans, step, right)
    for h in range(len(held)):
        pull = HELD * masses[held[h]]
        for c in range(3):
            j = 3 * held[h] + c
            bands[j, 0] += pull
            right[j] += pull * follow[h, c]
    if not _solve(bands, right):
        return False
    for i in range(n):
        for c in range(3):
            wanted[i, c] = right[3 * i + c]
    for h in range(len(held)):
        for c in range(3):
            wanted[held[h], c] = follow[h, c]
    return True


@_compiled(f'UniTuple(f8, 6)({MATRIX}, i8, i8)')
def _closest(points: Floats, first: int, second: int) -> tuple[float, float, float, float, float, float]:
    """Return s, t, the normal and the distance of two segments; see `contact`."""
    p0, p1, p2 = points[first, 0], points[first, 1], points[first, 2]
    q0, q1, q2 = points[second, 0], points[second, 1], points[second, 2]
    u0, u1, u2 = points[first + 1, 0] - p0, points[first + 1, 1] - p1, points[first + 1, 2] - p2
    v0, v1, v2 = points[second + 1, 0] - q0, points[second + 1, 1] - q1, points[second + 1, 2] - q2
    r0, r1, r2 = p0 - q0, p1 - q1, p2 - q2
    a = u0 * u0 + u1 * u1 + u2 * u2
    e = v0 * v0 + v1 * v1 + v2 * v2
    b = u0 * v0 + u1 * v1 + u2 * v2
    c = u0 * r0 + u1 * r1 + u2 * r2
    f = v0 * r0 + v1 * r1 + v2 * r2
    determinant = a * e - b * b
    s = 0.5
    if not determinant < 1e-9 * a * e:
        s = min(max((b * f - c * e) / determinant, 0.0), 1.0)
    t = (b * s + f) / e
    clipped = min(max(t, 0.0), 1.0)
    if t != clipped:
        s = min(max((b * clipped - c) / a, 0.0), 1.0)
    n0 = r0 + s * u0 - clipped * v0
    n1 = r1 + s * u1 - clipped * v1
    n2 = r2 + s * u2 - clipped * v2
    distance = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if distance > TINY:
        return s, clipped, n0 / distance, n1 / distance, n2 / distance, distance
    return s, clipped, 0.0, 0.0, 1.0, distance


@_compiled(f'i8({MATRIX}, {VECTOR}, {VECTOR}, f8, f8, f8, f8, {PAIRS})')
def near_pairs(points: Floats, middles: Floats, half: Floats, apart: float, diameter: float, stretch: float,
               reach: float, pairs: Any) -> int:
    """
    List the pairs of segments that may touch each other and are nearer than `reach` [m].

    :param middles: (S,) [m] of the segments along the DLO; `half` (S,) [m] half their lengths.
    :param apart: pairs that are nearer along the DLO cannot touch [m].
    :param stretch: how much longer than at rest a segment may be.
    :param pairs: (S (S - 1) / 2, 2) to write to.
    :returns: how many there are.
    """
    count, segments = 0, len(half)
    x, y, z = np.empty(segments), np.empty(segments), np.empty(segments)
    for i in range(segments):
        x[i] = (points[i, 0] + points[i + 1, 0]) / 2
        y[i] = (points[i, 1] + points[i + 1, 1]) / 2
        z[i] = (points[i, 2] + points[i + 1, 2]) / 2
    for i in range(segments):
        first = i + 1
        while first < segments and middles[first] - middles[i] - half[first] - half[i] <= apart:
            first += 1
        for j in range(first, segments):
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            far = stretch * (half[i] + half[j] + diameter) + reach
            if dx * dx + dy * dy + dz * dz <= far * far:
                pairs[count, 0] = i
                pairs[count, 1] = j
                count += 1
    return count


@_compiled(f'void({MATRIX}, {VECTOR}, {VECTOR}, f8, f8, {PAIRS}, {MATRIX})')
def start_distances(points: Floats, middles: Floats, half: Floats, apart: float, diameter: float, pairs: Any,
                    distances: Floats) -> None:
    """Fill (S, S) `distances` [m] that pairs must keep; see `contact.SelfContact.start`."""
    distances[:] = diameter
    for k in range(near_pairs(points, middles, half, apart, diameter, 1.0, 0.0, pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        distances[i, j] = min(diameter, _closest(points, i, j)[5])


@_compiled(f'void({MATRIX}, {MATRIX}, {VECTOR}, {MATRIX}, {PAIRS}, {MATRIX}, f8, f8, f8, {MATRIX}, {MATRIX})')
def resolve(points: Floats, velocities: Floats, inverse_masses: Floats, support: Floats, pairs: Any,
            distances: Floats, diameter: float, friction: float, step: float, contacts: Floats,
            change: Floats) -> None:
    """
    Make `velocities` what the contacts between pairs of segments allow; see `contact.SelfContact`.

    :param pairs: (c, 2) segments that are near each other.
    :param distances: (S, S) [m] that pairs keep.
    :param contacts: (c, CONTACT_COLUMNS), workspace: see the names below.
    :param change: (N, 3), workspace.
    """
    # columns of contacts: four nodes, weights, yieldings; normal, mobility, target, pushed, rubbed, impulse
    node, weight, yielding, normal = 0, 4, 8, 12
    mobility, target, pushed, rubbed, impulse = 15, 16, 17, 18, 21
    count = 0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        s, t, n0, n1, n2, distance = _closest(points, i, j)
        allowed = max(distances[i, j], min(distance, diameter))
        distances[i, j] = allowed
        gap = distance - allowed
        wanted = -gap / step if gap > 0 else min(-PUSH_OUT * gap / step, FASTEST_PUSH_OUT)
        approach = 0.0
        contact = contacts[count]
        contact[normal], contact[normal + 1], contact[normal + 2] = n0, n1, n2
        contact[node], contact[node + 1], contact[node + 2], contact[node + 3] = i, i + 1, j, j + 1
        contact[weight], contact[weight + 1] = 1 - s, s
        contact[weight + 2], contact[weight + 3] = -(1 - t), -t
        for m in range(4):
            at = int(contact[node + m])
            approach += contact[weight + m] * (
                velocities[at, 0] * n0 + velocities[at, 1] * n1 + velocities[at, 2] * n2)
        if approach < wanted:
            contact[target] = wanted
            count += 1
    if count == 0:
        return
    change[:] = 0.0
    for k in range(count):
        for m in range(4):
            change[int(contacts[k, node + m]), 0] += 1.0  # how many contacts share the node
    for k in range(count):
        contact = contacts[k]
        given, full, shared = 0.0, 0.0, 0.0
        for m in range(4):
            at = int(contact[node + m])
            w = contact[weight + m]
            backing, size = 0.0, 0.0
            for c in range(3):
                backing += support[at, c] * contact[normal + c]
                size += support[at, c] * support[at, c]
            if w < 0:
                backing = -backing
            elif w == 0:
                backing = 0.0
            resistance = max(SUPPORTED * math.sqrt(size), UNSUPPORTED)
            contact[yielding + m] = inverse_masses[at] if backing > -resistance else 0.0
            given += w * w * contact[yielding + m]
            full += w * w * inverse_masses[at]
        for m in range(4):
            at = int(contact[node + m])
            if given < WEDGED * full:
                contact[yielding + m] = inverse_masses[at]
            shared += contact[weight + m]**2 * contact[yielding + m] * change[at, 0]
        contact[mobility] = shared if shared > 0 else math.inf  # both held
        contact[pushed] = 0.0
        contact[rubbed:rubbed + 3] = 0.0
    for _ in range(ITERATIONS):
        change[:] = 0.0
        for k in range(count):
            contact = contacts[k]
            approach, size = 0.0, 0.0
            for c in range(3):
                relative = 0.0
                for m in range(4):
                    relative += contact[weight + m] * velocities[int(contact[node + m]), c]
                contact[impulse + c] = relative
                approach += relative * contact[normal + c]
            push = max(contact[pushed] + (contact[target] - approach) / contact[mobility], 0.0)
            for c in range(3):
                contact[impulse + c] = contact[rubbed + c] - (
                    contact[impulse + c] - approach * contact[normal + c]) / contact[mobility]
                size += contact[impulse + c]**2
            share = min(1.0, friction * push / max(math.sqrt(size), TINY))
            for c in range(3):
                rub = share * contact[impulse + c]
                contact[impulse + c] = rub - contact[rubbed + c] + (
                    push - contact[pushed]) * contact[normal + c]
                contact[rubbed + c] = rub
            contact[pushed] = push
            for m in range(4):
                at = int(contact[node + m])
                factor = contact[weight + m] * contact[yielding + m]
                for c in range(3):
                    change[at, c] += factor * contact[impulse + c]
        velocities += change
    for k in range(count):
        contact = contacts[k]
        for m in range(4):
            at = int(contact[node + m])
            passed_on = contact[weight + m] * (inverse_masses[at] - contact[yielding + m])
            for c in range(3):
                velocities[at, c] += passed_on * (
                    contact[pushed] * contact[normal + c] + contact[rubbed + c])


@_compiled(f'void({MATRIX}, {MATRIX}, f8, f8, f8)')
def rest_on_table(points: Floats, velocities: Floats, level: float, friction: float, step: float) -> None:
    """
    Make `velocities` what a table allows, with Coulomb friction, as Bullet does.

    :param level: height of nodes that touch the table [m].
    """
    for i in range(len(points)):
        distance = points[i, 2] - level
        if distance > CONTACT:
            continue
        depth = -(distance + SLOP)
        wanted = PUSHED_OUT * depth / step if depth > 0 else depth / step
        push = wanted - velocities[i, 2]
        if push <= 0:
            continue
        velocities[i, 2] = wanted
        speed = math.hypot(velocities[i, 0], velocities[i, 1])
        share = 1.0 - min(1.0, friction * push / speed) if speed > 0 else 0.0
        velocities[i, 0] *= share
        velocities[i, 1] *= share


@_compiled(f'i8(f8[:,:,::1], {INDICES}, {MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, {VECTOR}, {VECTOR}, {VECTOR},'
           f' {MATRIX}, {VECTOR}, {MATRIX}, {MATRIX}, {PAIRS}, {MATRIX}, {MATRIX}, {VECTOR}, {MATRIX},'
           f' {MATRIX}, {VECTOR}, f8[:,:,::1])')
def advance(targets: Floats, held: Any, points: Floats, velocities: Floats, support: Floats, rest: Floats,
            stiffness: Floats, masses: Floats, inverse_masses: Floats, bending: Floats, natural: Floats,
            spans: Floats, distances: Floats, pairs: Any, contacts: Floats, bands: Floats, right: Floats,
            wanted: Floats, change: Floats, constants: Floats, path: Floats) -> int:
    """
    Take k steps; what is not explained here is the state, see `compiled.CompiledRope`.

    :param targets: (k, h, 3) [m] where the held nodes are after each step.
    :param path: (k, N, 3) to write where all nodes are after each step [m]; or empty.
    :returns: how many steps were taken; fewer than k where the rollout diverged.
    """
    drag, implicit, step, gravity = constants[0], constants[1], constants[2], constants[3]
    level, friction, diameter, apart = constants[4], constants[5], constants[6], constants[7]
    n = len(points)
    places = rest.cumsum()
    half = rest / 2
    middles = places - half
    follow = np.empty((len(held), 3))
    for k in range(len(targets)):
        for h in range(len(held)):
            for c in range(3):
                follow[h, c] = (targets[k, h, c] - points[held[h], c]) / step
        for i in range(n):
            velocities[i, 2] -= step * gravity
        if not rod_velocities(points, velocities, wanted, held, follow, rest, stiffness, masses, bending,
                              natural, spans, drag, implicit, step, bands, right):
            return k
        fastest = 0.0
        for i in range(n):
            fastest = max(fastest, wanted[i, 0]**2 + wanted[i, 1]**2 + wanted[i, 2]**2)
        travel = 2 * step * math.sqrt(fastest)
        constants[8] -= travel
        if constants[8] < 0:
            constants[9] = near_pairs(points, middles, half, apart, diameter, 1.2, travel + SKIN, pairs)
            constants[8] = SKIN
        if constants[9] > 0:
            resolve(points, wanted, inverse_masses, support, pairs[:int(constants[9])], distances, diameter,
                    friction, step, contacts, change)
        for i in range(n):
            for c in range(3):
                velocities[i, c] = wanted[i, c]
        rest_on_table(points, velocities, level, friction, step)
        for h in range(len(held)):
            for c in range(3):
                velocities[held[h], c] = follow[h, c]
        for i in range(n):
            for c in range(3):
                support[i, c] = velocities[i, c] - wanted[i, c]
                points[i, c] += step * velocities[i, c]
        for h in range(len(held)):
            for c in range(3):
                points[held[h], c] = targets[k, h, c]
        if len(path) > 0:
            path[k] = points
    return len(targets)
