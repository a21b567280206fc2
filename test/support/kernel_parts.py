# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Parts of the kernels that tests call by themselves; see `stepping`, which declares them."""

from __future__ import annotations

import stepping

from dlo_calibration.simulation import kernels, kernels_contact, kernels_frame, kernels_near, kernels_slip
from dlo_calibration.simulation.compilation import entry
from dlo_calibration.simulation.states import (
    FrameState,
    IndexRows,
    Matrix,
    RodState,
    SelfContact,
    SlipState,
    Vector,
)


@entry(stepping.rod_velocities)
def rod_velocities(rod: RodState, points: Matrix, velocities: Matrix, predicted: Matrix) -> int:
    """Take a step without contacts."""
    return 1 if kernels.rod_velocities(rod, points, velocities, predicted) else 0


@entry(stepping.turn_clamps)
def turn_clamps(clamped: IndexRows, clamps: Matrix, turns: Matrix) -> None:
    """Turn clamps with their hands."""
    kernels_frame.turn_clamps(clamped, clamps, turns)


@entry(stepping.add_frame)
def add_frame(frame: FrameState, step: float, right: Vector) -> None:
    """Add the impulses of the material frame."""
    kernels_frame.add_frame(frame, step, right)


@entry(stepping.near_pairs)
def near_pairs(contact: SelfContact, points: Matrix, stretch: float, reach: float) -> int:
    """Find pairs of segments that are near."""
    return kernels_near.near_pairs(contact, points, stretch, reach)


@entry(stepping.touch)
def touch(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector, support: Matrix,
          step: float, last: Vector) -> None:
    """Let contacts change the velocities."""
    coming = kernels_near.movement(velocities, step)
    if kernels_near.is_near(contact, points, (last[0], last[1]), coming):
        kernels_contact.keep_apart(contact, points, velocities, inverse_masses, support, step)
    last[0], last[1] = kernels_near.movement(velocities, step)


@entry(stepping.rub)
def rub(friction: SlipState, points: Matrix, step: float) -> None:
    """Let the strands rub on each other."""
    kernels_slip.rub(friction, points, step)
