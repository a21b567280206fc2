# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels: the physics of a DLO, compiled by Numba.

They compute the rod's internal forces with natural curvature and twist, contact of the DLO
with itself, and a table with friction.  Numba's cache keeps the machine code, so that it is
compiled once per machine.  Numba notices only changes of the file that a kernel is in, not of the
kernels that it calls: `kernel_cache` knows which other files they depend on.
"""

from __future__ import annotations

import math
from typing import Any, Callable, NamedTuple, TypeVar

import numba
from numba.extending import overload
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.lanes import (
    both,
    cosine_and_sine,
    COUNT,
    every,
    finite,
    LANES,
    numbers_of,
    some,
    where,
)

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

# Annotations that tell the number of axes:
Vector = Floats
Matrix = Floats
Cube = Floats
Indices = NDArray[np.int64]
Contacts = NDArray[np.void]
IndexRows = NDArray[np.int64]
#: annotation -> the type that a kernel is compiled for
TYPES: dict[str, Any] = {
    'None': numba.void, 'bool': numba.boolean, 'int': numba.int64, 'float': numba.float64,
    'Vector': numba.float64[::1], 'Matrix': numba.float64[:, ::1], 'Cube': numba.float64[:, :, ::1],
    'Indices': numba.int64[::1], 'IndexRows': numba.int64[:, ::1]}

HELD = 1e12  # weight of the equation that gives a held node its velocity, relative to its mass
ROUNDED = 0.05  # rad; mean bend below which the energy of natural curvature is rounded off
STEADY = 0.01  # rad; where the bends are smaller than this, natural curvature turns the frame slowly
REACH = 0.2  # rad; most that the material frame turns in a step
FIRST_TURNS = 30  # iterations for the angles at the start; later, one in each step does
AHEAD = 0.6  # c of friction between strands, relative to the squared step; see `rod`
HAIRPIN = 0.01  # least squared cosine of half the angle between two segments: limits divisions
TINY = 1e-12  # m or m/s; shorter vectors have no direction

# Contact of a DLO with itself:
ITERATIONS = 10  # of the contact solver, as many as Bullet makes
PUSH_OUT = 0.8  # share of a penetration that one step corrects
FASTEST_PUSH_OUT = 0.8  # m/s; limits that correction, so that it does not throw the DLO apart
SUPPORTED = 0.5  # cosine between a push and the opposing support from which on the node is supported
UNSUPPORTED = 1e-6  # m/s; a smaller change of velocity is rounding, not support
WEDGED = 0.1  # least share of the mobility of a pair; with less it is wedged, and all its nodes yield
SKIN = 0.0001, 0.008  # m, least and most; pairs within this gap are checked until nodes may have moved so far
STEPS_AHEAD = 10.0  # between these, the gap is as wide as nodes move in so many steps

BAND = 7  # entries per column of the lower triangle: node i couples with i + 2, three coordinates each


def record(record: Any) -> Any:
    """Let kernels take a named tuple; its annotations give the types of its fields."""
    make: Any = numba.types.NamedTuple
    TYPES[record.__name__] = make([TYPES[word.__forward_arg__] for word in record.__annotations__.values()],
                                  record)
    return record


def part(kernel: Kernel) -> Kernel:
    """Compile a function together with the kernels that call it."""
    options: dict[str, Any] = {'_nrt': False}  # parts make no arrays: references to them need not be counted
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def _of_numbers(kernel: Kernel) -> Kernel:
    """Compile a part in which no number is nan, so that the least of many is found four at once."""
    options: dict[str, Any] = {'_nrt': False, 'fastmath': {'nnan', 'nsz'}}
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def _inlined(kernel: Kernel) -> Kernel:
    """Compile a function as a piece of the kernels that call it, in their loops."""
    compile_: Any = numba.njit(inline='always', error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


def _one_or_each(function: Callable[..., Any]) -> Callable[[Kernel], Kernel]:
    """Compile `function` as what the decorated one returns for the types: for one DLO, or for each lane."""
    def register(choose: Kernel) -> Kernel:
        overload(function, strict=False, inline='never', jit_options={
            'nogil': True, 'error_model': 'numpy', '_nrt': False})(choose)
        return choose
    return register


def entry(kernel: Kernel) -> Kernel:
    """Compile a kernel at import, or load it from the cache: a rollout never waits for the compiler."""
    *arguments, returned = (TYPES[word] for word in kernel.__annotations__.values())
    compile_: Any = numba.njit(returned(*arguments), cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


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

TYPES['Contacts'] = numba.from_dtype(CONTACT)[::1]


@record
class FrameState(NamedTuple):
    """
    The material frame of N - 1 segments, which carries the rest shape and resists twist; see `rod`.

    :param natural: (N - 2, 3) [N m] EI times natural curvature at each inner node, in two directions, and the
        length of that vector.
    :param twisting: (N - 2,) [N m] torque per angle between the two segments at each inner node; (0,): the
        DLO does not twist, and turns freely as a whole.
    :param angles: (N - 1,) [rad] from a frame that is carried along without twist; (0,): there is none.
    :param clamped: (s, 2) segments that clamps keep from turning, in order, and which of the held nodes tells
        how each of them turns.
    :param clamps: (s, 7) a unit vector of the material frame in each clamp, nan: unknown; the unit
        tangent there, nan: unknown; and how far [rad] the segment must turn now.
    :param carried: (3, 3) unit tangent of the first segment in the last step, a unit vector across it, and
        workspace.
    :param begun: (1,) 1 once the angles are in equilibrium.
    :param segments: (N - 1, 7) workspace: unit tangents, inverse lengths [1/m], and unit vectors across.
    :param joints: (N - 2, 7) bends in two directions across, inverse cosine of half the bending angle, cosine
        and sine of the mean angle, twisting moment [N m], and cosine of half the bending angle.
    :param turning: (N - 1, 2) workspace.
    """

    natural: Matrix
    twisting: Vector
    angles: Vector
    clamped: IndexRows
    clamps: Matrix
    carried: Matrix
    begun: Indices
    segments: Matrix
    joints: Matrix
    turning: Matrix


@record
class SlipState(NamedTuple):
    """
    Friction between the strands of a DLO: an elastic, perfectly plastic element at each inner node.

    :param rows: (N - 2, 5) curvature from three nodes [1/m]: multiplied by the points it gives
        t_i - t_(i-1); stiffness [N m] and the change of t_i - t_(i-1) at which the strands slip.  (0, 5):
        there is no such friction.
    :param kept: (N - 2, 9) t_i - t_(i-1) at which the element is free of stress; mean unit tangents in the
        last step; strain in the last step, so far does the bend differ from what is kept.
    :param begun: (1,) 1 once `kept` is known.
    :param pull: (N, 6) workspace: what the equation of each node gets: diagonal and the two entries below it
        [kg], and the impulse against the bend [N s].
    """

    rows: Matrix
    kept: Matrix
    begun: Indices
    pull: Matrix


@record
class RodState(NamedTuple):
    """
    All that determines the internal forces of N nodes; `rod.Rod` makes it.

    :param rest_lengths: (N - 1,) [m] lengths of the segments at rest.
    :param stiffness: (N - 1,) [N/m] of the stretching springs.
    :param masses: (N,) [kg].
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param bending: (3, N) [N/m] bending matrix: its diagonal and the two below.
    :param frame: the material frame.
    :param friction: hysteresis of bending.
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
    frame: FrameState
    friction: SlipState
    held: Indices
    follow: Matrix
    drag: float
    implicit: float
    step: float
    bands: Matrix
    right: Vector


