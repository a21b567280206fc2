# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled engine: the same rope as in `bullet`, with its own contact with a table.

Kernels, table, grips, the test of stability and the time step are those of the PyBullet engine.
It is faster because no call into another library is needed for each node and step.
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


class CompiledRope(Rope):
    """
    A rope on a table or in the air, stepped by `kernels`.

    :param level: height [m] of nodes that touch the table; None: no table.
    """

    def __init__(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
                 time_step: float, level: float | None = None, features: Floats | None = None,
                 directions: Floats | None = None) -> None:
        super().__init__(places, points, velocities, physical, time_step, np.array([0.0, 0.0, -GRAVITY]),
                         features, directions)
        self.time_step = time_step
        self._level = -1e6 if level is None else level  # so low that nothing touches it

    def advance(self, targets: Floats, path: Floats | None = None, turns: Floats | None = None) -> None:
        """
        Take k steps; see `rollout.Stepper.advance`.

        :raises SimulationError: if the rollout diverges.
        """
        path = np.empty((0, 0, 3)) if path is None else path
        turns = np.empty((0, 0, 9)) if turns is None else np.ascontiguousarray(turns)
        targets = np.ascontiguousarray(targets)
        if kernels.advance(self.state, targets, turns, self._level, path) < len(targets):
            raise diverged()


class CompiledSimulator(Engine):
    """Simulates trials on a table or in the air, 20 to 30 times as fast as `bullet.BulletSimulator`."""

    name = 'compiled'

    def _rope(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              level: float | None) -> CompiledRope:
        return CompiledRope(layout.places, points, layout.velocities, physical, self._time_step, level,
                            layout.features, layout.directions)
