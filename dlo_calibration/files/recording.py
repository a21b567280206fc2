# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Recording: writes a session into a new rosbag2 folder while it takes place.

The folder has one MCAP file in the form of `ros2 bag record` (profile ``ros2``,
schema encoding ``ros2msg``, CDR bytes) and a ``metadata.yaml``.  `ros2 bag play`,
Foxglove and the library rosbags can read it.
"""

from __future__ import annotations

from contextlib import contextmanager, suppress
import json
from pathlib import Path
from textwrap import indent
import time
from typing import Any, BinaryIO, cast, Iterable, Iterator, Mapping

import mcap  # noqa: F401  # required; its writer is slow to load, and reading does not need it
import yaml

from dlo_calibration.calibration.options import recordable
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.files.record import Record, typestore
from dlo_calibration.model.parameters import SCALES
from dlo_calibration.writing import replacing, whole

OUR_RECORD = 'dlo_calibration'  # name of our metadata records in the MCAP file
METADATA_FILE = 'metadata.yaml'  # name and key are rosbag2's
METADATA_KEY = 'rosbag2_bagfile_information'
LATCHED = ('result', 'status', 'dlo_description', 'markers')  # late subscribers get the last message


class RecordingError(DloCalibrationError):
    """A session can no longer be written (disk full, no permission, ...)."""


class SessionWriter:
    """
    Writes a session into a new rosbag2 folder.

    No file is overwritten: where `path` exists, the folder is called ``path_2``,
    ``path_3``, ...  `write` returns when the operating system has the message, so a killed
    process loses none.

    :param path: the folder to create, or, if it ends in ``.mcap``, a single file
        without folder and metadata.yaml; parent folders are created too.
    :param options: as for `write_options`; None: written later or never.
    :ivar failure: why nothing more can be written; empty while writing works.
    :raises RecordingError: here and in every method, where writing fails.
        Nothing is written after the first such error.
    """

    def __init__(self, path: str | Path, options: Mapping[str, Any] | None = None) -> None:
        self.failure = ''
        self._epoch = time.time_ns() - time.monotonic_ns()
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._first, self._last = 2**63 - 1, 0  # rosbag2's starting time of a bag without messages
        self._closed = False
        try:
            self.path, self.file, self._stream = _create(Path(path))
        except OSError as error:
            raise RecordingError(f'session {path}: cannot be written: {error}') from error
        from mcap.writer import CompressionType, Writer

        self._writer = cast(Any, Writer(self._stream, compression=CompressionType.ZSTD))  # partly untyped
        try:
            with self._disk():
                self._writer.start(profile='ros2', library='dlo_calibration')
                self._writer.flush()
                self._write_metadata_file()
        except RecordingError:  # a session without content is of no use
            with suppress(OSError):
                self.file.unlink()
                self.path.rmdir()
            raise
        if options is not None:
            self.write_options(options)

    def write(self, topic: str, message_type: str, data: bytes, log_time: int | None = None,
              flush: bool = True) -> None:
        """
        Record one message.

        :param topic: its full name, e.g. ``/calibrator/action``.
        :param message_type: ``package/msg/Type``, one of Jazzy's common_interfaces.
        :param data: CDR bytes.
        :param log_time: [ns], greater than 0; None: now, by a clock that never goes back.
        :param flush: False where more messages follow at once; such a group takes less
            space, and is written with its last message.
        """
        key = topic, message_type
        if log_time is None:
            log_time = self._epoch + time.monotonic_ns()
        with self._disk():
            new = key not in self._channels
            if new:
                self._add_channel(topic, message_type)
            self._writer.add_message(self._channels[key], log_time, data, log_time, self._counts[key])
            self._counts[key] += 1
            self._first, self._last = min(self._first, log_time), max(self._last, log_time)
            if flush:
                self._writer.flush()
            if new:
                self._write_metadata_file()

    def write_options(self, options: Mapping[str, Any]) -> None:
        """Record the current options, by name, for a replay; those of the machine are left out."""
        self._write_metadata_record('options', json.dumps(recordable(options), sort_keys=True),
                                    scales=str(SCALES))

    def write_mark(self, mark: str) -> None:
        """
        Record a mark, by which `Bag.used` selects the messages of a result.

        :param mark: ``start`` of a calibration, or ``reset``, which forgets the trials; see `write_discard`.
        """
        self._write_metadata_record('mark', mark)

    def write_discard(self, first: int, last: int) -> None:
        """Record that the trial with messages stamped from `first` to `last` [ns] is discarded."""
        self.write_mark(f'discard {first} {last}')

    def write_dropped(self, counts: Mapping[str, int]) -> None:
        """Record how many messages of each kind were dropped since the session began."""
        self._write_metadata_record('dropped', json.dumps(dict(counts), sort_keys=True))

    def flush(self) -> None:
        """Give the messages that wait in a group to the operating system."""
        with self._disk():
            self._writer.flush()

    def close(self) -> None:
        """Write the index and the final metadata.yaml; closing twice does nothing."""
        if self._closed or self.failure:
            return
        self._closed = True
        with self._disk():
            self._writer.flush()
            self._writer.add_metadata('rosbag2', {'serialized_metadata': self._metadata()})
            self._writer.finish()
            self._stream.close()
            self._write_metadata_file()

    def __enter__(self) -> SessionWriter:
        """Return the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """Turn errors of the disk into RecordingError, and write nothing after the first one."""
        if self.failure:
            raise RecordingError(self.failure)
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError: the stream is closed
            self.failure = f'session {self.path}: cannot be written: {error}; recording ends here'
            with suppress(OSError):  # the first error is the one to report
                self._stream.close()
            raise RecordingError(self.failure) from error

    def _write_metadata_record(self, key: str, text: str, **more: str) -> None:
        with self._disk():
            self._writer.flush()
            self._writer.add_metadata(OUR_RECORD, {key: text, **more})
            self._writer.flush()

    def _add_channel(self, topic: str, message_type: str) -> None:
        if message_type not in self._schemas:
            definition = typestore().generate_msgdef(message_type, ros_version=2)[0]
            self._schemas[message_type] = self._writer.register_schema(
                message_type, 'ros2msg', definition.encode())
        self._channels[topic, message_type] = self._writer.register_channel(
            topic, 'cdr', self._schemas[message_type],
            {'offered_qos_profiles': _yaml([_qos(topic)]),
             'topic_type_hash': typestore().hash_rihs01(message_type)})
        self._counts[topic, message_type] = 0

    def _metadata(self) -> str:
        """Return the metadata, in YAML, in the form of rosbag2_storage's struct BagMetadata, version 9."""
        # Jazzy writes version 9, and rosbags reads none above it.
        count = sum(self._counts.values())
        times: dict[str, Any] = {
            'duration': {'nanoseconds': self._last - self._first if count else 0},
            'starting_time': {'nanoseconds_since_epoch': self._first}}
        return _yaml({
            'version': 9, 'storage_identifier': 'mcap', **times, 'message_count': count,
            'topics_with_message_count': [
                {'message_count': messages, 'topic_metadata': {
                    'name': topic, 'type': message_type, 'serialization_format': 'cdr',
                    'offered_qos_profiles': [_qos(topic)],
                    'type_description_hash': typestore().hash_rihs01(message_type)}}
                for (topic, message_type), messages in self._counts.items()],
            'compression_format': '', 'compression_mode': '',
            'relative_file_paths': [self.file.name],
            'files': [{'path': self.file.name, **times, 'message_count': count}],
            'custom_data': {}, 'ros_distro': 'jazzy'})

    def _write_metadata_file(self) -> None:
        """Replace metadata.yaml as a whole, so that it is never incomplete."""
        if self.file == self.path:
            return
        # The node calls this while it listens, so it does not wait for the disk.
        with replacing(self.path / METADATA_FILE, fsync=False) as new:
            new.write_text(f'{METADATA_KEY}:\n{indent(self._metadata(), "  ")}\n', encoding='utf-8')


