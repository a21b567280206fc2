# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The examples do what they say, with the node."""

from pathlib import Path
import signal
import subprocess
import sys

from graph import child, ended

from dlo_calibration.files.session import read_session

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
PATIENCE = 60.0  # s


def robot_session(environment):
    done = subprocess.run([sys.executable, EXAMPLES / 'robot_session.py'], env=environment, text=True,
                          capture_output=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_robot_session_sends_a_trial_starts_and_hears_the_result(ros_environment, tmp_path):
    with child(ros_environment, tmp_path / 'out', '-p', 'evaluations:=5') as process:
        heard = robot_session(ros_environment)
        again = robot_session(ros_environment)
        process.send_signal(signal.SIGINT)
        assert ended(process) == 0
    for name in ('flexibility', 'elasticity', 'friction', 'self_collision', 'calibration'):
        assert f'[robot]: {name}: ' in heard
    assert 'calibrating on 1 trial(s), 5 evaluations' in heard
    assert 'calibrating on 2 trial(s), 5 evaluations' in again
    folder, = (tmp_path / 'out').iterdir()
    assert len(read_session(folder).messages) == 6
