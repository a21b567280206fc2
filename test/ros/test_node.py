# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The node over a real graph: what robot software sees."""

import functools
import json
import logging
import os
import signal
import subprocess
import sys
import time

from live_node import LOG_WARN
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from ros_robot import child, ended, LATCHED, PATIENCE, robot_of, TYPES, values, whole
from rosgraph_msgs.msg import Clock
from toy_command import one_worker
from toy_messages import session_messages
from toy_simulator import ToySimulator
from wire import result_values

from dlo_calibration import InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import ACTION, GOAL, INITIAL, OUTPUT_TYPES, TRIAL_TYPES
from dlo_calibration.model.parameters import PAPER_PARAMETERS
from dlo_calibration.ros.calibrator_node import CalibratorNode
from dlo_calibration.ros.graph_node import spin

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')


@pytest.fixture
def start_node(ros_environment, tmp_path):
    """Give a function that starts the node in this process, with the toy, and returns the robot."""
    with robot_of(ros_environment) as robot:
        def start(toy=None, **parameters):
            parameters = {'output_directory': str(tmp_path), 'workers': 1, 'evaluations': 30, **parameters}
            robot.calibrator = CalibratorNode(
                functools.partial(lambda toy, _: toy, toy or ToySimulator()), context=robot.context,
                parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()])
            robot.executor.add_node(robot.calibrator)
            robot.matched()
            return robot

        yield start
        if robot.calibrator is not None:
            robot.calibrator.close()


def folders(path):
    return sorted(path.glob('dlo_session_*'))


def fitted(session, capsys, *flags):
    """Return the JSON of `fit` with the toy."""
    assert cli.main(one_worker(['fit', session, '--json', *flags]), lambda _: ToySimulator()) == 0
    return json.loads(capsys.readouterr().out)


def test_session_over_the_graph_gives_a_result_and_the_replay_the_same(start_node, tmp_path, capsys):
    robot = start_node(seed=7, workers=2)
    robot.send(session_messages(TYPES, 3))
    robot.until_status(state='collecting', trials='3')
    assert robot.call('start').success
    live = robot.until_result()
    assert [status.name for status in live.status] == [*PAPER_PARAMETERS, 'calibration']
    assert whole(live)['trials'] == '3'
    assert whole(live)['seed'] == '7'
    robot.until(lambda: robot.heard['progress'])
    last = values(robot.heard['progress'][-1].status[0])
    assert (last['evaluation'], last['evaluations']) == (whole(live)['evaluations'], '30')
    assert last['best_score'] == whole(live)['score']
    robot.calibrator.close()

    folder, = folders(tmp_path)
    replayed = fitted(folder, capsys)
    result = result_values(live)
    for name, estimate in replayed['parameters'].items():
        for key, value in estimate.items():
            assert repr(value) == repr(result[name][key]), (name, key)
    assert [repr(score) for score in replayed['scores']] == whole(live)['scores'].split()
    written = read_result(folder / 'result.xml')
    assert written.values == {name: estimate['value'] for name, estimate in replayed['parameters'].items()}
    page = (folder / 'report.html').read_text(encoding='utf-8')  # closing the node has waited for it
    assert f'dlo-calibration fit {folder.name}' in page
    assert page.count(' seen from above: ') == 3
    kinds = {record.name for record in read_session(folder).records}
    assert kinds | {'advice'} == {*TRIAL_TYPES, *OUTPUT_TYPES}


def test_a_late_listener_gets_the_latched_messages(start_node):
    robot = start_node()
    robot.send(session_messages(TYPES, 1))
    robot.until_status(trials='1')
    robot.call('start')
    robot.until_result()
    late = {}
    for name in OUTPUT_TYPES.keys() - {'progress'}:
        robot.node.create_subscription(TYPES.find(OUTPUT_TYPES[name]), f'/calibrator/{name}',
                                       functools.partial(late.__setitem__, name), LATCHED)
    robot.until(lambda: len(late.keys() - {'advice'}) == 4, 'something is not latched')
    robot.until(lambda: 'trial_1/simulated' in {marker.ns for marker in late['markers'].markers},
                'the markers do not show the result')
    assert values(late['status'].status[0])['state'] == 'done'
    assert whole(late['result']) == whole(robot.heard['result'][-1])
    assert late['dlo_description'].data.startswith('<?xml')