@record
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
    :param room: (3,) [m] how far neighbours may still move against each other until segments that are near
        along the DLO can touch; how far nodes may until others can, and until `pairs` must be found anew.
    :param contacts: (S (S - 1) / 2,) of `CONTACT`, workspace.
    :param change: (S + 1, 3) workspace.
    :param balls: (8, S) workspace.
    :param overlaps: (1,) 1 if some of `distances` may be below the diameter.
    :param next_one: how many segments further the first one is that a segment can touch.
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
    balls: Matrix
    overlaps: Indices
    next_one: int


@record
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


@part
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
        inverse = 1.0 / pivot
        positive: bool = pivot > 0.0
        if not every(positive):
            if not some(positive):
                return positive
            inverse = where(positive, inverse, math.nan)
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
        for k in range(BAND - 1, 0, -1):  # the one that is known last comes last: no waiting
            value -= bands[j, k] * right[j + k]
        right[j] = value
        total += value
    solved: bool = finite(total)
    return solved


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


def _begin_to_carry(segments: Matrix, carried: Matrix, begun: bool) -> None:
    """Carry the first vector of the reference frame from where it was in the last step."""
    raise NotImplementedError('kernels alone use this')


@_one_or_each(_begin_to_carry)
def _begin_to_carry_in(segments: Matrix, carried: Matrix, begun: bool) -> Any:
    if segments.dtype != LANES:
        return lambda segments, carried, begun: _begin_to_carry_one(segments, carried, begun)

    def each(segments: Matrix, carried: Matrix, begun: bool) -> None:
        for lane in range(COUNT):
            _begin_to_carry_one(numbers_of(segments)[:, :, lane], numbers_of(carried)[:, :, lane], begun)
    return each


