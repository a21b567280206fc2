# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Episodes: a film of a DLO and of hands, cut where the DLO rests before and after hands were at work.

`grasps` finds which hand held which point, and when.  One camera shows a point of the DLO only on its line
of sight; the points are given where that line meets the level of a DLO on the table.  Points near a hand that
lifts the DLO are left out, as their height is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.observation.grasps import Grasp, grasps_of, LIFTED
from dlo_calibration.observation.sightings import (
    complete,
    HandSightings,
    pictures_between,
    points_at,
    Sightings,
    SPAN,
    usable,
)

MOVES = 0.010  # m/s; a DLO of which some points move faster moves
NOISE, QUIET = 2.5, 0.25  # times the motion below which a DLO is in a quarter of all pictures
MOVED = 0.005  # m; a shorter movement is none
SHARE = 8  # of a DLO's points that are taken together when its motion is measured: one in so many
LEAST = 0.3  # s of a rest, where a person wants less
REST = 0.5  # s; a shorter rest is a pause of the same movement
HIDDEN = 0.05  # share of the length to both sides of a grip that fingers hide
#: A beam that is lifted by its diameter leaves the table at 6 to 12 diameters to either side, and with the
#: fourth root of the height farther away (see vision.axis.BUMP); a limp one hangs down.
BUMP, SLACK = 12.0, 1.5
TAG_ABOVE = 0.06  # m, from what a hand holds up to its tag, at most, where its grip is not yet known
THIN, SHIFT = 0.1, 0.003  # s, m; goals of a DLO that moves lie at least so far apart
START, END = 4.0, 2.5  # s of rest before and after a movement that are used at most
LEAVES = 1.0  # s after it, in which a hand still hides a part of the DLO; left out if the rest is longer
FEWEST = 12  # chains of a rest, as for a stream of goals; fewer are given as their mean
PATH = 0.03  # s between waypoints of a hand, at least


@dataclass(frozen=True, eq=False)
class Episode:
    """
    What happened from one rest of the DLO to the next one.

    :param start: of the rest before [s]; `end` is that of the rest after.
    :param initial: the DLO at rest before.
    :param hands: their paths, with the times of the film; closed at the first waypoint, opened at the last.
    :param places: share of the length at which each holds the DLO.
    :param goals: times [s] and points (m, 3) [m] of the DLO afterwards.
    :param moving: number of goals that show the DLO while it is moved.
    :param latest_start: it could start as late as this [s], with `bounds`.
    :param earliest_end: likewise [s].
    """

    start: float
    end: float
    initial: Chain
    hands: tuple[Hand, ...]
    places: tuple[float, ...]
    goals: tuple[tuple[float, Floats], ...]
    moving: int
    latest_start: float
    earliest_end: float


@dataclass(frozen=True)
class Bounds:
    """
    From when to when an episode lasts, as a person wants it: at most to the movements before and after.

    LEAST of the rests before and after its own movement is always in it.

    :param at: an instant of its movement [s]; with none within REST of it, the bounds are without effect.
    :param start: of the rest before [s]; None: as it is found.
    :param end: of the rest after [s]; None: as it is found.
    """

    at: float
    start: float | None = None
    end: float | None = None


def episodes(seen: Sightings, hands: Sequence[HandSightings], count: int | None = None,
             bounds: Sequence[Bounds] = ()) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """
    Return the episodes of a film, and a sentence about each movement that makes none.

    :param count: of points of their chains; None: as many as were seen.
    :param bounds: of those episodes that shall begin or end elsewhere.
    """
    times, movements = seen.times, _movements(seen, _motion(seen))
    wanted = [_bounds_of((times[first], times[last]), bounds) for first, last in movements]
    rests = []
    for k, (first, _) in enumerate(movements):
        own, until = wanted[k].start, times[first] - SPAN
        since = times[first] - START if own is None else min(own, until - LEAST)
        before = movements[k - 1][1] if k else 0
        rests.append(pictures_between(times, max(times[before], since), until))
    starts = {k: start for k, rest in enumerate(rests)
              if len(rest) and usable(start := _resting(seen.points[rest]))}
    held: dict[int, list[Grasp]] = {k: [] for k in starts}
    for hand in hands:
        grasps = grasps_of(seen, hand, [(Chain(start), *movements[k]) for k, start in starts.items()])
        for k, grasp in zip(starts, grasps, strict=True):
            held[k] += [] if grasp is None else [grasp]
    cut: list[Episode] = []
    problems: list[str] = []
    if not movements and _shift(_median(seen.points[:5]), _median(seen.points[-5:])) > MOVED:
        error = InputError('movement', 'a DLO that moves nearly all the time',
                           f'a rest of {REST:g} s before and after each movement',
                           'begin to film earlier, and wait after each movement')
        problems.append(f'{times[0]:.1f} to {times[-1]:.1f} s: {error}')
    for k, (first, last) in enumerate(movements):
        after = movements[k + 1][0] if k + 1 < len(movements) else len(times) - 1
        try:
            if k not in held:
                raise InputError('movement', 'a DLO that moves or is hidden from the beginning',
                                 f'a rest of {REST:g} s before it',
                                 'begin to film earlier, or wait between two movements')
            if not held[k]:
                raise InputError('movement', 'no tag that moves with the DLO' if hands else
                                 'no tag in the film', 'one on what moves it', 'glue a tag on what holds the '
                                 'DLO where it is seen, or click the point that is held (--held)')
            latest = max(float(times[first] - SPAN - LEAST), 0.0)
            cut.append(_episode(seen, held[k], starts[k], (float(times[rests[k][0]]), latest), last, after,
                                wanted[k].end, count))
        except InputError as error:
            problems.append(f'{times[first]:.1f} to {times[last]:.1f} s: {error}')
    return tuple(cut), tuple(problems)


