# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The tracker over a real graph: a camera publishes, and a calibrator's topics get what it sends."""

import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_robot import Robot, robot_of, TYPES
from test_tracker_session import pixels, points, raw, START, xyz

from dlo_calibration.ros.tracker_node import TrackerNode
from dlo_calibration.ros.tracker_session import CHAIN, IMAGE, INPUT_TYPES, OUTPUT_TYPES


class Camera(Robot):
    """A camera, and whoever listens to the tracker."""

    name = 'tracker'
    inputs = {IMAGE: INPUT_TYPES[IMAGE]}
    outputs = {'status': OUTPUT_TYPES['status']}
    services = ('start', 'stop')


@pytest.fixture
def camera(ros_environment):
    """Give a camera that publishes with best effort, as drivers do."""
    with robot_of(ros_environment, Camera, reliability=ReliabilityPolicy.BEST_EFFORT) as connected:
        yield connected
        if connected.calibrator is not None:
            connected.calibrator.close()


def of_ros(message):
    """Return an image message of the ROS installation."""
    header = TYPES.header(START, 'camera')
    return TYPES.build('sensor_msgs/msg/Image', header=header, height=message.height, width=message.width,
                       encoding=message.encoding, is_bigendian=0, step=message.step,
                       data=TYPES.octets(bytes(message.data)))


def test_a_calibrator_hears_the_chains_of_a_camera(camera):
    node = TrackerNode(context=camera.context, cli_args=[], parameter_overrides=[
        Parameter('points', value=points())])
    camera.calibrator = node
    camera.executor.add_node(node)
    heard = []
    camera.node.create_subscription(TYPES.find(OUTPUT_TYPES[CHAIN]), '/tracker/chain', heard.append,
                                    QoSProfile(depth=10))
    message = of_ros(raw(pixels(), START))
    camera.matched()

    def tracked():
        camera.publishers[IMAGE].publish(message)
        camera.executor.spin_once(timeout_sec=0.05)
        return bool(heard)
    camera.until(tracked)
    assert heard[0].header.stamp.sec == START // 10**9
    assert heard[0].header.frame_id == 'table'
    assert xyz(heard[0]).shape == (21, 3)
    camera.until_status(state='tracking')
    assert camera.call('stop').success
    camera.until_status(state='stopped')
    refused = node.set_parameters([Parameter('points', value='no pixels')])[0]
    assert not refused.successful
    assert 'points' in refused.reason
