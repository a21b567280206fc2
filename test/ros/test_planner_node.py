# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The planner over a real graph: what robot software sees."""

from dataclasses import replace
import json
import os
import signal

import numpy as np
from planner_robot import PlannerRobot
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from ros_robot import ended, LATCHED, python_process, robot_of, TYPES
from toy_planner import CHAIN, description, RESULT, ToyPlan

from dlo_calibration import Chain, InputError
from dlo_calibration.files.result import read_description, read_result, write_result
from dlo_calibration.ros import planner_session
from dlo_calibration.ros.executable import execute
from dlo_calibration.ros.graph_node import spin
from dlo_calibration.ros.planner_node import PlannerNode

STRING = TYPES.find('std_msgs/msg/String')


@pytest.fixture
def robot(ros_environment, monkeypatch):
    """Give the robot; the node searches as `start` says."""
    monkeypatch.setattr(planner_session, 'plan', planner_session.plan)  # restores it afterwards
    with robot_of(ros_environment, PlannerRobot) as connected:
        yield connected
        if connected.calibrator is not None:
            connected.calibrator.close()


def start(robot, plan=None, remapped=(), **parameters):
    """Start the node in this process, with a search that a test makes up."""
    planner_session.plan = plan or ToyPlan()
    robot.calibrator = PlannerNode(
        context=robot.context, cli_args=list(remapped),
        parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()])
    robot.executor.add_node(robot.calibrator)
    return robot.calibrator


def listened(robot):
    """Return a list that receives the descriptions."""
    heard = []
    robot.node.create_subscription(STRING, '/planner/dlo_description', heard.append, LATCHED)
    return heard


def child(environment, *arguments):
    """Run the executable in a process of its own."""
    return python_process(environment, '-m', 'dlo_calibration.ros.executable', 'planner', '--ros-args',
                          *arguments)


@pytest.mark.long
def test_plans_of_the_real_search_bring_the_dlo_nearer_and_ctrl_c_ends_it_while_it_plans(ros_environment):
    options = ('-p', f'description:={RESULT}', '-p', 'actions:=1', '-p', 'draws:=0', '-p', 'workers:=1',
               '-p', 'tolerance:=0.01', '-p', 'simulation:=[nodes=15, time_step=0.006]')
    along = np.linspace(0, CHAIN.length, len(CHAIN))
    arc = np.stack([np.sin(2 * along) / 2, (1 - np.cos(2 * along)) / 2, 0 * along], axis=1)
    goal = Chain(CHAIN.points[0] * (1, 1, 0) + arc + (0, 0, CHAIN.points[:, 2].mean()))
    with child(ros_environment, *options) as process, \
            robot_of(ros_environment, PlannerRobot, reliability=ReliabilityPolicy.BEST_EFFORT) as robot:
        robot.matched()
        robot.send_chains(CHAIN, goal)
        assert robot.plan()['state'] == 'done', robot.status
        action, = json.loads(robot.heard['steps'][-1].data)['actions']
        predicted = np.array(action['predicted'])
        before, after = (np.linalg.norm(points - goal.points, axis=1).mean()
                         for points in (CHAIN.points, predicted))
        assert after < 0.7 * before
        assert float(robot.status['error_before_mm']) == pytest.approx(1e3 * before, rel=0.01)
        robot.until(lambda: robot.heard['action'] and robot.heard['progress'])
        for _ in range(10):  # a tracker's stream: the newest chain may arrive after the request
            robot.send_chains(Chain(predicted), goal)  # a robot did just that
            assert robot.plan()['state'] == 'done', robot.status
            if float(robot.status['error_before_mm']) == pytest.approx(1e3 * after, rel=0.01):
                break
        else:
            pytest.fail(f'it plans from an old chain: {robot.status}')
        robot.until(lambda: len(robot.heard['action']) == int(robot.status['plans']))
        actions = len(robot.heard['action'])
        assert robot.call('plan').success
        for _ in range(2):  # to its processes too, as Ctrl-C in a terminal
            os.killpg(process.pid, signal.SIGINT)
        assert ended(process) == 0
        assert len(robot.heard['action']) == actions  # nobody should execute an interrupted plan