def test_requests_are_answered_while_it_calibrates_and_stop_gives_the_best_so_far(start_node):
    robot = start_node(ToySimulator(0.01), evaluations=10000)
    robot.send(session_messages(TYPES, 1))
    robot.until_status(trials='1')
    assert not robot.call('stop').success
    assert robot.call('start').success
    robot.until(lambda: robot.heard['progress'])
    robot.until_status(state='calibrating')
    for refused in ('start', 'reset'):
        answer = robot.call(refused)
        assert not answer.success
        assert 'under way' in answer.message
    before = len(robot.heard['progress'])
    robot.until(lambda: len(robot.heard['progress']) > before)
    assert robot.call('stop').success
    result = robot.until_result()
    assert whole(result)['stop_reason'] == 'stopped on request'
    assert 0 < int(whole(result)['evaluations']) < 10000
    assert robot.call('reset').success
    robot.until_status(state='collecting', trials='0')


def bad_cloud():
    (_, cloud), *_ = session_messages(TYPES, 1, first=5)
    cloud.header.stamp.sec = 0
    cloud.header.stamp.nanosec = 0
    return cloud


def test_refusal_reaches_status_and_log_and_the_trials_stay(start_node):
    robot = start_node()
    robot.send(session_messages(TYPES, 1))
    robot.until_status(trials='1')
    robot.send([(INITIAL, bad_cloud())])
    robot.until(lambda: robot.status['last_refusal'])
    for word in ('initial_chain', 'stamp of zero', 'header.stamp'):
        assert word in robot.status['last_refusal']
    assert robot.status['trials'] == '1'
    robot.until(lambda: any(log.msg == robot.status['last_refusal'] for log in robot.heard['log']))
    warning, = (log for log in robot.heard['log'] if log.msg == robot.status['last_refusal'])
    assert warning.level == LOG_WARN


def test_best_effort_publishers_are_heard(start_node, ros_environment):
    robot = start_node()
    with robot_of(ros_environment, reliability=ReliabilityPolicy.BEST_EFFORT) as tracker:
        def sees_all():
            robot.executor.spin_once(timeout_sec=0.01)
            return all(p.get_subscription_count() for p in tracker.publishers.values())

        tracker.until(sees_all, 'the subscriptions never matched')
        for pair in session_messages(TYPES, 1):
            tracker.publishers[pair[0]].publish(pair[1])
        robot.until_status(trials='1')
    robot.send(session_messages(TYPES, 1, first=1))  # reliable ones are heard as before
    robot.until_status(trials='2')


@pytest.mark.long
def test_burst_of_goal_chains_arrives_whole(start_node, tmp_path):
    robot = start_node(evaluations=3)
    initial, action, (_, goal) = session_messages(TYPES, 1)
    robot.send([initial, action])
    robot.until(lambda: robot.status['incomplete'].startswith('a goal_chain'))
    for k in range(500):
        goal.header.stamp.nanosec = 2_000_000 * k
        robot.publishers[GOAL].publish(goal)
    assert robot.call('start').success
    robot.until_result()
    robot.calibrator.close()
    session = read_session(folders(tmp_path)[0])
    assert sum(record.name == GOAL for record in session.records) == 500


@pytest.mark.long
def test_starts_by_itself_after_enough_trials(start_node):
    robot = start_node(start_after_trials=2)
    robot.send(session_messages(TYPES, 1))
    robot.until_status(trials='1')
    robot.send(session_messages(TYPES, 1, first=1))
    assert whole(robot.until_result())['trials'] == '2'


def test_warnings_of_the_package_are_in_the_log_of_the_node(start_node):
    robot = start_node()
    logging.getLogger('dlo_calibration.calibration.engines').warning('engine compiled knows no scene')
    robot.until(lambda: any(entry.msg == 'engine compiled knows no scene' and entry.level == LOG_WARN
                            for entry in robot.heard['log']))


def test_every_option_is_a_parameter_with_description_unit_and_range(start_node):
    node = start_node().calibrator
    for declaration in Options.declarations():
        descriptor = node.describe_parameter(declaration.name)
        assert declaration.description in descriptor.description
        assert declaration.unit in descriptor.description
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        if declaration.minimum is not None:
            assert (ranges[0].from_value, ranges[0].to_value) == (declaration.minimum, declaration.maximum)


