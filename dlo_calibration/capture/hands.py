# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Hands: from the steps that a person named, and the chains before and after, to the paths of the hands."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.capture.steps import Hold, Step
from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, PushDown, TwoHands

PAUSE = 1.0  # s between steps, and before the goal: the DLO comes to rest, as a person waits for it
RAISED = 0.005  # m; a hand that is higher above its point's place on the table holds it in the air
BESIDE = 0.02  # m; a target that is so near to the goal's point is meant to be this point


@dataclass
class _Path:
    """The path of one hand from closing to opening, while it is put together."""

    name: str
    grip: int
    times: list[float]
    positions: list[Floats]

    def rest_until(self, time: float) -> None:
        if time > self.times[-1]:
            self.times.append(time)
            self.positions.append(self.positions[-1])

    def hand(self) -> Hand:
        return Hand(self.name, (self.grip,), np.array(self.times), np.array(self.positions))


@dataclass(frozen=True)
class Movements:
    """
    What the hands of a trial did.

    :param hands: their paths, in the order of their closing.
    :param held_by: names of those that hold the DLO in the goal.
    :param end: when all of them have arrived or opened [s].
    :param unknown: numbers, from 1, of steps that grip a point which an earlier step may have moved, so that
        nobody knows where the hand closed.
    """

    hands: tuple[Hand, ...]
    held_by: tuple[str, ...]
    end: float
    unknown: tuple[int, ...] = ()

    @property
    def actions(self) -> tuple[Action, ...]:
        """The paths as actions: hands that close and open together act together."""
        together: dict[tuple[float, float], list[Hand]] = {}
        for hand in self.hands:
            together.setdefault((hand.start, hand.end), []).append(hand)
        return tuple(Action(tuple(hands)) for hands in together.values())

    def raised(self, radius: float) -> tuple[str, ...]:
        """Return the names of the hands that hold the DLO in the air in the goal."""
        last = {hand.name: hand for hand in self.hands}
        return tuple(name for name in self.held_by if last[name].positions[-1, 2] > radius + RAISED)


