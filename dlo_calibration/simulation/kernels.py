# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels: the physics of a DLO, compiled by Numba.

The rod and what bends it, twist between clamps, contact of a DLO with itself, and a table
with friction.  The machine code is kept in Numba's cache, so that it is compiled once a
machine.  All kernels are in one file, because a change of this file is all that the cache
looks at.
"""

from __future__ import annotations

import math
from typing import Any, Callable, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

# How a signature says the number of axes:
Vector = Floats
Matrix = Floats
Cube = Floats
Indices = NDArray[np.int64]
Spans = NDArray[np.void]
Contacts = NDArray[np.void]
IndexRows = NDArray[np.int64]
#: type that a kernel is compiled for, by the annotation
TYPES: dict[str, Any] = {
    'None': numba.void, 'bool': numba.boolean, 'int': numba.int64, 'float': numba.float64,
    'Vector': numba.float64[::1], 'Matrix': numba.float64[:, ::1], 'Cube': numba.float64[:, :, ::1],
    'Indices': numba.int64[::1], 'IndexRows': numba.int64[:, ::1]}

HELD = 1e12  # a held node's share of the matrix, relative to its mass
ROUNDED = 0.05  # rad of the bends in all below which the direction of the natural curvature is not settled
HAIRPIN = 0.01  # least squared cosine of half the angle between two segments
TINY = 1e-12  # m or m/s; a smaller vector has no direction

# Contact of a DLO with itself:
ITERATIONS = 10
PUSH_OUT = 0.8  # share of a penetration that one step removes
FASTEST_PUSH_OUT = 0.8  # m/s, so that nothing is kicked
SUPPORTED = 0.5  # cosine between a push and the support against it
UNSUPPORTED = 1e-6  # m/s; a smaller change of velocity is rounding
WEDGED = 0.1  # a pair of which less than that share can yield is wedged: then all of it does
STRETCH = 1.2  # how much longer than at rest a segment may be for its pairs to be found
SKIN = 0.004  # m; pairs that near are watched until the nodes may have moved that far

# Bullet's treatment of a contact, as found by single steps of a sphere on a plane (PyBullet 3.2.7):
SLOP = 1e-5  # m that it lets a contact penetrate
PUSHED_OUT = 0.08  # share of a deeper penetration that one step removes
MARGIN = 0.02 * math.sqrt(3.0) * 0.005  # m; a sphere of 5 mm that is further away is not in contact

BAND = 7  # entries of a column of the matrix: node i couples to i + 2, three coordinates each


def _state(record: Any) -> Any:
    """Let kernels take a named tuple whose fields have the types that its annotations say."""
    make: Any = numba.types.NamedTuple
    TYPES[record.__name__] = make([TYPES[word.__forward_arg__] for word in record.__annotations__.values()],
                                  record)
    return record


# Numba counts references to all arrays of a record that a kernel is called with, and to a field that
# is taken out.  So fields are taken out before a loop, and a step calls with few records.


def _part(kernel: Kernel) -> Kernel:
    """Compile as a part of the kernels that call it."""
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


def _compiled(kernel: Kernel) -> Kernel:
    """Compile at import, or take it from the cache: a rollout never waits for the compiler."""
    *arguments, returned = (TYPES[word] for word in kernel.__annotations__.values())
    compile_: Any = numba.njit(returned(*arguments), cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


#: a part of a DLO between two clamps
SPAN = np.dtype([
    ('first', 'i8'), ('last', 'i8'),  # segments, which the clamps hold
    ('stiffness', 'f8'),  # torque per angle [N m]
    ('angle', 'f8'),  # of twist [rad]
    ('begun', 'i8'),  # 1 where it has been stepped since the clamps closed, else 0
    ('start', 'f8', 3), ('start_frame', 'f8', 3),  # unit vectors along and across the first when it began
    ('end', 'f8', 3), ('end_frame', 'f8', 3)], align=True)  # and of the last

#: two segments that touch each other
CONTACT = np.dtype([
    ('nodes', 'i8', 4),  # the ends of the first and of the second
    ('weights', 'f8', 4),  # of the nodes' velocities in that of the closest points to each other
    ('yielding', 'f8', 4),  # inverse masses of the nodes [1/kg], 0 where something supports them
    ('normal', 'f8', 3),  # unit vector from the second to the first
    ('mobility', 'f8'),  # velocity per impulse [1/kg]
    ('wanted', 'f8'),  # least velocity at which they part [m/s]
    ('pushed', 'f8'), ('rubbed', 'f8', 3),  # impulses along the normal and across it until now [N s]
    ('impulse', 'f8', 3)], align=True)  # of the iteration under way [N s]

TYPES['Spans'], TYPES['Contacts'] = numba.from_dtype(SPAN)[::1], numba.from_dtype(CONTACT)[::1]


@_state
class RodState(NamedTuple):
    """
    What the internal forces of N nodes follow from; see `rod.Rod`, which makes it.

    :param rest_lengths: (N - 1,) [m] of the segments.
    :param stiffness: (N - 1,) of each stretching spring [N/m].
    :param masses: (N,) [kg].
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param bending: (3, N) bending matrix [N/m]: its diagonal and the two below it.
    :param natural: (N - 2,) [N m] EI times natural curvature at each inner node; (0,): straight at rest.
    :param spans: (s,) of `SPAN`: what resists twist.
    :param held: (h,) nodes that follow given velocities.
    :param follow: (h, 3) [m/s] these velocities.
    :param drag: [1/s].
    :param implicit: c of the step [s^2].
    :param step: [s].
    :param bands: (3 N + 6, 7), workspace: columns of the lower triangle of the matrix.
    :param right: (3 N + 6,), workspace: right side.
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


