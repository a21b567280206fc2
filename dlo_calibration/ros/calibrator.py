# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The executable `calibrator`: installs its signal handlers before it loads ROS.

So SIGINT and SIGTERM end it cleanly even while it is starting.
"""

from __future__ import annotations

import sys
from typing import Sequence

from dlo_calibration.signals import clean, StopFlag


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the node until a signal arrives.

    :param args: command line without the program's name; None: that of the process.
    :returns: exit code: 0; 2, with one line on stderr, if an argument, a parameter or ROS cannot be used.
    """
    args = list(sys.argv[1:] if args is None else args)
    if args in (['-h'], ['--help']):
        sys.stdout.write('usage: calibrator [--ros-args -p NAME:=VALUE ... --params-file FILE ...]\n\n'
                         'Calibrates a deformable linear object from messages; ends on SIGINT or SIGTERM.\n')
        return 0
    stop = StopFlag()
    stop.listen()
    try:
        from dlo_calibration.ros.calibrator_node import spin

        return spin(args, stop)
    except ImportError as error:
        if stop():  # an import that a signal disturbs may fail in any way
            return 0
        sys.stderr.write(f'calibrator: {error}; source a ROS 2 Jazzy installation, or install the '
                         "libraries with pip install 'dlo_calibration[ros]'\n")
        return 2
    finally:
        stop.ignore()
        clean()


if __name__ == '__main__':
    sys.exit(main())