@pytest.mark.parametrize('topic', ['/planner/dlo_description', '/calibrator/dlo_description'])
def test_a_description_that_was_latched_before_is_heard_and_none_is_published(robot, topic):
    publisher = robot.node.create_publisher(STRING, topic, LATCHED)
    publisher.publish(STRING(data=description().data))
    node = start(robot, remapped=('--ros-args', '-r', f'~/dlo_description:={topic}'))
    robot.matched()
    robot.until(lambda: robot.status['description'] == '~/dlo_description')
    assert node.count_publishers(topic) == 1
    robot.send_chains()
    assert robot.plan()['state'] == 'done'


def test_a_description_that_is_not_latched_gives_a_warning(robot):
    start(robot)
    robot.node.create_publisher(STRING, '/planner/dlo_description', 1)
    robot.until(lambda: any('durability transient local' in entry.msg for entry in robot.heard['log']))


def test_a_description_from_a_file_is_published_latched_and_can_be_replaced(robot, tmp_path):
    plan = ToyPlan()
    node = start(robot, plan, description=str(RESULT))
    robot.matched()
    late = listened(robot)
    robot.until(lambda: late)
    assert read_description(late[0].data).values == read_result(RESULT).values
    assert not node.get_subscriptions_info_by_topic('/planner/dlo_description')[1:]  # that of the robot alone
    other = tmp_path / 'other.xml'
    write_result(other, replace(read_result(RESULT), length=0.61))
    refused, = node.set_parameters([Parameter('description', value=str(tmp_path / 'none.xml'))])
    assert not refused.successful and 'none.xml' in refused.reason
    assert node.options().description == str(RESULT)
    assert node.set_parameters([Parameter('description', value=str(other))])[0].successful
    robot.until(lambda: len(late) == 2)
    assert read_description(late[1].data).length == 0.61
    robot.send_chains()
    robot.plan()
    assert plan.calls[0][0].length == 0.61


def test_a_robot_that_comes_late_gets_the_steps_and_no_old_action(robot):
    start(robot, description=str(RESULT))
    robot.matched()
    robot.send_chains()
    robot.plan()
    robot.until(lambda: robot.heard['action'])
    late = {'steps': [], 'action': [], 'markers': [], 'status': []}
    for name, heard in late.items():
        robot.node.create_subscription(TYPES.find(robot.outputs[name]), f'/planner/{name}', heard.append,
                                       10 if name == 'action' else LATCHED)
    robot.until(lambda: all(late[name] for name in late if name != 'action'))
    assert late['steps'][0].data == robot.heard['steps'][-1].data
    assert not late['action']


def test_mode_publish_serves_the_description_and_nothing_else(robot):
    node = start(robot, mode='publish', description=str(RESULT))
    heard = listened(robot)
    robot.until(lambda: heard)
    assert read_description(heard[0].data).values == read_result(RESULT).values
    published = {name for name, _ in node.get_publisher_names_and_types_by_node('planner', '/')}
    assert {name for name in published if name.startswith('/planner/')} == {'/planner/dlo_description'}
    services = {name for name, _ in node.get_service_names_and_types_by_node('planner', '/')}
    assert not services & {'/planner/plan', '/planner/stop'}
    refused, = node.set_parameters([Parameter('mode', value='plan')])
    assert not refused.successful and 'start the node again' in refused.reason


@pytest.mark.parametrize('parameters, words', [
    ({'mode': 'publish'}, 'parameter description'),
    ({'description': 'none.xml'}, 'none.xml'),
    ({'description': str(RESULT.parent)}, 'a folder'),
    ({'reach_1': 'ball 0 0'}, 'parameter reach_1')])
def test_parameters_that_cannot_be_used_are_refused_when_the_node_is_made(robot, parameters, words):
    with pytest.raises(InputError, match=words):
        start(robot, **parameters)


def test_a_bad_command_line_gives_one_line_and_exit_code_2(ros_environment, capfd):
    for arguments in (('-p', 'description:=none.xml'), ('-p', 'tolerance:=-1.0'), ('--nonsense',)):
        assert spin('planner', PlannerNode, ['--ros-args', *arguments], lambda: False) == 2
        output, errors = capfd.readouterr()
        line, = errors.splitlines()
        assert output == '' and line.startswith('planner: ')


def test_help_says_how_it_is_used(capsys):
    assert execute('planner', ['--help']) == 0
    assert capsys.readouterr().out.startswith('usage: planner [--ros-args')