@dataclass
class _Course:
    start: Chain
    goal: Chain
    radius: float
    measured_height: bool
    known: Floats = field(init=False)
    moved: set[int] = field(default_factory=set)  # points whose place is known from an earlier step
    held: dict[str, _Path] = field(default_factory=dict)
    paths: list[_Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.known = self.start.points.copy()

    def hold(self, name: str, grip: int) -> None:
        """Let a hand hold a point from the beginning."""
        self.held[name] = _Path(name, grip, [0.0], [self.known[grip]])
        self.paths.append(self.held[name])

    def conduct(self, step: Step, grips: Sequence[int], begin: float) -> float:
        """Let hands take a step; return when it ends [s]."""
        if step.kind == 'release':
            return self._release(step.hands, begin)
        if len(set(grips)) < len(grips):
            raise InputError(step.kind, 'two hands at the same place', 'two places', 'move one of them')
        for name, grip in zip(step.hands, grips, strict=True):
            others = [path.name for path in self.held.values() if path.grip == grip and path.name != name]
            if others:
                raise InputError(f'hand {name}', f'a point that hand {others[0]} holds', 'a place of its own',
                                 f'let {others[0]} open first, or move one of them')
            if name in self.held and self.held[name].times[-1] > begin:
                raise InputError(f'hand {name}', 'two steps at the same time', 'one after the other',
                                 'clear "with the previous step", or name another hand')
        ways = self._ways(step, grips)
        end = begin
        for name, grip, (times, positions) in zip(step.hands, grips, ways, strict=True):
            path = self.held.pop(name, None)
            if path is not None and path.grip != grip and path.times == [begin]:
                self.paths.remove(path)  # it held from before, and opened before it moved
            elif path is not None:
                path.rest_until(begin)
            if path is None or path.grip != grip:
                path = _Path(name, grip, [begin], [positions[0]])
                self.paths.append(path)
            path.times += [begin + time for time in times[1:]]
            path.positions += list(positions[1:])
            self.known[grip] = positions[-1]
            self.moved.add(grip)
            if step.values['hold']:
                self.held[name] = path
            end = max(end, path.times[-1])
        return end

    def _release(self, names: Sequence[str], begin: float) -> float:
        for name in names:
            if name not in self.held:
                raise InputError(f'hand {name}', 'a release, but it holds nothing', 'a hand that holds',
                                 'remove this step, or let an earlier step hold')
            self.held.pop(name).rest_until(begin)
        return begin

    def _ways(self, step: Step, grips: Sequence[int]) -> list[tuple[Floats, Floats]]:
        """Return the times (k,) [s] from the beginning of a step, and positions (k, 3) [m], of each hand."""
        values, here = step.values, Chain(self.known)
        if step.kind == 'two_hands':
            given = {name: value for name, value in values.items() if name != 'fractions'}
            return _of(TwoHands(points=tuple(grips), **given).action(here))
        grip, speed = grips[0], values['speed']
        if step.kind == 'path':
            places = [self.known[grip], *(np.array([x, y, self.radius + height])
                                          for x, y, height in values['waypoints'])]
            return [_along(places, speed)]
        if step.kind in ('lift_and_hold', 'push_down') and self.measured_height and values['hold']:
            return [_along([self.known[grip], self.goal.points[grip]], speed)]
        if step.kind == 'lift_and_hold':
            return _of(LiftAndHold(point=grip, height=values['height'], speed=speed).action(here))
        if step.kind == 'push_down':
            return _of(PushDown(point=grip, distance=values['distance'], speed=speed).action(here))
        target = tuple(self._target(grip, values['to']).tolist())
        if step.kind == 'drag':
            return _of(Drag(point=grip, to=target, speed=speed).action(here))
        return _of(GraspAndPlace(point=grip, to=target, height=values['height'], speed=speed).action(here))

    def _target(self, grip: int, to: tuple[float, ...] | None) -> Floats:
        """Return where a hand lets a point go, (3,) [m]."""
        seen: Floats = self.goal.points[grip]
        if to is None:
            return seen
        near = float(np.hypot(seen[0] - to[0], seen[1] - to[1])) < BESIDE
        return np.array([*to, seen[2] if near else self.radius])


def movements(steps: Sequence[Step], start: Chain, goal: Chain, grip_of: Callable[[float], int],
              radius: float, measured_height: bool = False, held: Sequence[Hold] = ()) -> Movements:
    """
    Return the paths of the hands.

    A hand that holds the DLO until a later step stays where it is.

    :param grip_of: returns the index of the chain's point at a fraction of the length.
    :param radius: of the DLO, which lies at this height [m].
    :param measured_height: True: the goal's heights are measured, also where the DLO is lifted; a hand that
        lifts or pushes a point, and holds it, ends there.
    :param held: the hands that hold the DLO at the start.
    :raises InputError: where the steps contradict each other; its thing begins with the step's number.
    """
    course = _Course(start, goal, radius, measured_height)
    for one in held:
        course.hold(one.hand, grip_of(one.fraction))
    begin, end, unknown = 0.0, -PAUSE, []
    for number, step in enumerate(steps, start=1):
        if number == 1 or not step.with_previous:
            begin = end + PAUSE
        grips = [grip_of(fraction) for fraction in step.fractions]
        if course.moved and step.kind != 'release' and not step.with_previous and not (
                set(grips) <= course.moved):
            unknown.append(number)
        try:
            end = max(end, course.conduct(step, grips, begin))
        except InputError as error:
            raise InputError(f'step {number}, {error.thing}', error.came, error.expected,
                             error.remedy) from error
    hands = tuple(path.hand() for path in course.paths)
    return Movements(hands, tuple(course.held), max(end, 0.0), tuple(unknown))


def _of(action: Action) -> list[tuple[Floats, Floats]]:
    return [(hand.times, hand.positions) for hand in action.hands]


def _along(places: Sequence[Floats], speed: float) -> tuple[Floats, Floats]:
    """Return times and positions of a hand that goes straight from place to place."""
    way = [places[0]]
    for place in places[1:]:
        if np.linalg.norm(place - way[-1]) > 1e-6:  # m
            way.append(place)
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1) if len(way) > 1 else np.zeros(0)
    return np.concatenate([[0.0], np.cumsum(lengths / speed)]), np.array(way)
