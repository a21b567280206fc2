# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Executable: runs a node as a program; it installs its signal handlers before it loads ROS."""

from __future__ import annotations

import sys
from typing import Callable, Sequence

from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import remove_unfinished

Spin = Callable[[Sequence[str], Callable[[], bool]], int]


def execute(program: str, purpose: str, load: Callable[[], Spin], args: Sequence[str] | None) -> int:
    """
    Run a node until a signal arrives.

    So SIGINT and SIGTERM end it cleanly even while it is starting.

    :param purpose: sentences for ``--help``.
    :param load: imports the node, and returns the function that runs it until its second argument is true.
    :param args: command line without the program's name; None: that of the process.
    :returns: exit code: 0; 2, with one line on stderr, if an argument, a parameter or ROS cannot be used.
    """
    args = list(sys.argv[1:] if args is None else args)
    if args in (['-h'], ['--help']):
        sys.stdout.write(f'usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE ...]\n\n'
                         f'{purpose}  Ends on SIGINT or SIGTERM.\n')
        return 0
    stop = StopFlag()
    stop.listen()
    try:
        return load()(args, stop)
    except ImportError as error:
        if stop():  # an import that a signal disturbs may fail in any way
            return 0
        sys.stderr.write(f'{program}: {error}; source a ROS 2 Jazzy installation, and install what README.md '
                         'of the package names: rosdep install, and pip install -r requirements.txt\n')
        return 2
    finally:
        stop.ignore()
        remove_unfinished()
