# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Options of a plan as parameters of a node: the parameter file, lists that are empty, refusals."""

from pathlib import Path

import pytest

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')

from rclpy.context import Context  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

from dlo_calibration.ros.graph_node import OptionsNode  # noqa: E402
from dlo_calibration.ros.planner_session import PlannerOptions  # noqa: E402

FILE = Path(__file__).resolve().parents[2] / 'config' / 'planner.yaml'


@pytest.fixture
def node(ros_environment):
    context = Context()
    rclpy.init(args=['--ros-args', '--params-file', str(FILE), '-p', 'tolerance:=2.5'], context=context,
               signal_handler_options=SignalHandlerOptions.NO)
    made = OptionsNode('planner', PlannerOptions, context=context)
    yield made
    made.destroy_node()
    context.try_shutdown()


def test_a_node_starts_with_the_file_and_its_boxes_can_be_set_and_removed(node):
    assert node.options() == PlannerOptions(tolerance=2.5)
    box = Parameter('no_go', Parameter.Type.STRING_ARRAY, ['0 0 0 1 1 1'])
    none = Parameter('no_go', Parameter.Type.BOOL_ARRAY, [])  # what `ros2 param set /planner no_go []` sends
    for given, boxes in ((box, ('0 0 0 1 1 1',)), (none, ()), (box, ('0 0 0 1 1 1',))):
        assert node.set_parameters_atomically([given]).successful
        assert node.options().no_go == boxes
    speed = Parameter('speed', Parameter.Type.INTEGER, 1)
    assert node.set_parameters_atomically([speed]).successful
    assert node.options().speed == 1.0


@pytest.mark.parametrize('name, value, words', [
    ('reach_2', 'ring 0 0 1 2', "parameter reach_2: 'ring 0 0 1 2'; expected 'box x0 y0 z0 x1 y1 z1'"),
    ('hands', 3, 'parameter hands: 3; expected 1 to 2'),
    ('mode', 'hide', "parameter mode: 'hide'; expected one of plan, publish"),
    ('mass', 1.0, "parameter: 'mass'; expected one of ")])
def test_a_bad_value_is_refused_in_one_sentence_and_changes_nothing(node, name, value, words):
    answer = node.set_parameters_atomically([Parameter(name, value=value)])
    assert not answer.successful and answer.reason.startswith(words)
    assert node.options() == PlannerOptions(tolerance=2.5)
