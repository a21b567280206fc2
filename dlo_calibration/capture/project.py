# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Project: a folder that keeps all that a person did, to be opened again.

It holds `project.json` (the document), the photographs as they came, each named by its id, and `lens.yaml`.
Photographs that the document no longer has keep their files, so that removing one can be undone.
"""

from __future__ import annotations

from collections import OrderedDict
from contextlib import suppress
import fcntl
import json
import os
from pathlib import Path
import secrets
import stat
import string
from threading import Lock
from typing import Any

from dlo_calibration.capture.camera import Lens, read_lens
from dlo_calibration.capture.document import BoardScale, Document, ID, NAME_LENGTH, PhotographEntry, SameScale
from dlo_calibration.capture.photograph import Photograph, read_photograph
from dlo_calibration.errors import InputError, shortened, told, unwritable
from dlo_calibration.writing import make_folder, whole

DOCUMENT, LENS, PHOTOGRAPHS, LOCK = 'project.json', 'lens.yaml', 'photographs', '.lock'
MOST_OCTETS = 4 * 2**20  # of the document; a full one has 2 MB
MOST_FILES = 400  # photographs, also those that were removed
MOST_OCTETS_OF_ALL = 4 * 2**30  # of these
LENS_OCTETS = 2**20
IN_MEMORY = 3  # decoded photographs; one of 12 megapixels takes 36 MB
SUFFIXES = {b'\xff\xd8\xff': '.jpg', b'\x89PN': '.png'}  # first bytes of a file -> its suffix


class OldRevision(InputError):
    """A change that was made to an older state of the document."""


class Project:
    """
    A folder with a document and its photographs.

    :param document: what the person said.
    :param revision: of the document; it grows with each change.
    :raises InputError: where the folder cannot be used, or another process uses it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_folder(folder / PHOTOGRAPHS)
        self._lock = _locked(folder)
        self._problems: list[str] = []
        self.revision = 1
        self._decoded: OrderedDict[str, Photograph] = OrderedDict()
        self._reading = Lock()
        self.document = self._opened()
        self.lens: Lens | None = None
        self.lens_name: str | None = None
        if (folder / LENS).exists():
            try:
                self.lens, self.lens_name = read_lens(folder / LENS), LENS
            except InputError as error:
                self._problems.append(f'The camera calibration in the folder is not used: {error}')

    @property
    def problems(self) -> tuple[str, ...]:
        """Sentences about what was wrong in the folder when it was opened."""
        return tuple(self._problems)

    def close(self) -> None:
        """Let other processes use the folder."""
        self._lock.close()

    def change(self, document: Document, revision: int) -> None:
        """
        Keep a document in place of the present one.

        :param revision: of the document that was changed.
        :raises OldRevision: where another change came first.
        :raises InputError: where it names a photograph that the folder does not have, or cannot be written.
        """
        if revision != self.revision:
            raise OldRevision('document', f'a change of revision {revision}', f'revision {self.revision}',
                              'repeat the change; another window changed the document')
        for one in document.photographs:
            self.path(one.id)
        with whole(self.folder / DOCUMENT) as new:
            new.write_text(json.dumps(document.plain(), indent=1, allow_nan=False), encoding='utf-8')
        self.document, self.revision = document, self.revision + 1

    def add_photograph(self, octets: bytes, name: str) -> str:
        """
        Keep a photograph, put it into the document, and return its id.

        Where the photograph before it has the board, or is that of a camera that does not move, it has too.

        :param octets: content of the file.
        :param name: of the file, as the person knows it; it is only shown.
        :raises InputError: where it is no photograph, or is one too many.
        """
        name = shortened(told(name), NAME_LENGTH) or 'photograph'
        photograph = read_photograph(octets, f'photograph {name}')
        files = [one for one in (self.folder / PHOTOGRAPHS).iterdir() if not one.name.startswith('.')]
        if len(files) >= MOST_FILES or sum(one.lstat().st_size for one in files) > MOST_OCTETS_OF_ALL:
            raise InputError(f'folder {self.folder}', f'{len(files)} photographs', 'fewer',
                             'go on in another folder')
        one = ''.join(secrets.choice(string.ascii_lowercase + string.digits) for _ in range(8))
        document = self.document.with_photograph(PhotographEntry(one, name, self._next_scale(photograph)))
        with whole(self.folder / PHOTOGRAPHS / f'{one}{SUFFIXES[octets[:3]]}') as new:
            new.write_bytes(octets)
        with self._reading:
            self._keep(one, photograph)
        self.change(document, self.revision)
        return one

    def path(self, one: str) -> Path:
        """Return the file of a photograph, given by its id."""
        if ID.fullmatch(one):
            for suffix in SUFFIXES.values():
                path = self.folder / PHOTOGRAPHS / f'{one}{suffix}'
                with suppress(OSError):
                    if stat.S_ISREG(path.lstat().st_mode):  # a link could lead anywhere
                        return path
        raise InputError(f'photograph {one}', 'no file in the folder of the project', 'its photograph',
                         'add it again')

    def photograph(self, one: str) -> Photograph:
        """
        Return a photograph, given by its id; any thread may ask for it.

        :raises InputError: where it cannot be read.
        """
        with self._reading:
            found = self._decoded.get(one)
            if found is None:
                entry = self.document.by_id.get(one)
                found = read_photograph(self.path(one), f'photograph {entry.name if entry else one}')
            self._keep(one, found)
            return found

    def set_lens(self, octets: bytes, name: str) -> None:
        """
        Use a camera calibration for all photographs.

        :param octets: content of its file.
        :param name: of the file; it is only shown.
        :raises InputError: where it cannot be used; the one before is then kept.
        """
        if len(octets) > LENS_OCTETS:
            raise InputError(f'camera calibration {told(name)}', f'more than {LENS_OCTETS} bytes',
                             'the YAML file of a ROS camera calibration', 'check the file')
        with whole(self.folder / LENS) as new:
            new.write_bytes(octets)
            try:
                lens = read_lens(new)
            except InputError as error:
                raise InputError(f'camera calibration {told(name)}', error.came, error.expected,
                                 error.remedy) from error
        self.lens, self.lens_name = lens, shortened(told(name), NAME_LENGTH) or LENS

    def remove_lens(self) -> None:
        """Use no camera calibration."""
        with suppress(FileNotFoundError):
            (self.folder / LENS).unlink()
        self.lens = self.lens_name = None

    def _opened(self) -> Document:
        """Return the document in the folder; an empty one where there is none that can be used."""
        path = self.folder / DOCUMENT
        if not path.exists() and not path.is_symlink():
            return Document()
        try:
            document = Document.of(_json(path))
            for one in document.photographs:
                self.path(one.id)
            return document
        except InputError as error:
            aside = _free_name(path)
            path.rename(aside)
            self._problems.append(f'{DOCUMENT} could not be used and is now called {aside.name}; '
                              f'the project begins anew. The reason: {error}')
            return Document()

    def _next_scale(self, photograph: Photograph) -> BoardScale | SameScale | None:
        """Return the scale that the next photograph probably has."""
        last = self.document.photographs[-1:]
        if not last or not isinstance(last[0].scale, (BoardScale, SameScale)):
            return None
        if isinstance(last[0].scale, SameScale):
            with suppress(InputError):
                if self.photograph(last[0].scale.photograph).size == photograph.size:
                    return last[0].scale
            return None
        return last[0].scale

    def _keep(self, one: str, photograph: Photograph) -> None:
        self._decoded[one] = photograph
        self._decoded.move_to_end(one)
        while len(self._decoded) > IN_MEMORY:
            self._decoded.popitem(last=False)


