# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Project: a folder with everything that a person entered, which can be opened again.

It holds `project.json` (the document), the original photographs and films, each named by its id, where the
DLO is in each film, and `lens.yaml`.  Removed photographs keep their files, so that removing can be undone.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
import fcntl
from functools import lru_cache
from itertools import count
import json
import os
from pathlib import Path
import secrets
import stat
import string
from threading import Lock
from typing import Any

from dlo_calibration.capture.document import (
    BoardScale,
    Document,
    FilmEntry,
    ID,
    MOST_FILMS,
    NAME_LENGTH,
    PhotographEntry,
    SameScale,
)
from dlo_calibration.capture.json_values import parsed
from dlo_calibration.errors import InputError, safe_line, shortened, unwritable
from dlo_calibration.reading import read_octets
from dlo_calibration.vision.film import Film, read_film
from dlo_calibration.vision.lens import Lens, read_lens
from dlo_calibration.vision.photograph import Photograph, read_photograph
from dlo_calibration.workspace.folder import REQUEST, SESSION
from dlo_calibration.writing import make_folder, whole, write_file

DOCUMENT, LENS, LOCK = 'project.json', 'lens.yaml', '.lock'
PHOTOGRAPHS, FILMS, CALIBRATION = 'photographs', 'films', 'result'  # folders in it
SCENE = 'obstacles.urdf'  # the obstacles of the document; also in the folder of the result
MOST_OCTETS = 4 * 2**20  # of the document; a full one has 2 MB
MOST_FILES = 400  # photographs, with the removed ones
MOST_OCTETS_OF_ALL = 4 * 2**30  # of these
LENS_OCTETS = 2**20  # of a camera calibration
IN_MEMORY = 3  # decoded photographs; one of 12 megapixels takes 36 MB
FILM_SUFFIX = '.film'  # whatever its kind
FOLLOWED_SUFFIX = '.npz'
SUFFIXES = {b'\xff\xd8\xff': '.jpg', b'\x89PN': '.png'}  # first bytes of a file -> its suffix


class OldRevision(InputError):
    """A change of an older state of the document."""