@_inlined
def _carry_along(segments: Matrix, joints: Matrix, i: int) -> tuple[float, float]:
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
        _carry_along(segments, joints, i)
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


@_one_or_each(_find_turn)
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
            x, y = _carry_along(segments, joints, i)
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


@_inlined
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


@_one_or_each(_begin_frame)
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
    _begin_to_carry(segments, frame.carried, begun[0] == 1)
    if len(twisting) == 0:
        for i in range(len(joints)):
            _carry_along(segments, joints, i)
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


@_inlined
def _limited(x: float, y: float, z: float, most: float) -> float:
    """Return by how much a vector must be multiplied so that it is not longer than `most`."""
    square = x * x + y * y + z * z
    share = 1.0
    longer = square > most * most
    if some(longer):
        share = where(longer, most / math.sqrt(square), share)
    return share


@_inlined
def _inverse(square: float) -> float:
    """Return 1 / square, the squared length of the sum of two unit vectors, which are mostly parallel."""
    away = 1.0 - square / 4
    inverse = (1.0 + away * (1.0 + away * (1.0 + away))) / 4
    far = away > 1e-4
    if some(far):
        inverse = where(far, 1.0 / max(square, 4 * HAIRPIN), inverse)
    return inverse


@part
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


@_one_or_each(_hold)
def _hold_in(bands: Matrix, right: Vector, masses: Vector, held: Indices, follow: Matrix) -> Any:
    if bands.dtype != LANES:
        return lambda bands, right, masses, held, follow: _hold_one(bands, right, masses, held, follow)

    def each(bands: Matrix, right: Vector, masses: Vector, held: Any, follow: Any) -> None:
        for lane in range(COUNT):
            _hold_one(numbers_of(bands)[:, :, lane], numbers_of(right)[:, lane], numbers_of(masses)[:, lane],
                      held[lane], follow[lane])
    return each


@part
def _let_follow_one(predicted: Matrix, held: Indices, follow: Matrix) -> None:
    for h in range(len(held)):
        for c in range(3):
            predicted[held[h], c] = follow[h, c]


def let_follow(predicted: Matrix, held: Indices, follow: Matrix) -> None:
    """Give held nodes exactly the velocities of their hands."""
    raise NotImplementedError('kernels alone use this')


@_one_or_each(let_follow)
def _let_follow_in(predicted: Matrix, held: Indices, follow: Matrix) -> Any:
    if predicted.dtype != LANES:
        return lambda predicted, held, follow: _let_follow_one(predicted, held, follow)

    def each(predicted: Matrix, held: Any, follow: Any) -> None:
        for lane in range(COUNT):
            _let_follow_one(numbers_of(predicted)[:, :, lane], held[lane], follow[lane])
    return each


@part
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
    framed, segments = len(rod.frame.angles) > 0, rod.frame.segments
    rubs, pull = len(rod.friction.rows) > 0, rod.friction.pull
    if rubs:
        rub(rod.friction, points, step)
    for j in range(size, size + BAND - 1):
        right[j] = 0.0
        for k in range(BAND):
            bands[j, k] = 0.0
    for i in range(n):
        diagonal = masses[i] * (1.0 + drag * step) + implicit * bending[0, i]
        first, second = implicit * bending[1, i], implicit * bending[2, i]
        if rubs:
            diagonal += pull[i, 0]
            first += pull[i, 1]
            second += pull[i, 2]
        for c in range(3):
            j = 3 * i + c
            bands[j, 0] = diagonal
            bands[j, 1] = 0.0
            bands[j, 2] = 0.0
            bands[j, 3] = first
            bands[j, 4] = 0.0
            bands[j, 5] = 0.0
            bands[j, 6] = second
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
            if rubs:
                right[j] -= pull[i, 3 + c]
    for i in range(n - 1):
        x = points[i + 1, 0] - points[i, 0]
        y = points[i + 1, 1] - points[i, 1]
        z = points[i + 1, 2] - points[i, 2]
        square = x * x + y * y + z * z
        inverse = 1.0 / math.sqrt(square)
        slack = 1.0 - rest[i] * inverse
        if framed:
            segments[i, 0], segments[i, 1], segments[i, 2] = x * inverse, y * inverse, z * inverse
            segments[i, 3] = inverse
        tension = stiffness[i] * slack * step
        across = max(slack, 0.0) * stiffness[i]
        along = implicit * (stiffness[i] - across) * inverse * inverse
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
    if framed:
        add_frame(rod.frame, step, right)
    _hold(bands, right, masses, held, follow)
    solved = _solve(bands, right)
    for i in range(n):
        for c in range(3):
            predicted[i, c] = right[3 * i + c]
    let_follow(predicted, held, follow)
    return solved