@_state
class SelfContact(NamedTuple):
    """
    Contact of S segments with each other: capsules that do not pass through each other.

    Spheres at the nodes cannot do this for a thin DLO, whose nodes lie further apart than its
    diameter.  Parts that are nearer along the DLO than half the circumference of its
    cross-section cannot touch: that is how far apart the legs of the tightest hairpin are.
    Pairs that are nearer than a diameter at the start keep that distance until they have
    moved apart, so that a radius that is larger than the real one does not burst the DLO open.

    :param half: (S,) [m] half the lengths of the segments.
    :param middles: (S,) [m] where their middles are along the DLO.
    :param diameter: [m].
    :param apart: pairs that are nearer along the DLO cannot touch [m].
    :param friction: Coulomb coefficient.
    :param distances: (S, S) [m] that pairs keep.
    :param pairs: (S (S - 1) / 2, 2), of which the first ones are near each other now.
    :param near: (1,) how many.
    :param room: (1,) how far nodes may move before others are [m]; less than 0: not known.
    :param contacts: (S (S - 1) / 2,) of `CONTACT`, workspace.
    :param change: (S + 1, 3), workspace.
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


@_state
class RopeState(NamedTuple):
    """
    A DLO between two steps; see `rope.Rope`, which makes it.

    :param points: (N, 3) [m].
    :param velocities: (N, 3) [m/s].
    :param wanted: (N, 3) [m/s] velocities that it would have but for other bodies.
    :param support: (N, 3) [m/s] change of velocity that other bodies caused in the last step.
    :param gravity: (3,) [m/s^2].
    :param rod: its internal forces.
    :param contact: with itself.
    """

    points: Matrix
    velocities: Matrix
    wanted: Matrix
    support: Matrix
    gravity: Vector
    rod: RodState
    contact: SelfContact


@_part
def _solve(bands: Matrix, right: Vector) -> bool:
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


@_part
def _carry(frame: Vector, before: Vector, tangent: Vector) -> None:
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


@_part
def _along(points: Matrix, tangents: Matrix, lengths: Vector) -> None:
    """Write the (n, 3) unit vectors along the segments and their (n,) lengths [m]."""
    for i in range(len(lengths)):
        for c in range(3):
            tangents[i, c] = points[i + 1, c] - points[i, c]
        lengths[i] = math.sqrt(tangents[i, 0]**2 + tangents[i, 1]**2 + tangents[i, 2]**2)
        for c in range(3):
            tangents[i, c] /= lengths[i]


@_part
def _across(tangent: Vector, frame: Vector) -> None:
    """Write to `frame` (3,) some unit vector perpendicular to a (3,) tangent."""
    least = 0
    for c in range(1, 3):
        if abs(tangent[c]) < abs(tangent[least]):
            least = c
    one, two = (least + 1) % 3, (least + 2) % 3
    size = math.hypot(tangent[one], tangent[two])
    frame[least], frame[one], frame[two] = 0.0, tangent[two] / size, -tangent[one] / size


@_part
def _add_couples(torques: Matrix, tangents: Matrix, lengths: Vector, step: float, right: Vector) -> None:
    """Add to `right` the impulses [N s] at the ends of segments that (n, 3) torques [N m] on them are."""
    for i in range(len(lengths)):
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            impulse = step * (torques[i, d] * tangents[i, e] - torques[i, e] * tangents[i, d]) / lengths[i]
            right[3 * i + 3 + c] += impulse
            right[3 * i + c] -= impulse


@_part
def add_natural(points: Matrix, moments: Vector, step: float, right: Vector) -> None:
    """
    Add to `right` (3 N,) the impulses [N s] of a DLO that is curved where nothing bends it.

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

    :param moments: (N - 2,) [N m] EI times natural curvature at each inner node.
    """
    n = len(points) - 1
    tangents, frames, torques = np.empty((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    lengths, halves, bends = np.empty(n), np.empty(n), np.empty((n, 2))  # two of them at the end of each
    _along(points, tangents, lengths)
    _across(tangents[0], frames[0])
    total_x, total_y, total_moment = 0.0, 0.0, 0.0
    for i in range(n - 1):
        a, b, frame = tangents[i], tangents[i + 1], frames[i]
        cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        halves[i] = math.sqrt(max((1.0 + cosine) / 2, HAIRPIN))
        x = b[0] * frame[0] + b[1] * frame[1] + b[2] * frame[2]
        y = (b[0] * (a[1] * frame[2] - a[2] * frame[1]) + b[1] * (a[2] * frame[0] - a[0] * frame[2])
             + b[2] * (a[0] * frame[1] - a[1] * frame[0]))
        frames[i + 1] = frame
        _carry(frames[i + 1], a, b)
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
    Add to `right` (3 N,) the impulses [N s] of twist between clamps; bring `spans` up to date.

    A DLO has next to no inertia about its axis, so that twist is the same all along,
    between two clamps, whenever its stiffness is; the energy is ``c / 2 angle^2`` (Bergou et al., Discrete
    Elastic Rods, 2008, 4.2.2).  The angle is that from a frame carried from the first clamp to the
    second along the DLO without twist to the frame that the second clamp holds.  It is
    zero when both are closed.  How a clamp turns about the DLO's axis is not known, only its
    direction: it turns by the smallest rotation from that when it closed.

    The forces are the exact slope: a torque of the same size about every joint, of
    which the segments pass on as a couple what is across them.
    """
    n = len(points) - 1
    tangents, torques, lengths = np.empty((n, 3)), np.zeros((n, 3)), np.empty(n)
    _along(points, tangents, lengths)
    frame, there, before = np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(spans)):
        span = spans[k]
        a, b = span.first, span.last
        if span.begun == 0:
            _across(tangents[a], frame)
            for c in range(3):
                span.start[c], span.start_frame[c] = tangents[a, c], frame[c]
        for c in range(3):
            before[c], frame[c] = span.start[c], span.start_frame[c]
        _carry(frame, before, tangents[a])
        for i in range(a, b):
            _carry(frame, tangents[i], tangents[i + 1])
        if span.begun == 0:
            span.begun = 1
            for c in range(3):
                span.end[c], span.end_frame[c] = tangents[b, c], frame[c]
        for c in range(3):
            before[c], there[c] = span.end[c], span.end_frame[c]
        _carry(there, before, tangents[b])
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
def rod_velocities(rod: RodState, points: Matrix, velocities: Matrix, wanted: Matrix) -> bool:
    """
    Put the velocities (N, 3) [m/s] after one step of the internal forces into `wanted`; see `rod`.

    :returns: False where the rollout diverges.
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
            wanted[i, c] = right[3 * i + c]
    for h in range(len(held)):
        for c in range(3):
            wanted[held[h], c] = follow[h, c]
    return True


@_part
def _closest(points: Matrix, first: int, second: int) -> tuple[float, ...]:
    """
    Return where two segments are nearest: Ericson, Real-Time Collision Detection, 5.1.9.

    :returns: s and t, 0..1, the places on the first and on the second segment; the unit normal
        from the second to the first; the distance [m].
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
    List in `contact.pairs` the pairs of segments that may touch each other and are nearer than `reach` [m].

    :param stretch: how much longer than at rest a segment may be.
    :returns: how many there are.
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
    """Take the (N, 3) [m] points at the start, where nothing may be kicked apart."""
    distances, diameter, pairs = contact.distances, contact.diameter, contact.pairs
    distances[:] = diameter
    for k in range(near_pairs(contact, points, 1.0, 0.0)):
        i, j = pairs[k, 0], pairs[k, 1]
        distances[i, j] = min(diameter, _closest(points, i, j)[5])
    contact.room[0] = -1.0