class Project:
    """
    A folder with a document and its photographs.

    :param document: what the person entered.
    :param revision: of the document; it grows with each change.
    :raises InputError: where the folder cannot be used, or another process uses it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _refuse_links(folder)
        make_folder(folder / PHOTOGRAPHS)
        self._lock = _locked(folder)
        self.warnings: list[str] = []  # about the folder when it was opened
        self.revision = 1
        self._decoded = lru_cache(IN_MEMORY)(self._read)
        self._decoding = Lock()
        self.document = self._opened()
        self.lens: Lens | None = None
        self.lens_name: str | None = None
        if (folder / LENS).exists():
            try:
                self.lens, self.lens_name = read_lens(folder / LENS), LENS
            except InputError as error:
                self.warnings.append(f'The camera calibration in the folder is not used: {error}')

    def close(self) -> None:
        """Let other processes use the folder."""
        self._lock.close()

    def change(self, document: Document, revision: int) -> None:
        """
        Save a document in place of the present one.

        :param revision: of the document that was changed.
        :raises OldRevision: where another change came first.
        :raises InputError: if a photograph of it is not in the folder, or it cannot be written.
        """
        if revision != self.revision:
            raise OldRevision('document', f'a change of revision {revision}', f'revision {self.revision}',
                              'repeat the change; another window changed the document')
        for photograph in document.photographs:
            self.path(photograph.id)
        for film in document.films:
            self.film_path(film.id)
        write_file(self.folder / DOCUMENT, json.dumps(document.plain(), indent=1, allow_nan=False))
        self.document, self.revision = document, self.revision + 1

    def add_photograph(self, octets: bytes, name: str) -> str:
        """
        Save a photograph, add it to the document, and return its id.

        Its scale is that of the photograph before: the board, or the same scale while the camera stays.

        :param octets: content of the file.
        :param name: of the file, as the person knows it; it is only shown.
        :raises InputError: if it is no photograph, or the folder is full.
        """
        name = shortened(safe_line(name), NAME_LENGTH) or 'photograph'
        photograph = read_photograph(octets, f'photograph {name}')
        files = [path for path in (self.folder / PHOTOGRAPHS).iterdir() if not path.name.startswith('.')]
        if len(files) >= MOST_FILES or sum(path.lstat().st_size for path in files) > MOST_OCTETS_OF_ALL:
            raise InputError(f'folder {self.folder}', f'{len(files)} photographs', 'fewer',
                             'continue in another folder')
        identity = _new_id()
        entry = PhotographEntry(identity, name, self._next_scale(photograph))
        document = self.document.with_photograph(entry)
        write_file(self.folder / PHOTOGRAPHS / f'{identity}{SUFFIXES[octets[:3]]}', octets)
        self.change(document, self.revision)
        return identity

    def path(self, identity: str) -> Path:
        """Return the file of a photograph, given by its id."""
        if ID.fullmatch(identity):
            for suffix in SUFFIXES.values():
                path = self.folder / PHOTOGRAPHS / f'{identity}{suffix}'
                with suppress(OSError):
                    if stat.S_ISREG(path.lstat().st_mode):  # a link could lead anywhere
                        return path
        raise InputError(f'photograph {identity}', 'no file in the folder of the project', 'its photograph',
                         'add it again')

    def new_film(self) -> Path:
        """
        Return a path at which the content of a film can be written, for `add_film`.

        :raises InputError: if there are too many films.
        """
        if len(self.document.films) >= MOST_FILMS:
            raise InputError('films', f'more than {MOST_FILMS}', 'fewer', 'remove one')
        make_folder(self.folder / FILMS)
        return self.folder / FILMS / f'.{_new_id()}'

    def add_film(self, path: Path, name: str) -> str:
        """
        Add a film to the document, and return its id.

        :param path: of its content, see `new_film`; it is renamed.
        :param name: of the file, as the person knows it; it is only shown.
        :raises InputError: if it is no film.
        """
        name = shortened(safe_line(name), NAME_LENGTH) or 'film'
        try:
            read_film(path)
        except InputError as error:
            raise InputError(f'film {name}', error.came, error.expected, error.remedy) from error
        identity = _new_id()
        path.rename(self.folder / FILMS / f'{identity}{FILM_SUFFIX}')
        films = (*self.document.films, FilmEntry(identity, name))
        self.change(replace(self.document, films=films), self.revision)
        return identity

    def film_path(self, identity: str) -> Path:
        """Return the file of a film, given by its id."""
        path = self.folder / FILMS / f'{identity}{FILM_SUFFIX}'
        with suppress(OSError):
            if ID.fullmatch(identity) and stat.S_ISREG(path.lstat().st_mode):
                return path
        raise InputError(f'film {identity}', 'no file in the folder of the project', 'its film',
                         'add it again')

    def followed_path(self, identity: str) -> Path:
        """Return the file of where the DLO is in a film, given by its id."""
        return self.folder / FILMS / f'{identity}{FOLLOWED_SUFFIX}'

    def film(self, identity: str) -> Film:
        """Return a film, given by its id."""
        return read_film(self.film_path(identity))

    def photograph(self, identity: str) -> Photograph:
        """
        Return a photograph, given by its id; any thread may ask for it.

        :raises InputError: where it cannot be read.
        """
        with self._decoding:
            return self._decoded(identity)

    def _read(self, identity: str) -> Photograph:
        entry = self.document.by_id.get(identity)
        return read_photograph(self.path(identity), f'photograph {entry.name if entry else identity}')

    def set_lens(self, octets: bytes, name: str) -> None:
        """
        Use a camera calibration for all photographs.

        :param octets: content of its file.
        :param name: of the file; it is only shown.
        :raises InputError: if it cannot be used; the one before then stays in use.
        """
        if len(octets) > LENS_OCTETS:
            raise InputError(f'camera calibration {safe_line(name)}', f'more than {LENS_OCTETS} bytes',
                             'the YAML file of a ROS camera calibration', 'check the file')
        with whole(self.folder / LENS) as new:
            new.write_bytes(octets)
            try:
                lens = read_lens(new)
            except InputError as error:
                raise InputError(f'camera calibration {safe_line(name)}', error.came, error.expected,
                                 error.remedy) from error
        self.lens, self.lens_name = lens, shortened(safe_line(name), NAME_LENGTH) or LENS

    def remove_lens(self) -> None:
        """Use no camera calibration."""
        (self.folder / LENS).unlink(missing_ok=True)
        self.lens = self.lens_name = None

    def _opened(self) -> Document:
        """Return the document in the folder; an empty one if there is none, or a damaged one."""
        path = self.folder / DOCUMENT
        if not path.exists():
            return Document()
        try:
            document = Document.of(_json(path))
            for photograph in document.photographs:
                self.path(photograph.id)
            for film in document.films:
                self.film_path(film.id)
            return document
        except InputError as error:
            aside = _free_name(path)
            path.rename(aside)
            self.warnings.append(f'{DOCUMENT} could not be used and is now called {aside.name}; '
                             f'the project begins anew. The reason: {error}')
            return Document()

    def _next_scale(self, photograph: Photograph) -> BoardScale | SameScale | None:
        """Return the scale that the next photograph probably has."""
        scale = self.document.photographs[-1].scale if self.document.photographs else None
        if isinstance(scale, SameScale):
            with suppress(InputError):
                return scale if self.photograph(scale.photograph).size == photograph.size else None
        return scale if isinstance(scale, BoardScale) else None


def _new_id() -> str:
    return ''.join(secrets.choice(string.ascii_lowercase + string.digits) for _ in range(8))


def _refuse_links(folder: Path) -> None:
    """
    Check that a project will read and write only regular files and folders in its folder.

    A link could lead anywhere, and opening a FIFO never ends.

    :raises InputError: for the first link, FIFO or other special file.
    """
    paths = [folder / name for name in (DOCUMENT, LENS, LOCK, PHOTOGRAPHS, FILMS, CALIBRATION, SESSION,
                                      REQUEST, SCENE)]
    try:
        while paths:
            path = paths.pop()
            with suppress(FileNotFoundError, NotADirectoryError):
                mode = path.lstat().st_mode
                if stat.S_ISDIR(mode):
                    paths += path.iterdir()
                elif not stat.S_ISREG(mode):
                    came = 'a link' if stat.S_ISLNK(mode) else 'something that is no file'
                    raise InputError(f'{path}', came, 'the files of a project',
                                     'remove it, or replace it by a copy')
    except OSError as error:
        raise InputError(f'folder {folder}', error.strerror or str(error), 'a folder that can be read',
                         'name another folder') from error


def _json(path: Path) -> Any:
    """Return the plain values in a file, which may be a stranger's."""
    expected, remedy = 'the document of a project', 'restore it from a copy'
    octets = read_octets(path, f'file {path}', expected, MOST_OCTETS)
    if len(octets) > MOST_OCTETS:
        raise InputError(f'file {path}', f'more than {MOST_OCTETS} bytes', expected, remedy)
    try:
        return parsed(octets)
    except (ValueError, RecursionError) as error:
        raise InputError(f'file {path}', f'no JSON document ({error})', expected, remedy) from error


def _free_name(path: Path) -> Path:
    """Return a free name for a damaged file."""
    names = (path.with_name(f'{path.stem}_damaged_{number}{path.suffix}') for number in count(1))
    return next(aside for aside in names if not aside.exists())


def _locked(folder: Path) -> Any:
    """Return an open file that locks this folder until it is closed."""
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
