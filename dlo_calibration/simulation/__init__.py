# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
How a trial is simulated: what an engine is, the nodes of the DLO, the course of a rollout.

The engines themselves are in `bullet` and `compiled`, the physics of both in `kernels`; they are imported
where they are used, as they take long to load.
"""

from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import Rollout, Simulator
from dlo_calibration.simulation.rollout import roll_out, Settling, Stepper

__all__ = ['NodeLayout', 'Rollout', 'Settling', 'Simulator', 'Stepper', 'roll_out']
