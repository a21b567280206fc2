# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where the machine code of the kernels is kept, also on read-only installations."""

import os
from pathlib import Path
import re
import shutil

import pytest

from dlo_calibration.simulation import kernel_cache
from dlo_calibration.simulation.kernel_cache import (
    is_compiled,
    place,
    remark,
    settle,
    SIMULATION,
    TOGETHER,
)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Give a package that an installer has compiled, and a function that makes folders read-only."""
    folder = tmp_path / 'opt' / 'simulation'
    (folder / '__pycache__').mkdir(parents=True)
    (tmp_path / 'home').mkdir()
    (folder / 'kernels.py').write_text('kernels')
    monkeypatch.setattr(kernel_cache, '_PACKAGE', folder.parent)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'home' / '.cache'))
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', None)
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    kept = place(SIMULATION)
    assert kept == folder / '__pycache__'
    for name in ('kernels.advance-1.py311.nbi', 'kernels.advance-1.py311.1.nbc',
                 'kernels_near.movement-1.py311.nbi', 'kernels_near.movement-1.py311.1.nbc',
                 kernel_cache._mark(folder / 'kernels.py')):
        (kept / name).write_text(name)
    denied = []

    def protect(*paths):
        denied.extend(paths)
        settle(folder)

    monkeypatch.setattr(kernel_cache.os, 'access', lambda path, mode: not any(
        Path(path).is_relative_to(one) for one in denied))
    yield folder, protect
    os.environ.pop('NUMBA_CACHE_DIR', None)


def test_what_an_installer_compiled_need_not_be_compiled_by_each_user(package):
    folder, protect = package
    protect(folder)
    users = place(SIMULATION)
    assert 'home' in users.parts and is_compiled(SIMULATION)
    assert {one.name for one in users.iterdir()} == {one.name for one in (folder / '__pycache__').iterdir()}
    assert remark() == ''


def test_code_of_another_version_is_not_taken_over(package):
    folder, protect = package
    (folder / 'kernels.py').write_text('newer kernels')
    assert not is_compiled(SIMULATION)
    protect(folder)
    assert not place(SIMULATION).exists()


def test_where_nothing_lasting_can_be_written_one_sentence_says_so(package, tmp_path):
    folder, protect = package
    protect(folder, tmp_path / 'home')
    chosen = Path(os.environ['NUMBA_CACHE_DIR'])
    assert chosen.stat().st_mode & 0o077 == 0
    assert place(SIMULATION).is_relative_to(chosen)
    for word in (str(folder.parent), str(tmp_path / 'home'), str(chosen), 'NUMBA_CACHE_DIR'):
        assert word in remark()


def test_a_folder_that_others_can_write_is_not_trusted(package, tmp_path):
    folder, protect = package
    open_to_all = kernel_cache._until_the_next_boot()
    open_to_all.chmod(0o777)
    protect(folder, tmp_path / 'home')
    assert Path(os.environ['NUMBA_CACHE_DIR']) != open_to_all


@pytest.mark.parametrize('module', [SIMULATION, TOGETHER])
def test_a_change_of_any_module_with_kernels_compiles_all_that_are_made_of_it(module, tmp_path):
    folder = Path(kernel_cache.__file__).parent
    names, unread = set(), {module.rpartition('.')[2]}
    while unread:
        text = (folder / f'{unread.pop()}.py').read_text(encoding='utf-8')
        found = set(re.findall(r'^from dlo_calibration\.simulation\.(\w+) import', text, re.MULTILINE))
        unread |= found - names
        names |= found
    assert len(names) > 5
    shutil.copytree(folder, tmp_path / 'copy', ignore=shutil.ignore_patterns('__pycache__'))
    main = tmp_path / 'copy' / f'{module.rpartition(".")[2]}.py'
    for name in names:
        before = kernel_cache._mark(main)
        with (tmp_path / 'copy' / f'{name}.py').open('a', encoding='utf-8') as file:
            file.write('# changed\n')
        assert kernel_cache._mark(main) != before, name


def test_numba_keeps_the_kernels_where_the_cache_says():
    from dlo_calibration.simulation import kernels

    assert Path(kernels.advance.stats.cache_path) == place(SIMULATION)
