# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels for several DLOs at once: the rods of four DLOs are stepped in `lanes`, their contacts one by one.

Each DLO gets the same positions, bit for bit, as by itself.
"""

from __future__ import annotations

import math
from typing import Any

from dlo_calibration.simulation import entries
from dlo_calibration.simulation.compilation import entry, inlined, part
from dlo_calibration.simulation.kernels import let_follow, rest_on_table, rod_velocities
from dlo_calibration.simulation.kernels_contact import keep_apart
from dlo_calibration.simulation.kernels_frame import turn_clamps
from dlo_calibration.simulation.kernels_near import is_near, movement
from dlo_calibration.simulation.lanes import lanes_of, where
from dlo_calibration.simulation.states import (
    COMING,
    Cube,
    DIVERGED,
    DRAG,
    FrameState,
    FRICTION,
    IMPLICIT,
    LAST,
    LEVEL,
    Matrix,
    Move,
    Moves,
    RodState,
    SlipState,
    SOLVED,
    STABLE,
    Together,
)


@part
def _copy_rows_in(lanes: Cube, lane: int, numbers: Matrix) -> None:
    for i in range(numbers.shape[0]):
        for k in range(numbers.shape[1]):
            lanes[i, k, lane] = numbers[i, k]


@part
def _copy_rows_out(lanes: Cube, lane: int, numbers: Matrix) -> None:
    for i in range(numbers.shape[0]):
        for k in range(numbers.shape[1]):
            numbers[i, k] = lanes[i, k, lane]


@inlined
def _aim(move: Move, points: Cube, lane: int, step: float) -> None:
    """Write the velocities of a DLO's held nodes in the next step."""
    k = min(move.progress[0], len(move.targets) - 1)
    for h in range(len(move.held)):
        for c in range(3):
            move.follow[h, c] = (move.targets[k, h, c] - points[move.held[h], c, lane]) / step


@inlined
def _follow_through(move: Move, together: Together, lane: int) -> None:
    """Turn a DLO's clamps with their hands, and let it not pass through itself in the coming step."""
    contact, points, predicted, support = move.contact, together.one[0], together.one[1], together.one[2]
    if len(move.turns) > 0:
        turn_clamps(together.clamped, together.clamps[:, :, lane],
                    move.turns[min(move.progress[0], len(move.turns) - 1)])
    numbers = together.numbers[:, lane]
    if numbers[SOLVED] == 1.0 and is_near(
            contact, together.points[:, :, lane], (numbers[LAST], numbers[LAST + 1]),
            (numbers[COMING], numbers[COMING + 1])):
        _copy_rows_out(together.points, lane, points)
        _copy_rows_out(together.predicted, lane, predicted)
        _copy_rows_out(together.support, lane, support)
        keep_apart(contact, points, predicted, move.inverse_masses, support, together.step)
        _copy_rows_in(together.predicted, lane, predicted)


@inlined
def _arrive(move: Move, together: Together, lane: int) -> bool:
    """Put a DLO's held nodes where their hands are, and count the step; tell whether its move ended."""
    progress, points = move.progress, together.points
    if together.numbers[SOLVED, lane] == 0.0:
        progress[3] = DIVERGED
        return True
    k = min(progress[0], len(move.targets) - 1)
    for h in range(len(move.held)):
        for c in range(3):
            points[move.held[h], c, lane] = move.targets[k, h, c]
    if len(move.path) > 0:
        _copy_rows_out(points, lane, move.path[progress[0]])
    progress[0] += 1
    if len(move.periods) > 0:
        progress[1] -= 1
        if (progress[1] == 0 or progress[0] == move.most) and _is_stable(move, points, lane):
            progress[3] = STABLE
            return True
    return False


@part
def _is_stable(move: Move, points: Cube, lane: int) -> bool:
    """Check whether a DLO is stable: all its nodes have stayed where they were."""
    seen, progress, count = move.seen, move.progress, len(move.periods)
    progress[2] += 1
    progress[1] = move.periods[progress[2] % count]
    _copy_rows_out(points, lane, seen[progress[2] % (count + 1)])
    if progress[2] < count:
        return False
    start, furthest = seen[(progress[2] + 1) % (count + 1)], 0.0
    for check in range(count + 1):
        for i in range(seen.shape[1]):
            x, y = seen[check, i, 0] - start[i, 0], seen[check, i, 1] - start[i, 1]
            z = seen[check, i, 2] - start[i, 2]
            furthest = max(furthest, x * x + y * y + z * z)
    return math.sqrt(furthest) < move.distance


@entry(entries.advance_together)
def advance_together(moves: Moves, together: Together, count: int, used: int) -> int:
    """
    Take steps of several DLOs at once, each as `kernels.advance` would take it, until a move ends.

    :param moves: of `COUNT` DLOs; those that are not used may be any of the others.
    :param count: most steps to take.
    :param used: how many of the DLOs are to move.
    :returns: number of steps taken.
    """
    a, b, c, d = moves
    lane, step = together.lane, together.step
    lanes, masses = lanes_of(together.numbers), lanes_of(together.masses)
    points, velocities = lanes_of(together.points), lanes_of(together.velocities)
    predicted, support = lanes_of(together.predicted), lanes_of(together.support)
    frame = FrameState(
        lanes_of(together.natural), lanes_of(together.twisting), lanes_of(together.angles), together.clamped,
        lanes_of(together.clamps), lanes_of(together.carried), together.begun, lanes_of(together.segments),
        lanes_of(together.joints), lanes_of(together.turning))
    friction = SlipState(
        lanes_of(together.rows), lanes_of(together.kept), together.begun, lanes_of(together.pull))
    held: Any = (a.held, b.held, c.held, d.held)
    follow: Any = (a.follow, b.follow, c.follow, d.follow)
    rod = RodState(
        lanes_of(together.rest_lengths), lanes_of(together.stiffness), masses, masses,
        lanes_of(together.bending), frame, friction, held, follow, lanes[DRAG], lanes[IMPLICIT], step,
        lanes_of(together.bands), lanes_of(together.right))
    for taken in range(count):
        _aim(a, together.points, lane[0], step)
        if used > 1:
            _aim(b, together.points, lane[1], step)
        if used > 2:
            _aim(c, together.points, lane[2], step)
        if used > 3:
            _aim(d, together.points, lane[3], step)
        for i in range(len(points)):
            for k in range(3):
                velocities[i, k] += step * together.gravity[k]
        lanes[SOLVED] = where(rod_velocities(rod, points, velocities, predicted), 1.0, 0.0)
        lanes[LAST], lanes[LAST + 1] = movement(velocities, step)
        lanes[COMING], lanes[COMING + 1] = movement(predicted, step)
        _follow_through(a, together, lane[0])
        if used > 1:
            _follow_through(b, together, lane[1])
        if used > 2:
            _follow_through(c, together, lane[2])
        if used > 3:
            _follow_through(d, together, lane[3])
        rest_on_table(points, predicted, velocities, lanes[LEVEL], lanes[FRICTION], step)
        let_follow(velocities, rod.held, rod.follow)
        for i in range(len(points)):
            for k in range(3):
                support[i, k] = velocities[i, k] - predicted[i, k]
                points[i, k] += step * velocities[i, k]
        ended = _arrive(a, together, lane[0])
        if used > 1:
            ended = _arrive(b, together, lane[1]) or ended
        if used > 2:
            ended = _arrive(c, together, lane[2]) or ended
        if used > 3:
            ended = _arrive(d, together, lane[3]) or ended
        if ended:
            return taken + 1
    return count
