# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Regions of space, boxes and annuli, and the straight ways that keep to them or enter them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array

MOST = 1e6  # m; limit of coordinates, far beyond those of any robot
ROUNDING = 1e-9  # m; a place that is so far outside is on the boundary
BOX = 'x0 y0 z0 x1 y1 z1, two opposite corners in metres'
REACH = "'box x0 y0 z0 x1 y1 z1' or 'annulus x y inner outer', in metres"


class Region(Protocol):
    """A closed region: its boundary belongs to it."""

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """
        Tell which straight ways are inside of it from their begin to their end.

        :param begin: (m, 3) [m]; `end` (m, 3) [m] may be the same place.
        :returns: (m,)
        """


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
        one, other = corners.reshape(2, 3)
        return cls(frozen_array(np.minimum(one, other)), frozen_array(np.maximum(one, other)))

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """Tell which straight ways are inside; see `Region`."""
        inside: NDArray[np.bool_] = np.all(
            [(place >= self.lower - ROUNDING) & (place <= self.upper + ROUNDING) for place in (begin, end)],
            axis=(0, 2))
        return inside

    def entered(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """
        Tell which straight ways touch or enter the box.

        A way is inside a slab between two parallel faces for an interval of its length; it enters the box if
        the intervals of the three slabs overlap (Kay and Kajiya, Ray Tracing Complex Scenes, 1986).

        :param begin: (m, 3) [m]; `end` (m, 3) [m] may be the same place.
        :returns: (m,)
        """
        step, lower, upper = end - begin, self.lower - ROUNDING, self.upper + ROUNDING
        with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
            one, other = (lower - begin) / step, (upper - begin) / step
        along = step == 0  # parallel to the slab: either always inside, or never
        within = (begin >= lower) & (begin <= upper)
        enter = np.where(along, np.where(within, -np.inf, np.inf), np.minimum(one, other)).max(axis=1)
        leave = np.where(along, np.where(within, np.inf, -np.inf), np.maximum(one, other)).min(axis=1)
        entered: NDArray[np.bool_] = np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)
        return entered


@dataclass(frozen=True)
class Annulus:
    """
    The space between two upright cylinders with one axis, at any height: what a robot arm reaches.

    :param centre: (2,) [m] x y of the axis.
    :param inner: radius [m]; `outer` radius [m].
    """

    centre: Floats
    inner: float
    outer: float

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """Tell which straight ways are inside, also where they pass the inner cylinder; see `Region`."""
        begin, end = begin[:, :2] - self.centre, end[:, :2] - self.centre
        step = end - begin
        square = (step**2).sum(axis=1)
        with np.errstate(divide='ignore', invalid='ignore'):
            nearest = np.where(square > 0, -(begin * step).sum(axis=1) / square, 0.0)
        least = np.linalg.norm(begin + np.clip(nearest, 0.0, 1.0)[:, None] * step, axis=1)
        most = np.maximum(np.linalg.norm(begin, axis=1), np.linalg.norm(end, axis=1))
        inside: NDArray[np.bool_] = (least >= self.inner - ROUNDING) & (most <= self.outer + ROUNDING)
        return inside


@dataclass(frozen=True)
class Everywhere:
    """The whole space."""

    def contains(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """Tell that all straight ways are inside."""
        return np.ones(len(begin), bool)


def read_box(thing: str, text: str) -> Box:
    """
    Read a box from a text with two opposite corners.

    :param thing: that the text is the value of, in the error.
    :raises InputError: if the text is something else.
    """
    return Box.between(_numbers(thing, text, text.split(), 6, BOX))


def read_reach(thing: str, text: str) -> Region:
    """
    Read the region that a hand reaches: a box or an annulus; everywhere, if the text is empty.

    :param thing: that the text is the value of, in the error.
    :raises InputError: if the text is something else.
    """
    kind, *words = text.split() or ('',)
    if not kind:
        return Everywhere()
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