def _bounds_of(movement: tuple[float, float], bounds: Sequence[Bounds]) -> Bounds:
    """Return the bounds of the episode of a movement between two instants [s]."""
    begin, end = movement
    away = [max(begin - own.at, own.at - end) for own in bounds]
    return bounds[away.index(min(away))] if away and min(away) <= REST else Bounds(begin)


def _episode(seen: Sightings, grasps: Sequence[Grasp], start: Floats, since: tuple[float, float], last: int,
             after: int, end: float | None, count: int | None) -> Episode:
    """
    Return the episode of one movement.

    :param start: the DLO at rest before (m, 3) [m].
    :param since: from when on [s], and from when on at the latest.
    :param last: picture of this movement; `after`: the first one of the next.
    :param end: until when the rest after it counts [s]; None: for a while.
    :raises InputError: where the DLO did not rest, or is not seen.
    """
    times = seen.times
    closes, opens = min(grasp.first for grasp in grasps), max(grasp.last for grasp in grasps)
    initial = Chain(_fewer(start, count))
    paths = [_path(seen, grasp, initial) for grasp in grasps]
    begin = times[max(last, opens)] + SPAN
    earliest = float(begin + LEAST)
    if times[after] - begin > LEAVES + END and (end is None or end > begin + LEAVES + LEAST):
        begin += LEAVES
    until = begin + END if end is None else max(end, begin + LEAST)
    settled = pictures_between(times, begin, min(until, times[after]))
    settled = settled[(settled <= after) & (settled > opens)]
    if not len(settled):
        raise InputError('movement', 'a film that ends, or a next movement that begins, before the DLO rests',
                         f'a rest of {REST:g} s after it', 'wait after each movement')
    moving = _thinned(seen, closes, opens)
    goals = [(float(times[k]), points) for k in moving if (points := _low(seen, grasps, k)) is not None]
    chains = [(float(times[k]), seen.points[k]) for k in settled if usable(seen.points[k])]
    if len(chains) < FEWEST:
        mean = _resting(seen.points[settled])
        chains = [(float(times[settled[-1]]), mean)] if usable(mean) else []
    if not chains:
        raise InputError('movement', 'a DLO of which less than half is seen afterwards', 'the whole DLO',
                         'take the hand away after each movement')
    chains = [(time, _fewer(points, count)) for time, points in (*goals, *chains)]
    return Episode(since[0], chains[-1][0], initial, tuple(paths),
                   tuple(grasp.place for grasp in grasps), tuple(chains), len(goals), since[1], earliest)


def _fewer(points: Floats, count: int | None) -> Floats:
    """Return `count` evenly spaced points of a chain (m, 3); NaN beside points that were not seen."""
    if count is None or count == len(points):
        return points
    return points_at(points, np.linspace(0.0, 1.0, count))


