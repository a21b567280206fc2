# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Entries: the kernels that Python calls."""

from __future__ import annotations

from dlo_calibration.simulation.kernel_cache import SIMULATION, TOGETHER
from dlo_calibration.simulation.machine_code import defined_in
from dlo_calibration.simulation.states import Cube, Matrix, Moves, RopeState, SelfContact, Together


@defined_in(SIMULATION)
def start_distances(contact: SelfContact, points: Matrix) -> int:
    """Set the least distances of pairs at the start, (N, 3) [m] points, so that none is pushed apart."""
    raise NotImplementedError


@defined_in(SIMULATION)
def predict_velocities(rope: RopeState, targets: Matrix, turns: Matrix) -> int:
    """
    Write to `rope.predicted` the velocities due to gravity, internal forces and self-contact.

    :param targets: (h, 3) [m] positions of the held nodes after the step.
    :param turns: see `kernels_frame.turn_clamps`.
    :returns: 0 if the rollout diverges.
    """
    raise NotImplementedError


@defined_in(SIMULATION)
def advance(rope: RopeState, targets: Cube, turns: Cube, level: float, path: Cube) -> int:
    """
    Take k steps on a table.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step.
    :param turns: (k, h, 9) of `kernels_frame.turn_clamps` in each step, or (0, 0, 0).
    :param level: height of nodes that touch the table [m].
    :param path: (k, N, 3) [m] where the positions of all nodes after each step are written; or empty.
    :returns: number of steps taken, below k if the rollout diverged.
    """
    raise NotImplementedError


@defined_in(TOGETHER)
def advance_together(moves: Moves, together: Together, count: int, used: int) -> int:
    """
    Take steps of several DLOs at once, each as `advance` would take it, until a move ends.

    :param moves: of `COUNT` DLOs; those that are not used may be any of the others.
    :param count: most steps to take.
    :param used: how many of the DLOs are to move.
    :returns: number of steps taken.
    """
    raise NotImplementedError
