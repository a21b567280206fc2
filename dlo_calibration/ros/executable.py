# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The executables of the nodes: each installs its signal handlers before it loads ROS."""

from __future__ import annotations

from importlib import import_module
import sys
from typing import Sequence

from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import remove_unfinished

#: Program -> module and class of its node, and what ``--help`` says of it.
PROGRAMS = {
    'calibrator': ('dlo_calibration.ros.calibrator_node', 'CalibratorNode',
                   'Calibrates a deformable linear object from messages.'),
    'planner': ('dlo_calibration.ros.planner_node', 'PlannerNode',
                'Plans actions that bring a calibrated deformable linear object to a goal.'),
    'tracker': ('dlo_calibration.ros.tracker_node', 'TrackerNode',
                'Follows a deformable linear object, and hands with tags, in the images of a camera.'),
}


def calibrator() -> int:
    """Run the calibrator with the command line of the process, as `execute` does."""
    return execute('calibrator', sys.argv[1:])


def planner() -> int:
    """Run the planner with the command line of the process, as `execute` does."""
    return execute('planner', sys.argv[1:])


def tracker() -> int:
    """Run the tracker with the command line of the process, as `execute` does."""
    return execute('tracker', sys.argv[1:])


def execute(program: str, args: Sequence[str]) -> int:
    """
    Run a node until a signal arrives; SIGINT and SIGTERM end it cleanly even while it is starting.

    :param program: one of PROGRAMS.
    :param args: command line without the program's name.
    :returns: exit code: 0; 2, with one line on stderr, if an argument, a parameter or ROS cannot be used.
    """
    module, node, purpose = PROGRAMS[program]
    if list(args) in (['-h'], ['--help']):
        sys.stdout.write(f'usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE ...]\n\n'
                         f'{purpose}  Ends on SIGINT or SIGTERM.\n')
        return 0
    stop = StopFlag()
    stop.listen()
    try:
        from dlo_calibration.ros.graph_node import spin

        return spin(program, getattr(import_module(module), node), args, stop)
    except ImportError as error:
        if stop():  # a signal can make an import fail in any way
            return 0
        sys.stderr.write(f'{program}: {error}; source a ROS 2 Jazzy installation, and install what README.md '
                         'of the package names: rosdep install, and pip install -r requirements.txt\n')
        return 2
    finally:
        stop.ignore()
        remove_unfinished()


if __name__ == '__main__':
    sys.exit(execute(sys.argv[1], sys.argv[2:]))
