# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Grasps: which place of a DLO a hand holds, when it closes and when it opens.

That follows from the DLO and the hand moving together. One camera shows a point of the DLO only on its line
of sight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.action import NO_ROTATION
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.observation.sightings import (
    complete,
    HandSightings,
    pictures_between,
    points_at,
    Sightings,
    SPAN,
)

STILL = 0.015  # m/s; a hand that moves slower stands still
WAY = 0.012  # m; the shortest way of a hand that moves a DLO
PLACES = 601  # along the DLO at which a hand may hold it
MOST, ROUNDS = 60, 4  # pictures in which they are compared, and rounds of a fit to them
LOW = 0.3  # height of a line of sight over the table, of its length; a lower one hardly shows a turn
DOUBTED = 0.006  # m; a picture in which a place is farther from where it is in the hand hardly counts
BRIDGED = 0.2  # share of the length to both sides of a place, in which the DLO must be seen
PARTED = 5  # pictures in a row that show hand and DLO apart
LEFT, SIGMAS = 0.005, 5.0  # m, and times what is typical: a grip farther from its hand is left
HELD = 0.012  # m; from a hand to the point that it holds, at most, in half of the movement's pictures
BESIDE = 0.005  # of a grip's distance from its tag that counts as error: of places alike, the nearest is held
AT_REST = 0.0015  # m; nearer to where a hand closes, it stands there
AGREES = 0.5  # of the difference between two such offsets of one hand: a tag is glued once, a hand tilts
REACH = 0.25  # m from a tag to what the hand holds, at most
LIFTED = 0.008  # m above the table


@dataclass(frozen=True, eq=False)
class Grasp:
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


def grasps_of(seen: Sightings, hand: HandSightings, movements: Sequence[tuple[Chain, int, int]]
              ) -> list[Grasp | None]:
    """
    Return how a hand holds the DLO in each movement; None: it does not.

    A tag is glued to a hand once, so it is beside what is held in much the same way each time.

    :param movements: the DLO at rest before, and the first and last picture of each.
    """
    if hand.place is not None:
        turns = np.tile(NO_ROTATION, (len(seen.times), 1))
        lifted = [bool(np.nanmax(hand.positions[first:last + 1, 2], initial=-np.inf) - seen.radius > LIFTED)
                  for _, first, last in movements]
        return [Grasp(hand.name, hand.place, hand.positions, turns, max(first - 1, 0), last, lifts)
                for (_, first, last), lifts in zip(movements, lifted, strict=True)]
    speed = _speed(seen.times, hand.positions)
    moved = [_moved_by(seen, hand, speed, *movement) for movement in movements]
    held = [way for way in moved if way is not None]
    chosen = dict(zip(map(id, held), _alike(held), strict=True))
    return [None if way is None else way.grasp(seen, hand, speed, chosen[id(way)], last)
            for way, (_, _, last) in zip(moved, movements, strict=True)]


def _moved_by(seen: Sightings, hand: HandSightings, speed: Floats, initial: Chain, first: int,
              last: int) -> _Motion | None:
    """Return how the places of the DLO and a hand move together in a movement; None: they do not."""
    times = seen.times
    known = np.isfinite(hand.positions[:, 0])
    near = pictures_between(times, times[first] - 3 * SPAN, times[first] + 5 * SPAN)
    near = near[known[near]]
    span = np.arange(first, last + 1)
    span = span[known[span]]
    if not len(near) or len(span) < 3:
        return None
    # It has come to a standstill before it moves again, with the DLO.
    still = near[speed[near] < STILL]
    stands = np.split(still, np.flatnonzero(np.diff(still) > 1) + 1)[0]
    closes = int(stands[-1]) if len(still) else max(first - 1, 0)
    shown = closes if len(still) else int(span[0])
    begin = hand.positions[shown]
    if np.linalg.norm(hand.positions[span] - begin, axis=1).max() < WAY:
        return None
    there = near[near <= closes]
    there = there[np.linalg.norm(hand.positions[there] - begin, axis=1) < AT_REST]
    sights = np.tile([0.0, 0.0, 1.0], (len(times), 1)) if seen.cameras is None else (
        seen.cameras - hand.positions)
    compared = span[np.unique(np.linspace(0, len(span) - 1, min(len(span), MOST)).astype(int))]
    turned = [np.tile(NO_ROTATION, (len(times), 1))] if hand.orientations is None else [
        hand.orientations, _about_vertical(hand.orientations, sights, span)]
    motion = min((_motion(seen, hand, rotations, initial, closes, there, compared) for rotations in turned),
                 key=lambda motion: motion.costs.min())
    return motion if motion.typical[motion.costs.argmin()] < HELD else None


