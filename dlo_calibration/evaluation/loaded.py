# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Loaded: importing this module loads what processes that simulate need, if the kernels are compiled.

The fork server of `processes` imports it, once for all of them.  What is not compiled yet, or fails to load,
each process loads when it needs it, and tells of it then.
"""

from __future__ import annotations

from contextlib import suppress
import gc
from importlib import import_module
import sys

sys.path[:] = filter(None, sys.path)  # not the folder in which the user works: files there may have any name

gc.disable()  # what is being loaded is no garbage
with suppress(Exception):
    from dlo_calibration.simulation.kernel_cache import is_compiled, SIMULATION, TOGETHER
    from dlo_calibration.simulation.machine_code import load

    for _module in ('evaluation.batch', 'simulation.compiled', 'simulation.together'):
        import_module(f'dlo_calibration.{_module}')  # what the first call of each process would load
    for _kernels in (SIMULATION, TOGETHER):
        if is_compiled(_kernels):
            load(_kernels)
    import_module('dlo_calibration.simulation.bullet')  # last, as it is needed last
gc.freeze()  # no process that is forked ever looks through it
gc.enable()
