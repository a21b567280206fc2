# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Imports run one way, and heavy libraries stay where they belong."""

import ast
import os
from pathlib import Path
import subprocess
import sys

import pytest

PACKAGE = 'dlo_calibration'
FOLDER = Path(__file__).resolve().parents[1] / PACKAGE

#: A module imports only from those before it; the modules of a subpackage share its place.
ORDER = (
    # pure NumPy and SciPy
    'errors', 'samples', 'chain', 'action', 'named_actions', 'trial', 'parameters', 'simulator', 'score',
    'noise', 'layout', 'suspension', 'estimate', 'excitation',
    'search', 'confirmation', 'uncertainty', 'evaluation', 'examination', 'advice', 'unexplained',
    'calibration', 'parts',
    '__init__', 'config', 'parameter_file', 'gain', 'findings', 'slices',
    # messages and files
    'messages', 'diagnostics', 'markers', 'segment', 'trial_messages',
    'collector', 'recording', 'xml', 'description',
    'request', 'session',
    # engines
    'rollout', 'contact', 'natural', 'twist', 'rod', 'scene', 'bullet', 'kernels', 'compiled', 'engines',
    # edges
    'pool', 'cluster', 'worker', 'appraiser', 'experiment', 'experiment_summary', 'picture', 'animation',
    'plot', 'terminal', 'charts', 'figures', 'report', 'reporter', 'experiment_report', 'experiment_verb',
    'signals', 'recorder', 'options_node', 'node',
    'calibrator', 'cli', '__main__', 'demo',
)

#: The only modules that may import something, be it at the top or inside a function.
ONLY = {
    # the demo stands for the robot, on the other side of the graph
    'rclpy': {'options_node', 'node', 'demo'},
    'pybullet': {'bullet'},
    'numba': {'kernels'},
    'cma': {'search'},
    'lxml': {'xml'},
    'distributed': {'cluster'},
    'dlo_calibration.bullet': {'engines'},
    'dlo_calibration.compiled': {'engines'},
    'dlo_calibration.engines': {'node', 'cli'},
    'dlo_calibration.trial': set(ORDER) - {'search'},
}

NOT_LOADED = ('rclpy', 'pybullet', 'numba', 'distributed', 'matplotlib', 'scipy.optimize', 'cma')

FILES = sorted(FOLDER.rglob('*.py'))


def place(file: Path) -> str:
    """Name the entry of ORDER that a file belongs to."""
    first, *rest = file.relative_to(FOLDER).parts
    return first if rest else file.stem


def imported(file: Path) -> set[str]:
    """List the full names that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{file.name}: line {node.lineno} imports relatively'
            names.add(node.module)
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return names


def own_places(names: set[str]) -> set[str]:
    """List the entries of ORDER among imported names; the bare package is its `__init__`."""
    parts = [name.split('.') for name in names if name.split('.')[0] == PACKAGE]
    found = {part[1] for part in parts if len(part) > 1 and part[1] in ORDER}
    named_in_init = any(len(part) > 1 and part[1] not in ORDER for part in parts)
    return found | ({'__init__'} if named_in_init else set())


def test_every_module_has_its_place_in_the_order():
    assert {place(file) for file in FILES} == set(ORDER), 'give each module its place in ORDER'


@pytest.mark.parametrize('file', FILES, ids=lambda file: str(file.relative_to(FOLDER)))
def test_module_imports_only_what_stands_before_it(file):
    here = place(file)
    assert here in ORDER, f'give {here} its place in ORDER'
    allowed = {here, *ORDER[:ORDER.index(here)]}
    assert own_places(imported(file)) - allowed == set()


@pytest.mark.parametrize('name', ONLY)
def test_only_its_owner_imports(name):
    importers = {place(file) for file in FILES
                 if any(one == name or one.startswith(f'{name}.') for one in imported(file))}
    assert importers - ONLY[name] == set()

#: What takes long to load; then commands, and what of that each needs.
SLOW = {'matplotlib', 'numba', 'pybullet', 'rclpy', 'scipy'}
LOADED = (
    (('--help',), set()),
    (('info', 'msg_samples/object1'), set()),
    (('info', 'msg_samples/xml/named_actions.xml'), set()),
    (('plot', 'msg_samples/object1'), {'matplotlib'}),
)


def test_importing_the_package_loads_no_heavy_library():
    program = f'import sys, {PACKAGE}; print(*(name for name in {NOT_LOADED} if name in sys.modules))'
    done = subprocess.run([sys.executable, '-c', program], cwd=FOLDER.parent, check=True,
                          capture_output=True, text=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize('words, needed', LOADED, ids=[' '.join(words) for words, _ in LOADED])
def test_a_command_loads_only_what_it_needs(words, needed, tmp_path):
    words = [FOLDER.parent / word if word.startswith('msg_samples') else word for word in words]
    done = subprocess.run([sys.executable, '-X', 'importtime', '-m', PACKAGE, *words], cwd=tmp_path,
                          env={**os.environ, 'PYTHONPATH': str(FOLDER.parent)}, check=True,
                          capture_output=True, text=True)
    loaded = {line.rpartition('|')[2].strip().split('.')[0] for line in done.stderr.splitlines()}
    assert PACKAGE in loaded
    assert loaded & SLOW == needed


def test_the_compiled_engine_loads_no_other_slow_library():
    program = f"""
import sys
from {PACKAGE} import ParameterSpace
from {PACKAGE}.compiled import CompiledSimulator
from {PACKAGE}.config import Options
from {PACKAGE}.session import read_session, session_trials
trials, _ = session_trials(read_session('msg_samples/object1'), Options())
CompiledSimulator().simulate(trials[0], ParameterSpace().physical({{}}, 0.6))
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, '-c', program], cwd=FOLDER.parent, check=True,
                          capture_output=True, text=True)
    loaded = set(done.stdout.split())
    assert loaded & (SLOW - {'scipy'}) == {'numba'}
    assert 'scipy.spatial' not in loaded  # Numba itself needs the rest of SciPy