def test_bad_value_is_refused_with_the_reason_and_changes_nothing(start_node):
    node = start_node().calibrator
    before = node.options()
    for name, value, reason in (
            ('search', 'magic', 'random'), ('calibrate', ['flexibility', 'colour'], 'colour'),
            ('calibrate', ['friction', 'friction'], 'different'), ('mass', -1.0, 'mass'),
            ('evaluations', -1, 'evaluations'), ('calibrate', ['auto', 'damping'], 'alone'),
            ('table', 3, 'BOOL')):
        answer, = node.set_parameters([Parameter(name, value=value)])
        assert not answer.successful
        assert reason in answer.reason
        assert node.options() == before


def test_integer_may_be_set_where_a_number_is_meant(start_node):
    node = start_node(table_height=1).calibrator
    assert node.options().table_height == 1.0
    assert node.set_parameters([Parameter('mass', value=2)])[0].successful
    assert node.options().mass == 2.0


def test_unknown_parameter_is_refused_when_the_node_is_made(start_node):
    with pytest.raises(InputError, match='masss'):
        start_node(masss=1.0)


@pytest.mark.parametrize(('number', 'workers'), [
    (signal.SIGINT, 2), pytest.param(signal.SIGTERM, 1, marks=pytest.mark.long)])
def test_signal_while_it_calibrates_ends_cleanly(ros_environment, tmp_path, number, workers):
    with child(ros_environment, tmp_path / 'out', '-p', f'workers:={workers}', '-p', 'evaluations:=10000',
               seconds=0.01) as process, robot_of(ros_environment) as robot:
        robot.send(session_messages(TYPES, 1))
        robot.until_status(trials='1')
        robot.call('start')
        robot.until(lambda: robot.heard['progress'])
        for _ in range(2):  # to its processes too, as Ctrl-C in a terminal or a service's stop
            os.killpg(process.pid, number)
        assert ended(process) == 0
    folder, = folders(tmp_path / 'out')
    session = read_session(folder)
    assert session.warnings == ()
    assert {kind for kind, _ in session.messages} == {INITIAL, ACTION, GOAL}
    assert session.outputs('result')  # the best so far is kept


@pytest.mark.parametrize(('number', 'delay'), [
    (signal.SIGTERM, 0.9), *(pytest.param(number, delay, marks=pytest.mark.long) for number, delay in (
        (signal.SIGINT, 0.5), (signal.SIGINT, 1.4), (signal.SIGTERM, 2.5)))])
def test_signal_at_any_time_while_it_starts_ends_cleanly(ros_environment, tmp_path, number, delay):
    marker = tmp_path / 'listening'
    program = (
        'import sys, pathlib; from dlo_calibration.signals import StopFlag; '
        f'stop = StopFlag(); stop.listen(); pathlib.Path({str(marker)!r}).touch(); '
        'from dlo_calibration.ros.calibrator_node import CalibratorNode; '
        'from dlo_calibration.ros.graph_node import spin; '
        "code = spin('calibrator', CalibratorNode, sys.argv[1:], stop); stop.ignore(); sys.exit(code)")
    process = subprocess.Popen(
        [sys.executable, '-c', program, '--ros-args', '-p', f'output_directory:={tmp_path}'], text=True,
        env={**ros_environment, 'PYTHONPATH': os.pathsep.join(sys.path)}, stderr=subprocess.PIPE)
    try:
        begun = time.monotonic()
        while not marker.exists():
            assert time.monotonic() - begun < PATIENCE
            time.sleep(0.005)
        time.sleep(delay - 0.5)
        process.send_signal(number)
        assert ended(process) == 0
    finally:
        process.kill()
    for folder in folders(tmp_path):
        assert (folder / 'metadata.yaml').exists()