def _resting(points: Floats) -> Floats:
    """
    Return the median (m, 3) of chains (k, m, 3) at rest; NaN where fewer than a third show a point.

    A hand that comes or goes hides a part for less than half of the time.
    """
    median = _median(points)
    median[np.isfinite(points[..., 0]).sum(axis=0) < max(1, len(points) // 3)] = np.nan
    return median


def _motion(seen: Sightings) -> Floats:
    """Return the speed (n,) [m/s] of the DLO: that of its fastest part, with several points."""
    times = seen.times
    speeds = np.zeros(len(times))
    if times[-1] - times[0] <= 2.0 * SPAN:
        return speeds
    middle = np.clip(times, times[0] + SPAN, times[-1] - SPAN)
    early = np.searchsorted(times, middle - SPAN - 1e-9)
    late = np.searchsorted(times, middle + SPAN + 1e-9)
    for k, (begin, end) in enumerate(zip(early, late, strict=True)):
        half = (begin + end) // 2
        if half > begin and end > half:
            # The medians of both halves are half the span apart.
            speeds[k] = _shift(_median(seen.points[begin:half]), _median(seen.points[half:end])) / SPAN
    return speeds


def _shift(begin: Floats, end: Floats) -> float:
    """Return by how much the part of the DLO that moves most has moved between chains (m, 3) [m]."""
    steps = end - begin
    steps = steps[np.isfinite(steps[:, 0])]
    width = max(len(steps) // SHARE, 1)
    if len(steps) < width:
        return 0.0
    sums = np.cumsum(np.vstack([np.zeros(3), steps]), axis=0)
    return float(np.linalg.norm(sums[width:] - sums[:-width], axis=1).max()) / width


def _median(points: Floats) -> Floats:
    shown = np.isfinite(points[..., 0]).any(axis=0)
    median = np.full(points.shape[1:], np.nan)
    median[shown] = np.nanmedian(points[:, shown], axis=0)
    return median


def _movements(seen: Sightings, motion: Floats) -> list[tuple[int, int]]:
    """Return the first and last picture of each movement, which rests of REST separate."""
    least = max(MOVES, NOISE * float(np.quantile(motion, QUIET)))
    moving = np.flatnonzero(motion > least)
    if not len(moving):
        return []
    pieces = np.split(moving, np.flatnonzero(np.diff(seen.times[moving]) > REST) + 1)
    around = [(seen.points[max(piece[0] - 4, 0):piece[0] + 1], piece) for piece in pieces]
    return [(int(piece[0]), int(piece[-1])) for before, piece in around if max(
        _shift(_median(before), _median(seen.points[k:k + 5])) for k in piece) > MOVED]


def _path(seen: Sightings, grasp: Grasp, initial: Chain) -> Hand:
    """Return the path of a hand while it holds the DLO."""
    known = [k for k in range(grasp.first, grasp.last + 1) if np.isfinite(grasp.grips[k]).all()]
    if len(known) < 2:
        raise InputError('hand', f'{grasp.name}, which is hardly seen while it holds the DLO',
                         'a tag that the camera sees', 'glue it where the hand does not hide it')
    kept = [known[0]]
    for k in known[1:]:
        if seen.times[k] - seen.times[kept[-1]] >= PATH or k == known[-1]:
            kept.append(k)
    point, offset = initial.grip(grasp.place * initial.length)
    return Hand(grasp.name, (point,), seen.times[kept], grasp.grips[kept], _without_gaps(grasp.turns)[kept],
                offset, True)


def _without_gaps(turns: Floats) -> Floats:
    """Return orientations (n, 4), those that are unknown as the nearest known ones."""
    known = np.flatnonzero(np.isfinite(turns[:, 0]))
    nearest = np.abs(np.arange(len(turns))[:, None] - known).argmin(axis=1)
    return np.asarray(turns[known[nearest]])


def without_lifted(points: Floats, tag: Floats, radius: float) -> Floats:
    """
    Return points (m, 3) [m] as one camera sees them, without those that a hand may hold in the air.

    :param tag: (3,) where the tag of the hand is [m]; what it holds is nearer than TAG_ABOVE below it.
    """
    lifted = float(tag[2]) - TAG_ABOVE - radius
    if not lifted > 0.0:
        return points
    reach = max(BUMP * 2.0 * radius, SLACK * lifted) + TAG_ABOVE
    low = np.array(points)
    low[np.linalg.norm(points[:, :2] - tag[:2], axis=1) <= reach] = np.nan
    return low


def _thinned(seen: Sightings, closes: int, opens: int) -> list[int]:
    """Return pictures between closing and opening that differ."""
    kept = [closes]
    for k in range(closes + 1, opens + 1):
        if seen.times[k] - seen.times[kept[-1]] < THIN or not usable(seen.points[k]):
            continue
        moved = np.linalg.norm(seen.points[k] - seen.points[kept[-1]], axis=1)
        if np.isfinite(moved).any() and np.nanmax(moved) >= SHIFT:
            kept.append(k)
    return kept[1:]


def _low(seen: Sightings, grasps: Sequence[Grasp], k: int) -> Floats | None:
    """Return the points (m, 3) of picture k, without those that may be in the air; None if too few remain."""
    points = np.array(seen.points[k])
    if seen.cameras is None:
        return points
    whole = complete(points)
    share = np.linspace(0.0, 1.0, len(points))
    length = float(np.nansum(np.linalg.norm(np.diff(points, axis=0), axis=1))) or 1.0
    diameter = max(2.0 * seen.radius, 1e-3)
    for grasp in grasps:
        lifted = float(grasp.grips[k, 2]) - seen.radius
        if grasp.lifts and grasp.first <= k <= grasp.last and lifted > LIFTED:
            reach = max(BUMP * diameter * (lifted / diameter) ** 0.25, SLACK * lifted)
            points[np.abs(share - grasp.place) * length <= reach] = np.nan
        elif whole is not None and not grasp.lifts and grasp.first <= k <= grasp.last:
            # What the fingers hide is where the path of the hand has it.
            near = np.abs(share - grasp.place) <= HIDDEN
            points[near] = whole[near]
    return points if usable(points) else None
