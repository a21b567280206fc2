# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bag: reads the messages of an MCAP file, a rosbag2 folder or a .db3 file, even if it is damaged."""

from __future__ import annotations

import json
from pathlib import Path, PurePath
import tempfile
from typing import Any, Iterable, Mapping

from dlo_calibration.errors import InputError
from dlo_calibration.files.input_messages import DEFINITIONS, input_types
from dlo_calibration.files.intake import Intake, LimitExceeded, Record, require_file
from dlo_calibration.files.mcap_file import McapFile
from dlo_calibration.files.recording import METADATA_FILE, METADATA_KEY, typestore
from dlo_calibration.files.sqlite_file import read_sqlite
from dlo_calibration.files.unpacking import unpack_file
from dlo_calibration.files.yaml import read_first
from dlo_calibration.messages.codec import INPUT_TYPES

SUFFIXES = ('.mcap', '.db3', '.zstd')  # of recordings in a folder
EXPECTED = 'an MCAP file, a rosbag2 folder, or an XML request (.xml)'
METADATA_SIZE = 10**6  # bytes; a recording of a hundred topics in a thousand files has a third
OPTIONS_SIZE = 10**5  # characters of recorded options; ours have 2000


def decode(record: Record) -> Any:
    """
    Return the message of a record, as an object with the fields of its type.

    :raises InputError: where the bytes are not a message of that type.
    """
    try:
        types = input_types() if record.type in DEFINITIONS else typestore()
        return types.deserialize_cdr(record.data, record.type)
    except Exception as error:  # damaged bytes can raise anything
        raise InputError(
            f'{record.name} recorded at {record.log_time / 1e9:.3f} s',
            f'bytes that do not decode ({error!r})', f'a {record.type}',
            'leave that message out, or record the session again') from error


def encode(message: Any, message_type: str) -> bytes:
    """Return the CDR bytes of a message object of the library rosbags."""
    return bytes(typestore().serialize_cdr(message, message_type))