@pytest.mark.long
def test_killed_node_leaves_a_readable_session(ros_environment, tmp_path, capsys):
    with child(ros_environment, tmp_path / 'out', '-p', 'workers:=2', '-p', 'evaluations:=10000',
               seconds=0.01) as process, robot_of(ros_environment) as robot:
        robot.send(session_messages(TYPES, 2))
        robot.until_status(trials='2')
        robot.call('start')
        robot.until(lambda: robot.heard['progress'])
        process.kill()
        process.wait()
    folder, = folders(tmp_path / 'out')
    session = read_session(folder)
    assert sorted(kind for kind, _ in session.messages) == sorted([INITIAL, ACTION, GOAL] * 2)
    assert session.outputs('progress')
    assert fitted(folder, capsys, '--evaluations', '10')['trials'] == 2


BAD = (('-p', 'masss:=1.0'), ('-p', 'mass:=-1.0'), ('-p', 'mass:=heavy'), ('-p', 'mass'), ('--nonsense',))


def one_line(errors):
    line, = errors.splitlines()
    return line.startswith('calibrator: ')


@pytest.mark.parametrize('arguments', BAD)
def test_a_bad_command_line_gives_one_line_and_exit_code_2(ros_environment, arguments, capfd):
    assert spin('calibrator', CalibratorNode, ['--ros-args', *arguments], lambda: False) == 2
    output, errors = capfd.readouterr()
    assert output == ''
    assert one_line(errors)


@pytest.mark.long
def test_bad_command_line_ends_the_process(ros_environment, tmp_path):
    with child(ros_environment, tmp_path / 'out', *BAD[0]) as process:
        output, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, output) == (2, '')
    assert one_line(errors)


@pytest.mark.long
def test_messages_dropped_in_a_flood_are_counted_and_reported(start_node, tmp_path, capsys):
    robot = start_node()
    initial, action, (_, goal) = session_messages(TYPES, 1)
    robot.send([initial, action, (GOAL, goal)])
    robot.until_status(trials='1')
    seconds = goal.header.stamp.sec
    for k in range(1, 3000):  # the node does nothing meanwhile, as it shares this thread
        goal.header.stamp.sec, goal.header.stamp.nanosec = seconds + k // 1000, k % 1000 * 1_000_000
        robot.publishers[GOAL].publish(goal)
    robot.until(lambda: int(robot.status['dropped']), 'nothing was dropped')
    robot.until(lambda: not len(robot.calibrator._inbox))
    robot.until(lambda: any('message(s) were dropped' in log.msg for log in robot.heard['log']))
    robot.calibrator.close()
    folder, = folders(tmp_path)
    heard = sum(record.name == GOAL for record in read_session(folder).records)
    assert heard + int(robot.status['dropped']) == 3000
    assert cli.main(['info', str(folder)]) == 0
    assert f'{robot.status["dropped"]} goal_chain message(s) came faster' in capsys.readouterr().out


def test_another_node_of_the_same_name_is_refused_once_with_the_remedy(start_node, tmp_path):
    robot = start_node()
    first = robot.calibrator
    try:
        start_node()
        robot.until(lambda: any('another node is named /calibrator' in log.msg and '__node:=NAME' in log.msg
                                for log in robot.heard['log']))
        robot.until(lambda: 'another node is named' in robot.status.get('last_refusal', ''))
    finally:
        first.close()
    assert len(folders(tmp_path)) == 2  # each has a session of its own


def test_simulated_time_that_jumps_back_begins_another_session(start_node, tmp_path):
    robot = start_node(use_sim_time=True)
    clock = robot.node.create_publisher(Clock, '/clock', 10)

    def tell(seconds):
        message = Clock()
        message.clock.sec = seconds
        clock.publish(message)
        robot.until(lambda: robot.calibrator.stamp() == seconds * 10**9)

    robot.until(lambda: clock.get_subscription_count())
    tell(60)
    robot.send(session_messages(TYPES, 1))
    robot.until_status(trials='1')
    tell(90)
    assert len(folders(tmp_path)) == 1
    begun = time.monotonic()
    robot.until(lambda: time.monotonic() - begun > 1.1)
    tell(50)
    robot.until_status(trials='0')
    assert robot.status['last_refusal'].startswith(
        'the clock went back by 40 s (from 90.000 to 50.000): a new session begins')
    robot.send(session_messages(TYPES, 1))  # the same stamps again
    robot.until_status(trials='1')
    robot.calibrator.close()
    assert [len(read_session(folder).trials) for folder in folders(tmp_path)] == [1, 1]
