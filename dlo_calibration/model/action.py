# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Action: the time-stamped paths of the hands that move a DLO."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import check_size, Floats, frozen_array

MAXIMUM_HANDS = 8  # the limit of the message contract
MAXIMUM_TIME = 1e12  # s; far more than between two stamps, and steps up to it can be counted
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)  # x y z w


def quaternion_lengths(orientations: Floats) -> Floats:
    """Return the lengths of (..., 4) quaternions, also of those whose squares overflow."""
    largest = np.abs(orientations).max(axis=-1, initial=1.0)
    lengths: Floats = largest * np.linalg.norm(orientations / largest[..., None], axis=-1)
    return lengths


def far_from_unit(lengths: Floats) -> NDArray[np.bool_]:
    """Tell which quaternions cannot be meant as rotations; rounded ones can, as they are normalised here."""
    return (lengths < 0.5) | (lengths > 1000)


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
    :param offset: a pin between two points is so far beyond the gripped one, as a share of the way to the
        next one, -1 to 1; negative: to the one before.
    """

    name: str
    grips: tuple[int, ...]
    times: Floats
    positions: Floats
    orientations: Floats = None  # type: ignore[assignment]  # __post_init__ makes it an array
    offset: float = 0.0

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
        if not (np.isfinite(times).all() and np.isfinite(positions).all()
                and np.isfinite(orientations).all()):
            raise InputError(thing, 'NaN or infinity in its path', 'finite numbers', 'correct the path')
        check_size(thing, 'waypoint', positions)
        if np.abs(times).max() > MAXIMUM_TIME:
            raise InputError(thing, f'a waypoint at {times[np.abs(times).argmax()]:g} s',
                             f'at most {MAXIMUM_TIME:g} s', 'count seconds from the start of the trial')
        if (np.diff(times) <= 0).any():
            raise InputError(thing, 'waypoints whose times do not increase', 'increasing times',
                             'sort the waypoints and remove repeated ones')
        norms = quaternion_lengths(orientations)[:, None]
        bad = norms[far_from_unit(norms)]
        if len(bad):
            raise InputError(thing, f'a quaternion of length {bad[0]:.2g}', 'a unit quaternion x y z w',
                             'use 0 0 0 1 for a hand that does not turn')
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

    def __post_init__(self) -> None:
        hands = tuple(self.hands)
        names = [hand.name for hand in hands]
        if not 1 <= len(hands) <= MAXIMUM_HANDS:
            raise InputError('action', f'{len(hands)} hands', f'1 to {MAXIMUM_HANDS}',
                             'leave out the hands that hold nothing')
        if len(set(names)) < len(names):
            raise InputError('action', f'hands named {", ".join(names)}', 'different names',
                             'give each hand a name of its own')
        object.__setattr__(self, 'hands', hands)

    @property
    def start(self) -> float:
        """When the first hand closes [s]."""
        return min(hand.start for hand in self.hands)

    @property
    def end(self) -> float:
        """When the last hand arrives [s]."""
        return max(hand.end for hand in self.hands)