class Bag:
    """
    The parts of a recording that were read so far, from one or more files.

    :param remap: topic -> name of the input topic as which it is read.
    """

    def __init__(self, path: Path, remap: Mapping[str, str]) -> None:
        self.path = path
        self.intake = Intake(remap)
        self.marks: list[tuple[str, int]] = []  # each mark, and the number of records before it
        self.taken_back: list[str] = []  # marks of trials that the last calibration did without; see `used`
        self._options: str | None = None  # the last recorded ones
        self._dropped = '{}'  # the last count of messages that the recording node dropped, as JSON

    @property
    def records(self) -> list[Record]:
        """The messages that are kept, as they came."""
        return self.intake.records

    @property
    def problems(self) -> list[str]:
        """One text for each defect."""
        return self.intake.problems

    def unusable(self, came: str, expected: str, remedy: str) -> InputError:
        """Return the error for a source that cannot be read at all."""
        return InputError(f'session {self.path}', came, expected, remedy)

    def dropped(self) -> list[str]:
        """Return a text for each kind of message of which the recording node dropped some."""
        try:
            counts = json.loads(self._dropped)
            return [f'{int(counts[kind])} {kind} message(s) came faster than the node could read them, '
                    'and were dropped' for kind in INPUT_TYPES if kind in counts]
        except (ValueError, TypeError):
            return []

    def used(self, inputs: Iterable[Record]) -> list[Record]:
        """
        Return the inputs that the last calibration used, or all where none was started.

        Inputs before a reset are left out, unless none came after it.
        """
        inputs = list(inputs)
        places = {id(record): place for place, record in enumerate(self.records)}
        newest = max((places[id(record)] for record in inputs), default=0)
        first = max((place for mark, place in self.marks if mark == 'reset' and place <= newest), default=0)
        last = max((place for mark, place in self.marks if mark == 'start' and place > first),
                   default=len(self.records))
        self.taken_back = [mark for mark, place in self.marks if first <= place < last]
        return [record for record in inputs if first <= places[id(record)] < last]

    def read(self) -> None:
        """
        Read the file or the folder.

        :raises InputError: where nothing in it can be read.
        """
        try:
            if self.path.is_dir():
                self._read_folder()
            else:
                require_file(self.path, f'session {self.path}', EXPECTED)
                self._read_file(self.path)
        except OSError as error:
            raise self.unusable(error.strerror or str(error), 'a file or a folder that can be read',
                                'check the path and its permissions') from error

    def _read_folder(self) -> None:
        """Read all files of a rosbag2 folder."""
        files = self._files()
        if not files:
            raise self.unusable('a folder without a recording', 'a rosbag2 folder, or an MCAP file',
                                'name the folder that holds the metadata.yaml')
        found = []
        for file in files:
            why = _unreadable(file)
            if why:
                self.problems.append(f'{file.name}: {why}')
            else:
                found.append(file)
        if not found:
            raise self.unusable(f'no recording that can be read ({self.problems[-1]})',
                                'the whole rosbag2 folder', 'copy the recording with all of its files')
        refusals = []
        for file in found:
            try:
                self._read_file(file)
            except InputError as error:
                refusals.append(error)
        if len(refusals) == len(found):
            raise refusals[0]
        self.problems.extend(str(error) for error in refusals)

    def _files(self) -> list[Path]:
        """Return the recordings of a folder that metadata.yaml names; all where it cannot be read."""
        file = self.path / METADATA_FILE
        names: list[str] = []
        try:
            why = _unreadable(file)
            if why:
                self.problems.append(f'{METADATA_FILE}: {why}')
            else:
                names = _recordings(file)
        except OSError:
            raise
        except Exception:  # damaged YAML can raise anything
            self.problems.append(
                f'{METADATA_FILE} cannot be read; all recordings in the folder are read instead')
        return [self.path / name for name in dict.fromkeys(names)] or sorted(
            one for one in self.path.iterdir() if one.suffix in SUFFIXES)

    def _read_file(self, file: Path) -> None:
        """Read one recording; a defect is noted, or raised where nothing was read."""
        before = len(self.records), sum(self.intake.counts.values())
        try:
            if file.suffix == '.zstd':
                self._read_packed(file)
            else:
                self._read_unpacked(file, file.name)
            return
        except (OSError, InputError):
            raise
        except LimitExceeded as error:
            text = f'{file.name} is not read to its end: {error}; the ' \
                   f'{len(self.records) - before[0]} message(s) before that are used; split the recording'
        except Exception as error:  # damaged files can raise anything
            text = ' '.join(f'{type(error).__name__}: {error}'.split())
            text = f'{file.name} is cut or damaged ({text}); ' \
                   f'the {len(self.records) - before[0]} message(s) before that were read'
        if sum(self.intake.counts.values()) == before[1]:
            raise self.unusable(f'a file without a readable message ({text.partition(";")[0]})', EXPECTED,
                                'name another file, or record it again')
        self.problems.append(text)

    def _read_packed(self, file: Path) -> None:
        """Read a recording that rosbag2 compressed as a whole."""
        self.intake.open(file.stat().st_size)
        with tempfile.TemporaryDirectory(prefix='dlo_calibration_') as folder:
            target = Path(folder) / f'recording{file.with_suffix("").suffix}'
            unpack_file(file, target, self.intake.unpack)
            self._read_unpacked(target, file.name)

    def _read_unpacked(self, file: Path, name: str) -> None:
        if file.suffix == '.db3':
            read_sqlite(file, name, self.intake)
            return
        with file.open('rb') as stream:
            McapFile(stream, file.stat().st_size, name, self.intake, self._take_entries).read()

    def _take_entries(self, entries: Mapping[str, str]) -> None:
        """Take the entries of one of our own metadata records."""
        self._options = entries.get('options', self._options)
        if 'mark' in entries:
            self.marks.append((entries['mark'], len(self.records)))
        if 'dropped' in entries:
            self._dropped = entries['dropped']

    def options(self) -> dict[str, Any] | None:
        """Return the last recorded options, as they stand there; None: none were recorded."""
        if self._options is None:
            return None
        try:
            found = json.loads(self._options[:OPTIONS_SIZE])
            if isinstance(found, dict):
                return found
        except (ValueError, RecursionError):
            pass
        self.problems.append('recorded options that cannot be read are left out')
        return None


def _unreadable(file: Path) -> str:
    """Return why a file of a folder is not to be read, if there is a reason."""
    if file.is_symlink() and file.resolve().parent != file.parent.resolve():
        return 'it is left out, as it is a link out of the folder; name the file it leads to'
    if not file.exists():
        return 'it is missing' + ('' if file.name == METADATA_FILE else f', though {METADATA_FILE} names it')
    return '' if file.is_file() else 'it is left out, as it is no regular file'


def _recordings(file: Path) -> list[str]:
    """Return the names of the recordings in a metadata.yaml; its damages can raise anything."""
    with file.open('rb') as stream:
        octets = stream.read(METADATA_SIZE + 1)
    if len(octets) > METADATA_SIZE:
        raise ValueError('too large')
    whole = read_first(octets)
    names = whole[METADATA_KEY].get('relative_file_paths') or []
    if not isinstance(names, list):
        raise ValueError('no list of files')
    return [PurePath(name).name for name in names]
