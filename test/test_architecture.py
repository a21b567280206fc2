# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Imports run one way, and heavy libraries stay where they belong."""

import ast
from collections import defaultdict
import functools
from graphlib import CycleError, TopologicalSorter
import importlib
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

PACKAGE = 'dlo_calibration'
FOLDER = Path(__file__).resolve().parents[1] / PACKAGE

#: The rooms of the house, in the order in which data flows: a room imports only from those before it.
ROOMS = ('model', 'observation', 'vision', 'simulation', 'evaluation', 'search', 'inference', 'calibration',
         'planning', 'messages', 'files', 'export', 'report', 'workspace', 'capture', 'page', 'experiment',
         'ros', 'cli')
#: Modules outside the rooms, which every room may import.
SHARED = ('errors', 'reading', 'signals', 'writing')

#: Where in the package something may be imported, be it at the top of a module or inside a function.
ONLY = {
    'aiohttp': ('page',),
    'rclpy': ('ros', 'cli/demo_robot.py'),  # which stands for the robot, on the other side of the graph
    'pybullet': ('simulation/bullet.py', 'simulation/window.py'),
    'cv2': ('vision',),
    'PIL': ('report/animation.py', 'vision'),
    'cma': ('search/sampling.py',),
    'lxml': ('files/xml.py',),
    'distributed': ('evaluation/cluster.py',),
    'dlo_calibration.simulation.bullet': ('__init__.py', 'evaluation/process_simulator.py',
                                           'simulation/window.py'),
    'dlo_calibration.simulation.compiled': ('calibration/engines.py', 'simulation/bullet.py'),
}

NOT_LOADED = ('aiohttp', 'cv2', 'PIL', 'jinja2', 'rclpy', 'pybullet', 'distributed', 'matplotlib',
              'scipy.optimize', 'cma')

FILES = sorted(FOLDER.rglob('*.py'))


def room(file: Path) -> str:
    """Name the room that a file is in; nothing for one outside the rooms."""
    return file.relative_to(FOLDER).parts[0] if file.parent != FOLDER else ''


def module_name(file: Path) -> str:
    """Return the full name of the module in a file."""
    return '.'.join(file.relative_to(FOLDER.parent).with_suffix('').parts).removesuffix('.__init__')