@_part
def _touching(touching: SelfContact, near: int, points: Matrix, velocities: Matrix, step: float) -> int:
    """Fill in which of the first `near` pairs would come too near within a step; return how many."""
    distances, diameter = touching.distances, touching.diameter
    pairs, contacts = touching.pairs, touching.contacts
    count = 0
    for k in range(near):
        i, j = pairs[k, 0], pairs[k, 1]
        s, t, n0, n1, n2, distance = _closest(points, i, j)
        allowed = max(distances[i, j], min(distance, diameter))
        distances[i, j] = allowed
        gap = distance - allowed
        wanted = -gap / step if gap > 0 else min(-PUSH_OUT * gap / step, FASTEST_PUSH_OUT)
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
        if approach < wanted:
            contact.wanted = wanted
            count += 1
    return count


@_part
def _prepare(contacts: Contacts, count: int, inverse_masses: Vector, support: Matrix, change: Matrix) -> None:
    """
    Fill in which nodes of the first `count` contacts yield, and how much.

    A node does not yield to a push against what supports it (a strand on a table carries another
    one), but passes the push on to that body.
    """
    change[:] = 0.0
    for k in range(count):
        for m in range(4):
            change[contacts[k].nodes[m], 0] += 1.0  # how many contacts share the node
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
        contact.mobility = shared if shared > 0 else math.inf  # both held
        contact.pushed = 0.0
        for c in range(3):
            contact.rubbed[c] = 0.0


