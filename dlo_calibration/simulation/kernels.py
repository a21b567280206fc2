# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels: the physics of a DLO, compiled by Numba.

They compute the rod's internal forces with natural curvature and twist, contact of the DLO
with itself, and a table with friction.  Numba's cache keeps the machine code, so that it is
compiled once per machine.  All kernels are in one file because the cache notices only
changes of the file that a kernel is in, not of the kernels that it calls.
"""

from __future__ import annotations

import math
from typing import Any, Callable, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

# Annotations that tell the number of axes:
Vector = Floats
Matrix = Floats
Cube = Floats
Indices = NDArray[np.int64]
Spans = NDArray[np.void]
Contacts = NDArray[np.void]
IndexRows = NDArray[np.int64]
#: annotation -> the type that a kernel is compiled for
TYPES: dict[str, Any] = {
    'None': numba.void, 'bool': numba.boolean, 'int': numba.int64, 'float': numba.float64,
    'Vector': numba.float64[::1], 'Matrix': numba.float64[:, ::1], 'Cube': numba.float64[:, :, ::1],
    'Indices': numba.int64[::1], 'IndexRows': numba.int64[:, ::1]}

HELD = 1e12  # weight of the equation that gives a held node its velocity, relative to its mass
ROUNDED = 0.05  # rad; mean bend below which the energy of natural curvature is rounded off
HAIRPIN = 0.01  # least squared cosine of half the angle between two segments: limits divisions
TINY = 1e-12  # m or m/s; shorter vectors have no direction

# Contact of a DLO with itself:
ITERATIONS = 10  # of the contact solver, as many as Bullet makes
PUSH_OUT = 0.8  # share of a penetration that one step corrects
FASTEST_PUSH_OUT = 0.8  # m/s; limits that correction, so that it does not throw the DLO apart
SUPPORTED = 0.5  # cosine between a push and the opposing support from which on the node is supported
UNSUPPORTED = 1e-6  # m/s; a smaller change of velocity is rounding, not support
WEDGED = 0.1  # least share of the mobility of a pair; with less it is wedged, and all its nodes yield
SKIN = 0.004  # m; pairs within this gap are checked until nodes may have moved this far

BAND = 7  # entries per column of the lower triangle: node i couples with i + 2, three coordinates each


def _record(record: Any) -> Any:
    """Let kernels take a named tuple; its annotations give the types of its fields."""
    make: Any = numba.types.NamedTuple
    TYPES[record.__name__] = make([TYPES[word.__forward_arg__] for word in record.__annotations__.values()],
                                  record)
    return record


# Numba counts references to all arrays of a record that is passed, and to each field that is read.  So
# kernels read fields before a loop, and pass few records in each step.


def _part(kernel: Kernel) -> Kernel:
    """Compile a function together with the kernels that call it."""
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


def _compiled(kernel: Kernel) -> Kernel:
    """Compile a kernel at import, or load it from the cache: a rollout never waits for the compiler."""
    *arguments, returned = (TYPES[word] for word in kernel.__annotations__.values())
    compile_: Any = numba.njit(returned(*arguments), cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


#: the part of a DLO between two clamps, which resists twist
SPAN = np.dtype([
    ('first', 'i8'), ('last', 'i8'),  # segments that the clamps hold
    ('stiffness', 'f8'),  # torque per angle [N m]
    ('angle', 'f8'),  # twist [rad]
    ('begun', 'i8'),  # 1 if it has been stepped since the clamps closed, else 0
    ('start', 'f8', 3), ('start_frame', 'f8', 3),  # unit vectors along and across `first` at that time
    ('end', 'f8', 3), ('end_frame', 'f8', 3)], align=True)  # and of `last`

#: two segments that touch each other
CONTACT = np.dtype([
    ('nodes', 'i8', 4),  # ends of the first and of the second segment
    ('weights', 'f8', 4),  # of the nodes in the relative velocity of the closest points
    ('yielding', 'f8', 4),  # inverse masses of the nodes [1/kg]; 0 if another body supports them
    ('normal', 'f8', 3),  # unit vector from the second to the first segment
    ('mobility', 'f8'),  # relative velocity per impulse [1/kg]
    ('least', 'f8'),  # least velocity along the normal [m/s]
    ('pushed', 'f8'), ('rubbed', 'f8', 3),  # total impulses along and across the normal [N s]
    ('impulse', 'f8', 3)], align=True)  # of the current iteration [N s]

TYPES['Spans'], TYPES['Contacts'] = numba.from_dtype(SPAN)[::1], numba.from_dtype(CONTACT)[::1]


@_record
class RodState(NamedTuple):
    """
    All that determines the internal forces of N nodes; `rod.Rod` makes it.

    :param rest_lengths: (N - 1,) [m] lengths of the segments at rest.
    :param stiffness: (N - 1,) [N/m] of the stretching springs.
    :param masses: (N,) [kg].
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param bending: (3, N) [N/m] bending matrix: its diagonal and the two below.
    :param natural: (N - 2,) [N m] EI times natural curvature at each inner node; (0,): a straight rest shape.
    :param spans: (s,) of `SPAN`: the parts that resist twist.
    :param held: (h,) nodes that follow given velocities.
    :param follow: (h, 3) [m/s] velocities of the held nodes.
    :param drag: acceleration against the velocity [1/s].
    :param implicit: c [s^2] of the step; see `rod`.
    :param step: time step [s].
    :param bands: (3 N + 6, 7) workspace: columns of the lower triangle of the matrix.
    :param right: (3 N + 6,) workspace: right side.
    """

    rest_lengths: Vector
    stiffness: Vector
    masses: Vector
    inverse_masses: Vector
    bending: Matrix
    natural: Vector
    spans: Spans
    held: Indices
    follow: Matrix
    drag: float
    implicit: float
    step: float
    bands: Matrix
    right: Vector


@_record
class SelfContact(NamedTuple):
    """
    Contact of S segments with each other: capsules that do not pass through each other.

    Spheres at the nodes would let parts of a thin DLO through, because its nodes lie further
    apart than its diameter.  Two segments whose arc-length distance is below half the
    circumference of the cross-section cannot touch: that is the shortest hairpin.  Pairs that
    are nearer than a diameter at the start keep that distance until they have moved apart, so
    that a radius that is too large does not burst the DLO open.

    :param half: (S,) [m] half the lengths of the segments.
    :param middles: (S,) [m] arc lengths of their middles.
    :param diameter: [m].
    :param apart: least arc length [m] between two segments that can touch.
    :param friction: Coulomb coefficient.
    :param distances: (S, S) [m] least distances of the pairs.
    :param pairs: (S (S - 1) / 2, 2) segments; the first `near` of these pairs are near each other.
    :param near: (1,) number of these pairs.
    :param room: (1,) [m] how far nodes may move until pairs must be searched again; negative: search now.
    :param contacts: (S (S - 1) / 2,) of `CONTACT`, workspace.
    :param change: (S + 1, 3) workspace.
    """

    half: Vector
    middles: Vector
    diameter: float
    apart: float
    friction: float
    distances: Matrix
    pairs: IndexRows
    near: Indices
    room: Vector
    contacts: Contacts
    change: Matrix


@_record
class RopeState(NamedTuple):
    """
    The state of a DLO between two steps; `rope.Rope` makes it.

    :param points: (N, 3) [m].
    :param velocities: (N, 3) [m/s].
    :param predicted: (N, 3) [m/s] velocities after the step without contact with other bodies.
    :param support: (N, 3) [m/s] change of the velocities by other bodies in the last step.
    :param gravity: (3,) [m/s^2].
    :param rod: all about the internal forces.
    :param contact: all about contact with itself.
    """

    points: Matrix
    velocities: Matrix
    predicted: Matrix
    support: Matrix
    gravity: Vector
    rod: RodState
    contact: SelfContact


@_part
def _solve(bands: Matrix, right: Vector) -> bool:
    """
    Solve a banded symmetric system in place, by L D L^T (Golub and Van Loan, Matrix Computations, 4.3).

    :param bands: (m + 6, 7) columns of the lower triangle, the last six rows unused; destroyed.
    :param right: (m + 6,) right side; becomes the solution.
    :returns: False if the matrix is not positive definite or a value is not finite.
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