def _alike(motions: Sequence[_Motion]) -> list[int]:
    """Return the index of the place that is held in each motion of one hand, whose tag is glued once."""
    best = [int(motion.costs.argmin()) for motion in motions]
    if len(motions) < 2:
        return best
    # Where the tag may be beside what is held: as one of the motions would have it.
    tried = np.concatenate([motion.beside[motion.costs <= 2.0 * motion.costs.min()] for motion in motions])
    costs = [np.square(motion.costs) + AGREES**2 * np.square(
        np.linalg.norm(motion.beside - tried[:, None], axis=2)) for motion in motions]
    together = int(sum(cost.min(axis=1) for cost in costs).argmin())
    return [int(cost[together].argmin()) for cost in costs]


@dataclass(frozen=True, eq=False)
class _Motion:
    """
    How a hand and p places of the DLO move together.

    :param closes: the picture in which the hand closes, and `turns`, (n, 4), its orientations.
    :param offsets: (p, 3) of each place from the tag in the frame of the hand [m]; `beside`, (p, 2), over the
        table, where the tag's x is level.
    :param typical: (p,) median distance between a place and where it is in the hand [m]; pictures in which
        the hand has opened do not count much in it, nor in `costs`, which count the offset, too.
    """

    closes: int
    turns: Floats
    offsets: Floats
    beside: Floats
    typical: Floats
    costs: Floats

    def grasp(self, seen: Sightings, hand: HandSightings, speed: Floats, place: int, last: int) -> Grasp:
        """Return how the hand holds a place of the DLO, which does not move after the picture `last`."""
        from scipy.spatial.transform import Rotation  # takes a quarter of a second to load

        closes, share = self.closes, place / (PLACES - 1)
        path = np.full((len(self.turns), 3), np.nan)
        known = np.isfinite(self.turns[:, 0]) & np.isfinite(hand.positions[:, 0])
        path[known] = hand.positions[known] + Rotation.from_quat(self.turns[known]).apply(self.offsets[place])
        own = _own(seen, share)
        apart = np.full(len(path), np.nan)
        both = np.isfinite(own[:, 0]) & known
        apart[both] = _apart(seen, path[both], own[both], both)
        begin = hand.positions[closes:][known[closes:]][0]
        stands = (speed < STILL) & (np.linalg.norm(hand.positions - begin, axis=1) > WAY)
        most = min(max(LEFT, SIGMAS * float(self.typical[place])), HELD)
        opens = _opens(seen.times, apart, most, stands, closes, last)
        low = path if seen.cameras is None else _dragged(seen, path)
        held = slice(closes, opens + 1)
        moving = path[held][(speed[held] >= STILL) & known[held]]
        lifts = seen.cameras is None or bool(
            len(moving) and np.median(moving[:, 2]) - seen.radius > LIFTED)
        return Grasp(hand.name, share, path if lifts else np.where(np.isfinite(low), low, own), self.turns,
                     closes, opens, lifts)


