# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
roll_out_together(): several trials, or one with several parameter sets, simulated at the same time.

Ropes of the same kind share the lanes of `kernels_together`; as soon as one of them comes to an event of
its trial, its course goes on to the next steps, and another rope may take its lane.
"""

from __future__ import annotations

from collections import Counter, deque
import math
from typing import Callable, Hashable, Iterable, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation import entries
from dlo_calibration.simulation.compiled import CompiledRope
from dlo_calibration.simulation.machine_code import Packed
from dlo_calibration.simulation.protocol import advanced, Rollout
from dlo_calibration.simulation.rollout import Course, PIECE, take
from dlo_calibration.simulation.rope import diverged
from dlo_calibration.simulation.states import (
    COUNT,
    DIVERGED,
    DRAG,
    FRICTION,
    GOES_ON,
    IMPLICIT,
    LEVEL,
    Move,
    RodState,
    RopeState,
    STABLE,
    Together,
)


class Lanes:
    """What `kernels_together` needs for ropes of one kind."""

    def __init__(self, rope: CompiledRope) -> None:
        rod, n = rope.state.rod, len(rope.state.points)
        frame, friction = rod.frame, rod.friction

        def room(array: Floats) -> Floats:
            return _aligned(*array.shape, COUNT)

        #: the state of the ropes in the lanes
        self.state = Together(
            points=_aligned(n, 3, COUNT), velocities=_aligned(n, 3, COUNT),
            predicted=_aligned(n, 3, COUNT), support=_aligned(n, 3, COUNT),
            rest_lengths=room(rod.rest_lengths), stiffness=room(rod.stiffness), masses=room(rod.masses),
            bending=room(rod.bending), bands=room(rod.bands), right=room(rod.right),
            natural=room(frame.natural), twisting=room(frame.twisting), angles=room(frame.angles),
            clamps=room(frame.clamps), carried=room(frame.carried), segments=room(frame.segments),
            joints=room(frame.joints), turning=room(frame.turning), rows=room(friction.rows),
            kept=room(friction.kept), pull=room(friction.pull), numbers=_aligned(9, COUNT),
            lane=np.arange(COUNT), gravity=rope.state.gravity, step=rod.step, clamped=frame.clamped,
            begun=np.ones(1, np.int64), one=np.empty((3, n, 3)))
        self._packed = Packed(self.state)
        self._ropes: list[RolloutUnderWay] = []

    def let_in(self, rollouts: Sequence[RolloutUnderWay]) -> None:
        """Give these, at most `COUNT`, and no others, a lane each."""
        places: list[RolloutUnderWay | None] = [None] * len(rollouts)
        for lane, one in enumerate(self._ropes):
            if one.inside and one in rollouts and lane < len(rollouts):
                places[lane] = one
            elif one.inside:
                self.let_out(one)
        coming = iter([one for one in rollouts if one not in places])
        for lane, place in enumerate(places):
            if place is None:
                place = places[lane] = next(coming)
                self._take_in(place.rope, lane)
                place.inside = True
        self._ropes = [one for one in places if one is not None]

    def let_out(self, one: RolloutUnderWay) -> None:
        """Give a rope its state back."""
        lane = self._ropes.index(one)
        for name, array in _changing(one.rope.state).items():
            array[...] = getattr(self.state, name)[..., lane]
        one.inside = False

    def _take_in(self, rope: CompiledRope, lane: int) -> None:
        rod = rope.state.rod
        for name, array in {**_changing(rope.state), **_lasting(rod)}.items():
            getattr(self.state, name)[..., lane] = array
        numbers = self.state.numbers[:, lane]
        numbers[DRAG], numbers[IMPLICIT] = rod.drag, rod.implicit
        numbers[FRICTION] = rope.state.contact.friction
        numbers[LEVEL] = rope.level

    def advance(self, count: int) -> None:
        """Take steps of all ropes that are in, at most `count`, until one of their moves ends."""
        moves = [one.packed for one in self._ropes]
        entries.advance_together(
            (*moves, *[moves[0]] * (COUNT - len(moves))), self._packed, count, len(moves))
        advanced()


def _changing(rope: RopeState) -> dict[str, Floats]:
    """Return what steps change of a rope, by the names of `Together`."""
    frame = rope.rod.frame
    return {'points': rope.points, 'velocities': rope.velocities, 'support': rope.support,
            'angles': frame.angles, 'clamps': frame.clamps, 'carried': frame.carried, 'joints': frame.joints,
            'kept': rope.rod.friction.kept}


def _lasting(rod: RodState) -> dict[str, Floats]:
    """Return what steps do not change of a rod, by the same names."""
    return {'rest_lengths': rod.rest_lengths, 'stiffness': rod.stiffness, 'masses': rod.masses,
            'bending': rod.bending, 'natural': rod.frame.natural, 'twisting': rod.frame.twisting,
            'rows': rod.friction.rows}


class RolloutUnderWay:
    """
    A rollout that is under way: a rope, and the course of its trial.

    :param number: its place among the rollouts that were asked for.
    """

    def __init__(self, number: int, rope: CompiledRope, course: Course) -> None:
        self.number, self.rope, self._course = number, rope, course
        self.inside = False  # whether its state is in a lane
        self.kind: Hashable = None
        self.outcome: Rollout | SimulationError | None = None
        self._take_next(None)

    @property
    def left(self) -> int:
        """The steps until its move ends, at most."""
        return self._steps.count - int(self.move.progress[0])

    @property
    def arrived(self) -> bool:
        """Whether its move has ended."""
        return self.left == 0 or self.move.progress[3] != GOES_ON

    def go_on(self) -> None:
        """Go on after a move."""
        if self.move.progress[3] == DIVERGED:
            self.outcome = diverged()
        else:
            stable = bool(self.move.progress[3] == STABLE)
            self._take_next((int(self.move.progress[0]), stable))

    def _take_next(self, taken: tuple[int, bool] | None) -> None:
        """Find the next steps that can be taken together with others; take those that cannot."""
        try:
            while True:
                self._steps = self._course.send(taken)
                if self._begin_move():
                    return
                taken = take(self.rope, self._steps)
        except StopIteration as end:
            self.outcome = end.value
        except SimulationError as error:
            self.outcome = error

    def _begin_move(self) -> bool:
        """Begin the next steps; tell whether they can be taken together with others."""
        rope, steps = self.rope, self._steps
        periods = steps.periods(rope.time_step)
        first = 0 if rope.has_begun else 1
        if steps.count <= first or len(periods) and periods[0] <= first:
            return False
        seen = np.empty((0, 0, 0))
        if len(periods):
            seen = np.empty((len(periods) + 1, *rope.state.points.shape))
            seen[0] = rope.state.points
        if first:
            rope.advance(steps.targets[:1], None if steps.path is None else steps.path[:1],
                         None if steps.turns is None else steps.turns[:1])
        until_check = periods[0] - first if len(periods) else 0
        rod = rope.state.rod
        self.kind = rope.kind
        self.move = Move(
            targets=np.ascontiguousarray(steps.targets),
            turns=np.empty((0, 0, 0)) if steps.turns is None else np.ascontiguousarray(steps.turns),
            path=np.empty((0, 0, 0)) if steps.path is None else steps.path, most=steps.count,
            periods=periods, seen=seen,
            distance=0.0 if steps.settling is None else steps.settling.distance,
            progress=np.array([first, until_check, 0, GOES_ON]), held=rod.held,
            follow=rod.follow, inverse_masses=rod.inverse_masses, contact=rope.contact)
        self.packed = Packed(self.move)
        return True


def roll_out_together(starts: Iterable[Callable[[], tuple[CompiledRope, Course]]],
                      between: Callable[[], None]) -> list[Rollout | SimulationError]:
    """
    Simulate trials together.

    :param starts: each returns a rope at the start of a trial, and the course of the trial.
    :param between: is called again and again; what it raises ends the simulation.
    :returns: the rollouts, or why they failed, in order.
    """
    waiting = deque(enumerate(starts))
    found: list[Rollout | SimulationError | None] = [None] * len(waiting)
    rollouts: list[RolloutUnderWay] = []
    rooms: dict[Hashable, Lanes] = {}
    kind: Hashable = None
    while waiting or rollouts:
        between()
        while waiting and len(rollouts) < 2 * COUNT:
            number, start = waiting.popleft()
            rollouts.append(RolloutUnderWay(number, *start()))
        for one in [one for one in rollouts if one.outcome is not None]:
            found[one.number] = one.outcome
            rollouts.remove(one)
        if not rollouts:
            continue
        counts = Counter(one.kind for one in rollouts)
        if counts[kind] < min(COUNT, max(counts.values())):
            if kind in rooms:
                rooms[kind].let_in([])
            kind = counts.most_common(1)[0][0]
        going = sorted((one for one in rollouts if one.kind == kind), key=lambda one: not one.inside)
        going = going[:COUNT]
        if kind not in rooms:
            rooms[kind] = Lanes(going[0].rope)
        lanes = rooms[kind]
        lanes.let_in(going)
        lanes.advance(min(PIECE, *(one.left for one in going)))
        for one in going:
            if one.arrived:
                lanes.let_out(one)
                one.go_on()
    return [one for one in found if one is not None]


def _aligned(*shape: int) -> Floats:
    """Return zeros at an address at which lanes do not lie across two lines of the processor's cache."""
    room = np.zeros(math.prod(shape) + 8)
    start = -(room.ctypes.data // 8) % 8
    return room[start:start + math.prod(shape)].reshape(shape)
