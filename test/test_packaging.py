# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The package installs with colcon and with pip, and says what it needs."""

import ast
from importlib.metadata import packages_distributions
from importlib.util import find_spec
import itertools
import os
from pathlib import Path
import re
import subprocess
import sys
import zipfile

from lxml import etree
import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = 'dlo_calibration'
FOLDERS = (NAME, 'launch', 'msg_samples')  # of Python files that are installed
EXECUTABLES = ('calibrator', 'dlo-calibration')

#: Import name of a Python library -> its rosdep key, where that is not python3-<name>.
ROSDEP_KEYS = {
    'PIL': 'python3-pil',
    'cv2': 'python3-opencv',
}

#: Import name of a Python library without a Debian package -> what brings it, of requirements.txt.
FROM_PIP = {
    'lz4': 'mcap',
    'mcap': 'mcap',
    'pybullet': 'pybullet',
    'rosbags': 'rosbags',
    'zstandard': 'mcap',
}

#: Imported only by what a user chooses, with words that tell what to install where it is missing.
OPTIONAL = {'cma', 'distributed'}  # have no rosdep key; imported where a search or a scheduler asks for them


def third_party_imports():
    """List the top-level names that whatever is installed imports from others."""
    names = set()
    for file in itertools.chain.from_iterable((ROOT / folder).rglob('*.py') for folder in FOLDERS):
        for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module)
    tops = {name.split('.')[0] for name in names}
    return sorted(tops - set(sys.stdlib_module_names) - {NAME})


def manifest():
    return etree.parse(ROOT / 'package.xml').getroot()


def setup_value(name):
    return re.search(rf"\b{name}='([^']+)'", (ROOT / 'setup.py').read_text(encoding='utf-8'))[1]


def test_manifest_is_a_format_3_ament_python_package():
    package = manifest()
    assert (package.tag, package.get('format')) == ('package', '3')
    assert package.findtext('name') == NAME
    assert package.findtext('license') == setup_value('license')
    assert package.find('maintainer').get('email') == setup_value('maintainer_email')
    assert package.findtext('export/build_type') == 'ament_python'


def test_manifest_and_setup_give_the_same_version():
    assert manifest().findtext('version') == setup_value('version')


def test_what_is_imported_is_declared():
    keys = {element.text for element in manifest().iterfind('exec_depend')}
    requirements = (ROOT / 'setup.py').read_text(encoding='utf-8')
    distributions = packages_distributions()
    # A ROS package is not for setup.py; it has the name of its module, or that with _py.
    names = {name for name in third_party_imports() if keys.isdisjoint({name, f'{name}_py'})}
    not_in_manifest = {name for name in names - OPTIONAL
                       if ROSDEP_KEYS.get(name, f'python3-{name}') not in keys
                       and FROM_PIP.get(name) not in from_pip()}
    not_in_setup = {name for name in names if not any(f"'{distribution}>=" in requirements
                                                      for distribution in distributions.get(name, [name]))}
    assert names
    assert not_in_manifest == set(), 'add them to package.xml or requirements.txt'
    assert not_in_setup == set(), 'add them to setup.py'


def from_pip():
    """Return what requirements.txt names: name -> lower bound."""
    text = (ROOT / 'requirements.txt').read_text(encoding='utf-8')
    return dict(re.findall(r'^([\w-]+)>=([^#\n]*[^#\s])', text, re.MULTILINE))


def test_requirements_are_those_of_setup():
    requirements = (ROOT / 'setup.py').read_text(encoding='utf-8')
    assert from_pip()
    for name, bound in from_pip().items():
        assert f"'{name}>={bound}'" in requirements


def test_a_missing_optional_library_gives_one_line():
    done = subprocess.run(
        [sys.executable, '-c', "import sys; sys.modules['mcap'] = None\n"
         'from dlo_calibration.__main__ import main; sys.exit(main())',
         'info', ROOT / 'msg_samples' / 'object1'], capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path])})
    assert done.returncode == 2
    assert 'pip install -r requirements.txt' in done.stderr
    assert done.stderr.count('\n') == 1


def test_bloom_takes_every_key():
    """It takes those that rosdep resolves to Debian packages; keys for pip end with -pip, but for a few."""
    for element in manifest().iter():
        if str(element.tag).endswith('depend'):
            assert not element.text.endswith('-pip')
            assert element.text != 'mcap-ros2-support'