def write_records(path: Path, records: Iterable[Record], options: Mapping[str, Any] | None) -> None:
    """
    Write records to one MCAP file.

    :param options: by name, to be recorded; None: none are.
    :raises InputError: where the file cannot be written.
    """
    with whole(path) as new, SessionWriter(new, options) as writer:
        for record in records:
            writer.write(record.topic, record.type, record.data, record.log_time, flush=False)


def _create(path: Path) -> tuple[Path, Path, BinaryIO]:
    """Create the folder or file under a free name; return its path, its MCAP file, and that file open."""
    for number in range(1, 100000):
        suffix = path.suffix if path.suffix == '.mcap' else ''
        free = path if number == 1 else path.with_name(f'{path.name.removesuffix(suffix)}_{number}{suffix}')
        free.parent.mkdir(parents=True, exist_ok=True)
        try:
            if suffix:
                return free, free, free.open('xb')
            free.mkdir()
        except FileExistsError:
            continue
        file = free / f'{free.name}_0.mcap'
        try:
            return free, file, file.open('xb')
        except OSError:
            free.rmdir()
            raise
    raise OSError(f'{path} and its numbered names all exist')


def _qos(topic: str) -> dict[str, Any]:
    """Return the quality of service with which a topic is offered, in rosbag2's form."""
    latched = topic.rsplit('/', 1)[-1] in LATCHED
    forever = {'sec': 9223372036, 'nsec': 854775807}  # rmw's infinite duration
    return {'history': 'keep_last', 'depth': 1 if latched else 10, 'reliability': 'reliable',
            'durability': 'transient_local' if latched else 'volatile',
            'deadline': forever, 'lifespan': forever, 'liveliness': 'automatic',
            'liveliness_lease_duration': forever, 'avoid_ros_namespace_conventions': False}


class _WithoutAliases(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _yaml(value: Any) -> str:
    return str(yaml.dump(value, Dumper=_WithoutAliases, width=4096)).strip()
