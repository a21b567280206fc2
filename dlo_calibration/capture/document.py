# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Document: all that a person said about photographs of a DLO: scales, clicks, and what the hands did.

It is plain JSON, which the page edits.  `Document.of` checks it, as it may come from a stranger.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import re
from typing import Any, Mapping, Union

from dlo_calibration.capture.plain_values import Entry, REMEDY, Values
from dlo_calibration.capture.steps import LARGEST_PLACE, Step
from dlo_calibration.errors import InputError

VERSION = 1
MOST_PHOTOGRAPHS = 200
MOST_TRIALS = 100
MOST_STEPS = 20  # of a trial
MOST_CLICKS = 50  # of a photograph; likewise its known points and crossings
NAME_LENGTH = 255  # characters of a photograph's name
LARGEST_PIXEL = 1e5  # px
ID = re.compile('[a-z0-9]{8}')

Pixel = tuple[float, ...]  # u, v


@dataclass(frozen=True)
class Dlo:
    """
    What is known of the DLO.

    :param diameter: [m]; None: measured in the photographs.
    :param mass: [kg]; 0: unknown.
    :param points: of its chain.
    """

    diameter: float | None = None
    mass: float = 0.0
    points: int = 21


@dataclass(frozen=True)
class BoardScale:
    """
    The printed board lies beside the DLO.

    :param ruler: measured length of its ruler line [m].
    """

    ruler: float = 0.1

    def plain(self) -> dict[str, Any]:
        """Return it as a document has it."""
        return {'kind': 'board', 'ruler': self.ruler}


@dataclass(frozen=True)
class PointsScale:
    """
    Known points on the table.

    :param points: pairs of a pixel u, v and its place x, y on the table [m].
    """

    points: tuple[tuple[Pixel, Pixel], ...]

    def plain(self) -> dict[str, Any]:
        """Return it as a document has it."""
        return {'kind': 'points', 'points': [{'pixel': list(pixel), 'table': list(table)}
                                             for pixel, table in self.points]}


@dataclass(frozen=True)
class SameScale:
    """The camera did not move since another photograph, given by its id."""

    photograph: str

    def plain(self) -> dict[str, Any]:
        """Return it as a document has it."""
        return {'kind': 'same', 'photograph': self.photograph}


@dataclass(frozen=True)
class Answer:
    """A person's answer, which strand is above at the crossing near a pixel: the first or the second."""

    pixel: Pixel
    first_above: bool


@dataclass(frozen=True)
class PhotographEntry:
    """
    What was said about a photograph.

    :param id: names its file.
    :param name: as the person knows it.
    :param clicks: (u, v) along the DLO, in order.
    """

    id: str
    name: str = ''
    scale: Union[BoardScale, PointsScale, SameScale, None] = None
    clicks: tuple[Pixel, ...] = ()
    crossings: tuple[Answer, ...] = ()

    def plain(self) -> dict[str, Any]:
        """Return it as a document has it."""
        return {'id': self.id, 'name': self.name, 'scale': self.scale and self.scale.plain(),
                'clicks': [list(click) for click in self.clicks],
                'crossings': [{'pixel': list(one.pixel), 'first_above': one.first_above}
                              for one in self.crossings]}


@dataclass(frozen=True)
class TrialEntry:
    """
    A trial: the ids of its photographs, and the steps of the hands.

    :param goal: None: there is no goal yet.
    :param start_side: a second photograph of the start, from the side; likewise `goal_side`.
    """

    start: str
    goal: str | None = None
    start_side: str | None = None
    goal_side: str | None = None
    steps: tuple[Step, ...] = ()

    @property
    def photographs(self) -> tuple[str, ...]:
        """The ids of all its photographs."""
        ids = (self.start, self.goal, self.start_side, self.goal_side)
        return tuple(one for one in ids if one is not None)

    def plain(self) -> dict[str, Any]:
        """Return it as a document has it."""
        return {'start': self.start, 'goal': self.goal, 'start_side': self.start_side,
                'goal_side': self.goal_side, 'steps': [step.plain() for step in self.steps]}


