# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chain: the ordered points along a DLO, and the curve through them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.errors import InputError

Floats = NDArray[np.float64]

MAXIMUM_COORDINATE = 1e8  # m; bytes read in the wrong order give more, and squares must not overflow
#: Of a chain: the largest number of simulated nodes; the time to estimate the noise grows with the cube.
MOST_POINTS = 1000
MINIMUM_SPACING = 1e-6  # m; nearer points are the same point
NEAR = 0.02  # of a segment; a hand that grips nearer to a point than this grips that point
SHORT = 0.3  # m; distances that are usual for longer DLOs are, for a shorter one, less in proportion
SAMPLES_PER_SEGMENT = 16  # of the arc length table; its error is below 1e-4 of a segment


def frozen_array(values: ArrayLike, dtype: type = float) -> NDArray[Any]:
    """Return a read-only copy of `values`."""
    array: NDArray[Any] = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def check_size(thing: str, what: str, positions: Floats) -> None:
    """
    Refuse finite but huge coordinates.

    :param thing: their owner's name in the error.
    :param what: the name of each of the `positions`, (n, ...) [m], in the error.
    :raises InputError: if a coordinate is larger than MAXIMUM_COORDINATE.
    """
    rows = positions.reshape(len(positions), positions[:1].size)
    bad = np.argwhere(np.isfinite(rows) & (np.abs(rows) > MAXIMUM_COORDINATE))
    if len(bad):
        raise InputError(thing, f'a coordinate of {rows[tuple(bad[0])]:g} m in {what} {bad[0][0]}',
                         f'at most {MAXIMUM_COORDINATE:g} m',
                         'send metres, in a message in the byte order that is_bigendian names')


def in_proportion(usual: float, length: float) -> float:
    """Return what is usual for a DLO; in proportion less if its length [m] is below `SHORT`."""
    return usual * min(1.0, length / SHORT)


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


def interpolate_unseen(points: Floats, seen: NDArray[np.bool_], places: Floats) -> Floats:
    """
    Return (n, 3) points [m] with the unseen ones moved onto the curve through the others, see `bezier_curve`.

    Beyond the first and the last seen point, the DLO continues straight.

    :param seen: (n,) which points were seen, at least three.
    :param places: (n,) increasing; arc lengths of the points, in any unit.
    """
    shown = np.flatnonzero(seen)
    knots, values = places[shown], points[shown]
    complete = bezier_curve(knots, values, places)
    for end, beyond in ((0, np.arange(shown[0])), (-1, np.arange(shown[-1] + 1, len(points)))):
        if len(beyond):
            near = knots[end] + (1e-3 if end == 0 else -1e-3) * np.ptp(knots[[end, 1 if end == 0 else -2]])
            slope = (bezier_curve(knots, values, np.array([near]))[0] - values[end]) / (near - knots[end])
            complete[beyond] = values[end] + (places[beyond] - knots[end])[:, None] * slope
    complete[shown] = values
    return complete


