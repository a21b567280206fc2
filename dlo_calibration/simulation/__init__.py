# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulate a trial: the interface of engines, the nodes of the DLO, the script of a rollout.

The engines are in `bullet` and `compiled`, the physics of both in `kernels`, which they call by `entries`.
"""

from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import Rollout, Simulator
from dlo_calibration.simulation.rollout import roll_out, Stepper
from dlo_calibration.simulation.script import Script, Settling

__all__ = ['NodeLayout', 'Rollout', 'Script', 'Settling', 'Simulator', 'Stepper', 'roll_out']
