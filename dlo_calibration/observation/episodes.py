# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Episodes: a film of a DLO and of hands, cut where the DLO rests before and after hands were at work.

Which point a hand holds, when it closes and when it opens follows from the DLO and the hand moving together.
One camera shows a point of the DLO only on its line of sight; the points are given where that line meets the
level of a DLO on the table.  Points near a hand that lifts the DLO are left out, as their height is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand, NO_ROTATION
from dlo_calibration.model.chain import Chain, Floats, frozen_array, interpolate_unseen

SPAN = 0.1  # s to either side over which a motion is measured
MOVES = 0.010  # m/s; a DLO of which some points move faster moves
NOISE, QUIET = 2.5, 0.25  # times the motion below which a DLO is in a quarter of all pictures
MOVED = 0.005  # m; a shorter movement is none
SHARE = 8  # of a DLO's points that are taken together when its motion is measured: one in so many
STILL = 0.015  # m/s; a hand that moves slower stands still
REST = 0.5  # s; a shorter rest is a pause of the same movement
WAY = 0.012  # m; the shortest way of a hand that moves a DLO
PLACES = 201  # along the DLO at which a hand may hold it
MOST, ROUNDS = 60, 4  # pictures in which they are compared, and weightings of these
DOUBTED = 0.006  # m; a picture in which a place is farther from where it is in the hand hardly counts
BRIDGED = 0.2  # share of the length to both sides of a place, in which the DLO must be seen
HIDDEN = 0.05  # share of the length to both sides of a grip that fingers hide
LEAVING = 0.6  # s; a hand that leaves a DLO stood still so long before they are apart, at most
PARTED = 5  # pictures in a row that show hand and DLO apart
SLIPPED = 0.0015  # m, by which a held point moves beside its hand when that opens
LEFT, SIGMAS = 0.005, 5.0  # m, and times what is typical: a grip farther from its hand is left
HELD = 0.012  # m; from a hand to the point that it holds, at most, in half of the movement's pictures
BESIDE = 0.005  # of a grip's distance from its tag that counts as error: of places alike, the nearest is held
AT_REST = 0.0015  # m; nearer to where a hand closes, it stands there
REACH = 0.25  # m from a tag to what the hand holds, at most
LIFTED = 0.008  # m above the table
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
class Sightings:
    """
    What a tracker saw of a DLO.

    :param times: (n,) of the pictures, increasing [s].
    :param points: (n, m, 3) evenly spaced material points in the table's frame [m], at the level of a DLO on
        the table; NaN where they were not seen.
    :param cameras: (n, 3) where the camera was [m]; None: the points were measured in space.
    :param radius: of the DLO [m].
    """

    times: Floats
    points: Floats
    cameras: Floats | None = None
    radius: float = 0.0

    def __post_init__(self) -> None:
        for name in ('times', 'points', 'cameras'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen_array(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class HandSightings:
    """
    What was seen of a hand: the poses of its tag, or where the point is that it holds.

    :param positions: (n, 3) [m], at the times of the DLO's sightings; NaN where unknown.
    :param orientations: (n, 4) quaternions x y z w; None: it does not turn.
    :param place: share of the length at which it holds the DLO, where a person said so; the positions are
        then those of this point.
    """

    name: str
    positions: Floats
    orientations: Floats | None = None
    place: float | None = None


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
    """

    start: float
    end: float
    initial: Chain
    hands: tuple[Hand, ...]
    places: tuple[float, ...]
    goals: tuple[tuple[float, Floats], ...]
    moving: int


@dataclass(frozen=True, eq=False)
class _Hold:
    """
    A hand that holds the DLO, from one picture to another.

    :param grips: (n, 3) where it holds the DLO [m], in all pictures, and `turns`, (n, 4); NaN where unknown.
    :param lifts: whether it lifts the DLO from the table.
    """

    name: str
    place: float
    grips: Floats
    turns: Floats
    first: int
    last: int
    lifts: bool


def episodes(seen: Sightings, hands: Sequence[HandSightings],
             count: int | None = None) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """
    Return the episodes of a film, and a sentence about each movement that makes none.

    :param count: of points of their chains; None: as many as were seen.
    """
    motion = _motion(seen)
    cut: list[Episode] = []
    problems: list[str] = []
    movements = _movements(seen, motion)
    bounds = [0, *(last for _, last in movements), len(seen.times) - 1]
    starts = [first for first, _ in movements[1:]] + [len(seen.times) - 1]
    for before, (first, last), after in zip(bounds, movements, starts, strict=False):
        span = f'{seen.times[first]:.1f} to {seen.times[last]:.1f} s'
        try:
            cut.append(_episode(seen, hands, motion, (before, first, last, after), count))
        except InputError as error:
            problems.append(f'{span}: {error}')
    return tuple(cut), tuple(problems)


def _episode(seen: Sightings, hands: Sequence[HandSightings], motion: Floats,
             pictures: tuple[int, int, int, int], count: int | None) -> Episode:
    """
    Return the episode of one movement.

    :param pictures: the last one of the movement before, the first and the last one of this movement, and
        the first one of the next.
    :raises InputError: where nothing shows what moved the DLO, or where it did not rest.
    """
    before, first, last, after = pictures
    times = seen.times
    rest = _between(times, max(times[before], times[first] - START), times[first] - SPAN)
    rest = rest[rest >= before]
    if not len(rest):
        raise InputError('movement', 'a DLO that moves from the beginning', f'a rest of {REST:g} s before it',
                         'begin to film earlier, or wait between two movements')
    start = _resting(seen.points[rest])
    initial = Chain(start)
    holds = [hold for hand in hands if (hold := _hold(seen, hand, initial, motion, first, last)) is not None]
    if not holds:
        raise InputError('movement', 'no tag that moves with the DLO' if hands else 'no tag in the film',
                         'one on what moves it', 'glue a tag on what holds the DLO where it is seen, or '
                         'click the point that is held (--held)')
    closes, opens = min(hold.first for hold in holds), max(hold.last for hold in holds)
    initial = Chain(_fewer(start, count))
    paths = [_path(seen, hold, initial) for hold in holds]
    begin = times[max(last, opens)] + SPAN
    begin += LEAVES if times[after] - begin > LEAVES + END else 0.0
    settled = _between(times, begin, min(begin + END, times[after]))
    settled = settled[(settled <= after) & (settled > opens)]
    if not len(settled):
        raise InputError('movement', 'a film that ends, or a next movement that begins, before the DLO rests',
                         f'a rest of {REST:g} s after it', 'wait after each movement')
    moving = _thinned(seen, closes, opens)
    goals = [(float(times[k]), points) for k in moving if (points := _low(seen, holds, k)) is not None]
    chains = [(float(times[k]), seen.points[k]) for k in settled if _usable(seen.points[k])]
    if len(chains) < FEWEST:
        mean = _resting(seen.points[settled])
        chains = [(float(times[settled[-1]]), mean)] if _usable(mean) else []
    if not chains:
        raise InputError('movement', 'a DLO of which less than half is seen afterwards', 'the whole DLO',
                         'take the hand away after each movement')
    chains = [(time, _fewer(points, count)) for time, points in (*goals, *chains)]
    return Episode(float(times[rest[0]]), chains[-1][0], initial, tuple(paths),
                   tuple(hold.place for hold in holds), tuple(chains), len(goals))


def _fewer(points: Floats, count: int | None) -> Floats:
    """Return `count` evenly spaced points of a chain (m, 3); NaN beside points that were not seen."""
    if count is None or count == len(points):
        return points
    return _at(points, np.linspace(0.0, 1.0, count))


def _between(times: Floats, begin: float, end: float) -> NDArray[np.intp]:
    return np.flatnonzero((times >= begin - 1e-9) & (times <= end + 1e-9))


def _resting(points: Floats) -> Floats:
    """
    Return the median (m, 3) of chains (k, m, 3) at rest; NaN where fewer than a third show a point.

    A hand that comes or goes hides a part for less than half of the time.
    """
    median = _median(points)
    median[np.isfinite(points[..., 0]).sum(axis=0) < max(1, len(points) // 3)] = np.nan
    return median


def _usable(points: Floats) -> bool:
    """Return whether a chain shows enough points, see `Chain`."""
    return bool(np.isfinite(points[:, 0]).sum() >= max(3, -(-len(points) // 2)))


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


def _complete(points: Floats) -> Floats | None:
    """Return a chain (m, 3) with its unseen points interpolated; None if too few are seen."""
    shown = np.isfinite(points[:, 0])
    if shown.all():
        return points
    return interpolate_unseen(points, shown, np.arange(float(len(points)))) if _usable(points) else None


def _at(points: Floats, places: Floats) -> Floats:
    """Return the points (p, 3) of a chain (m, 3) at shares (p,) of its length."""
    at = places * (len(points) - 1)
    below = np.minimum(np.floor(at + 1e-9).astype(int), len(points) - 1)
    beyond = np.minimum(below + 1, len(points) - 1)
    weight = np.clip(at - below, 0.0, 1.0)[:, None]
    between = (1.0 - weight) * points[below] + weight * points[beyond]
    return np.asarray(np.where(weight < 1e-6, points[below], between))  # not NaN for one beside it


def _hold(seen: Sightings, hand: HandSightings, initial: Chain, motion: Floats, first: int,
          last: int) -> _Hold | None:
    """Return how a hand holds the DLO in a movement, from picture `first` to `last`; None: it does not."""
    times = seen.times
    still_turned = np.tile(NO_ROTATION, (len(times), 1))
    if hand.place is not None:
        high = np.nanmax(hand.positions[first:last + 1, 2], initial=-np.inf) - seen.radius
        return _Hold(hand.name, hand.place, hand.positions, still_turned, max(first - 1, 0), last,
                     bool(high > LIFTED))
    known = np.isfinite(hand.positions[:, 0])
    speed = _speed(times, hand.positions)
    near = _between(times, times[first] - 3 * SPAN, times[first] + 5 * SPAN)
    near = near[known[near]]
    span = np.arange(first, last + 1)
    span = span[known[span]]
    if not len(near) or len(span) < 3:
        return None
    # It has come to a standstill before it moves again, with the DLO.
    still = near[speed[near] < STILL]
    stands = np.split(still, np.flatnonzero(np.diff(still) > 1) + 1)[0]
    closes = int(stands[-1]) if len(still) else int(near[speed[near].argmin()])
    if np.linalg.norm(hand.positions[span] - hand.positions[closes], axis=1).max() < WAY:
        return None
    there = near[near <= closes]
    there = there[np.linalg.norm(hand.positions[there] - hand.positions[closes], axis=1) < AT_REST]
    compared = span[np.unique(np.linspace(0, len(span) - 1, min(len(span), MOST)).astype(int))]
    turned = [still_turned] if hand.orientations is None else [
        hand.orientations, _about_vertical(hand.orientations, closes)]
    grip = min((_grip(seen, hand, rotations, initial, there, compared) for rotations in turned),
               key=lambda grip: grip.cost)
    if not grip.typical < HELD:
        return None
    own = _own(seen, grip.place)
    apart = np.full(len(times), np.nan)
    both = np.isfinite(own[:, 0]) & known
    apart[both] = _apart(seen, grip.path[both], own[both], both)
    way = np.linalg.norm(hand.positions - hand.positions[closes], axis=1)
    opens = _opens(times, apart, min(max(LEFT, SIGMAS * grip.typical), HELD), speed, way, closes, last)
    stands = closes + np.flatnonzero(
        np.linalg.norm(grip.path[closes:opens + 1] - grip.path[opens], axis=1) < LEFT)
    low = grip.path if seen.cameras is None else _dragged(seen, grip.path)
    opens = _slips(low - own, closes, opens, stands)
    held = slice(closes, opens + 1)
    moving = grip.path[held][(speed[held] >= STILL) & known[held]]
    lifts = seen.cameras is None or bool(
        len(moving) and np.median(moving[:, 2]) - seen.radius > LIFTED)
    path = grip.path if lifts else _like_the_dlo(times, low, own, held)
    return _Hold(hand.name, grip.place, path, grip.turns, closes, opens, lifts)


@dataclass(frozen=True, eq=False)
class _Motion:
    """
    How a hand and a place of the DLO move together.

    :param typical: median distance between the place and where it is in the hand [m]; pictures in which the
        hand has opened do not count much in it, nor in `cost`, which counts the offset, too.
    :param path: (n, 3) where the grip is, as the tag shows it [m], and `turns`, (n, 4); NaN where unknown.
    """

    place: float
    typical: float
    cost: float
    path: Floats
    turns: Floats


def _about_vertical(orientations: Floats, start: int) -> Floats:
    """
    Return the part of the turning that is about the vertical, (n, 4), since a picture.

    A small tag that the camera sees from straight ahead looks the same while it tilts a little; how it turns
    about the line of sight is seen well.
    """
    from scipy.spatial.transform import Rotation  # takes a quarter of a second to load

    turned = np.full_like(orientations, np.nan)
    known = np.isfinite(orientations[:, 0])
    first = Rotation.from_quat(orientations[start])
    since = (Rotation.from_quat(orientations[known]) * first.inv()).as_matrix()
    angle = np.arctan2(since[:, 1, 0] - since[:, 0, 1], since[:, 0, 0] + since[:, 1, 1])
    turned[known] = (Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]) * first).as_quat()
    return turned


def _grip(seen: Sightings, hand: HandSightings, turns: Floats, initial: Chain, there: NDArray[np.intp],
          compared: NDArray[np.intp]) -> _Motion:
    """
    Return the place of the DLO, and its offset from the tag, that move together best.

    :param turns: (n, 4) quaternions of the hand.
    :param there: pictures in which the hand is at the resting DLO; `compared`: those of the movement.
    """
    from scipy.spatial.transform import Rotation  # takes a quarter of a second to load

    places = np.linspace(0.0, 1.0, PLACES)
    chains = {int(k): chain for k in compared if (chain := _complete(seen.points[k])) is not None}
    resting = initial.resample(places * initial.length)
    pictures = np.array([*there, *chains], int)
    points = np.stack([*[resting] * len(there), *(_at(chain, places) for chain in chains.values())])
    # Across the line of sight: one camera does not show more, but a DLO at rest lies on the table.
    across = np.tile(np.eye(3), (*points.shape[:2], 1, 1))
    if seen.cameras is not None:
        rays = points - seen.cameras[pictures, None]
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        across[len(there):] -= (rays[..., :, None] * rays[..., None, :])[len(there):]
    rotations = Rotation.from_quat(turns[pictures]).as_matrix()
    tags = hand.positions[pictures, None]
    slopes = across @ rotations[:, None]  # (k, PLACES, 3, 3)
    values = (across @ (points - tags)[..., None])[..., 0]
    offsets = np.einsum('kba,kpb->pa', rotations[:len(there)], resting - tags[:len(there)]) / len(there)
    for _ in range(ROUNDS):
        apart = np.linalg.norm(np.einsum('kpab,pb->kpa', slopes, offsets) - values, axis=2)
        weights = 1.0 / np.square(1.0 + np.square(apart / DOUBTED))  # Geman and McClure's
        normal = np.einsum('kp,kpab,kpac->pbc', weights, slopes, slopes)
        normal += BESIDE**2 * len(pictures) * np.eye(3)
        right = np.einsum('kp,kpab,kpa->pb', weights, slopes, values)
        offsets = np.linalg.solve(normal, right[..., None])[..., 0]
    apart = np.linalg.norm(np.einsum('kpab,pb->kpa', slopes, offsets) - values, axis=2)
    mean = np.sqrt(np.mean(np.square(apart) / (1.0 + np.square(apart / DOUBTED)), axis=0))
    reach = np.linalg.norm(offsets, axis=1)
    cost = np.where(reach > REACH, np.inf, np.hypot(mean, BESIDE * reach))
    best = int(cost.argmin())
    path = np.full((len(turns), 3), np.nan)
    known = np.isfinite(turns[:, 0]) & np.isfinite(hand.positions[:, 0])
    path[known] = hand.positions[known] + Rotation.from_quat(turns[known]).apply(offsets[best])
    return _Motion(float(places[best]), float(np.median(apart[:, best])), float(cost[best]), path, turns)


def _own(seen: Sightings, place: float) -> Floats:
    """
    Return where a place of the DLO was seen, (n, 3) [m].

    It is NaN where too little of the DLO was seen, or nothing near the place on one side of it: beyond what
    is seen, the DLO can lie anywhere.
    """
    own = np.full((len(seen.times), 3), np.nan)
    count = seen.points.shape[1]
    at = place * (count - 1)
    near = max(round(BRIDGED * count), 1)
    before = slice(max(int(at) - near, 0), int(at) + 1)
    after = slice(int(np.ceil(at)), int(np.ceil(at)) + near + 1)
    for k, points in enumerate(seen.points):
        chain = _complete(points)
        if chain is not None and all(np.isfinite(points[side, 0]).any() for side in (before, after)):
            own[k] = _at(chain, np.array([place]))[0]
    return own


def _dragged(seen: Sightings, path: Floats) -> Floats:
    """Return the path (n, 3) [m] of a grip on the table, from how a tag shows it."""
    assert seen.cameras is not None
    share = (seen.radius - seen.cameras[:, 2:]) / (path[:, 2:] - seen.cameras[:, 2:])
    return np.asarray(seen.cameras + share * (path - seen.cameras))


def _like_the_dlo(times: Floats, path: Floats, own: Floats, held: slice) -> Floats:
    """
    Return the smooth path (n, 3) [m] of a grip on the table as the DLO itself shows it.

    That is better than a tag beside it; where the DLO is lost, the tag shows how it moves on.  A hand does
    not tremble as the noise of single pictures does, which would shake a simulated DLO.

    :param path: as the tag shows it, and `own` as the DLO does; `held`: in which pictures the hand holds it.
    """
    moves = np.where(np.isfinite(path), path, 0.0)
    both = held.start + np.flatnonzero(np.isfinite(own[held, 0]) & np.isfinite(path[held, 0]))
    if not len(both):
        return path
    off = (own - moves)[both]
    smooth = np.full_like(path, np.nan)
    for k in np.flatnonzero(np.isfinite(path[:, 0])):
        near = np.maximum(np.exp(-np.square((times[both] - times[k]) / SPAN) / 2.0), 1e-9)
        smooth[k] = path[k] + near @ off / near.sum()
    return np.asarray(np.where(np.isfinite(smooth), smooth, own))


def _opens(times: Floats, apart: Floats, most: float, speed: Floats, way: Floats, closes: int,
           last: int) -> int:
    """
    Return the picture in which a hand opens: the last one before hand and DLO part.

    A hand that moves away has stood still before.  While both stay together, it opens when it has come to a
    standstill: nothing shows that it holds the DLO any longer.

    :param apart: (n,) how far both are apart [m]; NaN where this is unknown.
    :param most: how far they are apart while the hand holds the DLO [m].
    :param way: (n,) of the hand from where it closed [m].
    """
    end = int(np.searchsorted(times, times[last] + 1.0))
    known = closes + np.flatnonzero(np.isfinite(apart[closes:end]))
    together = known[apart[known] < most]
    parts = [k for k in together if (apart[known[known > k][:PARTED]] >= most).all()]
    parted = bool(parts) and bool((known > parts[0]).sum() >= PARTED)
    held = parts[0] if parted else together[-1] if len(together) else closes
    unseen = np.arange(held + 1, known[known > held][0] if (known > held).any() else end)
    moves = closes + np.flatnonzero(speed[closes:end] >= STILL)
    stood = unseen[(speed[unseen] < STILL) & (way[unseen] > WAY)]
    if len(stood):  # they part while this is not seen, after the hand has come to a standstill
        return int(np.split(stood, np.flatnonzero(np.diff(stood) > 1) + 1)[0][0])
    if len(unseen) and times[unseen[-1]] - times[held] > LEAVING:
        return int(np.clip(last, held, unseen[-1]))
    if parted:
        for before in together[together < held][::-1]:  # they begin to part
            if not apart[held] > max(apart[before] + most / 4, most / 2):
                break
            held = before
        stood = together[(speed[together] < STILL) & (times[together] > times[held] - LEAVING)
                         & (together <= held)]
        return int(stood[-1] if len(stood) else held)
    moves = moves[moves <= held]
    stands = min(int(moves[-1]) + 1 if len(moves) else held, held)
    return int(max(stands, min(last, held)))


def _slips(apart: Floats, closes: int, opens: int, stands: NDArray[np.intp]) -> int:
    """
    Return the picture in which a hand opens: the last one before the DLO begins to move without it.

    :param apart: (n, 3) from the hand's grip to the place that it holds [m]; NaN where unknown.
    :param stands: pictures in which the hand stands where it opens.
    """
    known = closes + np.flatnonzero(np.isfinite(apart[closes:opens + 1, 0]))
    for k in range(PARTED, len(known)):
        if known[k] not in stands:
            continue
        usual = np.median(apart[known[k - PARTED:k]], axis=0)
        if (np.linalg.norm(apart[known[k:]] - usual, axis=1) > SLIPPED).all():
            return int(known[k - 1])
    return opens


def _apart(seen: Sightings, grips: Floats, points: Floats, pictures: NDArray[np.bool_]) -> Floats:
    """Return the distances (k,) [m] of grips (k, 3) from points (k, 3), or from their lines of sight."""
    between = grips - points
    if seen.cameras is not None:
        ray = points - seen.cameras[pictures]
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        between = between - (between * ray).sum(axis=1, keepdims=True) * ray
    return np.asarray(np.linalg.norm(between, axis=1))


def _speed(times: Floats, positions: Floats) -> Floats:
    """Return speeds (n,) [m/s], the slopes of straight lines over the span; infinite where unknown."""
    speed = np.full(len(times), np.inf)
    early = np.searchsorted(times, times - SPAN - 1e-9)
    late = np.searchsorted(times, times + SPAN + 1e-9)
    for k, (begin, end) in enumerate(zip(early, late, strict=True)):
        since = times[begin:end] - times[begin:end].mean()
        if since.any():
            slope = np.linalg.norm(since @ positions[begin:end]) / np.square(since).sum()
            speed[k] = slope if np.isfinite(slope) else np.inf
    return speed


def _path(seen: Sightings, hold: _Hold, initial: Chain) -> Hand:
    """Return the path of a hand while it holds the DLO."""
    known = [k for k in range(hold.first, hold.last + 1) if np.isfinite(hold.grips[k]).all()]
    if len(known) < 2:
        raise InputError('hand', f'{hold.name}, which is hardly seen while it holds the DLO',
                         'a tag that the camera sees', 'glue it where the hand does not hide it')
    kept = [known[0]]
    for k in known[1:]:
        if seen.times[k] - seen.times[kept[-1]] >= PATH or k == known[-1]:
            kept.append(k)
    point, offset = initial.grip(hold.place * initial.length)
    return Hand(hold.name, (point,), seen.times[kept], hold.grips[kept], _without_gaps(hold.turns)[kept],
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
        if seen.times[k] - seen.times[kept[-1]] < THIN or not _usable(seen.points[k]):
            continue
        moved = np.linalg.norm(seen.points[k] - seen.points[kept[-1]], axis=1)
        if np.isfinite(moved).any() and np.nanmax(moved) >= SHIFT:
            kept.append(k)
    return kept[1:]


def _low(seen: Sightings, holds: Sequence[_Hold], k: int) -> Floats | None:
    """Return the points (m, 3) of picture k, without those that may be in the air; None if too few remain."""
    points = np.array(seen.points[k])
    if seen.cameras is None:
        return points
    whole = _complete(points)
    share = np.linspace(0.0, 1.0, len(points))
    length = float(np.nansum(np.linalg.norm(np.diff(points, axis=0), axis=1))) or 1.0
    diameter = max(2.0 * seen.radius, 1e-3)
    for hold in holds:
        lifted = float(hold.grips[k, 2]) - seen.radius
        if hold.lifts and hold.first <= k <= hold.last and lifted > LIFTED:
            reach = max(BUMP * diameter * (lifted / diameter) ** 0.25, SLACK * lifted)
            points[np.abs(share - hold.place) * length <= reach] = np.nan
        elif whole is not None and not hold.lifts and hold.first <= k <= hold.last:
            # What the fingers hide is where the path of the hand has it.
            near = np.abs(share - hold.place) <= HIDDEN
            points[near] = whole[near]
    return points if _usable(points) else None