def test_the_changelog_can_be_released():
    """Do what catkin_prepare_release does, and read back what is then in the Debian package."""
    changelog = pytest.importorskip('catkin_pkg.changelog')
    package_version = pytest.importorskip('catkin_pkg.package_version')
    text = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')
    label = package_version.get_forthcoming_label(text)
    title = f'{setup_value("version")} (2030-01-01)'
    released = text.replace(f'{label}\n{"-" * len(label)}', f'{title}\n{"-" * len(title)}')
    parsed = changelog.populate_changelog_from_rst(changelog.Changelog(NAME), released)
    (version, _, entries), = parsed.foreach_version()
    assert version == setup_value('version')
    assert sum(str(entry).count('* ') for entry in entries) >= text.count('\n* ')


def test_rosdoc2_finds_its_configuration():
    assert (ROOT / manifest().findtext('export/rosdoc2')).is_file()


@pytest.mark.long
def test_colcon_puts_executables_where_ros2_run_looks(prefix):
    for name in EXECUTABLES:
        assert os.access(prefix / 'lib' / NAME / name, os.X_OK)


@pytest.mark.long
def test_colcon_registers_the_package(prefix):
    assert (prefix / 'share/ament_index/resource_index/packages' / NAME).is_file()
    assert (prefix / 'share' / NAME / 'package.xml').is_file()


@pytest.mark.long
def test_colcon_installs_the_shared_folders(prefix, sources):
    for folder in ('config', 'launch', 'msg_samples'):
        wanted = {file.relative_to(sources) for file in (sources / folder).rglob('*')
                  if file.is_file() and not file.name.startswith('.')}
        share = prefix / 'share' / NAME
        assert wanted <= {file.relative_to(share) for file in share.rglob('*')}


def loaded(folder, tmp_path):
    """Return the file of the core that a process loads from a folder of packages."""
    done = subprocess.run(
        [sys.executable, '-c', f'from {NAME}.simulation.core import _core; print(_core.__file__)'],
        cwd=tmp_path, env={**os.environ, 'PYTHONPATH': str(folder)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.strip())


@pytest.mark.long
def test_colcon_compiles_the_core(prefix, tmp_path):
    folder = next(prefix.glob('lib/python*/site-packages'))
    assert loaded(folder, tmp_path).is_relative_to(folder)


@pytest.mark.long
def test_colcon_with_links_compiles_the_core(colcon, tmp_path):
    """It puts the core into a folder of links to the sources, and so into the sources."""
    colcon(tmp_path / 'install', '--symlink-install')
    folder = tmp_path / 'install.build' / NAME
    core = loaded(folder, tmp_path)
    core.unlink()
    assert core.is_relative_to(folder)


@pytest.mark.long
def test_a_wheel_from_a_source_distribution_has_all_that_is_used(sources, building, tmp_path):
    if find_spec('setuptools') is None or find_spec('setuptools.command.bdist_wheel') is None:
        pytest.skip('setuptools is missing or cannot build wheels; the extra "test" of setup.py has it')
    for command in (['setup.py', '--quiet', 'sdist', '--dist-dir', tmp_path],
                    ['-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation', '--no-index',
                     '--find-links', tmp_path, '--wheel-dir', tmp_path, NAME]):
        subprocess.run([sys.executable, *command], cwd=sources, env=building, check=True)
    wheel = zipfile.ZipFile(next(tmp_path.glob('*.whl')))
    names = wheel.namelist()
    entry_points = wheel.read(next(name for name in names if name.endswith('entry_points.txt'))).decode()
    assert all(f'{name} = ' in entry_points for name in EXECUTABLES)
    assert {f'{NAME}/py.typed', f'{NAME}/search/__init__.py'} <= set(names)
    assert {str(file.relative_to(ROOT)) for kind in ('html', 'pyi', 'xsd')
            for file in (ROOT / NAME).rglob(f'*.{kind}')} <= set(names)
    assert any(name.endswith(f'share/{NAME}/package.xml') for name in names)
    assert not any(name.startswith('test') for name in names)
    wheel.extractall(tmp_path / 'all')
    assert loaded(tmp_path / 'all', tmp_path).is_relative_to(tmp_path / 'all')


def test_licence_is_the_one_that_each_file_names():
    first, second = (ROOT / 'LICENSE').read_text(encoding='utf-8').split('\n')[1:3]
    assert first.strip() == 'Apache License'
    assert second.strip() == 'Version 2.0, January 2004'