@_part
def _push_apart(contacts: Contacts, count: int, friction: float, velocities: Matrix, change: Matrix) -> None:
    """Make one iteration over the first `count` contacts, with Coulomb friction."""
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
        push = max(contact.pushed + (contact.wanted - approach) / contact.mobility, 0.0)
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
    """Let the nodes that did not yield pass the impulses on to what supports them."""
    for k in range(count):
        contact = contacts[k]
        for m in range(4):
            at = contact.nodes[m]
            passed_on = contact.weights[m] * (inverse_masses[at] - contact.yielding[m])
            for c in range(3):
                velocities[at, c] += passed_on * (contact.pushed * contact.normal[c] + contact.rubbed[c])


@_part
def _travel(velocities: Matrix, step: float) -> float:
    """Return how far the two fastest nodes may come nearer to each other in a step [m]."""
    fastest = 0.0
    for i in range(len(velocities)):
        fastest = max(fastest, velocities[i, 0]**2 + velocities[i, 1]**2 + velocities[i, 2]**2)
    return 2 * step * math.sqrt(fastest)


@_part
def may_touch(velocities: Matrix, step: float, room: Vector, near: Indices) -> bool:
    """Tell whether any pair is near; `room` and `near` are those of `SelfContact`."""
    room[0] -= _travel(velocities, step)
    return bool(room[0] < 0 or near[0] > 0)


