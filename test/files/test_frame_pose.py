# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""With frame_pose, a camera that looks down at an angle gives the trials of the table's frame."""

from dataclasses import replace

import numpy as np
import pytest
from toy_messages import toy_trials

from dlo_calibration.calibration.options import FileOptions, Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import (
    Request,
    request_manipulations,
    request_trials,
    TrialRequest,
    write_request,
)
from dlo_calibration.files.session import read_session, session_manipulations, trial_records
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, TwoHands
from dlo_calibration.model.pose import Pose

CAMERA = Pose([0.2, -0.1, 1.5], [0.95, 0.05, 0.02, 0.3])  # in the table's frame
TEXT = str(CAMERA)


@pytest.fixture
def seen():
    """Give two trials in the frame of the camera."""
    return [CAMERA.inverse.trial(trial) for trial in toy_trials(2)]


def assert_on_the_table(trials):
    for trial, true in zip(trials, toy_trials(2), strict=True):
        assert np.allclose(trial.initial.points, true.initial.points, atol=1e-12)
        assert np.allclose(trial.goals[0].chain.points, true.goals[0].chain.points, atol=1e-12)
        for hand, right in zip(trial.hands, true.hands, strict=True):
            assert np.allclose(hand.positions, right.positions, atol=1e-12)
            assert np.allclose(hand.poses(hand.times)[1], right.poses(hand.times)[1], atol=1e-12)


def record(path, trials, **options):
    with SessionWriter(path, options) as writer:
        for message in trial_records(trials, 'camera'):
            writer.write(message.topic, message.type, message.data, message.log_time)
        return writer.path


def test_a_recorded_session_holds_the_messages_as_they_came_and_the_pose(tmp_path, seen):
    session = read_session(record(tmp_path / 'session', seen, frame_pose=TEXT))
    assert_on_the_table(session.trials)
    raw = read_session(record(tmp_path / 'raw', seen)).trials
    assert np.allclose(raw[0].initial.points, seen[0].initial.points)
    manipulations, _ = session_manipulations(session, session.options)
    assert np.allclose(manipulations[0].start.points, toy_trials(1)[0].initial.points, atol=1e-12)


def test_frame_pose_of_a_request_and_of_the_flag(tmp_path, seen, command):
    request = Request(tuple(map(TrialRequest.of, seen)), FileOptions({'frame_pose': TEXT}))
    trials, _ = request_trials(request, request.file_options.options())
    assert_on_the_table(trials)
    manipulations = request_manipulations(request, request.file_options.options())
    assert np.allclose(manipulations[1].start.points, toy_trials(2)[1].initial.points, atol=1e-12)
    write_request(tmp_path / 'request.xml', Request(request.trials))
    _, wrong, _ = command('info', tmp_path / 'request.xml', '--json')
    assert 'a DLO' in wrong['problems'][0]
    _, right, _ = command('info', tmp_path / 'request.xml', '--json', '--frame-pose', TEXT)
    assert right['problems'] == []
    code, _, errors = command('info', tmp_path / 'request.xml', '--frame-pose', 'table')
    assert code == 2
    assert 'only the node looks up' in errors[-1]


@pytest.mark.parametrize('action', [
    LiftAndHold(point=0, speed=1.0), GraspAndPlace(point=1, direction=(1, 2, 0), distance=0.1, speed=1.0),
    Drag(fraction=0.9, to=(0.3, 0.1, 0.0), speed=1.0), TwoHands(points=(0, -1), height=0.05, speed=1.0)],
    ids=lambda action: action.name)
def test_a_named_action_is_done_in_the_frame_of_the_table(action):
    level = replace(TrialRequest.of(toy_trials(1)[0]), actions=(action,))
    camera = CAMERA.inverse
    aim = {name: tuple(move(np.array(value)).tolist())
           for name, move in (('to', camera.points), ('direction', camera.vectors))
           if (value := getattr(action, name, None)) is not None}
    tilted = Request((replace(TrialRequest.of(camera.trial(toy_trials(1)[0])),
                              actions=(replace(action, **aim),)),))
    (trial,), refusals = request_trials(tilted, Options(frame_pose=TEXT))
    assert refusals == ()
    for hand, right in zip(trial.hands, level.trial().hands, strict=True):
        assert np.allclose(hand.positions, right.positions, atol=1e-12)
    placed, = request_manipulations(tilted, Options(frame_pose=TEXT))
    right = level.manipulation()
    path, = (step.actions[0].action(right.start) for step in placed.steps)
    assert np.allclose(path.hands[0].positions, trial.hands[0].positions)


@pytest.mark.parametrize('text', ['0 0 1', '0,0,1,0,0,0,1', '7seven'])
def test_a_frame_pose_that_is_neither_a_pose_nor_a_name_is_refused(text):
    with pytest.raises(InputError, match='frame_pose'):
        Options(frame_pose=text)
