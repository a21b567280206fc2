# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Steps: what a person can say that a hand did, and the fields of each kind of step.

Most kinds are named actions (`dlo_calibration.model.named_actions`); `path` is a way that the person drew.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping, Sequence

from dlo_calibration.capture.plain_values import Entry, Values
from dlo_calibration.model.action import MAXIMUM_HANDS

NAME_LENGTH = 40  # characters of a hand's name
MOST_WAYPOINTS = 50  # of a drawn way
LARGEST_PLACE = 100.0  # m from the origin of the table's frame


@dataclass(frozen=True)
class Field:
    """
    One field of a step.

    :param default: its value where the document does not give one.
    :param form: what it is: `number`, `truth`, `choice`, `name`, `names`, `numbers`, `place`, `waypoints`.
    :param choices: the values that a `choice` has.
    """

    default: Any
    form: str = 'number'
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()

    def read(self, entry: Entry) -> Any:
        """Return the value of an entry of a document, checked."""
        low, high = self.minimum or 0.0, self.maximum or 0.0
        if self.form == 'number':
            return entry.number(low, high)
        if self.form == 'truth':
            return entry.truth()
        if self.form == 'choice':
            return entry.choice(self.choices)
        if self.form == 'name':
            return entry.word(NAME_LENGTH)
        if self.form == 'names':
            return tuple(one.word(NAME_LENGTH) for one in entry.entries(1, MAXIMUM_HANDS))
        if self.form == 'numbers':
            return entry.numbers(2, low, high)
        if self.form == 'place':
            return entry.numbers(2, -LARGEST_PLACE, LARGEST_PLACE) if entry.given else None
        return tuple(_waypoint(one) for one in entry.entries(0, MOST_WAYPOINTS))

    def described(self) -> dict[str, Any]:
        """Return it as plain values, for the page."""
        plain = {'default': _plain(self.default), 'form': self.form, 'unit': self.unit,
                 'minimum': self.minimum, 'maximum': self.maximum}
        return {**plain, 'choices': list(self.choices)} if self.choices else plain


@dataclass(frozen=True)
class Kind:
    """
    A kind of step.

    :param text: what it shows of the DLO, for the person who chooses.
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
        'Along a drawn way', 'The hand carries a point along the places that are drawn, each at a height. '
        'What it shows depends on the way.',
        {**_HAND, 'waypoints': Field((), 'waypoints', 'm'), 'speed': _SPEED, 'hold': _hold(False)}),
    'release': Kind(
        'Release', 'A hand that still holds the DLO opens where it is. After a lift, it shows the bends that '
        'remain.', {'hands': Field(('left_hand',), 'names')}),
}


@dataclass(frozen=True)
class Step:
    """
    What one hand did, or two together.

    :param kind: one of `KINDS`.
    :param values: all fields of the kind, by name.
    :param with_previous: True: it begins with the step before it; False: after all before it have ended.
    """

    kind: str
    values: Mapping[str, Any]
    with_previous: bool = False

    @classmethod
    def of(cls, values: Values) -> Step:
        """Return the step of a document; what is not given has its default."""
        kind = values.entry('kind').choice(tuple(KINDS))
        fields = KINDS[kind].fields
        values.only('kind', 'with_previous', *fields)
        read = {name: field.read(values.entry(name, field.default)) for name, field in fields.items()}
        return cls(kind, read, values.entry('with_previous', False).truth())

    @property
    def hands(self) -> tuple[str, ...]:
        """The names of the hands that it moves or opens."""
        names: tuple[str, ...] = self.values.get('hands') or (self.values['hand'],)
        return names

    @property
    def fractions(self) -> tuple[float, ...]:
        """Where the hands grip, each as a fraction of the length; none where they hold it already."""
        if 'fraction' in self.values:
            return (self.values['fraction'],)
        return tuple(self.values.get('fractions', ()))

    def plain(self) -> dict[str, Any]:
        """Return the step as a document has it."""
        return {'kind': self.kind, **{name: _plain(value) for name, value in self.values.items()},
                'with_previous': self.with_previous}


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


def held_after(steps: Sequence[Step], before: Sequence[Hold] = ()) -> tuple[Hold, ...]:
    """Return which hands hold the DLO after some steps, if those in `before` hold it at first."""
    held = {one.hand: one for one in before}
    for step in steps:
        for name in step.hands:
            held.pop(name, None)
        if step.values.get('hold'):
            held.update({name: Hold(name, fraction, _raises(step))
                         for name, fraction in zip(step.hands, step.fractions, strict=False)})
    return tuple(held.values())


def _raises(step: Step) -> bool:
    """Tell whether a step ends with its point in the air."""
    if step.kind == 'path':
        return bool(step.values['waypoints']) and step.values['waypoints'][-1][2] > 0
    return step.kind in ('lift_and_hold', 'push_down') or (
        step.kind == 'two_hands' and step.values['height'] > 0)


def described() -> list[dict[str, Any]]:
    """Return all kinds of steps as plain values, for the page."""
    return [{'kind': name, 'title': kind.title, 'text': kind.text,
             'fields': {one: field.described() for one, field in kind.fields.items()}}
            for name, kind in KINDS.items()]


def _waypoint(entry: Entry) -> tuple[float, ...]:
    x, y, height = entry.numbers(3, -LARGEST_PLACE, LARGEST_PLACE)
    if height < 0:
        raise entry.refused(f'a height of {height:g} m', '0 or more')
    return x, y, height


def _plain(value: Any) -> Any:
    return [_plain(one) for one in value] if isinstance(value, tuple) else value
