# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chain: the ordered points along a DLO, and the curve through them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.errors import InputError

Floats = NDArray[np.float64]

MAXIMUM_COORDINATE = 1e8  # m; bytes read in the wrong order give more, and squares must not overflow
MINIMUM_SPACING = 1e-6  # m; nearer points are the same point
SAMPLES_PER_SEGMENT = 16  # of the arc length table; its error is below 1e-4 of a segment


def frozen_array(values: ArrayLike, dtype: type = float) -> NDArray[Any]:
    """Return a read-only copy of `values`."""
    array: NDArray[Any] = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def check_size(thing: str, what: str, positions: Floats) -> None:
    """
    Refuse finite but huge coordinates.

    :param thing: that has them, in the error.
    :param what: one of the `positions`, (n, ...) [m], is called.
    :raises InputError: if a coordinate is larger than MAXIMUM_COORDINATE.
    """
    if np.abs(positions).max(initial=0.0) <= MAXIMUM_COORDINATE:
        return
    rows = positions.reshape(len(positions), positions[:1].size)
    bad = np.argwhere(np.isfinite(rows) & (np.abs(rows) > MAXIMUM_COORDINATE))
    if len(bad):
        raise InputError(thing, f'a coordinate of {rows[tuple(bad[0])]:g} m in {what} {bad[0][0]}',
                         f'at most {MAXIMUM_COORDINATE:g} m',
                         'send metres, in a message in the byte order that is_bigendian names')


def bezier_curve(knots: Floats, values: Floats, at: Floats) -> Floats:
    """
    Evaluate the piecewise cubic Bezier curve through `values` at `knots`.

    Each piece's inner control points lie a third of the piece away from its
    ends, along the tangents; a tangent is the slope of the parabola through a
    point and its neighbours (Farin, Curves and Surfaces for CAGD, 5th ed., 9.8:
    Bessel tangents).  The curve passes through every point, and a parabola is
    reproduced exactly.

    :param knots: (n,) increasing parameter of each point (any unit), n >= 3.
    :param values: (n, k) points.
    :param at: (m,) parameters to evaluate at, clipped to the range of `knots`.
    :returns: (m, k) points; linear in `values`.
    """
    steps = np.diff(knots)[:, None]
    chords = np.diff(values, axis=0) / steps
    tangents = np.empty_like(values)
    tangents[1:-1] = (chords[:-1] * steps[1:] + chords[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
    tangents[0] = 2 * chords[0] - tangents[1]
    tangents[-1] = 2 * chords[-1] - tangents[-2]
    at = np.clip(at, knots[0], knots[-1])
    piece = np.clip(np.searchsorted(knots, at, side='right') - 1, 0, len(knots) - 2)
    width = steps[piece]
    t = (at - knots[piece])[:, None] / width
    s = 1 - t
    inner_first = values[piece] + tangents[piece] * width / 3
    inner_last = values[piece + 1] - tangents[piece + 1] * width / 3
    return (s**3 * values[piece] + 3 * s**2 * t * inner_first
            + 3 * s * t**2 * inner_last + t**3 * values[piece + 1])


def interpolation_matrix(knots: Floats, at: Floats) -> Floats:
    """Return the (m, n) weights that `bezier_curve` gives the n values at the m places."""
    return bezier_curve(knots, np.eye(len(knots)), at)


@dataclass(frozen=True)
class Chain:
    """
    Ordered points along a DLO, first to last.

    :param points: (n, 3) positions [m], n >= 3, finite, at most
        MAXIMUM_COORDINATE, neighbours apart.
    :param hands: (n,) number of the hand that holds each point, 0 for none; or
        None where the source does not annotate it.
    :param features: (n,) True where an annotator marked a geometric feature.
    """

    points: Floats
    hands: NDArray[np.uint8] | None = None
    features: NDArray[np.bool_] = None  # type: ignore[assignment]  # __post_init__ makes it an array

    def __post_init__(self) -> None:
        points = frozen_array(self.points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(
                'chain', f'points of shape {points.shape}', 'an array of shape (n, 3)',
                'give one x y z row per point')
        if len(points) < 3:
            raise InputError(
                'chain', f'{len(points)} point(s)', 'at least 3',
                'send the points along the whole DLO, first to last')
        check_size('chain', 'point', points)
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise InputError(
                'chain', f'NaN or infinity in point(s) {_listed(bad)}', 'finite coordinates in metres',
                'leave such frames out, or fill the points before sending')
        gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        same = np.flatnonzero(gaps < MINIMUM_SPACING)
        if len(same):
            raise InputError(
                'chain', f'coincident neighbours after point(s) {_listed(same)}',
                f'neighbours at least {MINIMUM_SPACING} m apart', 'remove the repeated points')
        object.__setattr__(self, 'points', points)
        if self.hands is not None:
            object.__setattr__(self, 'hands', self._annotation('hands', self.hands, np.uint8))
        features = np.zeros(len(points), bool) if self.features is None else self.features
        object.__setattr__(self, 'features', self._annotation('features', features, bool))

    def _annotation(self, name: str, values: ArrayLike, dtype: type) -> NDArray[Any]:
        array = frozen_array(values, dtype)
        if array.shape != (len(self.points),):
            raise InputError(
                f'chain annotation {name!r}', f'shape {array.shape}',
                f'one value for each of the {len(self.points)} points', 'give one value per point')
        return array

    def __len__(self) -> int:
        return len(self.points)

    @property
    def length(self) -> float:
        """Length of the curve through the points [m]."""
        return float(self.arc_lengths()[-1])

    def arc_lengths(self) -> Floats:
        """Return the arc length at each point, (n,) [m], from 0; read-only."""
        return self._places

    def resample(self, arc_lengths: ArrayLike) -> Floats:
        """Return the points of the curve, (m, 3) [m], at the given arc lengths, (m,) [m]."""
        parameters, along = self._arc_length_table()
        at = np.interp(np.asarray(arc_lengths, dtype=float), along, parameters)
        return bezier_curve(self._knots(), self.points, at)

    @cached_property
    def _places(self) -> Floats:
        return frozen_array(self._arc_length_table()[1][::SAMPLES_PER_SEGMENT])

    def _knots(self) -> Floats:
        chords = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(chords)])

    def _arc_length_table(self) -> tuple[Floats, Floats]:
        """Return parameters of the curve, and the arc length [m] at each of them."""
        knots = self._knots()
        fractions = np.arange(SAMPLES_PER_SEGMENT) / SAMPLES_PER_SEGMENT
        parameters = np.append((knots[:-1, None] + np.diff(knots)[:, None] * fractions).ravel(), knots[-1])
        samples = bezier_curve(knots, self.points, parameters)
        steps = np.linalg.norm(np.diff(samples, axis=0), axis=1)
        return parameters, np.concatenate([[0.0], np.cumsum(steps)])


def _listed(indices: NDArray[np.intp]) -> str:
    shown = ', '.join(str(i) for i in indices[:5])
    return shown if len(indices) <= 5 else f'{shown} and {len(indices) - 5} more'
