# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where frame_pose names the table's frame, the node takes the pose from tf2, and messages wait for it."""

import re
import sys
import time
from types import ModuleType, SimpleNamespace

from live_node import live_node, robot_types
import numpy as np
import pytest
from toy_messages import MINUTE, toy_trials, trial_messages

from dlo_calibration.errors import InputError
from dlo_calibration.files.session import read_session
from dlo_calibration.model.pose import Pose

CAMERA = Pose([0.2, -0.1, 1.5], [0.95, 0.05, 0.02, 0.3])


class Buffer:
    """The part of tf2_ros.Buffer that is used; it knows what a test puts into `poses`."""

    poses = {}

    def lookup_transform(self, target, source, _):
        if (target, source) not in self.poses:
            raise LookupError(f'"{target}" passed to lookupTransform argument target_frame does not exist')
        pose = self.poses[target, source]
        return SimpleNamespace(transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip('xyz', pose.position, strict=True))),
            rotation=SimpleNamespace(**dict(zip('xyzw', pose.orientation, strict=True)))))


@pytest.fixture
def tf2(monkeypatch):
    """Put a stand-in in place of tf2_ros, which is on no index; return what it knows."""
    module = ModuleType('tf2_ros')
    module.Buffer, module.TransformException = Buffer, LookupError
    module.TransformListener = lambda buffer, node: None
    monkeypatch.setattr(Buffer, 'poses', {})
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    return Buffer.poses


def test_messages_wait_for_the_transform_and_are_then_in_the_tables_frame(ros_environment, tmp_path, tf2):
    with live_node(ros_environment, tmp_path, frame_pose='table') as robot:
        trial = toy_trials(1)[0]
        robot.send(trial_messages(robot_types(), CAMERA.inverse.trial(trial), MINUTE, 'camera'))
        words = "no transform from 'camera' to 'table'"
        robot.until(lambda: words in robot.status['last_refusal'], 'silence')
        assert robot.status['trials'] == '0'
        tf2['table', 'camera'] = CAMERA
        robot.until_status(trials='1')
        assert robot.call('start').success
        robot.until_result()
    session = read_session(next(tmp_path.glob('dlo_session_*')))
    assert Pose.of(session.options.frame_pose).position.tolist() == CAMERA.position.tolist()
    assert np.allclose(session.trials[0].initial.points, trial.initial.points, atol=1e-9)


def test_messages_from_before_the_frame_was_named_wait_for_the_transform_too(ros_environment, tmp_path, tf2):
    from rclpy.parameter import Parameter

    with live_node(ros_environment, tmp_path) as robot:
        trial = toy_trials(1)[0]
        robot.send(trial_messages(robot_types(), CAMERA.inverse.trial(trial), MINUTE, 'camera'))
        robot.until_status(trials='1')
        assert robot.calibrator.set_parameters([Parameter('frame_pose', value='table')])[0].successful
        answer = robot.call('start')
        assert answer.message == 'no pose of their frame came yet; start follows when they are read'
        tf2['table', 'camera'] = CAMERA
        robot.until_result()
        collected = robot.calibrator.session.collecting.collector.trials[0]
        assert np.allclose(collected.initial.points, trial.initial.points, atol=1e-9)


def test_without_tf2_a_name_is_refused_in_one_sentence(ros_environment, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    with pytest.raises(InputError, match="the name 'table'; expected the numbers x y z .* not installed"):
        with live_node(ros_environment, tmp_path, frame_pose='table'):
            pass


def test_a_new_table_height_applies_to_the_next_messages(ros_environment, tmp_path):
    from rclpy.parameter import Parameter

    with live_node(ros_environment, tmp_path) as robot:
        lifted = [Pose([0.0, 0.0, 0.75], [0.0, 0.0, 0.0, 1.0]).trial(trial) for trial in toy_trials(2)]
        robot.send(trial_messages(robot_types(), lifted[0], MINUTE))
        robot.until(lambda: 'trial 1: a DLO' in robot.status['last_refusal'], 'silence')
        answer, = robot.calibrator.set_parameters([Parameter('table_height', value=0.75)])
        assert answer.successful
        robot.send(trial_messages(robot_types(), lifted[1], 2 * MINUTE))
        robot.until_status(trials='2')
        assert 'trial 2' not in robot.status['last_refusal']


@pytest.mark.long
def test_a_stream_is_collected_anew_while_services_answer_and_a_start_waits_for_it(
        ros_environment, tmp_path, monkeypatch):
    from rclpy.parameter import Parameter
    from ros_robot import values

    from dlo_calibration.ros import calibrator_node

    lifted = Pose([0.0, 0.0, 0.75], [0.0, 0.0, 0.0, 1.0]).trial(toy_trials(1)[0])
    with live_node(ros_environment, tmp_path) as robot:
        pairs = trial_messages(robot_types(), lifted, MINUTE)
        robot.send(pairs)
        for k in range(1, 201):
            pairs[-1][1].header.stamp.nanosec = 4_000_000 * k
            robot.send(pairs[-1:])
        robot.until(lambda: len(robot.calibrator.session.collecting.collector._known) == len(pairs) + 200)
        session, anew = robot.calibrator.session, robot.calibrator.session.collect_anew
        monkeypatch.setattr(session, 'collect_anew', lambda: (time.sleep(0.005), anew()))
        monkeypatch.setattr(calibrator_node, 'ANSWER', 1e-4)
        pose = Parameter('frame_pose', value='0 0 -0.75 0 0 0 1')
        assert robot.calibrator.set_parameters([pose])[0].successful
        robot.calibrator._work()
        robot.calibrator.session.tick()
        robot.until(lambda: any('anew' in values(message.status[0])['detail']
                                for message in robot.heard['status']))
        answer = robot.call('start')
        assert answer.success
        assert re.fullmatch('[0-9]+ messages came before; start follows when they are read', answer.message)
        robot.until_result()
        assert robot.calibrator.session.collecting.collector.trials[0].initial.points[:, 2].max() < 0.5
