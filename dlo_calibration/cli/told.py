# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Told: the engine of the verbs, which tell before they compile its kernels, as that takes long."""

from __future__ import annotations

from multiprocessing import parent_process

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli.output import tell
from dlo_calibration.simulation.kernel_cache import (
    compile_kernels,
    is_compiled,
    KERNELS,
    SIMULATION,
    TOGETHER,
)
from dlo_calibration.simulation.protocol import Simulator


def make_told(options: Options) -> Simulator:
    """Return the simulator that `options` name."""
    if parent_process() is None:
        for module in (SIMULATION, TOGETHER):
            if not is_compiled(module):
                tell(f'compiling the {KERNELS[module]} for this machine, once, about half a minute')
                compile_kernels(module)
    return make_chosen_simulator(options)
