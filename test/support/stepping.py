# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Single steps of the kernels, for tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.simulation.kernels import rod_velocities
from dlo_calibration.simulation.kernels_contact import keep_apart
from dlo_calibration.simulation.kernels_frame import add_frame, turn_clamps
from dlo_calibration.simulation.kernels_near import is_near, movement, near_pairs, start_distances
from dlo_calibration.simulation.rod import Rod
from dlo_calibration.simulation.rope import self_contact

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
        self._step, self._last = time_step, (0.0, 0.0)

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
        coming = movement(allowed, self._step)
        if is_near(self.state, points, self._last, coming):
            keep_apart(self.state, points, allowed, inverse_masses, support, self._step)
        self._last = movement(allowed, self._step)
        return allowed
