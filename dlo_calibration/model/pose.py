# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pose: position and orientation of a frame in another; it transforms points, quaternions and trials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, far_from_unit, Hand, quaternion_lengths, rotation_matrix
from dlo_calibration.model.chain import Chain, check_size, Floats, frozen_array
from dlo_calibration.model.named_actions import NamedAction
from dlo_calibration.model.trial import Force, Trial

NUMBERS = 'x y z qx qy qz qw'


@dataclass(frozen=True, eq=False)
class Pose:
    """
    The pose of a frame in another one.

    :param position: (3,) [m] of its origin.
    :param orientation: (4,) unit quaternion x y z w.
    """

    position: Floats
    orientation: Floats

    def __post_init__(self) -> None:
        position, orientation = frozen_array(self.position), np.array(self.orientation, dtype=float)
        check_size('frame_pose', 'position', position[None, :])
        length = quaternion_lengths(orientation)
        if not (np.isfinite(position).all() and np.isfinite(length)) or bool(far_from_unit(length)):
            raise InputError('frame_pose', ' '.join(f'{number:g}' for number in (*position, *orientation)),
                             f'finite numbers {NUMBERS} with a unit quaternion', 'correct it')
        object.__setattr__(self, 'position', position)
        object.__setattr__(self, 'orientation', frozen_array(orientation / length))

    @classmethod
    def of(cls, text: str) -> Self:
        """
        Return the pose from a text with seven numbers, as `str` writes it.

        :raises InputError: if the text is something else.
        """
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 7:
            raise InputError('frame_pose', repr(text), f'the numbers {NUMBERS}',
                             'give metres and a unit quaternion, with blanks between them')
        return cls(np.array(numbers[:3]), np.array(numbers[3:]))

    def __str__(self) -> str:
        return ' '.join(map(repr, (*self.position.tolist(), *self.orientation.tolist())))

    @cached_property
    def rotation(self) -> Floats:
        """(3, 3) rotation matrix."""
        return frozen_array(rotation_matrix(self.orientation))

    @property
    def inverse(self) -> Pose:
        """The pose of the other frame in this one."""
        return Pose(-self.position @ self.rotation, self.orientation * [-1.0, -1.0, -1.0, 1.0])

    def points(self, points: Floats) -> Floats:
        """Return (..., 3) points of the frame in the other one [m]."""
        return np.asarray(points @ self.rotation.T + self.position)

    def vectors(self, vectors: Floats) -> Floats:
        """Return (..., 3) vectors of the frame, such as velocities, in the other one."""
        return np.asarray(vectors @ self.rotation.T)

    def orientations(self, orientations: Floats) -> Floats:
        """Return (..., 4) quaternions x y z w of the frame in the other one."""
        (x, y, z, w), (i, j, k, r) = self.orientation, np.moveaxis(orientations, -1, 0)
        return np.stack([w * i + x * r + y * k - z * j, w * j - x * k + y * r + z * i,
                         w * k + x * j - y * i + z * r, w * r - x * i - y * j - z * k], axis=-1)

    def chain(self, chain: Chain) -> Chain:
        """Return a chain of the frame in the other one."""
        return replace(chain, points=self.points(chain.points))

    def forces(self, forces: Sequence[Force]) -> tuple[Force, ...]:
        """Return forces of the frame in the other one."""
        return tuple(replace(force, vector=self.vectors(force.vector)) for force in forces)

    def trial(self, trial: Trial) -> Trial:
        """Return a trial of the frame in the other one."""
        return replace(
            trial, initial=self.chain(trial.initial), actions=tuple(map(self.action, trial.actions)),
            goals=tuple(replace(goal, chain=self.chain(goal.chain), forces=self.forces(goal.forces))
                        for goal in trial.goals),
            velocity=None if trial.velocity is None else self.vectors(trial.velocity))

    def action(self, action: Action) -> Action:
        """Return the paths of hands of the frame in the other one."""
        return Action(tuple(Hand(hand.name, hand.grips, hand.times, self.points(hand.positions),
                                 self.orientations(hand.orientations), hand.offset, hand.nearest)
                            for hand in action.hands))

    def named_action(self, action: NamedAction) -> NamedAction:
        """Return a named action of the frame for the other one, whose z is up."""
        moved: dict[str, Any] = {
            name: tuple(move(np.array(given)).tolist())
            for name, move in (('to', self.points), ('direction', self.vectors))
            if (given := getattr(action, name, None)) is not None}
        return replace(action, **moved)
