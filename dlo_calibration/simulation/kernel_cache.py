# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The kernel cache: where the machine code of the kernels is kept, and whether it is there.

It lies beside the kernels, or in the user's cache of Numba, which compiles them, where that folder is
read-only.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
import hashlib
from importlib.util import find_spec
import os
from pathlib import Path
import platform
import stat
import subprocess
import sys
import tempfile

from dlo_calibration.errors import SimulationError
from dlo_calibration.writing import replacing

CHOSEN = 'NUMBA_CACHE_DIR'  # the environment variable that tells where, to Numba as well
_PACKAGE = Path(os.path.abspath(__file__)).parents[1]
#: module with kernels -> what they do, in words
KERNELS: dict[str, str] = {
    'dlo_calibration.simulation.kernels': 'simulation',
    'dlo_calibration.simulation.kernels_together': 'simulation of several trials at once',
    'dlo_calibration.capture.path_kernels': 'tracer'}
SIMULATION, TOGETHER, TRACER = KERNELS
#: modules that machine code depends on, whatever kernels it is made of
_SOURCES = ('compilation', 'lanes', 'machine_code', 'states', 'kernels*')


def place(module: str) -> Path:
    """Return the folder in which the machine code of a module's kernels is kept, or would be."""
    return _place(_file(module))


def is_compiled(module: str) -> bool:
    """Tell, without loading Numba, whether this machine has compiled the kernels of a module."""
    file = _file(module)
    return (_place(file) / _name(file)).exists()


def compile_kernels(module: str) -> Path:
    """
    Compile the kernels of a module if they are not; return the file with their machine code.

    :raises SimulationError: if they cannot be compiled, kept or loaded.
    """
    source = _file(module)
    folder, name = _place(source), _name(source)
    if not (folder / name).exists():
        # With Intel's library of vector functions, machine code could not be loaded without Numba.
        os.environ.setdefault('NUMBA_DISABLE_INTEL_SVML', '1')
        from dlo_calibration.simulation.compilation import machine_code

        code = machine_code(module)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / name) as new:
                new.write_bytes(code)
                _try(new)
        except OSError as error:
            raise SimulationError(
                f'the machine code of the {KERNELS.get(module, module)} cannot be kept in {folder}: {error}; '
                f'let {CHOSEN} name a folder that can be written') from error
    return folder / name


def remark() -> str:
    """Return what to tell where no lasting place can be written; else nothing."""
    chosen = os.environ.get(CHOSEN, '')
    if chosen != str(_until_the_next_boot(make=False)):
        return ''
    return (f'neither {_PACKAGE} nor {_users()} can be written: compiled code is kept in {chosen}, which '
            f'may not stay; set {CHOSEN} to a folder that does')


def _file(module: str) -> Path:
    if module in KERNELS:  # without importing the packages that it is in
        return _PACKAGE.joinpath(*module.split('.')[1:]).with_suffix('.py')
    found = find_spec(module)
    assert found is not None and found.origin is not None
    return Path(found.origin)


def _place(file: Path) -> Path:
    folder = file.parent
    if chosen := os.environ.get(CHOSEN):
        return _below(Path(chosen), folder)
    places = folder / '__pycache__', _below(_users(), folder)
    for one in places:
        if (one / _name(file)).exists():  # an installer may have compiled into a folder that is read-only now
            return one
    for one in places:
        if _writable(one):
            return one
    os.environ[CHOSEN] = str(_until_the_next_boot())  # processes that this one starts use it, too
    return _place(file)


def _try(file: Path) -> None:
    """
    Load machine code in another process: one that cannot load it would end.

    :raises SimulationError: if it cannot be loaded.
    """
    program = ('import sys; from pathlib import Path; '
               'from dlo_calibration.simulation.machine_code import loaded; loaded(Path(sys.argv[1]))')
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    # -P: files in the folder in which the user works may have any name.
    done = subprocess.run([sys.executable, '-P', '-c', program, str(file)], capture_output=True, check=False,
                          text=True, env=environment)
    if done.returncode:
        raise SimulationError(f'what Numba compiled cannot be loaded: {done.stderr.strip()[-500:]}')


def _users() -> Path:
    """Return where Numba keeps code of packages that are read-only."""
    return Path(os.environ.get('XDG_CACHE_HOME') or Path('~/.cache').expanduser()) / 'numba'


def _below(cache: Path, folder: Path) -> Path:
    """Return the folder in a cache that is for the modules of a folder."""
    return cache / f'{folder.name}_{hashlib.sha1(str(folder).encode(), usedforsecurity=False).hexdigest()}'


def _writable(folder: Path) -> bool:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)


def _until_the_next_boot(make: bool = True) -> Path:
    """Return a folder of this user alone, for temporary files: whoever can write there can run code here."""
    user = os.getuid() if hasattr(os, 'getuid') else 0
    folder = Path(tempfile.gettempdir()) / f'dlo_calibration_kernels_{user}'
    if make:
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077:
                return folder
        return Path(tempfile.mkdtemp(prefix='dlo_calibration_'))
    return folder


def _name(file: Path) -> str:
    """Return the name of the file with the machine code of a module's kernels, as they are now."""
    folder = _PACKAGE / 'simulation'
    sources = [file, *(one for name in _SOURCES for one in sorted(folder.glob(f'{name}.py')))]
    return _name_of(file.stem, tuple((one, one.stat().st_mtime_ns) for one in sources))


@lru_cache(maxsize=16)
def _name_of(stem: str, sources: tuple[tuple[Path, int], ...]) -> str:
    found = hashlib.sha256()
    for source, _ in sources:
        found.update(source.read_bytes())
    for name in ('numba', 'llvmlite'):
        spec = find_spec(name)
        if spec is not None and spec.origin:
            with suppress(OSError):  # importlib.metadata would take longer than all the rest
                found.update(Path(spec.origin).with_name('_version.py').read_bytes())
    found.update(f'{sys.implementation.cache_tag} {platform.machine()}'.encode())
    with suppress(OSError):  # Numba compiles for the processor that it finds
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8', errors='replace').splitlines()
        found.update('\n'.join(dict.fromkeys(
            one for one in lines if one.startswith(('model name', 'flags', 'Features')))).encode())
    return f'{stem}.{found.hexdigest()[:16]}.compiled'
