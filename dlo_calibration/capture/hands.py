# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Hands: the steps that a person enters, and the paths of the hands that they mean.

Most kinds of steps are named actions (`dlo_calibration.model.named_actions`); `path` is drawn by the person.
The chains before and after give the places where the hands close and open.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.capture.json_values import JsonValue, plain
from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand, MAXIMUM_HANDS
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import NAMED_ACTIONS

PAUSE = 1.0  # s between steps, and before the goal: people wait until the DLO is at rest
RAISED = 0.005  # m; a hand higher than this above its point's place on the table holds it in the air
BESIDE = 0.02  # m; a target nearer than this to the goal's point means that point
NAME_LENGTH = 40  # characters of a hand's name
MOST_WAYPOINTS = 50  # of a drawn path
LARGEST_PLACE = 100.0  # m from the origin of the table's frame


@dataclass(frozen=True)
class Field:
    """
    One field of a step.

    :param default: its value where the document has none.
    :param form: `number`, `truth`, `choice`, `name`, `names`, `numbers`, `place` or `waypoints`.
    :param choices: the values that a `choice` has.
    """

    default: Any
    form: str = 'number'
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()


def _waypoint(entry: JsonValue) -> tuple[float, ...]:
    x, y, height = entry.numbers(3, -LARGEST_PLACE, LARGEST_PLACE)
    if height < 0:
        raise entry.refused(f'a height of {height:g} m', '0 or more')
    return x, y, height


#: Form of a field -> reader that checks and returns the value of an entry.
READERS: Mapping[str, Callable[[Field, JsonValue], Any]] = {
    'number': lambda field, entry: entry.number(field.minimum or 0.0, field.maximum or 0.0),
    'truth': lambda _, entry: entry.truth(),
    'choice': lambda field, entry: entry.choice(field.choices),
    'name': lambda _, entry: entry.word(NAME_LENGTH),
    'names': lambda _, entry: tuple(name.word(NAME_LENGTH) for name in entry.entries(1, MAXIMUM_HANDS)),
    'numbers': lambda field, entry: entry.numbers(2, field.minimum or 0.0, field.maximum or 0.0),
    'place': lambda _, entry: entry.numbers(2, -LARGEST_PLACE, LARGEST_PLACE) if entry.given else None,
    'waypoints': lambda _, entry: tuple(map(_waypoint, entry.entries(0, MOST_WAYPOINTS))),
}


@dataclass(frozen=True)
class Kind:
    """
    A kind of step.

    :param text: what the hand does, and which parameters that shows.
    """

    title: str
    text: str
    fields: Mapping[str, Field]


_HAND = {'hand': Field('left_hand', 'name'), 'fraction': Field(0.5, unit='', minimum=0.0, maximum=1.0)}
_TO = Field(None, 'place', 'm')
_SPEED = Field(0.1, unit='m/s', minimum=0.001, maximum=10.0)


def _length(default: float, least: float = 0.0) -> Field:
    return Field(default, unit='m', minimum=least, maximum=5.0)


def _hold(default: bool) -> Field:
    return Field(default, 'truth')