@_part
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


@_part
def _tangents(points: Matrix, tangents: Matrix, lengths: Vector) -> None:
    """Write the (n, 3) unit tangents of the segments and their (n,) lengths [m]."""
    for i in range(len(lengths)):
        for c in range(3):
            tangents[i, c] = points[i + 1, c] - points[i, c]
        lengths[i] = math.sqrt(tangents[i, 0]**2 + tangents[i, 1]**2 + tangents[i, 2]**2)
        for c in range(3):
            tangents[i, c] /= lengths[i]


@_part
def _perpendicular(tangent: Vector, frame: Vector) -> None:
    """Write to `frame` (3,) a unit vector perpendicular to a (3,) tangent."""
    least = 0
    for c in range(1, 3):
        if abs(tangent[c]) < abs(tangent[least]):
            least = c
    one, two = (least + 1) % 3, (least + 2) % 3
    size = math.hypot(tangent[one], tangent[two])
    frame[least], frame[one], frame[two] = 0.0, tangent[two] / size, -tangent[one] / size


@_part
def _add_couples(torques: Matrix, tangents: Matrix, lengths: Vector, step: float, right: Vector) -> None:
    """Add to `right` the impulses [N s] at the segments' ends that are equal to (n, 3) torques [N m]."""
    for i in range(len(lengths)):
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            impulse = step * (torques[i, d] * tangents[i, e] - torques[i, e] * tangents[i, d]) / lengths[i]
            right[3 * i + 3 + c] += impulse
            right[3 * i + c] -= impulse


