# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The kernel cache: where Numba keeps the machine code of the kernels, and whether it is there.

Numba writes it beside the kernels, or into the user's cache where that folder is read-only.  What an
installer compiled into a read-only folder is copied from there: Numba itself reads only folders that it can
write.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
import hashlib
import importlib
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import platform
import shutil
import stat
import sys
import tempfile

CHOSEN = 'NUMBA_CACHE_DIR'  # the environment variable that tells Numba where
_PACKAGE = Path(os.path.abspath(__file__)).parents[1]
#: module with kernels -> what they do, in words
KERNELS: dict[str, str] = {
    'dlo_calibration.simulation.kernels': 'simulation',
    'dlo_calibration.simulation.kernels_together': 'simulation of several trials at once',
    'dlo_calibration.capture.path': 'tracer'}
SIMULATION, TOGETHER, TRACER = KERNELS
#: name of a module with kernels -> modules whose kernels are compiled with its own
_PARTS = {'kernels': ('kernels_carry', 'kernels_contact', 'kernels_frame', 'kernels_near', 'kernels_slip')}
#: name of a module with kernels -> other modules that its machine code depends on
_SOURCES = {'kernels': ('compilation', 'lanes', *_PARTS['kernels']),
            'kernels_together': ('compilation', 'lanes', 'kernels', *_PARTS['kernels'])}


def settle(folder: Path) -> None:
    """See to it, before kernels in a folder of the package are imported, that Numba has a place for them."""
    if os.environ.get(CHOSEN):
        return
    beside, users = folder / '__pycache__', _below(_users(), folder)
    if _writable(beside):
        return
    if not _writable(users):
        os.environ[CHOSEN] = str(_until_the_next_boot())  # processes that this one starts use it, too
        return
    for file in (file for file in map(_file, KERNELS) if file.parent == folder):
        name = _mark(file)
        if (beside / name).exists() and not (users / name).exists():
            with suppress(OSError):  # then they are compiled once more
                users.mkdir(parents=True, exist_ok=True)
                for one in [*_code(file, beside), beside / name]:
                    shutil.copyfile(one, users / one.name)


def place(module: str) -> Path:
    """Return the folder in which Numba keeps the machine code of a module's kernels."""
    folder = _file(module).parent
    if chosen := os.environ.get(CHOSEN):
        return _below(Path(chosen), folder)
    beside = folder / '__pycache__'
    return beside if _writable(beside) else _below(_users(), folder)


def is_compiled(module: str) -> bool:
    """Tell, without loading Numba, whether this machine has compiled the kernels of a module."""
    return (place(module) / _mark(_file(module))).exists()


def compile_kernels(module: str) -> None:
    """Import a module, which compiles its kernels or loads them, and note that they are compiled."""
    folder, mark = place(module), _mark(_file(module))
    begun = (folder / mark).with_suffix('.begun')
    with suppress(OSError):
        if not (folder / mark).exists() and not begun.exists():
            # Numba does not notice that another module has changed; after an interruption it may go on.
            for old in _code(_file(module), folder):
                old.unlink()
            folder.mkdir(parents=True, exist_ok=True)
            begun.touch()
    importlib.import_module(module)
    with suppress(OSError):
        (folder / mark).touch()


def remark() -> str:
    """Return what to tell where no lasting place can be written; else nothing."""
    chosen = os.environ.get(CHOSEN, '')
    if chosen != str(_until_the_next_boot(make=False)):
        return ''
    return (f'neither {_PACKAGE} nor {_users()} can be written: compiled code is kept in {chosen}, which '
            f'may not stay; set {CHOSEN} to a folder that does')


def _file(module: str) -> Path:
    return _PACKAGE.joinpath(*module.split('.')[1:]).with_suffix('.py')


def _code(file: Path, folder: Path) -> list[Path]:
    """Return the files in a folder with the machine code of a module's kernels."""
    stems = file.stem, *_PARTS.get(file.stem, ())
    return [one for stem in stems for one in folder.glob(f'{stem}.*.nb[ic]')]


def _users() -> Path:
    """Return where Numba keeps code of packages that are read-only."""
    return Path(os.environ.get('XDG_CACHE_HOME') or Path('~/.cache').expanduser()) / 'numba'


def _below(cache: Path, folder: Path) -> Path:
    """Return the folder in a cache that Numba uses for the modules of a folder."""
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


def _mark(file: Path) -> str:
    """Return the name of the file that tells that a module's kernels, as they are now, were compiled here."""
    sources = [file, *(file.with_name(f'{name}.py') for name in _SOURCES.get(file.stem, ()))]
    return _mark_of(file.stem, tuple((one, one.stat().st_mtime_ns) for one in sources if one.exists()))


@lru_cache(maxsize=16)
def _mark_of(stem: str, sources: tuple[tuple[Path, int], ...]) -> str:
    found = hashlib.sha256()
    for source, _ in sources:
        found.update(source.read_bytes())
    for name in ('numba', 'llvmlite'):
        with suppress(PackageNotFoundError):
            found.update(version(name).encode())
    found.update(f'{sys.implementation.cache_tag} {platform.machine()}'.encode())
    with suppress(OSError):  # Numba compiles for the processor that it finds
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8', errors='replace').splitlines()
        found.update('\n'.join(dict.fromkeys(
            one for one in lines if one.startswith(('model name', 'flags', 'Features')))).encode())
    return f'{stem}.{found.hexdigest()[:16]}.compiled'