@_part
def keep_apart(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector,
               support: Matrix, step: float) -> None:
    """
    Make `velocities` what the contacts between pairs of segments allow, where they `may_touch`.

    They are velocity constraints, solved by Jacobi iterations with mass splitting (Tonge et al., Mass
    Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).

    :param points: (N, 3) [m] now.
    :param velocities: (N, 3) [m/s] that the DLO would have without contacts.
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param support: (N, 3) [m/s] change of velocity that other bodies last caused.
    :param step: [s].
    """
    near = contact.near
    if contact.room[0] < 0:
        near[0] = near_pairs(contact, points, STRETCH, _travel(velocities, step) + SKIN)
        contact.room[0] = SKIN
    count = _touching(contact, near[0], points, velocities, step)
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
    Make `velocities` what a table allows, with Coulomb friction, as Bullet does.

    :param level: height of nodes that touch the table [m].
    """
    for i in range(len(points)):
        distance = points[i, 2] - level
        if distance > MARGIN:
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


@_part
def _start_step(points: Matrix, velocities: Matrix, gravity: Vector, targets: Matrix, held: Indices,
                follow: Matrix, step: float) -> None:
    """Add gravity to the velocities, and find those of the held nodes."""
    for h in range(len(held)):
        for c in range(3):
            follow[h, c] = (targets[h, c] - points[held[h], c]) / step
    for i in range(len(points)):
        for c in range(3):
            velocities[i, c] += step * gravity[c]


@_compiled
def want(rope: RopeState, targets: Matrix) -> bool:
    """
    Put into `rope.wanted` the velocities that gravity, the internal forces and self-contact give.

    :param targets: (h, 3) [m] where the held nodes are after the step.
    :returns: False where the rollout diverges.
    """
    rod, contact = rope.rod, rope.contact
    points, velocities, wanted = rope.points, rope.velocities, rope.wanted
    _start_step(points, velocities, rope.gravity, targets, rod.held, rod.follow, rod.step)
    if not rod_velocities(rod, points, velocities, wanted):
        return False
    if may_touch(wanted, rod.step, contact.room, contact.near):
        keep_apart(contact, points, wanted, rod.inverse_masses, rope.support, rod.step)
    return True


@_compiled
def advance(rope: RopeState, targets: Cube, level: float, path: Cube) -> int:
    """
    Take k steps on a table.

    :param targets: (k, h, 3) [m] where the held nodes are after each step.
    :param level: height of nodes that touch the table [m].
    :param path: (k, N, 3) to write where all nodes are after each step [m]; or empty.
    :returns: how many steps were taken; fewer than k where the rollout diverged.
    """
    rod, contact, gravity, inverse_masses = rope.rod, rope.contact, rope.gravity, rope.rod.inverse_masses
    points, velocities, wanted, support = rope.points, rope.velocities, rope.wanted, rope.support
    held, follow, step, friction = rod.held, rod.follow, rod.step, contact.friction
    room, near = contact.room, contact.near
    for k in range(len(targets)):
        _start_step(points, velocities, gravity, targets[k], held, follow, step)
        if not rod_velocities(rod, points, velocities, wanted):
            return k
        if may_touch(wanted, step, room, near):
            keep_apart(contact, points, wanted, inverse_masses, support, step)
        for i in range(len(points)):
            for c in range(3):
                velocities[i, c] = wanted[i, c]
        rest_on_table(points, velocities, level, friction, step)
        for h in range(len(held)):
            for c in range(3):
                velocities[held[h], c] = follow[h, c]
        for i in range(len(points)):
            for c in range(3):
                support[i, c] = velocities[i, c] - wanted[i, c]
                points[i, c] += step * velocities[i, c]
        for h in range(len(held)):
            for c in range(3):
                points[held[h], c] = targets[k, h, c]
        if len(path) > 0:
            for i in range(len(points)):
                for c in range(3):
                    path[k, i, c] = points[i, c]
    return len(targets)
