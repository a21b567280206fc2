# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bag reader: reads an MCAP file, a rosbag2 folder or a .db3 file, even if it is damaged."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Mapping

from dlo_calibration.errors import InputError
from dlo_calibration.files.bag import Bag, LimitExceeded, unpack_file
from dlo_calibration.files.mcap_file import McapFile
from dlo_calibration.files.recording import METADATA_FILE, METADATA_KEY
from dlo_calibration.files.sqlite_file import read_sqlite
from dlo_calibration.reading import parse_yaml, require_file
from dlo_calibration.writing import scratch_folder

SUFFIXES = ('.mcap', '.db3', '.zstd')  # of recordings in a folder
EXPECTED = 'an MCAP file, a rosbag2 folder, or an XML request (.xml)'
METADATA_SIZE = 10**6  # bytes; a recording of a hundred topics in a thousand files has a third


def read_bag(path: Path, remap: Mapping[str, str]) -> Bag:
    """
    Read a file or a folder.

    :param remap: topic -> name of the input topic as which it is read.
    :raises InputError: where nothing in it can be read.
    """
    bag = Bag(remap)
    try:
        if path.is_dir():
            _read_folder(path, bag)
        else:
            require_file(path, f'session {path}', EXPECTED)
            _read_file(path, path, bag)
    except OSError as error:
        raise _unusable(path, error.strerror or str(error), 'a file or a folder that can be read',
                        'check the path and its permissions') from error
    return bag


def _unusable(path: Path, came: str, expected: str, remedy: str) -> InputError:
    """Return the error for a recording that cannot be read at all."""
    return InputError(f'session {path}', came, expected, remedy)


def _read_folder(path: Path, bag: Bag) -> None:
    """Read all files of a rosbag2 folder."""
    files = _files(path, bag)
    if not files:
        raise _unusable(path, 'a folder without a recording', 'a rosbag2 folder, or an MCAP file',
                        'name the folder that holds the metadata.yaml')
    refusals = []
    for file in files:
        try:
            why = _unreadable(file)
            if why:
                raise _unusable(path, f'{file.name}: {why}', 'the whole rosbag2 folder',
                                'copy the recording with all of its files')
            _read_file(path, file, bag)
        except InputError as error:
            refusals.append(error)
    if len(refusals) == len(files):
        raise refusals[0]
    bag.warnings.extend(map(str, refusals))


def _files(path: Path, bag: Bag) -> list[Path]:
    """Return the recordings of a folder that metadata.yaml names; all where it cannot be read."""
    file = path / METADATA_FILE
    names: list[str] = []
    try:
        why = _unreadable(file)
        if why:
            bag.warnings.append(f'{METADATA_FILE}: {why}')
        else:
            names = _recordings(file)
    except OSError:
        raise
    except Exception:  # damaged YAML can raise anything
        bag.warnings.append(f'{METADATA_FILE} cannot be read; all recordings in the folder are read instead')
    return [path / name for name in dict.fromkeys(names)] or sorted(
        file for file in path.iterdir() if file.suffix in SUFFIXES)


def _read_file(path: Path, file: Path, bag: Bag) -> None:
    """Read one recording; a defect becomes a warning, or an error where nothing was read."""
    records, messages = len(bag.records), sum(bag.counts.values())
    try:
        if file.suffix == '.zstd':  # rosbag2 compressed it as a whole
            bag.open(file.stat().st_size)
            with scratch_folder() as folder:
                unpacked = folder / f'recording{file.with_suffix("").suffix}'
                unpack_file(file, unpacked, bag.unpack)
                _read_unpacked(unpacked, file, bag)
        else:
            _read_unpacked(file, file, bag)
        return
    except (OSError, InputError):
        raise
    except LimitExceeded as error:
        text = f'{file.name} is not read to its end: {error}; the {len(bag.records) - records} message(s) ' \
               'before that are used; split the recording'
    except Exception as error:  # damaged files can raise anything
        text = ' '.join(f'{type(error).__name__}: {error}'.split())
        text = f'{file.name} is cut or damaged ({text}); ' \
               f'the {len(bag.records) - records} message(s) before that were read'
    if sum(bag.counts.values()) == messages:
        raise _unusable(path, f'a file without a readable message ({text.partition(";")[0]})', EXPECTED,
                        'name another file, or record it again')
    bag.warnings.append(text)


def _read_unpacked(path: Path, file: Path, bag: Bag) -> None:
    """Read a recording at `path`: a file of the session, or its unpacked content."""
    if path.suffix == '.db3':
        read_sqlite(path, file, bag)
        return
    with path.open('rb') as stream:
        McapFile(stream, path.stat().st_size, file.name, bag).read()


def _unreadable(file: Path) -> str:
    """Return why a file of a folder must not be read; empty if it may."""
    if file.is_symlink() and file.resolve().parent != file.parent.resolve():
        return 'it is left out, as it is a link out of the folder; name the file it leads to'
    if not file.exists():
        return 'it is missing' + ('' if file.name == METADATA_FILE else f', though {METADATA_FILE} names it')
    return '' if file.is_file() else 'it is left out, as it is no regular file'


def _recordings(file: Path) -> list[str]:
    """Return the names of the recordings in a metadata.yaml; a damaged file can raise anything."""
    with file.open('rb') as stream:
        octets = stream.read(METADATA_SIZE + 1)
    if len(octets) > METADATA_SIZE:
        raise ValueError('too large')
    whole = parse_yaml(octets)
    names = whole[METADATA_KEY].get('relative_file_paths') or []
    if not isinstance(names, list):
        raise ValueError('no list of files')
    return [PurePath(name).name for name in names]
