# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Document: all that a person entered about photographs: scales, clicks, obstacles, and the steps of the hands.

It is plain JSON, which the page edits.  `Document.of` checks it: it may be a stranger's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import re
from typing import Any, Callable, Mapping, Union

from dlo_calibration.capture.hands import LARGEST_PLACE, StepEntry
from dlo_calibration.capture.json_values import entry_field, JsonValue, plain, REMEDY
from dlo_calibration.errors import InputError

VERSION = 1
MOST_PHOTOGRAPHS = 200
MOST_TRIALS = 100
MOST_FILMS = 10
LONGEST_FILM = 3600.0  # s
MOST_STEPS = 20  # of a trial
MOST_HANDS = 8
MOST_OBSTACLES = 20
PEG, BOX = 'peg', 'box'
MOST_CLICKS = 50  # of a photograph; likewise its known points and crossings
NAME_LENGTH = 255  # characters of a photograph's name
LARGEST_PIXEL = 1e5  # px
ID = re.compile('[a-z0-9]{8}')

Pixel = tuple[float, ...]  # u, v


def _pixel(entry: JsonValue) -> Pixel:
    return entry.numbers(2, -LARGEST_PIXEL, LARGEST_PIXEL)


def _size(entry: JsonValue) -> float | None:
    return entry.number(1e-3, LARGEST_PLACE) if entry.given else None


def _id(entry: JsonValue) -> str:
    if not ID.fullmatch(entry.text(NAME_LENGTH)):
        raise entry.refused(repr(entry.value), 'an id of 8 letters a to z and digits')
    return str(entry.value)


def _refused(where: str, came: str, expected: str) -> InputError:
    return InputError(where, came, expected, REMEDY)


def _optional_id(entry: JsonValue) -> str | None:
    return _id(entry) if entry.given else None


def _each(noun: str, most: int, read: Callable[[JsonValue], Any]) -> Callable[[JsonValue], Any]:
    """Return a reader of lists; errors name an entry by the noun and its number."""
    return lambda entry: tuple(map(read, entry.entries(0, most, noun)))


def _kind(name: str) -> Any:
    """Declare the field with the kind of a scale."""
    return entry_field(lambda entry: entry.choice([name]), name, init=False)


@dataclass(frozen=True)
class Dlo:
    """
    What is known of the DLO.

    :param diameter: [m]; None: measured in the photographs.
    :param mass: [kg]; 0: unknown.
    :param points: of its chain.
    """

    diameter: float | None = entry_field(
        lambda entry: entry.number(2e-4, 0.2) if entry.given else None, None)
    mass: float = entry_field(lambda entry: entry.number(0.0, 1000.0), 0.0)
    points: int = entry_field(lambda entry: entry.whole(5, 200), 21)


@dataclass(frozen=True)
class BoardScale:
    """
    The printed board lies beside the DLO.

    :param ruler: measured length of its ruler line [m].
    """

    kind: str = _kind('board')
    ruler: float = entry_field(lambda entry: entry.number(0.05, 0.2), 0.1)


@dataclass(frozen=True)
class KnownPoint:
    """A pixel u, v and its place x, y on the table [m]."""

    pixel: Pixel = entry_field(_pixel)
    table: Pixel = entry_field(lambda entry: entry.numbers(2, -LARGEST_PLACE, LARGEST_PLACE))


@dataclass(frozen=True)
class PointsScale:
    """Known points on the table."""

    kind: str = _kind('points')
    points: tuple[KnownPoint, ...] = entry_field(
        _each('point', MOST_CLICKS, lambda entry: entry.record(KnownPoint)), ())


@dataclass(frozen=True)
class SameScale:
    """The camera did not move since another photograph, given by its id."""

    kind: str = _kind('same')
    photograph: str = entry_field(_id)


@dataclass(frozen=True)
class HangingScale:
    """
    The DLO hangs between two clamps before the camera, which looks squarely at it: a trial by itself.

    :param length: of the DLO from clamp to clamp [m]; None: `gap` counts.
    :param gap: distance between the places where the DLO leaves the clamps [m].
    :param clamps: a pixel in each clamp, on the middle of the DLO, that of the first click first; fewer: the
        DLO's own direction counts.
    """

    kind: str = _kind('hanging')
    length: float | None = entry_field(_size, None)
    gap: float | None = entry_field(_size, None)
    clamps: tuple[Pixel, ...] = entry_field(_each('clamp', 2, _pixel), ())


ScaleEntry = Union[BoardScale, PointsScale, SameScale, HangingScale]
SCALES: Mapping[str, type[ScaleEntry]] = {
    'board': BoardScale, 'points': PointsScale, 'same': SameScale, 'hanging': HangingScale}


def _scale(entry: JsonValue) -> ScaleEntry | None:
    return entry.record(SCALES[entry.entry('kind').choice(tuple(SCALES))]) if entry.given else None


