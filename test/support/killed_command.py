# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line with a toy: `killed_command.py SIMULATIONS VERB ...` is killed (-9) at that simulation."""

import os
import signal
import sys

from toy_simulator import CountingToy


def main():
    """Execute a verb with a toy that kills this process."""
    from without_drawings import leave_out_drawings, leave_out_slices

    from dlo_calibration.cli.main import main as execute

    leave_out_drawings()
    leave_out_slices()
    toy = CountingToy(last=int(sys.argv[1]), die=lambda: os.kill(os.getpid(), signal.SIGKILL))
    return execute(sys.argv[2:], lambda _: toy)


if __name__ == '__main__':
    sys.exit(main())