def _about_vertical(orientations: Floats, sights: Floats, pictures: NDArray[np.intp]) -> Floats:
    """
    Return the orientations (n, 4) of a hand that turns about the vertical alone, with one tilt all the time.

    A small tag that the camera sees from straight ahead looks the same while it tilts a little; how it turns
    about the line of sight is seen well, and says how far the hand has turned.

    :param sights: (n, 3) from the tag to the camera [m].
    :param pictures: those that determine the tilt.
    """
    from scipy.spatial.transform import Rotation  # takes a quarter of a second to load

    turned = np.full_like(orientations, np.nan)
    known = np.isfinite(orientations[:, 0]) & np.isfinite(sights[:, 0])
    seen, moving = Rotation.from_quat(orientations[known]), np.isin(np.flatnonzero(known), pictures)
    sight = sights[known]
    sight = sight / np.maximum(sight[:, 2:], LOW * np.linalg.norm(sight, axis=1, keepdims=True))
    matrices = seen.as_matrix()
    yaw = np.unwrap(np.arctan2(matrices[:, 1, 0] - matrices[:, 0, 1], matrices[:, 0, 0] + matrices[:, 1, 1]))
    for _ in range(ROUNDS):
        about = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
        tilt = (about.inv() * seen)[moving].mean()
        away = (seen * (about * tilt).inv()).as_rotvec()
        yaw = yaw + (away * sight).sum(axis=1)
    turned[known] = (Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]) * tilt).as_quat()
    return turned


def _motion(seen: Sightings, hand: HandSightings, turns: Floats, initial: Chain, closes: int,
            there: NDArray[np.intp], compared: NDArray[np.intp]) -> _Motion:
    """
    Return how places of the DLO, each with its offset from the tag, move together with it.

    :param turns: (n, 4) quaternions of the hand.
    :param there: pictures in which the hand is at the resting DLO; `compared`: those of the movement.
    """
    from scipy.spatial.transform import Rotation  # takes a quarter of a second to load

    places = np.linspace(0.0, 1.0, PLACES)
    chains = {int(k): chain for k in compared if (chain := complete(seen.points[k])) is not None}
    resting = initial.resample(places * initial.length)
    pictures = np.array([*there, *chains], int)
    points = np.stack([*[resting] * len(there), *(points_at(chain, places) for chain in chains.values())])
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
    first = max(len(there), 1)
    offsets = np.einsum('kba,kpb->pa', rotations[:first], points[:first] - tags[:first]) / first
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
    rotation = rotations[0]
    yaw = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    level = offsets @ rotation[:2].T @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return _Motion(closes, turns, offsets, level, np.median(apart, axis=0), cost)


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
        chain = complete(points)
        if chain is not None and all(np.isfinite(points[side, 0]).any() for side in (before, after)):
            own[k] = points_at(chain, np.array([place]))[0]
    return own


def _dragged(seen: Sightings, path: Floats) -> Floats:
    """Return the path (n, 3) [m] of a grip on the table, from how a tag shows it."""
    assert seen.cameras is not None
    share = (seen.radius - seen.cameras[:, 2:]) / (path[:, 2:] - seen.cameras[:, 2:])
    return np.asarray(seen.cameras + share * (path - seen.cameras))


def _opens(times: Floats, apart: Floats, most: float, stands: NDArray[np.bool_], closes: int,
           last: int) -> int:
    """
    Return the picture in which a hand opens.

    A hand that comes to a standstill before the DLO rests may hold it longer, but nothing shows that, and
    nothing moves.  A hand that does not opens before both part, or when the DLO rests.

    :param apart: (n,) how far both are apart [m]; NaN where this is unknown.
    :param most: how far they are apart while the hand holds the DLO [m].
    :param stands: (n,) whether the hand stands still, elsewhere than where it closed.
    :param last: the last picture in which the DLO moves.
    """
    end = int(np.searchsorted(times, times[last] + 2.0 * SPAN))
    known = closes + np.flatnonzero(np.isfinite(apart[closes:]))
    away = apart[known] >= most
    parted = known[[k for k in range(len(known) - PARTED + 1) if away[k:k + PARTED].all()]]
    end = min(end, *parted[:1])
    begins = closes + 1 + np.flatnonzero(stands[closes + 1:end] & ~stands[closes:end - 1])
    return int(begins[-1]) if len(begins) else max(min(last, end - 1), closes)


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
