# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Fixtures that several test modules share."""

from collections.abc import Iterator, Mapping
import fcntl
import gc
from importlib.util import find_spec
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from hypothesis import settings
import pytest
from random_examples import USUAL
from ros_domain import ros_graph, WORKER
from toy_command import one_worker
from toy_simulator import ToySimulator
from wire import SOURCES
from without_drawings import leave_out_drawings, leave_out_slices

from dlo_calibration.cli import main as cli

# No test is timed: an example takes long where other programs keep the machine busy.
settings.register_profile('untimed', settings(), deadline=None)
settings.register_profile('soak', settings(), deadline=None, max_examples=10 * USUAL)
settings.load_profile('untimed')

ROOT = Path(__file__).resolve().parents[1]
NAME = 'dlo_calibration'
#: They compare with PyBullet, or show its window.
WITH_PYBULLET = ['files/test_samples.py', 'model/test_named_actions.py', *(
    f'simulation/test_{name}.py' for name in (
        'bullet', 'compiled', 'engine_contract', 'hysteresis', 'rest_shape', 'window'))]
collect_ignore = [] if find_spec('pybullet') else WITH_PYBULLET
FOLDERS = (NAME, 'config', 'launch', 'msg_samples', 'resource')  # of what is installed


def pytest_report_header():
    """Say what is left out where PyBullet cannot be installed."""
    return [f'PyBullet is not installed; skipped: {", ".join(collect_ignore)}'] if collect_ignore else []


def pytest_collection_modifyitems(items):
    """Begin with what takes longest, so that no process is left alone with it at the end."""
    items.sort(key=lambda item: item.name != 'test_mypy_finds_nothing')


def pytest_runtest_setup(item):
    """Skip what needs PyBullet where it cannot be installed."""
    if item.get_closest_marker('pybullet') and not find_spec('pybullet'):
        pytest.skip('needs PyBullet')


def pytest_collection_finish():
    """Let the garbage collector pass over all that was imported, which stays to the end."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def ros_environment(tmp_path) -> Iterator[Mapping[str, str]]:
    """Give a ROS graph of the test's own."""
    with ros_graph(tmp_path) as environment:
        yield environment


@pytest.fixture(scope='module')
def shared_ros_environment(tmp_path_factory) -> Iterator[Mapping[str, str]]:
    """Give a ROS graph to the tests of one module together."""
    with ros_graph(tmp_path_factory.mktemp('graph')) as environment:
        yield environment


@pytest.fixture
def without_drawings(monkeypatch):
    """Leave the drawings of pages out."""
    leave_out_drawings(monkeypatch.setattr)


@pytest.fixture
def without_slices(monkeypatch):
    """Leave the slices of pages out."""
    leave_out_slices(monkeypatch.setattr)


@pytest.fixture(params=SOURCES)
def types(request):
    """Give the message classes of either source."""
    return SOURCES[request.param]()


@pytest.fixture(scope='session')
def sources(tmp_path_factory):
    """Copy the sources, so that a build leaves nothing in the repository."""
    copy = tmp_path_factory.mktemp('workspace') / 'src'
    copy.mkdir()
    for name in FOLDERS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns('__pycache__', '*.so'))
    for file in ROOT.glob('*.*'):
        if file.is_file():
            shutil.copy(file, copy)
    shutil.copy(ROOT / 'LICENSE', copy)
    return copy


@pytest.fixture(scope='session')
def building():
    """Give the environment of a build: the core is not made fast, which takes half of the time."""
    return {**os.environ, 'DLO_CXXFLAGS': f'{os.environ.get("DLO_CXXFLAGS", "")} -O0'}


@pytest.fixture(scope='session')
def colcon(sources, building):
    """Give a function that builds the package into a folder."""
    if find_spec('colcon_core') is None or find_spec('colcon_ros') is None:
        pytest.skip('colcon is not installed; the extra "test" of setup.py has it')

    def build(folder, *flags):
        done = subprocess.run(
            [sys.executable, '-W', 'ignore', '-m', 'colcon', '--log-base', 'log', 'build', '--install-base',
             folder, '--build-base', folder.with_suffix('.build'), *flags],
            cwd=sources.parent, env=building, capture_output=True, text=True)
        assert done.returncode == 0, f'{done.stdout}{done.stderr}'

    return build


@pytest.fixture(scope='session')
def install(colcon, tmp_path_factory):
    """Build with colcon, once for all workers, and return the folder `install` of the workspace."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if WORKER else base) / 'install'
    with folder.with_suffix('.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            colcon(folder)
    return folder


@pytest.fixture(scope='session')
def prefix(install):
    """Return where the package is installed."""
    return install / NAME


@pytest.fixture
def command(capsys):
    """Give a function that does what a command line says, with the toy: its code, JSON, lines on stderr."""
    def act(*words):
        capsys.readouterr()
        try:
            code = cli.main(one_worker(words), lambda _: ToySimulator())
        except SystemExit as end:  # argparse
            code = end.code
        output, errors = capsys.readouterr()
        return code, json.loads(output) if output else None, errors.splitlines()

    return act
