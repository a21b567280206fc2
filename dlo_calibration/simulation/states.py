# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""States: what kernels read and write, as named tuples of arrays and numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

COUNT = 4  # DLOs that are simulated at once: numbers of 64 bits in a register of AVX2
BAND = 7  # entries per column of the lower triangle: node i couples with i + 2, three coordinates each
GOES_ON, STABLE, DIVERGED = 0, 1, 2  # how a move ends
DRAG, IMPLICIT, FRICTION, LEVEL, SOLVED, LAST, COMING = 0, 1, 2, 3, 4, 5, 7  # rows of `Together.numbers`

# Annotations that tell the number of axes:
Vector = Floats
Matrix = Floats
Cube = Floats
Indices = NDArray[np.int64]
Contacts = NDArray[np.void]
IndexRows = NDArray[np.int64]
Vector32 = NDArray[np.float32]
Matrix32 = NDArray[np.float32]
Cube32 = NDArray[np.float32]
Bytes = NDArray[np.int8]
ByteRows = NDArray[np.int8]

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
    :param bands: (6 + 3 N, 7) workspace: six of zeros, then the columns of the lower triangle of the matrix.
    :param right: (3 N,) workspace: right side.
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


class Move(NamedTuple):
    """
    What happens to one of the DLOs until its next event.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step; after k steps, they stay.
    :param turns: (k, h, 9) of `turn_clamps` in each step, or (0, 0, 0).
    :param path: (k, N, 3) [m] where the positions of all nodes after each step are written; or (0, 0, 0).
    :param most: steps of the move, at most.
    :param periods: (c,) steps between two checks whether the DLO is stable, the last one after `most` steps;
        (0,): it is not checked.
    :param seen: (c + 1, N, 3) [m] where the nodes were at the last checks; or more.
    :param distance: [m] it is stable if no node is further from the first of these places.
    :param progress: (4,) steps taken; steps until the next check; checks made; how the move ended: `GOES_ON`,
        `STABLE` or `DIVERGED`.
    :param held: see `RodState`, like the following; they are those of the DLO.
    :param contact: contact of the DLO with itself.
    """

    targets: Cube
    turns: Cube
    path: Cube
    most: int
    periods: Indices
    seen: Cube
    distance: float
    progress: Indices
    held: Indices
    follow: Matrix
    inverse_masses: Vector
    contact: SelfContact


class Together(NamedTuple):
    """
    `COUNT` DLOs of N nodes that are simulated together; the last axis is the DLO's.

    What the arrays are is said at `RopeState`, `RodState`, `FrameState` and `SlipState`.

    :param numbers: (9, COUNT) drag, `implicit`, friction, height of nodes on the table [m], 1 where the step
        could be solved, and two rows each of `movement` in the last step and the coming one.
    :param lane: (COUNT,) 0, 1, 2, ...
    :param gravity: (3,) is the same for all, like the following.
    :param step: time step [s].
    :param clamped: (s, 2).
    :param begun: (1,) 1.
    :param one: (3, N, 3) workspace: points, predicted velocities and support of one of them.
    """

    points: Cube
    velocities: Cube
    predicted: Cube
    support: Cube
    rest_lengths: Matrix
    stiffness: Matrix
    masses: Matrix
    bending: Cube
    bands: Cube
    right: Matrix
    natural: Cube
    twisting: Matrix
    angles: Matrix
    clamps: Cube
    carried: Cube
    segments: Cube
    joints: Cube
    turning: Cube
    rows: Cube
    kept: Cube
    pull: Cube
    numbers: Matrix
    lane: Indices
    gravity: Vector
    step: float
    clamped: IndexRows
    begun: Indices
    one: Cube


Moves = tuple[Move, ...]  # one of each lane

#: annotation -> how its values are given to kernels: as `int` or `float`, as an array of a type and a number
#: of axes, or as a tuple of others
LAYOUTS: dict[str, Any] = {
    'int': int, 'float': float, 'Vector': (np.dtype(float), 1), 'Matrix': (np.dtype(float), 2),
    'Cube': (np.dtype(float), 3), 'Indices': (np.dtype(np.int64), 1), 'IndexRows': (np.dtype(np.int64), 2),
    'Vector32': (np.dtype(np.float32), 1), 'Matrix32': (np.dtype(np.float32), 2),
    'Cube32': (np.dtype(np.float32), 3), 'Bytes': (np.dtype(np.int8), 1), 'ByteRows': (np.dtype(np.int8), 2),
    'Contacts': (CONTACT, 1), 'Moves': [Move] * COUNT,
    **{one.__name__: one for one in (
        SlipState, FrameState, SelfContact, RodState, RopeState, Move, Together)}}
