# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A live node in the process of the test, with the toy as its engine."""

from contextlib import contextmanager

from toy_simulator import ToySimulator

QUICK = {'evaluations': 4, 'workers': 1}
LOG_WARN = 30  # rcl_interfaces/msg/Log


@contextmanager
def live_node(environment, folder, toy=None, **parameters):
    """Give the robot of `test_node` with a node in this process; skip where there is no ROS."""
    import test_node

    with test_node.robot_of(environment) as robot:
        robot.calibrator = test_node.CalibratorNode(
            lambda _: toy or ToySimulator(), context=robot.context, parameter_overrides=[
                test_node.Parameter(name, value=value)
                for name, value in {**QUICK, 'output_directory': str(folder), **parameters}.items()])
        robot.executor.add_node(robot.calibrator)
        try:
            robot.matched()
            yield robot
        finally:
            robot.calibrator.close()


def robot_types():
    """Return the message classes of the graph."""
    from test_node import TYPES

    return TYPES
