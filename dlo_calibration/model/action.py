# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Action: the time-stamped paths of the hands that move a DLO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import check_size, Floats, frozen_array

MAXIMUM_HANDS = 8  # the limit of the message contract
MAXIMUM_TIME = 1e12  # s; far more than between two stamps, and still countable in time steps
PATHS = 'hand_paths'  # name of explicit paths
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)  # x y z w


def quaternion_lengths(orientations: Floats) -> Floats:
    """Return the lengths of (..., 4) quaternions, also of those whose squares overflow."""
    largest = np.abs(orientations).max(axis=-1, initial=1.0)
    return np.asarray(largest * np.linalg.norm(orientations / largest[..., None], axis=-1))


def far_from_unit(lengths: Floats) -> NDArray[np.bool_]:
    """Return which lengths are too far from 1 for a rotation; rounded quaternions are normalised."""
    return (lengths < 0.5) | (lengths > 1000)


def rotation_matrix(quaternion: Floats) -> Floats:
    """Return the (3, 3) rotation matrix of a unit quaternion x y z w."""
    x, y, z, w = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def check_waypoints(thing: str, what: str, names: Sequence[str], paths: Mapping[str, Floats],
                    step: float = 0.0) -> None:
    """
    Refuse paths that hands cannot follow.

    :param thing: their owner in the error; `what`: the word for a waypoint; `names` of the h hands.
    :param paths: (k,) times [s], (k, ...) positions [m] and (k, h, 4) quaternions, by their names.
    :param step: least time from one waypoint to the next [s].
    :raises InputError: if a number is not finite or too large, times do not increase, or a quaternion is far
        from unit length.
    """
    for name, values in paths.items():
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if len(bad):
            raise InputError(thing, f'NaN or infinity in {name} of {what} {bad[0]}', 'finite numbers',
                             'leave such points out')
    times, positions, orientations = paths.values()
    check_size(thing, what, positions)
    bad = np.flatnonzero(np.diff(times) <= 0.999 * step)
    if len(bad):
        k = bad[0]
        raise InputError(
            thing, f'{next(iter(paths))} {times[k + 1]:.9g} s of {what} {k + 1} after {times[k]:.9g} s',
            f'increasing times{f", by {step:g} s at least" if step else ""}',
            'sort the points and leave out repeated ones')
    norms = quaternion_lengths(orientations)
    for k, hand in np.argwhere(far_from_unit(norms))[:1]:
        raise InputError(
            thing, f'a quaternion of length {norms[k, hand]:g} for {names[hand]} in {what} {k}',
            'a unit quaternion x y z w', 'use 0 0 0 1 for a hand that does not turn')