@part
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


@part
def near_pairs(contact: SelfContact, points: Matrix, stretch: float, reach: float) -> int:
    """
    Write to `contact.pairs` the pairs of segments that can touch and whose gap is below `reach` [m].

    From a segment that is far away, the search goes on as far along the DLO as no other can be near.

    :param stretch: largest length of a segment, relative to its rest length.
    :returns: the number of pairs.
    """
    half, middles, pairs, diameter = contact.half, contact.middles, contact.pairs, contact.diameter
    apart, count, segments, longest = contact.apart, 0, len(half), 0.0
    x, y, z = contact.balls[0], contact.balls[1], contact.balls[2]
    for i in range(segments):
        x[i] = (points[i, 0] + points[i + 1, 0]) / 2
        y[i] = (points[i, 1] + points[i + 1, 1]) / 2
        z[i] = (points[i, 2] + points[i + 1, 2]) / 2
        longest = max(longest, half[i])
    longest *= 2 * stretch
    for i in range(segments):
        j = i + 1
        while j < segments and middles[j] - middles[i] - half[j] - half[i] <= apart:
            j += 1
        far = stretch * (half[i] + diameter) + longest / 2 + reach
        while j < segments:
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            beyond = math.sqrt(dx * dx + dy * dy + dz * dz) - far
            if beyond > 0.0:
                j += 1 + int(min(beyond / longest, float(segments)))  # points may be infinite
                continue
            if _closest(points, i, j)[5] <= stretch * diameter + reach:
                pairs[count, 0] = i
                pairs[count, 1] = j
                count += 1
            j += 1
    return count


@entry
def start_distances(contact: SelfContact, points: Matrix) -> None:
    """Set the least distances of pairs at the start, (N, 3) [m] points, so that none is pushed apart."""
    distances, diameter, pairs = contact.distances, contact.diameter, contact.pairs
    distances[:] = diameter
    contact.overlaps[0] = 0
    for k in range(near_pairs(contact, points, 1.0, 0.0)):
        i, j = pairs[k, 0], pairs[k, 1]
        distances[i, j] = min(diameter, _closest(points, i, j)[5])
        contact.overlaps[0] = 1
    contact.room[:] = -1.0


@part
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


@part
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


@part
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


@part
def _pass_on(contacts: Contacts, count: int, inverse_masses: Vector, velocities: Matrix) -> None:
    """Let the nodes that did not yield pass the impulses on to the bodies that support them."""
    for k in range(count):
        contact = contacts[k]
        for m in range(4):
            at = contact.nodes[m]
            passed_on = contact.weights[m] * (inverse_masses[at] - contact.yielding[m])
            for c in range(3):
                velocities[at, c] += passed_on * (contact.pushed * contact.normal[c] + contact.rubbed[c])


@part
def movement(velocities: Matrix, step: float) -> tuple[float, float]:
    """Return upper bounds [m] of how two nodes, and two neighbours, move against each other in a step."""
    n = len(velocities)
    middle = n // 2
    away, beside = 0.0, 0.0
    for i in range(n):
        x, y = velocities[i, 0] - velocities[middle, 0], velocities[i, 1] - velocities[middle, 1]
        z = velocities[i, 2] - velocities[middle, 2]
        away = max(away, x * x + y * y + z * z)
    for i in range(n - 1):
        x, y = velocities[i + 1, 0] - velocities[i, 0], velocities[i + 1, 1] - velocities[i, 1]
        z = velocities[i + 1, 2] - velocities[i, 2]
        beside = max(beside, x * x + y * y + z * z)
    return 2 * step * math.sqrt(away), step * math.sqrt(beside)