@dataclass(frozen=True)
class Answer:
    """A person's answer, which strand is above at the crossing near a pixel: the first or the second."""

    pixel: Pixel = entry_field(_pixel)
    first_above: bool = entry_field(JsonValue.truth)


@dataclass(frozen=True)
class PhotographEntry:
    """
    What the person entered about a photograph.

    :param id: names its file.
    :param name: as the person knows it.
    :param clicks: (u, v) along the DLO, in order.
    """

    id: str = entry_field(_id)
    name: str = entry_field(lambda entry: entry.text(NAME_LENGTH), '')
    scale: ScaleEntry | None = entry_field(_scale, None)
    clicks: tuple[Pixel, ...] = entry_field(_each('click', MOST_CLICKS, _pixel), ())
    crossings: tuple[Answer, ...] = entry_field(
        _each('crossing', MOST_CLICKS, lambda entry: entry.record(Answer)), ())


@dataclass(frozen=True)
class MarkEntry:
    """
    Clicks along the DLO in one image of a film; the line follows the DLO from there on, up to the next marks.

    :param time: of the image [s].
    :param clicks: (u, v), in order from the same end in all marks.
    """

    time: float = entry_field(lambda entry: entry.number(0.0, LONGEST_FILM))
    clicks: tuple[Pixel, ...] = entry_field(_each('click', MOST_CLICKS, _pixel), ())


@dataclass(frozen=True)
class HeldEntry:
    """
    The point that a hand without a tag holds.

    :param place: share of the length, from the first click's end.
    :param height: of the hand above the table [m].
    """

    place: float = entry_field(lambda entry: entry.number(0.0, 1.0))
    height: float = entry_field(lambda entry: entry.number(0.0, 2.0), 0.0)


def _instant(entry: JsonValue) -> float | None:
    return entry.number(0.0, LONGEST_FILM) if entry.given else None


@dataclass(frozen=True)
class FilmedTrialEntry:
    """
    What the person changed about a trial of a film.

    :param at: an instant at which a hand moves the DLO in it [s].
    :param start: from when on the rest before counts [s]; None: as it is found.
    :param end: until when the rest afterwards counts [s]; None: as it is found.
    :param name: as the person calls it; empty: its number.
    """

    at: float = entry_field(lambda entry: entry.number(0.0, LONGEST_FILM))
    start: float | None = entry_field(_instant, None)
    end: float | None = entry_field(_instant, None)
    name: str = entry_field(lambda entry: entry.text(NAME_LENGTH), '')
    used: bool = entry_field(JsonValue.truth, True)


@dataclass(frozen=True)
class FilmEntry:
    """
    What the person entered about a film.

    :param id: names its file.
    :param name: as the person knows it.
    :param ruler: measured length of the board's ruler line [m].
    :param held: what hands without a tag hold.
    :param trials: what is changed about the trials that are found in it.
    """

    id: str = entry_field(_id)
    name: str = entry_field(lambda entry: entry.text(NAME_LENGTH), '')
    ruler: float = entry_field(lambda entry: entry.number(0.05, 0.2), 0.1)
    marks: tuple[MarkEntry, ...] = entry_field(
        _each('mark', MOST_CLICKS, lambda entry: entry.record(MarkEntry)), ())
    held: tuple[HeldEntry, ...] = entry_field(
        _each('held point', MOST_HANDS, lambda entry: entry.record(HeldEntry)), ())
    trials: tuple[FilmedTrialEntry, ...] = entry_field(
        _each('trial', MOST_TRIALS, lambda entry: entry.record(FilmedTrialEntry)), ())


@dataclass(frozen=True)
class ObstacleEntry:
    """
    An obstacle that stands on the table.

    :param photograph: id of the one in which it was clicked.
    :param first: pixel of the middle of a peg's top, or of a corner of a box's top.
    :param second: pixel of the rim of the peg's top, or of the opposite corner of the box's.
    :param height: [m].
    :param turn: angle from x of the table to an edge of a box, anticlockwise seen from above [rad].
    """

    photograph: str = entry_field(_id)
    kind: str = entry_field(lambda entry: entry.choice([PEG, BOX]))
    first: Pixel = entry_field(_pixel)
    second: Pixel = entry_field(_pixel)
    height: float = entry_field(lambda entry: entry.number(1e-3, 2.0), 0.05)
    turn: float = entry_field(lambda entry: entry.number(-3.2, 3.2), 0.0)


@dataclass(frozen=True)
class TrialEntry:
    """
    A trial: the ids of its photographs, and the steps of the hands.

    :param goal: None: there is no goal yet.
    :param start_side: a second photograph of the start, from the side; likewise `goal_side`.
    """

    start: str = entry_field(_id)
    goal: str | None = entry_field(_optional_id, None)
    start_side: str | None = entry_field(_optional_id, None)
    goal_side: str | None = entry_field(_optional_id, None)
    steps: tuple[StepEntry, ...] = entry_field(_each('step', MOST_STEPS, StepEntry.of), ())

    @property
    def photographs(self) -> tuple[str, ...]:
        """The ids of all its photographs."""
        ids = (self.start, self.goal, self.start_side, self.goal_side)
        return tuple(identity for identity in ids if identity is not None)


