# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Single steps of the kernels, for tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.simulation.entries import start_distances
from dlo_calibration.simulation.machine_code import defined_in
from dlo_calibration.simulation.rod import Rod
from dlo_calibration.simulation.rope import self_contact
from dlo_calibration.simulation.states import (
    FrameState,
    IndexRows,
    Matrix,
    RodState,
    SelfContact,
    SlipState,
    Vector,
)

PARTS = 'kernel_parts'


@defined_in(PARTS)
def rod_velocities(rod: RodState, points: Matrix, velocities: Matrix, predicted: Matrix) -> int:
    """Take a step without contacts; return 0 if it diverges."""


@defined_in(PARTS)
def turn_clamps(clamped: IndexRows, clamps: Matrix, turns: Matrix) -> int:
    """Turn clamps with their hands."""


@defined_in(PARTS)
def add_frame(frame: FrameState, step: float, right: Vector) -> int:
    """Add the impulses of the material frame."""


@defined_in(PARTS)
def near_pairs(contact: SelfContact, points: Matrix, stretch: float, reach: float) -> int:
    """Find pairs of segments that are near; return their number."""


@defined_in(PARTS)
def touch(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector, support: Matrix,
          step: float, last: Vector) -> int:
    """Let contacts change the velocities; `last` is what `kernels_near.movement` returned after it."""


@defined_in(PARTS)
def rub(friction: SlipState, points: Matrix, step: float) -> int:
    """Let the strands rub on each other."""


NO_TURNS = np.zeros((0, 9))


class SteppedRod(Rod):
    """A rod whose kernel is called step by step."""

    def velocities(self, points, velocities, gravity, held_velocities, turns=NO_TURNS):
        """Return the (N, 3) [m/s] velocities after a step without contacts."""
        self.state.follow[:] = held_velocities
        wanted = np.empty_like(points)
        pushed = velocities + self.state.step * gravity
        assert rod_velocities(self.state, points, pushed, wanted)
        turn_clamps(self.state.frame.clamped, self.state.frame.clamps, turns)
        return wanted

    def frame_forces(self, points, times=1):
        """Return the (N, 3) [N] forces of the material frame, after so many steps at the same points."""
        for _ in range(times):
            self.velocities(points, np.zeros_like(points), np.zeros(3), np.zeros((len(self.state.held), 3)))
        impulses = np.zeros(points.size)
        if len(self.state.frame.angles):
            add_frame(self.state.frame, 1.0, impulses)
        return impulses.reshape(-1, 3)

    def turned(self, points, axes):
        """Turn clamps by rotation vectors (3,), given by held node; what they hold stays where it is."""
        pieces = 1 + int(max((np.linalg.norm(axis) for axis in axes.values()), default=0))
        rotations = np.tile(np.eye(3), (len(self.state.held), 1, 1))
        for place, node in enumerate(self.state.held):
            if node in axes:
                rotations[place] = Rotation.from_rotvec(np.array(axes[node]) / pieces).as_matrix()
        still = np.zeros((len(self.state.held), 3))
        for _ in range(pieces):
            self.velocities(points, np.zeros_like(points), np.zeros(3), still, rotations.reshape(-1, 9))


class Touching:
    """Contact of a DLO with itself, of which a kernel is called step by step; see `self_contact`."""

    def __init__(self, places, radius, friction, time_step):
        self.state = self_contact(np.diff(places), radius, friction)
        self._step, self._last = time_step, np.zeros(2)

    def start(self, points):
        """Take the (N, 3) [m] points at the start."""
        start_distances(self.state, points)

    def check_every_pair(self, points):
        """Check every pair of segments in the coming steps, however far apart they are."""
        self.state.near[0] = near_pairs(self.state, points, 1.2, np.inf)
        self.state.room[:] = -1.0, -1.0, np.inf

    def velocities(self, points, velocities, inverse_masses, support):
        """Return the (N, 3) [m/s] velocities that contacts allow."""
        allowed = velocities.copy()
        touch(self.state, points, allowed, inverse_masses, support, self._step, self._last)
        return allowed
