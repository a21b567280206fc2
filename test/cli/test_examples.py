# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The examples do what they say."""

import os
from pathlib import Path
import re
import signal
import subprocess
import sys

import pytest
from ros_robot import child, ended

from dlo_calibration.files.session import read_session

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 60.0  # s


def example(environment, name, *words):
    """Execute an example; return what it logs or prints."""
    done = subprocess.run([sys.executable, ROOT / 'examples' / name, *words], text=True, capture_output=True,
                          env={**environment, 'PYTHONPATH': os.pathsep.join(sys.path)}, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return done.stderr + done.stdout


@pytest.mark.long
def test_robot_session_sends_trials_starts_and_hears_the_result(ros_environment, tmp_path):
    with child(ros_environment, tmp_path / 'out', '-p', 'evaluations:=5', '-p', 'workers:=1') as process:
        heard = example(ros_environment, 'robot_session.py')
        process.send_signal(signal.SIGINT)
        assert ended(process) == 0
    assert heard.count('last refusal: none') == 4
    assert 'calibrating on 4 trial(s), at most 5 evaluations' in heard
    for name in ('flexibility', 'elasticity', 'friction', 'self_collision', 'calibration'):
        assert f'[robot]: {name}: ' in heard
    assert 'The simulated points are' in heard  # the findings
    folder, = (tmp_path / 'out').iterdir()
    assert len(read_session(folder).trials) == 4


@pytest.mark.long
def test_closed_loop_plans_and_executes_until_the_goal_is_reached(ros_environment):
    planner = subprocess.Popen(
        [sys.executable, '-m', 'dlo_calibration.ros.executable', 'planner', '--ros-args', '-p', 'workers:=1',
         '-p', f'description:={ROOT / "msg_samples" / "xml" / "dlo.xml"}',
         '-p', 'tolerance:=12.0', '-p', 'draws:=0'],  # one action is enough
        env={**ros_environment, 'PYTHONPATH': os.pathsep.join(sys.path)}, stderr=subprocess.PIPE, text=True)
    try:
        heard = example(ros_environment, 'closed_loop.py', '--pace', '50')
        planner.send_signal(signal.SIGINT)
        assert ended(planner) == 0
    finally:
        planner.kill()
        planner.communicate()
    before, predicted, after = (float(number) for number in re.findall(r'([\d.]+) % of its length', heard))
    assert before > 20
    assert predicted < 12 and after < 12
    assert abs(after - predicted) < 2
    assert 'the planner says: The DLO is at the goal already' in heard


@pytest.mark.long
def test_robot_arm_carries_the_rope_without_stretching_it():
    heard = example(dict(os.environ), 'robot_arm.py', '--pace', '4')
    largest, = re.findall(r'The largest stretch was ([\d.]+) %', heard)
    assert 0 < float(largest) < 5
    lifted, = re.findall(r'It was lifted by (\d+) mm', heard)
    assert int(lifted) > 250


@pytest.mark.long
def test_an_arm_in_mujoco_carries_the_rope_without_stretching_it():
    pytest.importorskip('mujoco', reason='needs MuJoCo: the extra "bench" of setup.py has it')
    heard = example(dict(os.environ), 'mujoco_arm.py', '--pace', '4')
    largest, = re.findall(r'The largest stretch was ([\d.]+) %', heard)
    assert 0 < float(largest) < 5
    lifted, moved = re.findall(r'It was lifted by (\d+) mm, and lies (\d+) mm away', heard)[0]
    assert int(lifted) > 250 and int(moved) > 450
