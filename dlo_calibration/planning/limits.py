# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Limits: where hands and DLO may be, what the DLO may bear, and how often it may cross itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Self, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.observation.table import crossing_segments
from dlo_calibration.simulation.loads import CURVATURE, Loads, TENSION

HANDS = ('hand_1', 'hand_2')
MOST = 1e6  # m; limit of coordinates, far beyond those of any robot
ROUNDING = 1e-9  # m; a place outside by less is on the boundary
BOX = 'x0 y0 z0 x1 y1 z1, two opposite corners in metres'
REACH = "'box x0 y0 z0 x1 y1 z1' or 'annulus x y inner outer', in metres"


@dataclass(frozen=True)
class Box:
    """
    A box with edges along the axes.

    :param lower: (3,) [m] its corner with the lowest coordinates; `upper` (3,) that with the highest.
    """

    lower: Floats
    upper: Floats

    @classmethod
    def between(cls, corners: Floats) -> Self:
        """Return the box between two opposite corners, (6,) [m]."""
        pair = corners.reshape(2, 3)
        return cls(frozen_array(pair.min(axis=0)), frozen_array(pair.max(axis=0)))

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """
        Tell which straight segments are inside the box from begin to end; its boundary belongs to it.

        :param begin: (m, 3) [m]; `end` (m, 3) [m] may be the same place.
        :returns: (m,)
        """
        return np.asarray(np.all(
            [(place >= self.lower - ROUNDING) & (place <= self.upper + ROUNDING) for place in (begin, end)],
            axis=(0, 2)))

    def entered(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """
        Tell which straight segments touch or enter the box.

        A segment is inside a slab between two parallel faces for an interval of its length; it enters the box
        if the intervals of the three slabs overlap (Kay and Kajiya, Ray Tracing Complex Scenes, 1986).

        :param begin: (m, 3) [m]; `end` (m, 3) [m] may be the same place.
        :returns: (m,)
        """
        step, lower, upper = end - begin, self.lower - ROUNDING, self.upper + ROUNDING
        with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
            low, high = (lower - begin) / step, (upper - begin) / step
        along = step == 0  # parallel to the slab: either always inside, or never
        within = (begin >= lower) & (begin <= upper)
        enter = np.where(along, np.where(within, -np.inf, np.inf), np.minimum(low, high)).max(axis=1)
        leave = np.where(along, np.where(within, np.inf, -np.inf), np.maximum(low, high)).min(axis=1)
        return np.asarray(np.maximum(enter, 0.0) <= np.minimum(leave, 1.0))


@dataclass(frozen=True)
class Annulus:
    """
    The space between two upright cylinders with one axis, at any height: the reach of a robot arm.

    :param centre: (2,) [m] x y of the axis.
    :param inner: radius [m]; `outer` radius [m].
    """

    centre: Floats
    inner: float
    outer: float

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """Tell which straight segments are inside, also where they pass the inner cylinder; see `Box`."""
        begin, end = begin[:, :2] - self.centre, end[:, :2] - self.centre
        step = end - begin
        square = (step**2).sum(axis=1)
        with np.errstate(divide='ignore', invalid='ignore'):
            nearest = np.where(square > 0, -(begin * step).sum(axis=1) / square, 0.0)
        least = np.linalg.norm(begin + np.clip(nearest, 0.0, 1.0)[:, None] * step, axis=1)
        most = np.maximum(np.linalg.norm(begin, axis=1), np.linalg.norm(end, axis=1))
        return np.asarray((least >= self.inner - ROUNDING) & (most <= self.outer + ROUNDING))


Region = Union[Box, Annulus]
EVERYWHERE = Box(frozen_array(np.full(3, -np.inf)), frozen_array(np.full(3, np.inf)))


def read_box(thing: str, text: str) -> Box:
    """
    Read a box from a text with two opposite corners.

    :param thing: name of the value in the error.
    :raises InputError: if the text is something else.
    """
    return Box.between(_numbers(thing, text, text.split(), 6, BOX))


def read_reach(thing: str, text: str) -> Region:
    """
    Read the region that a hand reaches: a box or an annulus; everywhere, if the text is empty.

    :param thing: name of the value in the error.
    :raises InputError: if the text is something else.
    """
    kind, *words = text.split() or ('',)
    if not kind:
        return EVERYWHERE
    if kind == 'box':
        return Box.between(_numbers(thing, text, words, 6, REACH))
    x, y, inner, outer = _numbers(thing, text, words if kind == 'annulus' else (), 4, REACH)
    if not 0 <= inner < outer:
        raise InputError(thing, repr(text), 'an inner radius from 0 to below the outer one',
                         'correct the radii')
    return Annulus(frozen_array([x, y]), float(inner), float(outer))


def _numbers(thing: str, text: str, words: Sequence[str], count: int, expected: str) -> Floats:
    """Return `count` finite numbers; raise the InputError for another text."""
    try:
        numbers = np.array([float(word) for word in words] if len(words) == count else [np.nan])
    except ValueError:
        numbers = np.array([np.nan])
    if not (np.abs(numbers) <= MOST).all():  # NaN is not
        raise InputError(thing, repr(text), expected, 'write the numbers with blanks between them')
    return numbers


@dataclass(frozen=True)
class Limits:
    """
    Where the hands of a plan can be, where neither they nor the DLO may be, and what the DLO may bear.

    A hand counts as a point.

    :param reach: for each name in HANDS, where this hand can be; `reach_texts` the options that say so.
    :param no_go: boxes, by the texts that describe them.
    :param least_bend_radius: of the DLO [m]; 0: any.
    :param most_tension: in the DLO [N]; 0: any.
    """

    reach: Mapping[str, Region]
    reach_texts: Mapping[str, str]
    no_go: Mapping[str, Box]
    least_bend_radius: float = 0.0
    most_tension: float = 0.0

    @classmethod
    def read(cls, reach_1: str, reach_2: str, no_go: Sequence[str], least_bend_radius: float = 0.0,
             most_tension: float = 0.0) -> Self:
        """
        Return the limits that options of a plan describe.

        :raises InputError: if one of them cannot be read.
        """
        texts = {'hand_1': reach_1, 'hand_2': reach_2}
        reach = {name: read_reach(f'parameter reach_{k}', texts[name]) for k, name in enumerate(HANDS, 1)}
        return cls(reach, texts, {text: read_box('parameter no_go', text) for text in no_go},
                   least_bend_radius, most_tension)

    def refusal(self, action: Action) -> str:
        """
        Return which limit an action breaks: a phrase such as 'hand_1 leaves its reach, annulus 0 0 0.2 0.8'.

        :param action: its hands have names in HANDS; they move straight from waypoint to waypoint.
        :returns: empty if the hands stay within their reach and out of the boxes.
        """
        for hand in action.hands:
            way = hand.positions if len(hand.positions) > 1 else hand.positions[[0, 0]]
            if not self.reach[hand.name].contains(way[:-1], way[1:]).all():
                return f'{hand.name} leaves its reach, {self.reach_texts[hand.name]}'
            if box := self.box(way[None]):
                return f'{hand.name} enters the no-go box {box}'
        return ''

    def entered(self, chains: Floats) -> str:
        """
        Return which box the DLO enters.

        :param chains: (m, n, 3) [m] the DLO at m instants.
        :returns: a phrase such as 'the DLO enters the no-go box 0 0 0 1 1 1'; empty if it enters none.
        """
        box = self.box(chains)
        return box and f'the DLO enters the no-go box {box}'

    @property
    def of_loads(self) -> bool:
        """Whether they limit what the DLO bears."""
        return self.least_bend_radius > 0 or self.most_tension > 0

    def overload(self, loads: Loads | None) -> str:
        """
        Return which limit loads pass; empty if they pass none, or are unknown.

        :returns: a phrase such as 'the DLO is pulled harder than most_tension, 2 N'.
        """
        if loads is None:
            return ''
        if self.least_bend_radius > 0 and loads.most[:, CURVATURE].max() > 1 / self.least_bend_radius:
            return f'the DLO is bent more sharply than least_bend_radius, {1e3 * self.least_bend_radius:g} mm'
        if self.most_tension > 0 and loads.most[:, TENSION].max() > self.most_tension:
            return f'the DLO is pulled harder than most_tension, {self.most_tension:g} N'
        return ''

    def box(self, chains: Floats) -> str:
        """Return the text of the first box that one of m chains, (m, n, 3) [m], enters; '' if none does."""
        begin, end = chains[:, :-1].reshape(-1, 3), chains[:, 1:].reshape(-1, 3)
        return next((text for text, box in self.no_go.items() if np.any(box.entered(begin, end))), '')


def crossings(points: Floats) -> int:
    """Return how often a DLO with (n, 3) points [m] crosses itself, seen from above."""
    return len(crossing_segments(points)[0])
