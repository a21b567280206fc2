# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The demo works, and ends what it started."""

import os
import signal
import subprocess
import sys
import time

from processes import children
import pytest
from toy_messages import session_messages, write_session

from dlo_calibration.files.session import read_session, samples
from dlo_calibration.messages.codec import bag_types

pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
pytest.importorskip('pybullet', reason='needs PyBullet')

PATIENCE = 120.0


def demo(environment, *arguments, **settings):
    return subprocess.Popen(
        [sys.executable, '-m', 'dlo_calibration.cli.demo', *arguments], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env={**environment, 'PYTHONPATH': os.pathsep.join(sys.path)},
        **settings)


def on_one_cpu():
    """Let a process see one CPU, so that its node starts no processes, which would take a second each."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@pytest.mark.long
def test_demo_ends_with_a_table_a_result_and_a_picture(ros_environment, tmp_path):
    sample = write_session(tmp_path / 'sample', session_messages(bag_types(), 1), {
        'calibrate': ['flexibility', 'damping'], 'nodes': 12, 'time_step': 0.01, 'settle_limit': 0.2})
    process = demo(ros_environment, '--output', str(tmp_path / 'out'), '--evaluations', '4',
                   '--sample', str(sample), preexec_fn=on_one_cpu)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    for word in ('flexibility', 'N m^2', 'mean error', 'demo.png'):
        assert word in output
    assert (tmp_path / 'out' / 'demo.png').read_bytes().startswith(b'\x89PNG')
    folder, = (tmp_path / 'out').glob('dlo_session_*')
    assert (folder / 'result.xml').exists()
    assert read_session(folder).warnings == ()


@pytest.mark.long
def test_interrupted_demo_leaves_no_node_behind(ros_environment, tmp_path):
    process = demo(ros_environment, '--output', str(tmp_path / 'out'), '--evaluations', '1000')
    begun = time.monotonic()
    while not list((tmp_path / 'out').glob('dlo_session_*')):
        assert time.monotonic() - begun < PATIENCE
        assert process.poll() is None
        time.sleep(0.02)
    started = children(process.pid)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors.splitlines()[-1]) == (143, 'demo: interrupted')
    assert 'Traceback' not in errors
    assert started
    assert not any(os.path.exists(f'/proc/{pid}') for pid in started)


def test_demo_says_what_is_wrong_with_a_sample(ros_environment, tmp_path):
    process = demo(ros_environment, '--output', str(tmp_path), '--sample', str(tmp_path / 'nowhere'))
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert len(errors.splitlines()) == 1
    assert 'nowhere' in errors


def test_the_sample_sessions_are_there():
    assert (samples() / 'object1').is_dir()
