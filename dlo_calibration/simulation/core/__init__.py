# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The core, in C++: simulates whole trials, four at a time, without Python's lock.

`roll_out` simulates trials; `Rope` is for engines that take the steps themselves.  Each physical term is one
header and one line of `step.hpp`.  `_core.pyi` documents the interface.
"""

from dlo_calibration.simulation.core._core import (
    Body,
    Event,
    Grid,
    Grip,
    roll_out,
    Rope,
    Scene,
    Script,
    Start,
    Stop,
    TARGETS,
)

__all__ = ['Body', 'Event', 'Grid', 'Grip', 'Rope', 'Scene', 'Script', 'Start', 'Stop', 'TARGETS', 'roll_out']