@dataclass(frozen=True, eq=False)
class Hand:
    """
    One gripper hand: the points that it grips, and its path.

    It closes at its first waypoint.  Between waypoints it moves on the shortest
    path at constant speed.  One gripped point is a pin; two or more are a clamp,
    which moves with the hand as one rigid piece.

    :param name: its name in the messages, e.g. ``left_hand``.
    :param grips: indices of the gripped points of the chain, at least one.
    :param times: (k,) seconds since the start of the trial, increasing, k >= 1.
    :param positions: (k, 3) [m], at most `MAXIMUM_COORDINATE`.
    :param orientations: (k, 4) unit quaternions x y z w; None for no rotation.
    :param offset: of a pin between two points: distance beyond the gripped one, as a share of the way to the
        next one, -1 to 1; negative: to the previous one.
    :param nearest: whether it grips where the DLO is nearest to its first waypoint; `grips` and `offset` say
        where that is.
    """

    name: str
    grips: tuple[int, ...]
    times: Floats
    positions: Floats
    orientations: Floats = None  # type: ignore[assignment]  # __post_init__ makes it an array
    offset: float = 0.0
    nearest: bool = False

    def __post_init__(self) -> None:
        thing = f'hand {self.name!r}'
        times = frozen_array(np.atleast_1d(self.times))
        positions = frozen_array(np.atleast_2d(self.positions))
        count = len(times)
        orientations = np.tile(NO_ROTATION, (count, 1)) if self.orientations is None \
            else np.atleast_2d(np.array(self.orientations, dtype=float))
        if not self.grips:
            raise InputError(thing, 'no gripped point', 'at least one',
                             'name the points of the chain that it holds')
        if not abs(self.offset) <= 1 or self.offset and len(self.grips) > 1:
            raise InputError(thing, f'an offset of {self.offset:g} from {len(self.grips)} gripped point(s)',
                             '-1 to 1 from one point', 'name the nearest point')
        if count == 0 or positions.shape != (count, 3) or orientations.shape != (count, 4):
            raise InputError(
                thing, f'{count} times, positions {positions.shape}, orientations {orientations.shape}',
                'k times, (k, 3) positions and (k, 4) orientations', 'give one pose per waypoint')
        if np.abs(times).max() > MAXIMUM_TIME:
            raise InputError(thing, f'a waypoint at {times[np.abs(times).argmax()]:g} s',
                             f'at most {MAXIMUM_TIME:g} s', 'count seconds from the start of the trial')
        check_waypoints(thing, 'waypoint', (self.name,), {
            'time': times, 'positions': positions, 'orientations': orientations[:, None]})
        norms = quaternion_lengths(orientations)[:, None]
        object.__setattr__(self, 'grips', tuple(dict.fromkeys(int(g) for g in self.grips)))
        object.__setattr__(self, 'times', times)
        object.__setattr__(self, 'positions', positions)
        norms[np.abs(norms - 1) < 1e-12] = 1  # dividing again would change the last digit
        object.__setattr__(self, 'orientations', frozen_array(orientations / norms))

    @property
    def start(self) -> float:
        """When the hand closes, seconds since the start of the trial."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """When the hand arrives at its last waypoint [s]."""
        return float(self.times[-1])

    def positions_at(self, at: ArrayLike) -> Floats:
        """Return positions, (m, 3) [m], at times `at`, (m,) [s]; the hand rests before and after its path."""
        times = np.atleast_1d(np.asarray(at, dtype=float))
        return np.stack([np.interp(times, self.times, axis) for axis in self.positions.T], axis=1)

    def poses(self, at: ArrayLike) -> tuple[Floats, Floats]:
        """
        Return the poses of the hand at the times `at`, (m,) [s].

        :returns: (m, 3) positions [m], and (m, 3, 3) rotations since the hand closed.
        """
        times = np.clip(np.atleast_1d(np.asarray(at, dtype=float)), self.start, self.end)
        if (self.orientations == NO_ROTATION).all():
            return self.positions_at(times), np.tile(np.eye(3), (len(times), 1, 1))
        from scipy.spatial.transform import Rotation, Slerp  # takes a quarter of a second to load

        turns = Rotation.from_quat(self.orientations)
        turned = Slerp(self.times, turns)(times) if len(self.times) > 1 else turns[np.zeros(len(times), int)]
        return self.positions_at(times), (turned * turns[0].inv()).as_matrix()


@dataclass(frozen=True)
class Action:
    """The paths of one to eight hands that act together."""

    hands: tuple[Hand, ...]

    name: ClassVar[str] = PATHS

    def __post_init__(self) -> None:
        hands = tuple(self.hands)
        names = tuple(hand.name for hand in hands)
        if not 1 <= len(hands) <= MAXIMUM_HANDS:
            raise InputError('action', f'{len(hands)} hands', f'1 to {MAXIMUM_HANDS}',
                             'leave out the hands that hold nothing')
        if len(set(names)) < len(names):
            raise InputError('action', f'hands named {", ".join(names)}', 'different names',
                             'give each hand a name of its own')
        object.__setattr__(self, 'hands', hands)

    @property
    def hand_names(self) -> tuple[str, ...]:
        """Names of its hands."""
        return tuple(hand.name for hand in self.hands)

    @property
    def start(self) -> float:
        """When the first hand closes [s]."""
        return min(hand.start for hand in self.hands)

    @property
    def end(self) -> float:
        """When the last hand arrives [s]."""
        return max(hand.end for hand in self.hands)


def check_grips(thing: str, hands: Iterable[Hand], count: int) -> None:
    """
    Refuse hands that grip points beyond the chain.

    :param thing: the owner of the hands in the error.
    :param count: number of points of the chain.
    :raises InputError: if there is such a hand.
    """
    for hand in hands:
        if not all(0 <= grip < count for grip in hand.grips):
            raise InputError(thing, f'hand {hand.name!r} gripping points {hand.grips}',
                             f'points 0 to {count - 1}', 'correct the gripped points')
