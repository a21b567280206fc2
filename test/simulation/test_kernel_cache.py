# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where the machine code of the kernels is kept, also on read-only installations."""

import os
from pathlib import Path
import re
import shutil

import pytest

from dlo_calibration.errors import SimulationError
from dlo_calibration.simulation import kernel_cache, machine_code
from dlo_calibration.simulation.kernel_cache import (
    compile_kernels,
    is_compiled,
    place,
    remark,
    SIMULATION,
    TOGETHER,
)

CODE = b'machine code'
MADE_BY = 'dlo_calibration.simulation.compilation.machine_code'


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Give a package with kernels that nobody has compiled, and a function that makes folders read-only."""
    folder = tmp_path / 'opt' / 'simulation'
    folder.mkdir(parents=True)
    (tmp_path / 'home').mkdir()
    (folder / 'kernels.py').write_text('kernels')
    monkeypatch.setattr(kernel_cache, '_PACKAGE', folder.parent)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'home' / '.cache'))
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', None)
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    monkeypatch.setattr(MADE_BY, lambda module: CODE)
    monkeypatch.setattr(kernel_cache, '_try', lambda file: None)
    denied = []
    monkeypatch.setattr(kernel_cache.os, 'access', lambda path, mode: not any(
        Path(path).is_relative_to(one) for one in denied))
    yield folder, lambda *paths: denied.extend(paths)
    os.environ.pop('NUMBA_CACHE_DIR', None)


def test_what_was_compiled_is_kept_beside_the_kernels(package):
    folder, _ = package
    assert not is_compiled(SIMULATION)
    file = compile_kernels(SIMULATION)
    assert file.parent == folder / '__pycache__' == place(SIMULATION) and file.read_bytes() == CODE
    assert is_compiled(SIMULATION) and [one.name for one in file.parent.iterdir()] == [file.name]


def test_what_an_installer_compiled_need_not_be_compiled_by_each_user(package):
    folder, protect = package
    file = compile_kernels(SIMULATION)
    protect(folder)
    assert is_compiled(SIMULATION) and compile_kernels(SIMULATION) == file
    assert remark() == ''


def test_in_a_read_only_package_a_user_compiles_for_himself(package):
    folder, protect = package
    protect(folder)
    file = compile_kernels(SIMULATION)
    assert 'home' in file.parts and is_compiled(SIMULATION) and place(SIMULATION) == file.parent


def test_code_of_another_version_is_not_used(package):
    folder, protect = package
    file = compile_kernels(SIMULATION)
    (folder / 'kernels.py').write_text('newer kernels')
    assert not is_compiled(SIMULATION)
    assert compile_kernels(SIMULATION) != file


def test_where_nothing_lasting_can_be_written_one_sentence_says_so(package, tmp_path):
    folder, protect = package
    protect(folder, tmp_path / 'home')
    assert compile_kernels(SIMULATION).read_bytes() == CODE
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
    assert not place(SIMULATION).is_relative_to(open_to_all)


def test_machine_code_that_cannot_be_kept_is_told_with_the_folder(package, monkeypatch, tmp_path):
    (tmp_path / 'file').write_text('no folder')
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'file'))
    with pytest.raises(SimulationError, match=f'cannot be kept in {tmp_path}/file.*NUMBA_CACHE_DIR'):
        compile_kernels(SIMULATION)


def test_machine_code_that_cannot_be_loaded_ends_no_process_but_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    strange = machine_code.Compiled('advance', 'symbol', ['numba_does_what_nobody_knows'], b'')
    for code, told in ((b'{"sha256": "", "kernels": []}\n', 'damaged'),
                       (machine_code.encoded([strange]), 'numba_does_what_nobody_knows')):
        monkeypatch.setattr(MADE_BY, lambda module, code=code: code)
        with pytest.raises(SimulationError, match=told):
            compile_kernels(SIMULATION)
        assert not is_compiled(SIMULATION)


def test_a_damaged_file_is_compiled_once_more(tmp_path, monkeypatch):
    good = compile_kernels(SIMULATION).read_bytes()
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    monkeypatch.setattr(MADE_BY, lambda module: good)
    file = compile_kernels(SIMULATION)
    file.write_bytes(good[:-1])
    machine_code.load(SIMULATION)
    assert file.read_bytes() == good


@pytest.mark.parametrize('module', [SIMULATION, TOGETHER])
def test_a_change_of_any_module_with_kernels_compiles_all_that_are_made_of_it(module, tmp_path, monkeypatch):
    folder = Path(kernel_cache.__file__).parent
    names, unread = set(), {module.rpartition('.')[2]}
    while unread:
        text = (folder / f'{unread.pop()}.py').read_text(encoding='utf-8')
        found = set(re.findall(r'^from dlo_calibration\.simulation\.(\w+) import', text, re.MULTILINE))
        unread |= found - names - {'kernel_cache'}
        names |= found - {'kernel_cache'}
    assert len(names) > 5
    shutil.copytree(folder, tmp_path / 'simulation', ignore=shutil.ignore_patterns('__pycache__'))
    monkeypatch.setattr(kernel_cache, '_PACKAGE', tmp_path)
    for name in names:
        before = kernel_cache._name(kernel_cache._file(module))
        with (tmp_path / 'simulation' / f'{name}.py').open('a', encoding='utf-8') as file:
            file.write('# changed\n')
        assert kernel_cache._name(kernel_cache._file(module)) != before, name
