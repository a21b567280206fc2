# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Writing: a file is complete or absent, whatever happens to the disk or the process."""

from __future__ import annotations

from contextlib import contextmanager, suppress
import errno
import fcntl
import os
from pathlib import Path
import shutil
import stat
import tempfile
from typing import Iterator

from dlo_calibration.errors import DloCalibrationError, InputError, unwritable

SCRATCH = '.dlo_calibration_scratch_'  # begins the names of temporary folders, and of nothing else

_unfinished: set[Path] = set()  # files that are being written
_scratch: set[Path] = set()  # temporary folders in use


def remove_unfinished() -> None:
    """Remove the files that are being written, and temporary folders; for a process that ends now."""
    for path in list(_unfinished):
        with suppress(OSError):
            os.unlink(path)
    for path in list(_scratch):
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def _temporary(folder: Path, suffix: str = '') -> Iterator[Path]:
    """Give the path of a temporary file, and remove the file when the block ends."""
    path = folder / f'.unfinished_{os.urandom(8).hex()}{suffix}'  # nobody else can know it
    _unfinished.add(path)
    try:
        yield path
    finally:
        with suppress(OSError):
            os.unlink(path)
        _unfinished.discard(path)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """
    Give a temporary folder, and remove it when the block ends or a signal ends the process.

    A killed process leaves its folder.  The next process that needs such a folder removes it, because no
    process holds its lock any longer.
    """
    for abandoned in Path(tempfile.gettempdir()).glob(f'{SCRATCH}*'):
        with suppress(OSError), _locked(abandoned, fcntl.LOCK_EX | fcntl.LOCK_NB):
            shutil.rmtree(abandoned)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=SCRATCH))
        with _locked(folder, fcntl.LOCK_EX):
            if not folder.exists():  # removed by another process before it was locked
                continue
            _scratch.add(folder)
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                _scratch.discard(folder)
            return


@contextmanager
def _locked(folder: Path, how: int) -> Iterator[None]:
    """
    Lock a folder of this user; `how` as for `fcntl.flock`.

    :raises OSError: where it cannot be locked, is no folder, or belongs to another user.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(descriptor).st_uid != os.geteuid():
            raise PermissionError(errno.EPERM, 'the folder belongs to another user')
        fcntl.flock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def replacing(path: Path, fsync: bool = True) -> Iterator[Path]:
    """
    Give the path of a new file, which takes the place of `path` when the block ends without an error.

    After an error, `path` is as before, and no temporary file remains.  A link at `path` is replaced, not
    followed; anything else there that is no file is refused.

    :param fsync: False: do not wait for the disk.  A power failure may then cost the file.
    :raises OSError: where the file cannot be written.
    """
    with suppress(FileNotFoundError):
        kind = os.lstat(path).st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISLNK(kind)):
            raise OSError(errno.EEXIST, 'something that is no file has this name')
    with _temporary(path.parent, path.suffix) as new:
        yield new
        if fsync:  # some file systems report only now that they are full
            descriptor = os.open(new, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        os.replace(new, path)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """
    Do what `replacing` does, with errors for users.

    :raises InputError: where the file cannot be written.
    """
    try:
        with replacing(path) as new:
            yield new
    except OSError as error:
        raise unwritable(path, error) from error


def write_file(path: str | Path, content: str | bytes) -> None:
    """
    Write a file, a text in UTF-8.

    :raises InputError: if it cannot be written.
    """
    with whole(Path(path)) as new:
        new.write_bytes(content.encode() if isinstance(content, str) else content)


def make_folder(folder: Path) -> None:
    """
    Make a folder, with its parents, and check that a file can be written there.

    :raises InputError: if that is not possible.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _temporary(folder) as new:
            new.write_bytes(b'?')  # a full disk may still make a file without content
    except FileExistsError as error:
        raise InputError(f'folder {folder}', 'a file of this name', 'a folder, or a name that is free',
                         'choose another place') from error
    except OSError as error:
        raise unwritable(folder, error, 'folder') from error


class Attempts:
    """
    Files that are written one after the other; a failure does not prevent the next file.

    :param folder: where they belong.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written: list[str] = []
        self._failed: dict[str, str] = {}

    @contextmanager
    def attempt(self, name: str) -> Iterator[None]:
        """Write one file in this block; its error is recorded, not raised."""
        try:
            yield
        except (DloCalibrationError, OSError) as error:
            self.fail(name, reason(error))
        else:
            self.written.append(name)

    def fail(self, name: str, why: str) -> None:
        """Note that a file could not be written."""
        self._failed[name] = why

    @property
    def failure(self) -> str:
        """What could not be written and why, as a part of a sentence; empty if all could be."""
        if not self._failed:
            return ''
        names = [f'{name} (an older one is there)' if (self.folder / name).is_file() else name
                 for name in self._failed]
        return f'{", ".join(names)}: {"; ".join(dict.fromkeys(self._failed.values()))}'

    def require(self) -> None:
        """
        Do nothing if all files were written.

        :raises DloCalibrationError: if not; it names the files that failed and those that were written.
        """
        if self._failed:
            there = f'; {", ".join(self.written)} could be' if self.written else ''
            raise DloCalibrationError(f'folder {self.folder}: could not be written: {self.failure}{there}; '
                                      'make room, or choose another folder, and repeat the command')


def reason(error: Exception) -> str:
    """Return why something could not be written, without its path."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return error.came if isinstance(error, InputError) else ' '.join(str(error).split()) or repr(error)
