# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `warm-up`: compiles everything ahead of the first use."""

from __future__ import annotations

import argparse
import sys
import time

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.output import print_json, standard_output, tell


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('--json', action='store_true', help='print one JSON document on stdout')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.simulation.kernel_cache import compile_kernels, is_compiled, KERNELS, place, remark

    told = []
    for module, name in KERNELS.items():
        begun, before = time.monotonic(), is_compiled(module)
        if not before:
            if sys.stderr.isatty():
                tell(f'compiling the {name}, about half a minute')
            compile_kernels(module)
        told.append({'name': name, 'compiled': not before, 'seconds': round(time.monotonic() - begun, 1),
                     'folder': str(place(module))})
    if problem := remark():
        tell(f'warning: {problem}')
    if chosen.json:
        print_json({'compiled': told})
        return 0
    with standard_output() as stream:
        for one in told:
            words = f'compiled in {one["seconds"]:.0f} s' if one['compiled'] else 'was compiled before'
            stream.write(f'{one["name"]}: {words}; kept in {one["folder"]}\n')
    return 0
