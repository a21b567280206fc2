# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The executable `planner`."""

from __future__ import annotations

import sys
from typing import Sequence

from dlo_calibration.ros.executable import execute, Spin


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the node until a signal arrives.

    :param args: command line without the program's name; None: that of the process.
    :returns: exit code: 0; 2, with one line on stderr, if an argument, a parameter or ROS cannot be used.
    """
    return execute('planner', 'Plans actions that bring a calibrated deformable linear object to a goal.',
                   _load, args)


def _load() -> Spin:
    from dlo_calibration.ros.planner_node import spin

    return spin


if __name__ == '__main__':
    sys.exit(main())