@_of_numbers
def _least_gap(balls: Matrix, count: int, away: int) -> float:
    """
    Return the least gap [m] between balls, each and the one that is `away` further.

    :param balls: (4, n) [m] centres and radii; the first `count` columns.
    """
    x, y, z, radius = balls[0], balls[1], balls[2], balls[3]
    # Slices, and no branch in the loop: the compiler makes four steps at once of it.
    x_there, y_there, z_there, radius_there = x[away:], y[away:], z[away:], radius[away:]
    least = math.inf
    for i in range(count - away):
        a, b, c = x_there[i] - x[i], y_there[i] - y[i], z_there[i] - z[i]
        least = min(least, math.sqrt(a * a + b * b + c * c) - radius_there[i] - radius[i])
    return least


@part
def _find_room(contact: SelfContact, points: Matrix) -> None:
    """
    Find how far nodes may move until any segments can touch.

    All pairs are checked, which takes less time than a search that branches: near ones along the DLO by balls
    around segments, the others by balls around two segments.
    """
    radius, segments, room = contact.diameter / 2, len(contact.half), contact.room
    single, double = contact.balls[:4], contact.balls[4:]
    for i in range(segments):
        length = 0.0
        for c in range(3):
            single[c, i] = (points[i, c] + points[i + 1, c]) / 2
            length += (points[i + 1, c] - points[i, c])**2
        single[3, i] = radius + math.sqrt(length) / 2
    count = (segments + 1) // 2
    for k in range(count):
        i = 2 * k + 1
        for c in range(3):
            double[c, k] = points[i, c]
        double[3, k] = 2 * max(single[3, i - 1], single[3, min(i, segments - 1)]) - radius
    room[:2] = math.inf
    first = 2 + contact.next_one // 2
    for away in range(contact.next_one, min(2 * first - 1, segments)):
        room[0] = min(room[0], _least_gap(single, segments, away) / (away + 1))
    for away in range(first, count):
        room[1] = min(room[1], _least_gap(double, count, away))


@part
def is_near(contact: SelfContact, points: Matrix, last: tuple[float, float],
            coming: tuple[float, float]) -> bool:
    """
    Tell whether the DLO may touch itself in a step, and find the pairs of segments that are near.

    :param last: `movement` in the last step.
    :param coming: `movement` in this step without contact.
    """
    near, room = contact.near, contact.room
    room[0] -= last[1]
    room[1] -= last[0]
    room[2] -= last[0]
    if room[0] >= coming[1] and room[1] >= coming[0]:
        return False
    if room[2] < coming[0]:
        _find_room(contact, points)
        if room[0] >= coming[1] and room[1] >= coming[0]:
            room[2] = -1.0
            if contact.overlaps[0] == 1:
                contact.distances[:] = contact.diameter
                contact.overlaps[0] = 0
            return False
        room[2] = coming[0] + min(max(SKIN[0], STEPS_AHEAD * coming[0]), SKIN[1])
        near[0] = near_pairs(contact, points, 1.2, room[2])  # a segment may be stretched by 20 %
        room[:2] = -1.0
    return bool(near[0] > 0)


@part
def keep_apart(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector,
               support: Matrix, step: float) -> None:
    """
    Correct `velocities` so that segments do not pass through each other; call it where the DLO `is_near`.

    Contacts are velocity constraints, solved by Jacobi iterations with mass splitting (Tonge et al., Mass
    Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).

    :param points: (N, 3) [m] at the start of the step.
    :param velocities: (N, 3) [m/s] that the DLO would have without contact.
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param support: (N, 3) [m/s] change of the velocities by other bodies in the last step.
    :param step: time step [s].
    """
    count = _find_contacts(contact, contact.near[0], points, velocities, step)
    if count == 0:
        return
    contacts, change = contact.contacts, contact.change
    _prepare(contacts, count, inverse_masses, support, change)
    for _ in range(ITERATIONS):
        _push_apart(contacts, count, contact.friction, velocities, change)
    _pass_on(contacts, count, inverse_masses, velocities)


@part
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
        depth = -(distance + slop)
        least = where(depth > 0.0, 0.08 * depth / step, depth / step)  # one step corrects 8 %
        push = least - velocities[i, 2]
        touches = both(distance < margin, push > 0.0)
        if some(touches):
            vx, vy = velocities[i, 0], velocities[i, 1]
            speed = math.sqrt(vx * vx + vy * vy)
            share = where(speed > 0.0, 1.0 - min(1.0, friction * push / speed), 0.0)
            velocities[i, 0] = where(touches, share * vx, vx)
            velocities[i, 1] = where(touches, share * vy, vy)
            velocities[i, 2] = where(touches, least, velocities[i, 2])


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


@entry
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


@entry
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