@dataclass(frozen=True)
class Document:
    """All that a person said."""

    dlo: Dlo = Dlo()
    photographs: tuple[PhotographEntry, ...] = ()
    trials: tuple[TrialEntry, ...] = ()
    by_id: Mapping[str, PhotographEntry] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'by_id', {one.id: one for one in self.photographs})
        if len(self.by_id) < len(self.photographs):
            raise _refused('photographs', 'one id twice', 'an id of its own for each')
        for number, trial in enumerate(self.trials, start=1):
            for one in trial.photographs:
                self._require(one, f'trial {number}')
        for number, photograph in enumerate(self.photographs, start=1):
            self._check_scale(photograph, f'photograph {number}')

    @classmethod
    def of(cls, plain: Any) -> Document:
        """
        Return the document of plain values; what is not given has its default.

        :raises InputError: where something is wrong; the text says where.
        """
        values = Entry('document', plain).values('version', 'dlo', 'photographs', 'trials')
        values = Values('', values.content)
        values.entry('version', VERSION).whole(VERSION, VERSION)
        photographs = values.each('photographs', 'photograph', MOST_PHOTOGRAPHS)
        trials = values.each('trials', 'trial', MOST_TRIALS)
        return cls(_dlo(values.entry('dlo', {})), tuple(map(_photograph, photographs)),
                   tuple(map(_trial, trials)))

    def plain(self) -> dict[str, Any]:
        """Return the document as plain values, with all defaults."""
        return {'version': VERSION, 'dlo': {'diameter': self.dlo.diameter, 'mass': self.dlo.mass,
                                            'points': self.dlo.points},
                'photographs': [one.plain() for one in self.photographs],
                'trials': [one.plain() for one in self.trials]}

    def with_photograph(self, entry: PhotographEntry) -> Document:
        """
        Return the document with one more photograph, which also takes its place in a trial.

        It is the goal of the last trial if that has none; else of a new trial, which starts at the last goal.
        The first photograph of all is the start of the first trial.
        """
        trials = self.trials
        if not trials:
            trials = (TrialEntry(entry.id),)
        elif trials[-1].goal is None:
            trials = (*trials[:-1], replace(trials[-1], goal=entry.id))
        elif len(trials) < MOST_TRIALS:
            trials = (*trials, TrialEntry(trials[-1].goal, entry.id, start_side=trials[-1].goal_side))
        if len(self.photographs) >= MOST_PHOTOGRAPHS:
            raise InputError('photographs', f'more than {MOST_PHOTOGRAPHS}', 'fewer',
                             'remove some, or go on in another folder')
        return replace(self, photographs=(*self.photographs, entry), trials=trials)

    def scale_of(self, photograph: PhotographEntry) -> PhotographEntry:
        """Return the photograph whose scale this one has: itself, or the one that it names as `same`."""
        while isinstance(photograph.scale, SameScale):
            photograph = self.by_id[photograph.scale.photograph]
        return photograph

    def _require(self, one: str, where: str) -> None:
        if one not in self.by_id:
            raise _refused(where, f'a photograph {one!r} that is not there', 'the id of a photograph')

    def _check_scale(self, photograph: PhotographEntry, where: str) -> None:
        seen = {photograph.id}
        while isinstance(photograph.scale, SameScale):
            self._require(photograph.scale.photograph, f'{where}, scale')
            if photograph.scale.photograph in seen:
                raise _refused(f'{where}, scale', "photographs that have each other's scale",
                               'one of them with a board or points')
            photograph = self.by_id[photograph.scale.photograph]
            seen.add(photograph.id)


def _refused(where: str, came: str, expected: str) -> InputError:
    return InputError(where, came, expected, REMEDY)


def _dlo(entry: Entry) -> Dlo:
    values = entry.values('diameter', 'mass', 'points')
    diameter = values.entry('diameter')
    return Dlo(diameter.number(2e-4, 0.2) if diameter.given else None,
               values.entry('mass', 0.0).number(0.0, 1000.0), values.entry('points', 21).whole(5, 200))


def _pixel(entry: Entry) -> Pixel:
    return entry.numbers(2, -LARGEST_PIXEL, LARGEST_PIXEL)


def _id(entry: Entry) -> str:
    if not ID.fullmatch(entry.text(NAME_LENGTH)):
        raise entry.refused(repr(entry.value), 'an id of 8 letters a to z and digits')
    return str(entry.value)


def _optional_id(entry: Entry) -> str | None:
    return _id(entry) if entry.given else None


def _photograph(entry: Entry) -> PhotographEntry:
    values = entry.values('id', 'name', 'scale', 'clicks', 'crossings')
    answers = []
    for one in values.each('crossings', 'crossing', MOST_CLICKS):
        answer = one.values('pixel', 'first_above')
        answers.append(Answer(_pixel(answer.entry('pixel')), answer.entry('first_above').truth()))
    scale = values.entry('scale')
    return PhotographEntry(
        _id(values.entry('id')), values.entry('name', '').text(NAME_LENGTH),
        _scale(scale) if scale.given else None,
        tuple(map(_pixel, values.each('clicks', 'click', MOST_CLICKS))), tuple(answers))


def _scale(entry: Entry) -> Union[BoardScale, PointsScale, SameScale]:
    values = entry.values()
    kind = values.entry('kind').choice(('board', 'points', 'same'))
    if kind == 'board':
        values.only('kind', 'ruler')
        return BoardScale(values.entry('ruler', 0.1).number(0.05, 0.2))
    if kind == 'same':
        values.only('kind', 'photograph')
        return SameScale(_id(values.entry('photograph')))
    values.only('kind', 'points')
    points = []
    for one in values.each('points', 'point', MOST_CLICKS):
        point = one.values('pixel', 'table')
        points.append((_pixel(point.entry('pixel')),
                       point.entry('table').numbers(2, -LARGEST_PLACE, LARGEST_PLACE)))
    return PointsScale(tuple(points))


def _trial(entry: Entry) -> TrialEntry:
    values = entry.values('start', 'goal', 'start_side', 'goal_side', 'steps')
    steps = [Step.of(one.values()) for one in values.each('steps', 'step', MOST_STEPS)]
    goal, start_side, goal_side = (_optional_id(values.entry(name))
                                   for name in ('goal', 'start_side', 'goal_side'))
    return TrialEntry(_id(values.entry('start')), goal, start_side, goal_side, tuple(steps))