KINDS: Mapping[str, Kind] = {
    'grasp_and_place': Kind(
        'Grasp and place', 'The hand lifts a point, carries it and puts it down. It shows some of the '
        'bending stiffness and the friction.',
        {**_HAND, 'to': _TO, 'height': _length(0.05, 0.001), 'speed': _SPEED, 'hold': _hold(False)}),
    'drag': Kind(
        'Drag', 'The hand pulls a point along the table. It shows much of the bending stiffness and the '
        'friction.', {**_HAND, 'to': _TO, 'speed': _SPEED, 'hold': _hold(False)}),
    'lift_and_hold': Kind(
        'Lift and hold', 'The hand lifts a point straight up and holds it there. It shows the bending '
        'stiffness best, and needs a second photograph from the side.',
        {**_HAND, 'height': _length(0.1, 0.001), 'speed': _SPEED, 'hold': _hold(True)}),
    'push_down': Kind(
        'Push down', 'The hand pushes a raised point down and holds it there. It shows much of the bending '
        'stiffness, and needs a second photograph from the side.',
        {**_HAND, 'distance': _length(0.05, 0.001), 'speed': _SPEED, 'hold': _hold(True)}),
    'two_hands': Kind(
        'Two hands', 'Two hands move apart or together. Apart, it is the only one that shows how the DLO '
        'stretches; together, it shows how it bends.',
        {'hands': Field(('left_hand', 'right_hand'), 'names'),
         'fractions': Field((0.25, 0.75), 'numbers', minimum=0.0, maximum=1.0),
         'motion': Field('together', 'choice', choices=('together', 'apart')),
         'distance': _length(0.1, 0.001),
         'moving': Field('both', 'choice', choices=('both', 'first', 'second')), 'height': _length(0.0),
         'speed': _SPEED, 'hold': _hold(True)}),
    'path': Kind(
        'Along a drawn path', 'The hand carries a point along a path that you draw, at a height that you '
        'choose at each place. What it shows depends on the path.',
        {**_HAND, 'waypoints': Field((), 'waypoints', 'm'), 'speed': _SPEED, 'hold': _hold(False)}),
    'release': Kind(
        'Release', 'A hand that still holds the DLO opens where it is. After a lift, it shows the bends that '
        'remain.', {'hands': Field(('left_hand',), 'names')}),
}


@dataclass(frozen=True)
class StepEntry:
    """
    A movement of one hand, or of two together.

    :param kind: one of `KINDS`.
    :param values: all fields of the kind, by name.
    :param with_previous: True: it begins with the step before it; False: after the end of all before it.
    """

    kind: str
    values: Mapping[str, Any]
    with_previous: bool = False

    @classmethod
    def of(cls, values: JsonValue) -> StepEntry:
        """Return the step of a document; missing values have their defaults."""
        kind = values.entry('kind').choice(tuple(KINDS))
        fields = KINDS[kind].fields
        values.only('kind', 'with_previous', *fields)
        read = {name: READERS[field.form](field, values.entry(name, field.default))
                for name, field in fields.items()}
        return cls(kind, read, values.entry('with_previous', False).truth())

    @property
    def hands(self) -> tuple[str, ...]:
        """The names of the hands that it moves or opens."""
        return tuple(self.values.get('hands') or (self.values['hand'],))

    @property
    def fractions(self) -> tuple[float, ...]:
        """Where the hands grip, each as a fraction of the length; empty: they hold the DLO already."""
        if 'fraction' in self.values:
            return (self.values['fraction'],)
        return tuple(self.values.get('fractions', ()))

    @property
    def json_entries(self) -> dict[str, Any]:
        """The values of the step in a document."""
        return {'kind': self.kind, **self.values, 'with_previous': self.with_previous}


@dataclass(frozen=True)
class Hold:
    """
    A hand that holds the DLO.

    :param fraction: of the length, where it grips.
    :param raised: whether it holds that point in the air.
    """

    hand: str
    fraction: float
    raised: bool = False


def held_after(steps: Sequence[StepEntry], before: Sequence[Hold] = ()) -> tuple[Hold, ...]:
    """Return the hands that hold the DLO after some steps, if those in `before` hold it at first."""
    held = {hold.hand: hold for hold in before}
    for step in steps:
        for name in step.hands:
            held.pop(name, None)
        if step.values.get('hold'):
            held.update({name: Hold(name, fraction, _raises(step))
                         for name, fraction in zip(step.hands, step.fractions, strict=False)})
    return tuple(held.values())


def _raises(step: StepEntry) -> bool:
    """Tell whether a step ends with its point in the air."""
    if step.kind == 'path':
        return bool(step.values['waypoints']) and step.values['waypoints'][-1][2] > 0
    return step.kind in ('lift_and_hold', 'push_down') or (
        step.kind == 'two_hands' and step.values['height'] > 0)


def described() -> list[dict[str, Any]]:
    """Return all kinds of steps as plain values, for the page."""
    return [{'kind': name, **plain(kind)} for name, kind in KINDS.items()]