def _json(path: Path) -> Any:
    """Return the plain values in a file, which may come from a stranger."""
    expected, remedy = 'the document of a project', 'restore it from a copy'
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            raise InputError(f'file {path}', 'something that is no file', expected, remedy)
        with path.open('rb') as stream:
            octets = stream.read(MOST_OCTETS + 1)
        if len(octets) > MOST_OCTETS:
            raise InputError(f'file {path}', f'more than {MOST_OCTETS} bytes', expected, remedy)
        return json.loads(octets.decode('utf-8'), parse_constant=_refuse_constant)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f'file {path}', f'no JSON document ({error})', expected, remedy) from error


def _refuse_constant(text: str) -> Any:
    raise ValueError(f'{text} is no number')


def _free_name(path: Path) -> Path:
    """Return a name for a damaged file that no other file has."""
    number = 1
    while (aside := path.with_name(f'{path.stem}_damaged_{number}{path.suffix}')).exists():
        number += 1
    return aside


def _locked(folder: Path) -> Any:
    """Return an open file that keeps other processes from this folder, until it is closed."""
    try:
        # A link at this name is not followed.
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        stream = os.fdopen(descriptor, 'r+b')
    except OSError as error:
        raise unwritable(folder / LOCK, error) from error
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        stream.close()
        raise InputError(f'folder {folder}', 'a folder that another capture has open', 'a folder of its own',
                         'end the other one, or name another folder') from error
    return stream
