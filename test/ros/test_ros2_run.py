# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The installed executables, found and started as `ros2 run` does it."""

from contextlib import contextmanager
from importlib.util import find_spec
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import threading

import pytest

NAME = 'dlo_calibration'
PATIENCE = 60.0  # s

pytestmark = pytest.mark.long  # colcon builds the package
index = pytest.importorskip('ament_index_python', reason='needs the ament index, with ROS 2 or from PyPI')


@pytest.fixture
def environment(install, ros_environment, monkeypatch):
    """Give the environment that `source install/setup.sh` leaves, to the test and to its children."""
    done = subprocess.run(['sh', '-c', '. "$0" && exec env -0', install / 'setup.sh'],
                          env=ros_environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    sourced = dict(pair.split('=', 1) for pair in done.stdout.rstrip('\0').split('\0'))
    monkeypatch.setenv('AMENT_PREFIX_PATH', sourced['AMENT_PREFIX_PATH'])
    return sourced


def directly(name):
    """Return the one executable file of that name, below lib/ of the package's prefix."""
    library = Path(index.get_package_prefix(NAME)) / 'lib' / NAME
    path, = (file for file in library.rglob('*') if file.name == name and os.access(file, os.X_OK))
    return [path]


def ros2(verb):
    if shutil.which('ros2') is None or find_spec(f'ros2{verb}') is None:
        pytest.skip(f'the command ros2 {verb} is not installed')
    return ['ros2', verb]


def by_command(name):
    return [*ros2('run'), NAME, name]


@pytest.fixture(params=[directly, by_command], ids=['directly', 'ros2 run'])
def command(request, environment):
    """Give a function from an executable's name to the command that starts it."""
    return request.param


@contextmanager
def started(command, **arguments):
    """Start a process in a session of its own, as from a terminal; kill it where it takes too long."""
    with subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, **arguments) as process:
        timer = threading.Timer(PATIENCE, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            yield process
        finally:
            timer.cancel()
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


READY = {'calibrator': 'collecting trials', 'planner': 'call ~/plan'}  # what a node says when it is


def interrupted(command, environment, folder, node='calibrator'):
    """Start a command; Ctrl-C when the node is ready; return what it wrote, and its exit code."""
    said = ''
    with started(command, cwd=folder, env=environment) as process:
        for line in process.stdout:
            said += line
            if READY[node] in line:
                os.killpg(process.pid, signal.SIGINT)
        process.wait()
    return said, process.returncode


def test_the_ament_index_leads_to_the_installed_package(environment, prefix):
    assert Path(index.get_package_prefix(NAME)) == prefix
    program = f'from {NAME}.simulation.core import _core; print(_core.__file__)'
    done = subprocess.run([sys.executable, '-c', program], cwd='/', env=environment, capture_output=True,
                          text=True)
    assert Path(done.stdout.strip()).is_relative_to(prefix), done.stderr


def test_calibrator_starts_and_ends_with_exit_code_0_at_ctrl_c(command, environment, tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
    command = [*command('calibrator'), '--ros-args', '-p', 'mass:=0.03']
    said, code = interrupted(command, environment, tmp_path)
    assert 'collecting trials' in said
    assert 'Traceback' not in said
    assert code == 0, said
    assert len(list(tmp_path.glob('dlo_session_*/*.mcap'))) == 1


def test_planner_starts_with_its_installed_parameter_file_and_ends_at_ctrl_c(environment, tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
    share = Path(index.get_package_share_directory(NAME))
    command = [*directly('planner'), '--ros-args', '--params-file', share / 'config' / 'planner.yaml',
               '-p', f'description:={share / "msg_samples" / "xml" / "dlo.xml"}']
    said, code = interrupted(command, environment, tmp_path, 'planner')
    assert 'a DLO of 0.602 m' in said
    assert 'Traceback' not in said
    assert code == 0, said


@pytest.mark.parametrize('node', READY)
def test_launch_file_starts_the_node_and_ctrl_c_ends_it(node, environment, tmp_path):
    said, code = interrupted([*ros2('launch'), NAME, f'{node}.launch.py'], environment, tmp_path, node)
    assert 'finished cleanly' in said
    assert code == 0, said


def test_launch_file_says_that_a_parameter_file_is_not_there(environment, tmp_path):
    done = subprocess.run([*ros2('launch'), NAME, 'calibrator.launch.py', 'params_file:=none.yaml'],
                          cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert 'none.yaml' in done.stdout
    assert 'exit code 2' in f'{done.stdout}{done.stderr}'


def test_mistaken_command_line_reaches_the_user(command, environment, tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
    done = subprocess.run([*command('calibrator'), '--ros-args', '-p', 'mas:=0.03'], cwd=tmp_path,
                          env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert "calibrator: parameter: 'mas'" in done.stderr


def test_dlo_calibration_reads_the_installed_sample(command, environment, tmp_path):
    sample = Path(index.get_package_share_directory(NAME)) / 'msg_samples' / 'object1'
    done = subprocess.run([*command('dlo-calibration'), 'info', sample, '--json'], cwd=tmp_path,
                          env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)['trials']) == 4
