# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A live node in the process of the test, with the toy as its engine."""

from contextlib import contextmanager

import pytest
from toy_simulator import ToySimulator
from without_drawings import leave_out_drawings, leave_out_slices

QUICK = {'calibrate': ['flexibility', 'friction'], 'evaluations': 4, 'workers': 1}
LOG_WARN = 30  # rcl_interfaces/msg/Log


@contextmanager
def live_node(environment, folder, toy=None, **parameters):
    """Give the robot of `graph` with a node in this process, which tells at once; skip without ROS."""
    from rclpy.parameter import Parameter
    from ros_robot import robot_of

    from dlo_calibration.ros.calibrator_node import CalibratorNode

    with robot_of(environment) as robot, pytest.MonkeyPatch.context() as patch:
        leave_out_drawings(patch.setattr)
        leave_out_slices(patch.setattr)
        patch.setattr('dlo_calibration.ros.node_session.NodeSession.status_period', 0.05)
        robot.calibrator = CalibratorNode(
            lambda _: toy or ToySimulator(), context=robot.context, parameter_overrides=[
                Parameter(name, value=value)
                for name, value in {**QUICK, 'output_directory': str(folder), **parameters}.items()])
        robot.executor.add_node(robot.calibrator)
        try:
            robot.matched()
            yield robot
        finally:
            robot.calibrator.close()


def robot_types():
    """Return the message classes of the graph."""
    from ros_robot import TYPES

    return TYPES
