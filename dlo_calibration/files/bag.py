# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bag: reads the messages of an MCAP file, a rosbag2 folder or a .db3 file, even if it is damaged."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path, PurePath
from typing import Any, BinaryIO, Iterable, Iterator, Mapping

from mcap.exceptions import EndOfFile
from mcap.records import Channel, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from ruamel.yaml import YAML

from dlo_calibration.errors import InputError
from dlo_calibration.files.recording import METADATA_FILE, METADATA_KEY, OUR_RECORD, typestore
from dlo_calibration.messages.codec import INPUT_TYPES


@dataclass(frozen=True)
class Record:
    """
    One recorded message.

    :param type: full name, ``package/msg/Type``.
    :param data: CDR bytes, with the encapsulation header.
    :param log_time: time of the recording [ns].
    """

    topic: str
    type: str
    data: bytes
    log_time: int

    @property
    def name(self) -> str:
        """The last component of the topic's name."""
        return self.topic.rsplit('/', 1)[-1]

    @property
    def namespace(self) -> str:
        """The topic's name without its last component."""
        return self.topic.rpartition('/')[0]


def decode(record: Record) -> Any:
    """
    Return the message of a record, as an object with the fields of its type.

    :raises InputError: where the bytes are not a message of that type.
    """
    try:
        return typestore().deserialize_cdr(record.data, record.type)
    except Exception as error:  # damaged bytes can raise anything
        raise InputError(
            f'{record.name} recorded at {record.log_time / 1e9:.3f} s',
            f'bytes that do not decode ({error!r})', f'a {record.type}',
            'leave that message out, or record the session again') from error


def encode(message: Any, message_type: str) -> bytes:
    """Return the CDR bytes of a message object of the library rosbags."""
    return bytes(typestore().serialize_cdr(message, message_type))


class _WholeReads:
    """A stream that raises an error instead of returning fewer bytes than requested."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def read(self, length: int) -> bytes:
        """Return exactly `length` bytes, or raise EndOfFile."""
        piece = self._stream.read(length)
        if len(piece) < length:
            raise EndOfFile
        return piece


class Bag:
    """The parts of a recording that were read so far, from one or more files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.records: list[Record] = []
        self.options: dict[str, Any] | None = None
        self.problems: list[str] = []
        self._dropped = '{}'  # the last count of messages that the recording node dropped, as JSON
        self.marks: list[tuple[str, int]] = []  # each mark, and the number of records before it

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
        return [record for record in inputs if first <= places[id(record)] < last]

    def read_folder(self) -> None:
        """Read all files of a rosbag2 folder."""
        about = self._about_folder()
        names = [PurePath(str(name)).name for name in about.get('relative_file_paths') or []]
        files = [self.path / name for name in names] or sorted(
            file for file in self.path.iterdir() if file.suffix in ('.mcap', '.db3'))
        if not files:
            raise self.unusable('a folder without a recording', 'a rosbag2 folder, or an MCAP file',
                                'name the folder that holds the metadata.yaml')
        if about.get('compression_mode') not in (None, '', 'NONE', 'none'):
            self.read_rosbags(self.path)
            return
        for file in files:
            if not file.exists():
                self.problems.append(f'{file.name} is missing, though metadata.yaml names it')
            elif file.suffix == '.db3':
                self.read_rosbags(file)
            else:
                self.read_mcap(file)
        if not any(file.exists() for file in files):
            raise self.unusable('none of the files that metadata.yaml names', 'the whole rosbag2 folder',
                                'copy the recording with all of its files')

    def _about_folder(self) -> Mapping[str, Any]:
        """Return the content of metadata.yaml; empty where the file is missing or damaged."""
        file = self.path / METADATA_FILE
        if not file.exists():
            self.problems.append(f'{METADATA_FILE} is missing')
            return {}
        try:
            about = YAML(typ='safe', pure=True).load(file.read_text(encoding='utf-8'))[METADATA_KEY]
            if isinstance(about, dict) and isinstance(about.get('relative_file_paths') or [], list):
                return about
        except OSError:
            raise
        except Exception:  # damaged YAML can raise anything
            pass
        self.problems.append(f'{METADATA_FILE} cannot be read; all recordings in the folder are read instead')
        return {}

    def read_rosbags(self, path: Path) -> None:
        """Read a SQLite file or a compressed folder with the library rosbags."""
        from rosbags.rosbag2 import Reader  # loads compression libraries that MCAP does not need

        before = len(self.records)
        try:
            with Reader(path) as reader:
                for connection, log_time, data in reader.messages():
                    self.records.append(Record(connection.topic, connection.msgtype, bytes(data), log_time))
        except Exception as error:  # damaged files can raise anything
            self._note_early_end(path, before, error)

    def read_mcap(self, path: Path) -> None:
        """Read an MCAP file to its end, or to the first damaged place."""
        before = len(self.records)
        with path.open('rb') as stream:
            try:
                for entry in _mcap_entries(stream, path.stat().st_size):
                    if isinstance(entry, Record):
                        self.records.append(entry)
                    elif isinstance(entry, str):
                        self.problems.append(entry)
                    else:
                        self._read_metadata(entry)
            except Exception as error:  # damaged files can raise anything
                self._note_early_end(path, before, error)

    def _read_metadata(self, entries: Mapping[str, str]) -> None:
        if 'options' in entries:
            try:
                options = json.loads(entries['options'])
            except ValueError:
                options = None
            if isinstance(options, dict):
                self.options = options
            else:
                self.problems.append('recorded options that cannot be read are left out')
        if 'mark' in entries:
            self.marks.append((entries['mark'], len(self.records)))
        if 'dropped' in entries:
            self._dropped = entries['dropped']

    def _note_early_end(self, path: Path, before: int, error: Exception) -> None:
        """Note an early end of reading; raise an error where nothing was read."""
        why = 'the file ends too early' if isinstance(error, EndOfFile) else \
            ' '.join(f'{type(error).__name__}: {error}'.split())
        if len(self.records) == before:
            raise self.unusable(f'a file without a readable message ({why})',
                                'an MCAP file or a rosbag2 folder', 'record it again') from error
        self.problems.append(f'{path.name} is cut or damaged ({why}); '
                             f'the {len(self.records) - before} message(s) before that were read')


def _mcap_entries(stream: BinaryIO, size: int) -> Iterator[Record | Mapping[str, str] | str]:
    """Yield the messages, our own metadata records, and a text for each thing that is left out."""
    reader = StreamReader(_WholeReads(stream), validate_crcs=True, record_size_limit=size)  # type: ignore
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in reader.records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.id not in channels and record.message_encoding != 'cdr':
                yield (f'topic {record.topic} is left out: its messages are '
                       f'{record.message_encoding!r}, not cdr')
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            if channel.message_encoding == 'cdr':
                schema = schemas.get(channel.schema_id)
                yield Record(channel.topic, _full_name(schema.name if schema else ''),
                             record.data, record.log_time)
        elif isinstance(record, Metadata) and record.name == OUR_RECORD:
            yield record.metadata
        elif isinstance(record, DataEnd):
            return


def _full_name(name: str) -> str:
    """Return ``package/msg/Type``, also for the short form ``package/Type`` of some writers."""
    package, slash, kind = name.partition('/')
    return f'{package}/msg/{kind}' if slash and '/' not in kind else name
