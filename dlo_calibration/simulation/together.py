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
from operator import attrgetter
from typing import Callable, Hashable, Iterable, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation import entries
from dlo_calibration.simulation.compiled import CompiledRope
from dlo_calibration.simulation.machine_code import Packed
from dlo_calibration.simulation.protocol import advanced, Rollout
from dlo_calibration.simulation.rollout import course, PIECE, take
from dlo_calibration.simulation.rope import diverged
from dlo_calibration.simulation.script import Script
from dlo_calibration.simulation.states import (
    COUNT,
    DIVERGED,
    DRAG,
    FRICTION,
    GOES_ON,
    IMPLICIT,
    LEVEL,
    RopeState,
    STABLE,
    Together,
)

# What steps change of a rope's state, and what they do not; the last word is the name in `Together`.
CHANGING = ('points', 'velocities', 'support', 'rod.frame.angles', 'rod.frame.clamps', 'rod.frame.carried',
            'rod.frame.joints', 'rod.friction.kept')
LASTING = ('rod.rest_lengths', 'rod.stiffness', 'rod.masses', 'rod.bending', 'rod.frame.natural',
           'rod.frame.twisting', 'rod.friction.rows')


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
        self._changing, self._all = self._used(CHANGING), self._used(CHANGING + LASTING)
        self._ropes: list[RolloutUnderWay] = []

    def _used(self, names: Sequence[str]) -> tuple[Callable[[RopeState], Sequence[Floats]], list[Floats]]:
        """Return what finds the arrays that ropes of this kind have, and those of the lanes."""
        used = [name for name in names if getattr(self.state, name.split('.')[-1]).size]
        return attrgetter(*used), [getattr(self.state, name.split('.')[-1]) for name in used]

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
        find, arrays = self._changing
        lane = self._ropes.index(one)
        for own, lanes in zip(find(one.rope.state), arrays, strict=True):
            own[...] = lanes[..., lane]
        one.inside = False

    def _take_in(self, rope: CompiledRope, lane: int) -> None:
        find, arrays = self._all
        for own, lanes in zip(find(rope.state), arrays, strict=True):
            lanes[..., lane] = own
        rod = rope.state.rod
        numbers = self.state.numbers[:, lane]
        numbers[DRAG], numbers[IMPLICIT] = rod.drag, rod.implicit
        numbers[FRICTION] = rope.state.contact.friction
        numbers[LEVEL] = rope.level

    def advance(self, count: int) -> None:
        """Take steps of all ropes that are in, at most `count`, until one of their moves ends."""
        moves = [one.move for one in self._ropes]
        entries.advance_together(
            (*moves, *[moves[0]] * (COUNT - len(moves))), self._packed, count, len(moves))
        advanced()


class RolloutUnderWay:
    """
    A rollout that is under way.

    :param number: its place among the rollouts that were asked for.
    :param script: of its trial.
    :param rope: at the start of the trial.
    """

    def __init__(self, number: int, script: Script, rope: CompiledRope) -> None:
        self.number, self.rope, self._course = number, rope, course(script, rope)
        self.inside = False  # whether its state is in a lane
        self.kind: Hashable = None
        self.outcome: Rollout | SimulationError | None = None
        self._take_next(None)

    @property
    def left(self) -> int:
        """Steps until its move ends, at most."""
        return self._steps.number - int(self.move['progress'].item(0))

    @property
    def arrived(self) -> bool:
        """Whether its move has ended."""
        return self.move['progress'].item(3) != GOES_ON or self.left == 0

    def go_on(self) -> None:
        """Go on after a move."""
        taken, _, _, ending = self.move['progress'].tolist()
        if ending == DIVERGED:
            self.outcome = diverged()
        else:
            self._take_next((taken, ending == STABLE))

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
        if steps.number <= first or len(periods) and periods[0] <= first:
            return False
        self.move = rope.packed_move(steps)
        self.move['seen'][0] = rope.state.points
        if first:
            rope.advance(steps.targets[:1], None if steps.path is None else steps.path[:1],
                         None if steps.turns is None else steps.turns[:1])
        until_check = periods[0] - first if len(periods) else 0
        self.move['progress'][:] = first, until_check, 0, GOES_ON
        self.kind = rope.kind
        return True


def roll_out_together(starts: Iterable[Callable[[], tuple[Script, CompiledRope]]], free: list[CompiledRope],
                      between: Callable[[], None]) -> list[Rollout | SimulationError]:
    """
    Simulate trials together.

    :param starts: each returns the script of a trial, and a rope at the start of it.
    :param free: to it the ropes are added whose rollouts have ended.
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
            try:
                rollouts.append(RolloutUnderWay(number, *start()))
            except SimulationError as error:
                found[number] = error
        for one in [one for one in rollouts if one.outcome is not None]:
            found[one.number] = one.outcome
            rollouts.remove(one)
            free.append(one.rope)
        if not rollouts:
            continue
        going = [one for one in rollouts if one.kind == kind]
        if len(going) < min(COUNT, len(rollouts)):
            most, count = Counter(one.kind for one in rollouts).most_common(1)[0]
            if len(going) < min(COUNT, count):
                if kind in rooms:
                    rooms[kind].let_in([])
                kind, going = most, [one for one in rollouts if one.kind == most]
        going = [*(one for one in going if one.inside), *(one for one in going if not one.inside)][:COUNT]
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
