# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The node with the toy, without drawings: `toy_calibrator.py SECONDS_PER_SIMULATION [--ros-args ...]`."""

import functools
import sys

from dlo_calibration.signals import StopFlag


def make_toy(seconds, options):
    """Return a toy that takes `seconds` for a simulation."""
    from toy_simulator import ToySimulator

    return ToySimulator(seconds)


def main():
    """Run it, as `dlo_calibration.ros.executable` runs the real one."""
    stop = StopFlag()
    stop.listen()
    from without_drawings import leave_out_drawings, leave_out_slices

    from dlo_calibration.ros.calibrator_node import CalibratorNode
    from dlo_calibration.ros.graph_node import spin

    leave_out_drawings()
    leave_out_slices()
    make_node = functools.partial(CalibratorNode, functools.partial(make_toy, float(sys.argv[1])))
    code = spin('calibrator', make_node, sys.argv[2:], stop)
    stop.ignore()
    return code


if __name__ == '__main__':
    sys.exit(main())
