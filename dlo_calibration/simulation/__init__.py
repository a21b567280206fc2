# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulate a trial: the interface of engines, the nodes of the DLO, the script of a trial.

The engines are in `bullet` and `compiled`, the physics of both in `core`.
"""

from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import Rollout, Simulator, Stop
from dlo_calibration.simulation.script import Script, Settling

__all__ = ['NodeLayout', 'Rollout', 'Script', 'Settling', 'Simulator', 'Stop']