@dataclass(frozen=True, eq=False)
class Chain:
    """
    Ordered points along a DLO, first to last; each chain equals only itself.

    A point with NaN was not seen; it is interpolated as if the points were equally spaced, see
    `interpolate_unseen`.  At least three points, and half of them, must be seen.

    :param points: (n, 3) positions [m], 3 <= n <= MOST_POINTS, at most MAXIMUM_COORDINATE, neighbours apart;
        in the chain, all are finite.
    :param hands: (n,) number of the hand that holds each point, 0 for none; or
        None where the source does not annotate it.
    :param features: (n,) True where an annotator marked a geometric feature.
    :param seen: (n,) False for points that were not seen; None: those with NaN were not.
    """

    points: Floats
    hands: NDArray[np.uint8] | None = None
    features: NDArray[np.bool_] = None  # type: ignore[assignment]  # __post_init__ makes it an array
    seen: NDArray[np.bool_] = None  # type: ignore[assignment]  # likewise

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
        if len(points) > MOST_POINTS:
            raise InputError('chain', f'{len(points)} points', f'at most {MOST_POINTS}',
                             'leave some of them out; 20 to 100 are enough')
        check_size('chain', 'point', points)
        bad = np.flatnonzero(np.isinf(points).any(axis=1))
        if len(bad):
            raise InputError(
                'chain', f'infinity in point(s) {_listed(bad)}', 'coordinates in metres',
                'leave such frames out, or send NaN for a point that was not seen')
        object.__setattr__(self, 'points', points)
        given = np.isfinite(points).all(axis=1)
        seen = given if self.seen is None else given & self._annotation('seen', self.seen, bool)
        least = max(3, -(-len(points) // 2))
        if seen.sum() < least:
            raise InputError(
                'chain', f'{seen.sum()} of {len(points)} points that were seen, and NaN in point(s) '
                f'{_listed(np.flatnonzero(~seen))}', f'at least {least} that were seen',
                'observe the DLO from where less of it is hidden')
        shown = np.flatnonzero(seen)
        gaps = np.linalg.norm(np.diff(points[shown], axis=0), axis=1)
        same = shown[:-1][gaps < MINIMUM_SPACING]
        if len(same):
            raise InputError(
                'chain', f'coincident neighbours after point(s) {_listed(same)}',
                f'neighbours at least {MINIMUM_SPACING} m apart', 'remove the repeated points')
        object.__setattr__(self, 'seen', frozen_array(seen, bool))
        if not given.all():
            places = np.arange(float(len(points)))
            object.__setattr__(self, 'points', frozen_array(interpolate_unseen(points, seen, places)))
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

    @cached_property
    def observed(self) -> Floats:
        """The points, (n, 3) [m]; NaN where a point was not seen; read-only."""
        return self.points if self.seen.all() else frozen_array(
            np.where(self.seen[:, None], self.points, np.nan))

    def interpolated(self, places: Floats, others: Mapping[int, Floats] = MappingProxyType({})) -> Chain:
        """
        Return the chain with its unseen points interpolated.

        :param places: arc lengths of all points, (n,) in any unit.
        :param others: positions of unseen points from another source, (3,) [m] by their index.
        """
        if self.seen.all():
            return self
        points, seen = np.array(self.points), np.array(self.seen)
        for k, point in others.items():
            points[k], seen[k] = point, True
        points = interpolate_unseen(points, seen, places)
        return self if np.array_equal(points, self.points) else replace(self, points=points)

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

    def nearest(self, position: Floats) -> tuple[int, float, float]:
        """
        Return the place of the curve that is nearest to a position, (3,) [m].

        :returns: the nearest point to it along the curve and its offset from there, see `grip_place`, and its
            distance from the position [m].
        """
        knots, places = self._knots(), self.arc_lengths()
        away = np.linalg.norm(self.points - position, axis=1)
        # From a place on a piece, the ways to both of its ends are together as long as the piece.
        least = (away[:-1] + away[1:] - np.diff(places)) / 2
        pieces = np.flatnonzero(least <= away.min() + MINIMUM_SPACING)
        fractions = np.linspace(0.0, 1.0, SAMPLES_PER_SEGMENT + 1)
        parameters = knots[pieces, None] + np.diff(knots)[pieces, None] * fractions
        samples = bezier_curve(knots, self.points, parameters.ravel()).reshape(*parameters.shape, 3)
        steps = np.diff(samples, axis=1)
        shares = ((position - samples[:, :-1]) * steps).sum(axis=-1) / (steps**2).sum(axis=-1)
        shares = np.clip(shares, 0.0, 1.0)
        away = np.linalg.norm(samples[:, :-1] + shares[..., None] * steps - position, axis=-1)
        row, k = np.unravel_index(away.argmin(), away.shape)
        ways = np.linalg.norm(steps[row], axis=1)
        place = places[pieces[row]] + ways[:k].sum() + shares[row, k] * ways[k]
        return *self.grip(float(place)), float(away[row, k])

    def grip(self, place: float) -> tuple[int, float]:
        """
        Return the point that is nearest to a place [m] along the curve, and the place's offset from there.

        A place that is nearer to a point than NEAR is that point.
        """
        places = self.arc_lengths()
        point = int(np.abs(places - place).argmin())
        rest = min(max(place, 0.0), float(places[-1])) - float(places[point])
        if not rest:
            return point, 0.0
        offset = rest / abs(float(places[point + (1 if rest > 0 else -1)] - places[point]))
        return point, offset if abs(offset) > NEAR else 0.0

    def gripped(self, grips: Sequence[int], offset: float) -> Floats:
        """Return the gripped places, (k, 3) [m]; `grips` are points, see `grip_place` for the offset."""
        if offset == 0:
            return np.asarray(self.points[list(grips)])
        return self.resample([grip_place(self.arc_lengths(), grip, offset) for grip in grips])

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


def grip_place(places: Floats, point: int, offset: float) -> float:
    """
    Return the arc length [m] at which a hand grips, between two points.

    :param places: (n,) arc lengths of the points [m].
    :param offset: distance beyond the point, as a share of the way to the next one, at most 1; negative: to
        the previous one. The DLO ends at its last point.
    """
    beside = min(max(point + (1 if offset > 0 else -1), 0), len(places) - 1)
    return float(places[point] + abs(offset) * (places[beside] - places[point]))


def check_ends(thing: str, initial: Chain) -> None:
    """
    Refuse an initial chain that does not show both ends of the DLO.

    :raises InputError: if more than one point at an end was not seen; `thing` is named.
    """
    for end, seen in (('first', initial.seen), ('last', initial.seen[::-1])):
        if not seen[:2].any():
            raise InputError(thing, f'an initial chain whose {end} {int(seen.argmax())} points were not seen',
                             'at most one unseen point at each end',
                             'observe the whole DLO before the action begins')


def length_change(start: Chain, goal: Chain) -> float:
    """Return the relative difference of length between start and goal [%], where neighbours were seen."""
    pairs = goal.seen[1:] & goal.seen[:-1]
    if pairs.all() or not pairs.any():
        return abs(goal.length - start.length) / start.length * 100
    there, here = (float(np.diff(chain.arc_lengths())[pairs].sum()) for chain in (goal, start))
    return abs(there - here) / here * 100


def _listed(indices: NDArray[np.intp]) -> str:
    shown = ', '.join(str(i) for i in indices[:5])
    return shown if len(indices) <= 5 else f'{shown} and {len(indices) - 5} more'
