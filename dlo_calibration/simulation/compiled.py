# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled engine: the rope of `bullet` with a contact of its own, for a table or none.

Same kernels, table, grips, stable test and time step as the PyBullet engine, without a call
into another library for each node and step.
"""

from __future__ import annotations

from typing import Mapping

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.engine import Engine
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.rope import diverged, Rope

NO_PATH = np.empty((0, 0, 3))
NOWHERE = -1e6  # m: where there is no table


class CompiledRope(Rope):
    """
    A rope on a table or in the air, stepped by `kernels`.

    :param level: height [m] of nodes that touch the table; None: no table.
    """

    def __init__(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
                 time_step: float, level: float | None = None, features: Floats | None = None) -> None:
        super().__init__(places, points, velocities, physical, time_step, np.array([0.0, 0.0, -GRAVITY]),
                         features)
        self.time_step = time_step
        self._level = NOWHERE if level is None else level

    def advance(self, targets: Floats, path: Floats = NO_PATH) -> None:
        """
        Take k steps; targets (k, h, 3) [m] of the held nodes after each.

        :param path: (k, N, 3) to write all nodes to after each step [m]; or empty.
        :raises SimulationError: where the rollout diverges; at that step.
        """
        if kernels.advance(self.state, np.ascontiguousarray(targets), self._level, path) < len(targets):
            raise diverged()


class CompiledSimulator(Engine):
    """Simulates trials on a table or in the air, about thirty times as fast as `bullet.BulletSimulator`."""

    name = 'compiled'

    def _rope(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              level: float | None) -> CompiledRope:
        return CompiledRope(layout.places, points, layout.velocities, physical, self._time_step, level,
                            layout.features)