@dataclass(frozen=True)
class Document:
    """All that a person entered."""

    version: int = entry_field(lambda entry: entry.whole(VERSION, VERSION), VERSION, init=False)
    dlo: Dlo = entry_field(lambda entry: entry.record(Dlo), Dlo())
    photographs: tuple[PhotographEntry, ...] = entry_field(
        _each('photograph', MOST_PHOTOGRAPHS, lambda entry: entry.record(PhotographEntry)), ())
    trials: tuple[TrialEntry, ...] = entry_field(
        _each('trial', MOST_TRIALS, lambda entry: entry.record(TrialEntry)), ())
    obstacles: tuple[ObstacleEntry, ...] = entry_field(
        _each('obstacle', MOST_OBSTACLES, lambda entry: entry.record(ObstacleEntry)), ())
    films: tuple[FilmEntry, ...] = entry_field(
        _each('film', MOST_FILMS, lambda entry: entry.record(FilmEntry)), ())

    def __post_init__(self) -> None:
        ids = [*(photograph.id for photograph in self.photographs), *(film.id for film in self.films)]
        if len(set(ids)) < len(ids):
            raise _refused('photographs', 'the same id twice', 'an id of its own for each')
        for number, trial in enumerate(self.trials, start=1):
            for identity in trial.photographs:
                self._require(identity, f'trial {number}')
        for number, obstacle in enumerate(self.obstacles, start=1):
            self._require(obstacle.photograph, f'obstacle {number}')
        for number, photograph in enumerate(self.photographs, start=1):
            self._check_scale(photograph, f'photograph {number}')

    @cached_property
    def by_id(self) -> Mapping[str, PhotographEntry]:
        """The photographs by their ids."""
        return {photograph.id: photograph for photograph in self.photographs}

    @classmethod
    def of(cls, given: Any) -> Document:
        """
        Return the document of plain values; missing ones have their defaults.

        :raises InputError: for a wrong value; the text names its place.
        """
        return JsonValue('', given).record(cls)

    def plain(self) -> dict[str, Any]:
        """Return the document as plain values, with all defaults."""
        return dict(plain(self))

    def hangs(self, photograph: str) -> bool:
        """Tell whether a photograph, given by its id, shows a DLO that hangs between clamps."""
        return isinstance(self.by_id[photograph].scale, HangingScale)

    def with_photograph(self, entry: PhotographEntry) -> Document:
        """
        Return the document with one more photograph, which is also given a place in a trial.

        It becomes the goal of the last trial if that has none; else the goal of a new trial, which starts at
        the last goal.  The very first photograph becomes the start of the first trial.  Where the DLO of the
        last trial hangs, it hangs in this photograph, too.
        """
        trials = self.trials
        if not trials:
            trials = (TrialEntry(entry.id),)
        elif isinstance(hanging := self.by_id[trials[-1].start].scale, HangingScale):
            entry = replace(entry, scale=replace(hanging, clamps=()))
            trials = (*trials, TrialEntry(entry.id))[:MOST_TRIALS]
        elif trials[-1].goal is None:
            trials = (*trials[:-1], replace(trials[-1], goal=entry.id))
        elif len(trials) < MOST_TRIALS:
            trials = (*trials, TrialEntry(trials[-1].goal, entry.id, start_side=trials[-1].goal_side))
        if len(self.photographs) >= MOST_PHOTOGRAPHS:
            raise InputError('photographs', f'more than {MOST_PHOTOGRAPHS}', 'fewer',
                             'remove some, or continue in another folder')
        return replace(self, photographs=(*self.photographs, entry), trials=trials)

    def scale_of(self, photograph: PhotographEntry) -> PhotographEntry:
        """Return the photograph whose scale this one has: itself, or the one that it names as `same`."""
        while isinstance(photograph.scale, SameScale):
            photograph = self.by_id[photograph.scale.photograph]
        return photograph

    def _require(self, identity: str, where: str) -> None:
        if identity not in self.by_id:
            raise _refused(where, f'an unknown photograph {identity!r}', 'the id of a photograph')

    def _check_scale(self, photograph: PhotographEntry, where: str) -> None:
        seen = {photograph.id}
        while isinstance(photograph.scale, SameScale):
            self._require(photograph.scale.photograph, f'{where}, scale')
            if photograph.scale.photograph in seen:
                raise _refused(f'{where}, scale', "photographs that have each other's scale",
                               'one of them with a board or points')
            photograph = self.by_id[photograph.scale.photograph]
            seen.add(photograph.id)
        if len(seen) > 1 and isinstance(photograph.scale, HangingScale):
            raise _refused(f'{where}, scale', 'the same as that of a DLO that hangs', 'a scale of its own')