@functools.cache
def imported(file: Path) -> frozenset[str]:
    """List the full names that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{file.name}: line {node.lineno} imports relatively'
            names.add(node.module)
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return frozenset(names)


def rooms_of(names: frozenset[str]) -> set[str]:
    """List the rooms that imported names are in."""
    return {name.split('.')[1] for name in names if name.startswith(f'{PACKAGE}.')} & set(ROOMS)


def test_every_folder_is_a_room():
    folders = {path.name for path in FOLDER.iterdir() if path.is_dir() and path.name != '__pycache__'}
    assert folders - set(ROOMS) == set(), 'give each room its place in ROOMS'


def test_contributors_read_what_each_room_is():
    table = (FOLDER.parent / 'CONTRIBUTING.md').read_text(encoding='utf-8').partition('| room |')[2]
    assert tuple(re.findall(r'^\| `(\w+)` \|', table.partition('\n\n')[0], re.MULTILINE)) == ROOMS


@pytest.mark.parametrize('folder', [name for name in ROOMS if (FOLDER / name).is_dir()])
def test_every_room_says_what_it_is_and_what_it_offers(folder):
    offered = importlib.import_module(f'{PACKAGE}.{folder}')
    assert len(offered.__doc__) > 30
    for name in getattr(offered, '__all__', ()):
        assert hasattr(offered, name)
    assert hasattr(offered, '__all__') or folder in ('report', 'ros', 'cli'), 'list what it offers'


def test_no_two_classes_have_the_same_name():
    places = defaultdict(list)
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(file.relative_to(FOLDER).as_posix())
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_no_modules_import_each_other_in_a_circle():
    """Imports inside functions and those for type checking count, too."""
    imports = {module_name(file): imported(file) for file in FILES}
    graph = {}
    for importer, names in imports.items():
        modules = names & set(imports)
        packages = {name.rpartition('.')[0] for name in modules}  # of imported modules
        graph[importer] = modules - packages
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f'imports form a circle: {" <- ".join(error.args[1])}')


def test_only_these_modules_stand_outside_the_rooms():
    assert {file.stem for file in FOLDER.glob('*.py')} == {'__init__', '__main__', *SHARED}


@pytest.mark.parametrize('here', ROOMS)
def test_a_room_imports_only_from_those_before_it(here):
    before = {*ROOMS[:ROOMS.index(here)], here}
    wrong = {file.name: rooms_of(imported(file)) - before for file in FILES if room(file) == here}
    assert {name: rooms for name, rooms in wrong.items() if rooms} == {}


@pytest.mark.parametrize('name', ONLY)
def test_only_its_owner_imports(name):
    importers = {file.relative_to(FOLDER) for file in FILES
                 if any(f'{module}.'.startswith(f'{name}.') for module in imported(file))}
    strangers = {file for file in importers if not {file.as_posix(), file.parts[0]} & set(ONLY[name])}
    assert strangers == set()


def test_vision_needs_only_the_chain_of_the_other_rooms():
    for file in (FOLDER / 'vision').glob('*.py'):
        others = {name for name in imported(file) if rooms_of(frozenset({name})) - {'vision'}}
        assert {name for name in others if not name.startswith(f'{PACKAGE}.model.chain')} == set()


def test_a_search_never_sees_a_trial():
    for file in (FOLDER / 'search').glob('*.py'):
        assert f'{PACKAGE}.model.trial' not in imported(file)


#: What loads slowly; then commands of a process, and what of this they need.
SLOW = {'dlo_calibration.planning', 'jinja2', 'matplotlib', 'pybullet', 'rclpy', 'scipy'}
LOADED = (
    ((['info', 'msg_samples/object1'], ['info', 'msg_samples/xml/named_actions.xml'], ['--help']), set()),
    pytest.param((['plot', 'msg_samples/xml/push_and_release.xml'],), {'matplotlib'}, marks=pytest.mark.long),
    ((['fit', 'msg_samples/object1', *'--workers 2 --calibrate friction --evaluations 4'.split()],),
     set()),
)


def test_every_public_name_can_be_imported():
    package = importlib.import_module(PACKAGE)
    assert {'Trial', 'calibrate', 'read_session'} <= set(package.__all__)
    assert all(getattr(package, name).__name__ == name for name in package.__all__)


def test_importing_the_package_loads_no_heavy_library():
    program = f'import sys, {PACKAGE}; print(*(name for name in {NOT_LOADED} if name in sys.modules))'
    done = subprocess.run([sys.executable, '-c', program], cwd=FOLDER.parent, check=True,
                          capture_output=True, text=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize('name', ['calibrator', 'planner'])
def test_a_node_that_sees_no_image_loads_nothing_that_does(name):
    program = f'import sys, {PACKAGE}.ros.{name}_node; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', program], cwd=FOLDER.parent, check=True, capture_output=True,
                          text=True)
    loaded = set(done.stdout.split())
    assert 'rclpy' in loaded
    assert not loaded & {'cv2', 'matplotlib', 'pybullet', 'scipy', f'{PACKAGE}.vision'}


@pytest.mark.parametrize('commands, needed', LOADED, ids=lambda value: ' '.join(sorted(map(str, value))))
def test_a_command_loads_only_what_it_needs(commands, needed, tmp_path):
    words = [[str(FOLDER.parent / word) if word.startswith('msg_samples') else word for word in command]
             for command in commands]
    program = f"""
import sys
from {PACKAGE}.cli.main import main
try:
    for words in {words}:
        assert main(words) == 0
except SystemExit as end:  # --help
    assert end.code == 0
sys.stderr.write('loaded: ' + ' '.join(sys.modules))
"""
    done = subprocess.run([sys.executable, '-c', program], cwd=tmp_path, check=True, capture_output=True,
                          text=True, env={**os.environ, 'PYTHONPATH': str(FOLDER.parent)})
    loaded = set(done.stderr.rpartition('loaded: ')[2].split())
    assert PACKAGE in loaded
    assert loaded & SLOW == needed


def test_the_compiled_engine_loads_no_other_slow_library():
    program = f"""
import sys
from {PACKAGE}.model.parameters import ParameterSpace
from {PACKAGE}.simulation.compiled import CompiledSimulator
from {PACKAGE}.calibration.options import Options
from {PACKAGE}.files.session import read_session, session_trials
trials, _ = session_trials(read_session('msg_samples/object1'), Options())
CompiledSimulator().simulate(trials[0], ParameterSpace().physical({{'natural_curvature': 60.0}}, 0.6))
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, '-c', program], cwd=FOLDER.parent, check=True,
                          capture_output=True, text=True)
    loaded = set(done.stdout.split())
    assert loaded & SLOW == set()


def test_the_index_of_the_support_modules_lists_each_once():
    folder = Path(__file__).with_name('support')
    listed = re.findall(r'^\| `(\w+)` \|', (folder / 'README.md').read_text(encoding='utf-8'), re.MULTILINE)
    assert sorted(listed) == sorted(path.stem for path in folder.glob('*.py'))