@_part
def add_natural(points: Matrix, moments: Vector, step: float, right: Vector) -> None:
    """
    Add to `right` (3 N,) the impulses [N s] of a DLO with a curved rest shape.

    With natural curvature k the bending energy of inner node i is
    ``EI / (2 l) |t_i - t_(i-1) - k l d_i|^2``.  There, l is the length that the node
    stands for, and d_i the direction of the curvature at rest: a unit vector of a frame
    without twist (Bishop, There is more than one way to frame a curve, 1975;
    transported from segment to segment as in Bergou et al., Discrete Elastic Rods,
    2008, 4.2).  Of the square, the first term is the energy of a straight DLO and the
    last one is constant.  The mixed term remains:

        -k EI g_i,    g_i = 2 sin(angle_i / 2) cos(angle from d_i to the plane of the bend)

    The frame as a whole turns freely about the DLO to the least energy, because a
    DLO has almost no inertia about its axis and the grips do not tell in which
    direction it was coiled.  With a and b the sums of ``k EI g_i`` for two perpendicular
    d, the least energy is ``-sqrt(a^2 + b^2)``.  It has a cusp where the DLO is
    straight; `ROUNDED` rounds it off.

    The forces are the exact gradient of this energy.  A segment has no inertia about its
    axis, so the torques of its two joints about the axis cancel; the twisting moments of
    the joints follow from that.  A couple of forces at the segment's ends replaces the
    rest of the torque.

    :param moments: (N - 2,) [N m] EI times natural curvature at each inner node.
    """
    n = len(points) - 1
    tangents, frames, torques = np.empty((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    lengths, halves, bends = np.empty(n), np.empty(n), np.empty((n, 2))  # bends: in two directions
    _tangents(points, tangents, lengths)
    _perpendicular(tangents[0], frames[0])
    total_x, total_y, total_moment = 0.0, 0.0, 0.0
    for i in range(n - 1):
        a, b, frame = tangents[i], tangents[i + 1], frames[i]
        cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        halves[i] = math.sqrt(max((1.0 + cosine) / 2, HAIRPIN))
        x = b[0] * frame[0] + b[1] * frame[1] + b[2] * frame[2]
        y = (b[0] * (a[1] * frame[2] - a[2] * frame[1]) + b[1] * (a[2] * frame[0] - a[0] * frame[2])
             + b[2] * (a[0] * frame[1] - a[1] * frame[0]))
        frames[i + 1] = frame
        _transport(frames[i + 1], a, b)
        bends[i, 0], bends[i, 1] = x / halves[i], y / halves[i]
        total_x += moments[i] * bends[i, 0]
        total_y += moments[i] * bends[i, 1]
        total_moment += moments[i]
    size = math.sqrt(total_x**2 + total_y**2 + (ROUNDED * total_moment / (n - 1))**2)
    total_x /= size
    total_y /= size
    for i in range(n):
        a, frame = tangents[i], frames[i]
        x = total_x * frame[0] + total_y * (a[1] * frame[2] - a[2] * frame[1])
        y = total_x * frame[1] + total_y * (a[2] * frame[0] - a[0] * frame[2])
        z = total_x * frame[2] + total_y * (a[0] * frame[1] - a[1] * frame[0])
        frame[0], frame[1], frame[2] = x, y, z
    against_twist = np.empty(n)
    sum_ = 0.0
    for i in range(n - 1):
        a, b = tangents[i], tangents[i + 1]
        both = (total_x * bends[i, 0] + total_y * bends[i, 1]) / (4 * halves[i]**2)
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            joint = moments[i] * (
                (b[d] * frames[i, e] - b[e] * frames[i, d]
                 + a[d] * frames[i + 1, e] - a[e] * frames[i + 1, d]) / (2 * halves[i])
                + both * (a[d] * b[e] - a[e] * b[d]))
            torques[i + 1, c] += joint
            torques[i, c] -= joint
        sum_ -= a[0] * torques[i, 0] + a[1] * torques[i, 1] + a[2] * torques[i, 2]
        against_twist[i] = sum_
    for i in range(n - 1):
        share = against_twist[i] / (2 * halves[i]**2)
        for c in range(3):
            axis = share * (tangents[i, c] + tangents[i + 1, c])
            torques[i + 1, c] -= axis
            torques[i, c] += axis
    _add_couples(torques, tangents, lengths, step, right)


@_part
def add_twist(points: Matrix, spans: Spans, step: float, right: Vector) -> None:
    """
    Add to `right` (3 N,) the impulses [N s] of twist between clamps; update `spans`.

    A DLO has almost no inertia about its axis, so its twisting moment is constant between two
    clamps.  The energy is ``c / 2 angle^2`` (Bergou et al., Discrete Elastic Rods, 2008, 4.2.2).
    To measure the angle, a frame is transported along the DLO without twist from the first clamp
    to the second and compared with the frame of the second clamp.  The angle is zero when both
    have just closed.  The trial gives only the direction of a clamp, not its rotation about the
    DLO's axis: we take the smallest rotation since it closed.

    The forces are the exact gradient: the same torque about every joint, whose part across
    a segment becomes a couple of forces at its ends.
    """
    n = len(points) - 1
    tangents, torques, lengths = np.empty((n, 3)), np.zeros((n, 3)), np.empty(n)
    _tangents(points, tangents, lengths)
    frame, there, before = np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(spans)):
        span = spans[k]
        a, b = span.first, span.last
        if span.begun == 0:
            _perpendicular(tangents[a], frame)
            for c in range(3):
                span.start[c], span.start_frame[c] = tangents[a, c], frame[c]
        for c in range(3):
            before[c], frame[c] = span.start[c], span.start_frame[c]
        _transport(frame, before, tangents[a])
        for i in range(a, b):
            _transport(frame, tangents[i], tangents[i + 1])
        if span.begun == 0:
            span.begun = 1
            for c in range(3):
                span.end[c], span.end_frame[c] = tangents[b, c], frame[c]
        for c in range(3):
            before[c], there[c] = span.end[c], span.end_frame[c]
        _transport(there, before, tangents[b])
        x, y = 0.0, 0.0
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            x += frame[c] * there[c]
            y += tangents[b, c] * (frame[d] * there[e] - frame[e] * there[d])
        angle = math.atan2(y, x)
        angle += 2 * math.pi * round((span.angle - angle) / (2 * math.pi))
        span.angle = angle
        for i in range(a, b):
            square = 0.0
            for c in range(3):
                square += (tangents[i, c] + tangents[i + 1, c])**2
            share = span.stiffness * angle / max(square / 2, 2 * HAIRPIN)
            for c in range(3):
                joint = share * (tangents[i, c] + tangents[i + 1, c])
                torques[i + 1, c] -= joint
                torques[i, c] += joint
    _add_couples(torques, tangents, lengths, step, right)


@_part
def rod_velocities(rod: RodState, points: Matrix, velocities: Matrix, predicted: Matrix) -> bool:
    """
    Write to `predicted` the (N, 3) velocities [m/s] after a step of the internal forces; see `rod`.

    :returns: False if the rollout diverges.
    """
    rest, stiffness, masses, bending = rod.rest_lengths, rod.stiffness, rod.masses, rod.bending
    held, follow, bands, right = rod.held, rod.follow, rod.bands, rod.right
    drag, implicit, step = rod.drag, rod.implicit, rod.step
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
    if len(rod.natural) > 0:
        add_natural(points, rod.natural, step, right)
    if len(rod.spans) > 0:
        add_twist(points, rod.spans, step, right)
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
            predicted[i, c] = right[3 * i + c]
    for h in range(len(held)):
        for c in range(3):
            predicted[held[h], c] = follow[h, c]
    return True


@_part
def _closest(points: Matrix, first: int, second: int) -> tuple[float, ...]:
    """
    Return the closest points of two segments (Ericson, Real-Time Collision Detection, 5.1.9).

    :returns: s and t, 0..1, their places on the first and on the second segment; the unit normal from
        the second to the first, three numbers; the distance [m].
    """
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


@_part
def near_pairs(contact: SelfContact, points: Matrix, stretch: float, reach: float) -> int:
    """
    Write to `contact.pairs` the pairs of segments that can touch and whose gap may be below `reach` [m].

    :param stretch: largest length of a segment, relative to its rest length.
    :returns: the number of pairs.
    """
    half, middles, pairs, diameter = contact.half, contact.middles, contact.pairs, contact.diameter
    apart, count, segments = contact.apart, 0, len(half)
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


@_compiled
def start_distances(contact: SelfContact, points: Matrix) -> None:
    """Set the least distances of pairs at the start, (N, 3) [m] points, so that none is pushed apart."""
    distances, diameter, pairs = contact.distances, contact.diameter, contact.pairs
    distances[:] = diameter
    for k in range(near_pairs(contact, points, 1.0, 0.0)):
        i, j = pairs[k, 0], pairs[k, 1]
        distances[i, j] = min(diameter, _closest(points, i, j)[5])
    contact.room[0] = -1.0


@_part
def _find_contacts(capsules: SelfContact, near: int, points: Matrix, velocities: Matrix, step: float) -> int:
    """Write those of the first `near` pairs that would come too near within a step; return their number."""
    distances, diameter = capsules.distances, capsules.diameter
    pairs, contacts = capsules.pairs, capsules.contacts
    count = 0
    for k in range(near):
        i, j = pairs[k, 0], pairs[k, 1]
        s, t, n0, n1, n2, distance = _closest(points, i, j)
        allowed = max(distances[i, j], min(distance, diameter))
        distances[i, j] = allowed
        gap = distance - allowed
        least = -gap / step if gap > 0 else min(-PUSH_OUT * gap / step, FASTEST_PUSH_OUT)
        approach = 0.0
        contact = contacts[count]
        contact.normal[0], contact.normal[1], contact.normal[2] = n0, n1, n2
        contact.nodes[0], contact.nodes[1], contact.nodes[2], contact.nodes[3] = i, i + 1, j, j + 1
        contact.weights[0], contact.weights[1] = 1 - s, s
        contact.weights[2], contact.weights[3] = -(1 - t), -t
        for m in range(4):
            at = contact.nodes[m]
            approach += contact.weights[m] * (
                velocities[at, 0] * n0 + velocities[at, 1] * n1 + velocities[at, 2] * n2)
        if approach < least:
            contact.least = least
            count += 1
    return count


@_part
def _prepare(contacts: Contacts, count: int, inverse_masses: Vector, support: Matrix, change: Matrix) -> None:
    """
    Find out which nodes of the first `count` contacts yield, and how much.

    A node does not yield to a push towards a body that supports it, but passes the push on to that
    body: so a strand on a table carries another one.
    """
    change[:] = 0.0
    for k in range(count):
        for m in range(4):
            change[contacts[k].nodes[m], 0] += 1.0  # number of contacts that share the node
    for k in range(count):
        contact = contacts[k]
        given, full, shared = 0.0, 0.0, 0.0
        for m in range(4):
            at, w = contact.nodes[m], contact.weights[m]
            backing, size = 0.0, 0.0
            for c in range(3):
                backing += support[at, c] * contact.normal[c]
                size += support[at, c] * support[at, c]
            if w < 0:
                backing = -backing
            elif w == 0:
                backing = 0.0
            resistance = max(SUPPORTED * math.sqrt(size), UNSUPPORTED)
            contact.yielding[m] = inverse_masses[at] if backing > -resistance else 0.0
            given += w * w * contact.yielding[m]
            full += w * w * inverse_masses[at]
        for m in range(4):
            at = contact.nodes[m]
            if given < WEDGED * full:
                contact.yielding[m] = inverse_masses[at]
            shared += contact.weights[m]**2 * contact.yielding[m] * change[at, 0]
        contact.mobility = shared if shared > 0 else math.inf  # all nodes are held
        contact.pushed = 0.0
        for c in range(3):
            contact.rubbed[c] = 0.0


@_part
def _push_apart(contacts: Contacts, count: int, friction: float, velocities: Matrix, change: Matrix) -> None:
    """Make one iteration of the solver over the first `count` contacts, with Coulomb friction."""
    change[:] = 0.0
    for k in range(count):
        contact = contacts[k]
        approach, size = 0.0, 0.0
        for c in range(3):
            relative = 0.0
            for m in range(4):
                relative += contact.weights[m] * velocities[contact.nodes[m], c]
            contact.impulse[c] = relative
            approach += relative * contact.normal[c]
        push = max(contact.pushed + (contact.least - approach) / contact.mobility, 0.0)
        for c in range(3):
            contact.impulse[c] = contact.rubbed[c] - (
                contact.impulse[c] - approach * contact.normal[c]) / contact.mobility
            size += contact.impulse[c]**2
        share = min(1.0, friction * push / max(math.sqrt(size), TINY))
        for c in range(3):
            rub = share * contact.impulse[c]
            contact.impulse[c] = rub - contact.rubbed[c] + (push - contact.pushed) * contact.normal[c]
            contact.rubbed[c] = rub
        contact.pushed = push
        for m in range(4):
            factor = contact.weights[m] * contact.yielding[m]
            for c in range(3):
                change[contact.nodes[m], c] += factor * contact.impulse[c]
    velocities += change


@_part
def _pass_on(contacts: Contacts, count: int, inverse_masses: Vector, velocities: Matrix) -> None:
    """Let the nodes that did not yield pass the impulses on to the bodies that support them."""
    for k in range(count):
        contact = contacts[k]
        for m in range(4):
            at = contact.nodes[m]
            passed_on = contact.weights[m] * (inverse_masses[at] - contact.yielding[m])
            for c in range(3):
                velocities[at, c] += passed_on * (contact.pushed * contact.normal[c] + contact.rubbed[c])


@_part
def _travel(velocities: Matrix, step: float) -> float:
    """Return an upper bound [m] of how far two nodes approach each other in a step."""
    fastest = 0.0
    for i in range(len(velocities)):
        fastest = max(fastest, velocities[i, 0]**2 + velocities[i, 1]**2 + velocities[i, 2]**2)
    return 2 * step * math.sqrt(fastest)


@_part
def may_touch(velocities: Matrix, step: float, room: Vector, near: Indices) -> bool:
    """Tell whether any pair may be near; `room` and `near` are those of `SelfContact`."""
    room[0] -= _travel(velocities, step)
    return bool(room[0] < 0 or near[0] > 0)


@_part
def keep_apart(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector,
               support: Matrix, step: float) -> None:
    """
    Correct `velocities` so that segments do not pass through each other; call it if they `may_touch`.

    Contacts are velocity constraints, solved by Jacobi iterations with mass splitting (Tonge et al., Mass
    Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).

    :param points: (N, 3) [m] at the start of the step.
    :param velocities: (N, 3) [m/s] that the DLO would have without contact.
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param support: (N, 3) [m/s] change of the velocities by other bodies in the last step.
    :param step: time step [s].
    """
    near = contact.near
    if contact.room[0] < 0:  # a segment may be stretched by 20 %
        near[0] = near_pairs(contact, points, 1.2, _travel(velocities, step) + SKIN)
        contact.room[0] = SKIN
    count = _find_contacts(contact, near[0], points, velocities, step)
    if count == 0:
        return
    contacts, change = contact.contacts, contact.change
    _prepare(contacts, count, inverse_masses, support, change)
    for _ in range(ITERATIONS):
        _push_apart(contacts, count, contact.friction, velocities, change)
    _pass_on(contacts, count, inverse_masses, velocities)


@_part
def rest_on_table(points: Matrix, velocities: Matrix, level: float, friction: float, step: float) -> None:
    """
    Correct `velocities` for contact with a table, with Coulomb friction.

    The constants are Bullet's (PyBullet 3.2.7), found by single steps of a sphere on a plane.

    :param level: height of nodes that touch the table [m].
    """
    slop = 1e-5  # m of penetration that is allowed
    margin = 0.02 * math.sqrt(3.0) * 0.005  # m; a sphere of 5 mm that is further away is not in contact
    for i in range(len(points)):
        distance = points[i, 2] - level
        if distance > margin:
            continue
        depth = -(distance + slop)
        least = 0.08 * depth / step if depth > 0 else depth / step  # one step corrects 8 %
        push = least - velocities[i, 2]
        if push <= 0:
            continue
        velocities[i, 2] = least
        speed = math.hypot(velocities[i, 0], velocities[i, 1])
        share = 1.0 - min(1.0, friction * push / speed) if speed > 0 else 0.0
        velocities[i, 0] *= share
        velocities[i, 1] *= share


@_part
def _start_step(points: Matrix, velocities: Matrix, gravity: Vector, targets: Matrix, held: Indices,
                follow: Matrix, step: float) -> None:
    """Add gravity to the velocities; write those of the held nodes to `follow`."""
    for h in range(len(held)):
        for c in range(3):
            follow[h, c] = (targets[h, c] - points[held[h], c]) / step
    for i in range(len(points)):
        for c in range(3):
            velocities[i, c] += step * gravity[c]


@_compiled
def predict_velocities(rope: RopeState, targets: Matrix) -> bool:
    """
    Write to `rope.predicted` the velocities due to gravity, internal forces and self-contact.

    :param targets: (h, 3) [m] positions of the held nodes after the step.
    :returns: False if the rollout diverges.
    """
    rod, contact = rope.rod, rope.contact
    points, velocities, predicted = rope.points, rope.velocities, rope.predicted
    _start_step(points, velocities, rope.gravity, targets, rod.held, rod.follow, rod.step)
    if not rod_velocities(rod, points, velocities, predicted):
        return False
    if may_touch(predicted, rod.step, contact.room, contact.near):
        keep_apart(contact, points, predicted, rod.inverse_masses, rope.support, rod.step)
    return True


@_compiled
def advance(rope: RopeState, targets: Cube, level: float, path: Cube) -> int:
    """
    Take k steps on a table.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step.
    :param level: height of nodes that touch the table [m].
    :param path: (k, N, 3) [m] where the positions of all nodes after each step are written; or empty.
    :returns: number of steps taken, below k if the rollout diverged.
    """
    rod, contact, gravity, inverse_masses = rope.rod, rope.contact, rope.gravity, rope.rod.inverse_masses
    points, velocities, predicted, support = rope.points, rope.velocities, rope.predicted, rope.support
    held, follow, step, friction = rod.held, rod.follow, rod.step, contact.friction
    room, near = contact.room, contact.near
    for k in range(len(targets)):
        _start_step(points, velocities, gravity, targets[k], held, follow, step)
        if not rod_velocities(rod, points, velocities, predicted):
            return k
        if may_touch(predicted, step, room, near):
            keep_apart(contact, points, predicted, inverse_masses, support, step)
        for i in range(len(points)):
            for c in range(3):
                velocities[i, c] = predicted[i, c]
        rest_on_table(points, velocities, level, friction, step)
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