@dataclass
class _Path:
    """The path of one hand from closing to opening, while it is built."""

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
    The movements of the hands in a trial.

    :param hands: their paths, in the order of closing.
    :param held_by: names of those that hold the DLO in the goal.
    :param end: time at which all of them have arrived or opened [s].
    :param unknown: numbers, from 1, of steps that grip a point which an earlier step may have moved: where
        the hand closed is unknown.
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
class _Paths:
    """The paths of the hands of a trial, while the steps are performed."""

    places: Floats  # (n, 3) of the chain's points, as far as they are known [m]
    goal: Chain
    radius: float
    measured_height: bool
    moved: set[int] = field(default_factory=set)  # points whose place is known from an earlier step
    held: dict[str, _Path] = field(default_factory=dict)
    paths: list[_Path] = field(default_factory=list)

    def perform(self, step: StepEntry, grips: Sequence[int], begin: float) -> float:
        """Perform a step; return when it ends [s]."""
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
        hand_paths = self._hand_paths(step, grips)
        end = begin
        for name, grip, (times, positions) in zip(step.hands, grips, hand_paths, strict=True):
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
            self.places[grip] = positions[-1]
            self.moved.add(grip)
            if step.values['hold']:
                self.held[name] = path
            end = max(end, path.times[-1])
        return end

    def _release(self, names: Sequence[str], begin: float) -> float:
        for name in names:
            if name not in self.held:
                raise InputError(f'hand {name}', 'a release, but it holds nothing', 'a hand that holds',
                                 'remove this step, or let an earlier step hold the DLO')
            self.held.pop(name).rest_until(begin)
        return begin

    def _hand_paths(self, step: StepEntry, grips: Sequence[int]) -> list[tuple[Floats, Floats]]:
        """Return the times (k,) [s] from the beginning of a step, and positions (k, 3) [m], of each hand."""
        values, grip, speed = step.values, grips[0], step.values['speed']
        if step.kind == 'path':
            places = [self.places[grip], *(np.array([x, y, self.radius + height])
                                          for x, y, height in values['waypoints'])]
            return [_along(places, speed)]
        if step.kind in ('lift_and_hold', 'push_down') and self.measured_height and values['hold']:
            return [_along([self.places[grip], self.goal.points[grip]], speed)]
        fields = {name: value for name, value in values.items() if name not in ('fraction', 'fractions')}
        if 'to' in fields:
            fields['to'] = tuple(self._target(grip, fields['to']).tolist())
        points = {'points': tuple(grips)} if step.kind == 'two_hands' else {'point': grip}
        action = NAMED_ACTIONS[step.kind](**points, **fields).action(Chain(self.places))
        return [(hand.times, hand.positions) for hand in action.hands]

    def _target(self, grip: int, to: tuple[float, ...] | None) -> Floats:
        """Return the place (3,) where a hand opens [m]."""
        seen: Floats = self.goal.points[grip]
        if to is None:
            return seen
        near = float(np.hypot(seen[0] - to[0], seen[1] - to[1])) < BESIDE
        return np.array([*to, seen[2] if near else self.radius])


def move(steps: Sequence[StepEntry], start: Chain, goal: Chain, grip_of: Callable[[float], int],
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
    paths = _Paths(start.points.copy(), goal, radius, measured_height)
    for hold in held:
        grip = grip_of(hold.fraction)
        paths.held[hold.hand] = _Path(hold.hand, grip, [0.0], [start.points[grip]])
        paths.paths.append(paths.held[hold.hand])
    begin, end, unknown = 0.0, -PAUSE, []
    for number, step in enumerate(steps, start=1):
        if number == 1 or not step.with_previous:
            begin = end + PAUSE
        grips = [grip_of(fraction) for fraction in step.fractions]
        if paths.moved and step.kind != 'release' and not step.with_previous and not (
                set(grips) <= paths.moved):
            unknown.append(number)
        try:
            end = max(end, paths.perform(step, grips, begin))
        except InputError as error:
            raise InputError(f'step {number}, {error.thing}', error.came, error.expected,
                             error.remedy) from error
    hands = tuple(path.hand() for path in paths.paths)
    return Movements(hands, tuple(paths.held), max(end, 0.0), tuple(unknown))


def _along(places: Sequence[Floats], speed: float) -> tuple[Floats, Floats]:
    """Return times and positions of a hand that goes straight from place to place."""
    positions = [places[0]]
    for place in places[1:]:
        if np.linalg.norm(place - positions[-1]) > 1e-6:  # m
            positions.append(place)
    lengths = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
    return np.cumsum(lengths / speed), np.array(positions)
