# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Single steps of the kernels, for tests."""

import numpy as np

from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.rod import Rod
from dlo_calibration.simulation.rope import self_contact


class SteppedRod(Rod):
    """A rod whose kernel is called step by step."""

    def velocities(self, points, velocities, gravity, held_velocities):
        """Return the (N, 3) [m/s] velocities after a step without contacts."""
        self.state.follow[:] = held_velocities
        wanted = np.empty_like(points)
        assert kernels.rod_velocities(self.state, points, velocities + self.state.step * gravity, wanted)
        return wanted


class Touching:
    """Contact of a DLO with itself, of which a kernel is called step by step; see `self_contact`."""

    def __init__(self, places, radius, friction, time_step):
        self.state = self_contact(np.diff(places), radius, friction)
        self._step = time_step

    def start(self, points):
        """Take the (N, 3) [m] points at the start."""
        kernels.start_distances(self.state, points)

    def velocities(self, points, velocities, inverse_masses, support):
        """Return the (N, 3) [m/s] velocities that contacts allow."""
        allowed = velocities.copy()
        if kernels.may_touch(allowed, self._step, self.state.room, self.state.near):
            kernels.keep_apart(self.state, points, allowed, inverse_masses, support, self._step)
        return allowed
