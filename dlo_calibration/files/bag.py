# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Bag: the content of a recording, within limits.

Files come from strangers: a few bytes may unpack to any number of messages.  Only messages that this package
uses are kept; all others are counted and dropped as they are read.
"""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import replace
import json
from pathlib import Path
import re
from typing import Any, Callable, Iterable, Mapping

from dlo_calibration.errors import InputError
from dlo_calibration.files.record import decode, Record
from dlo_calibration.messages.codec import (
    INITIAL,
    INPUT_TYPES,
    NANOSECONDS,
    OUTPUT_TYPES,
    TRIAL_TYPES,
    WRENCH,
)
from dlo_calibration.model.parameters import from_first_scale, SCALE

USED_TYPES: Mapping[str, str] = {**INPUT_TYPES, **OUTPUT_TYPES}

KEPT_MESSAGES = 300_000  # nearly three hours of a tracker at 30 Hz
KEPT_OCTETS = 200 * 10**6  # bytes of kept messages; a tracker's chain of 21 points has 700
KEPT_OF_ANY = 20_000  # messages of a file of any size; a larger file may have one per MESSAGE_OCTETS
UNPACKED_OCTETS = 2 * 10**9  # of all messages, or UNPACKED_RATIO times the files: images pack 10 to 1
UNPACKED_RATIO = 100
MESSAGES_OF_ANY = 200_000  # of all topics, likewise
MESSAGE_OCTETS = 16  # least bytes of a file for each message: its stamp, its entry in an index
NAMED_TOPICS = 10  # left-out topics that the warnings name
NAME_LENGTH = 255  # of a topic or a type, as ROS allows
OPTIONS_SIZE = 10**5  # characters of recorded options; ours have 2000
AT_ONCE = 128 * 2**20  # bytes: rosbag2's chunks have one megabyte, or one message where that is larger
PIECE = 2**20  # bytes that are in memory while a file is unpacked
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # begins every frame; a CDR message begins with a zero
DISCARD = re.compile(r'discard (\d{1,19}) (\d{1,19})')  # mark of a discarded trial: its first and last stamp


class LimitExceeded(Exception):
    """A recording contains more than any real one."""


class Bag:
    """
    The content of the files of one recording that were read so far.

    :param records: the messages on topics that this package uses, as they came.
    :param counts: number of messages by (topic, type), also of those that are not kept.
    :param warnings: one text for each defect.
    :param remap: topic -> name of the input topic as which it is read.
    """

    def __init__(self, remap: Mapping[str, str]) -> None:
        self.remap = remap
        self.records: list[Record] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        self.warnings: list[str] = []
        self._first, self._last = 2**64, -2**64  # log times of all messages [ns]
        self._octets = 0  # bytes of `records`
        self._size = 0
        self._messages = 0
        self._unpacked = 0
        self._marks: list[tuple[str, int]] = []  # each mark, and the number of records before it
        self._options: str | None = None  # the last recorded ones
        self._scales = ''  # version of the scales in them; the first wrote none
        self._left_out: set[str] = set()  # topics
        self._dropped = '{}'  # the last count of messages that the recording node dropped, as JSON

    @property
    def duration(self) -> float:
        """Time from the first to the last message of all topics [s]."""
        return max(self._last - self._first, 0) / 1e9

    def open(self, size: int) -> None:
        """Count the bytes of the next file."""
        self._size += size

    def unpack(self, octets: int) -> None:
        """
        Count bytes that a file unpacks to.

        :raises LimitExceeded: if there are too many; so do `count` and `keep`.
        """
        self._unpacked += octets
        limit = max(UNPACKED_OCTETS, UNPACKED_RATIO * self._size)
        if self._unpacked > limit:
            raise LimitExceeded(f'it unpacks to more than {limit / 1e6:.0f} MB, and has {self._size} bytes')

    def count(self, topic: str, kind: str, log_time: int) -> None:
        """Count a message of any topic, recorded at `log_time` [ns]."""
        self.counts[topic, kind] += 1
        self._messages += 1
        self._first, self._last = min(self._first, log_time), max(self._last, log_time)
        if self._messages > max(MESSAGES_OF_ANY, self._size // MESSAGE_OCTETS):
            raise LimitExceeded(f'it has more than {self._messages - 1} messages in {self._size} bytes')

    def keep(self, record: Record) -> None:
        """Keep a message; the outputs of the node, and wrenches, take at most half of the room."""
        limit = min(KEPT_MESSAGES, max(KEPT_OF_ANY, self._size // MESSAGE_OCTETS))
        if record.type not in TRIAL_TYPES.values() and (
                2 * len(self.records) >= limit or 2 * self._octets > KEPT_OCTETS):
            if record.type == INPUT_TYPES[WRENCH] and record.topic not in self._left_out:
                self._left_out.add(record.topic)
                self.warnings.append(f'topic {record.topic} is not read to its end: publish 100 wrenches a '
                                     'second at most')
            return
        self._octets += len(record.data)
        if len(self.records) >= limit or self._octets > KEPT_OCTETS:
            raise LimitExceeded(f'it has more than {limit} messages or {KEPT_OCTETS / 1e6:.0f} MB '
                                'on the topics of the calibrator')
        self.records.append(replace(record, stands_for=self.remap.get(record.topic, '')))

    def leave_out(self, topic: str, encoding: str) -> None:
        """Warn that a topic is not read, because its messages are not CDR."""
        if topic in self._left_out or len(self._left_out) > NAMED_TOPICS:
            return
        self._left_out.add(topic)
        self.warnings.append(f'topic {topic} is left out: its messages are {encoding!r}, not cdr'
                             if len(self._left_out) <= NAMED_TOPICS else 'more topics are left out likewise')

    def uses(self, topic: str, kind: str) -> bool:
        """Return whether this package uses the messages on a topic, of type `kind`."""
        return USED_TYPES.get(self.remap.get(topic) or topic.rsplit('/', 1)[-1]) == kind

    def take_entries(self, entries: Mapping[str, str]) -> None:
        """Take the entries of one of our own metadata records."""
        if 'options' in entries:
            self._options, self._scales = entries['options'], entries.get('scales', '')
        if 'mark' in entries:
            self._marks.append((entries['mark'], len(self.records)))
        if 'dropped' in entries:
            self._dropped = entries['dropped']

    def options(self) -> dict[str, Any] | None:
        """Return the last recorded options, unchecked; None if none were recorded."""
        if self._options is None:
            return None
        with suppress(ValueError, RecursionError):
            options = json.loads(self._options[:OPTIONS_SIZE])
            if isinstance(options, dict):
                value = options.get('flexibility')
                if not self._scales and isinstance(value, (int, float)) and 0 <= value <= SCALE:
                    options['flexibility'] = from_first_scale(value)
                return options
        self.warnings.append('recorded options that cannot be read are left out')
        return None

    def dropped(self) -> list[str]:
        """Return a warning for each kind of message that the recording node dropped."""
        try:
            counts = json.loads(self._dropped)
            return [f'{int(counts[kind])} {kind} message(s) came faster than the node could read them, '
                    'and were dropped' for kind in INPUT_TYPES if kind in counts]
        except (ValueError, TypeError):
            return []

    def used(self, inputs: Iterable[Record]) -> list[Record]:
        """
        Return the inputs that the last calibration used, or all where none was started.

        The inputs before a reset are left out, unless none follow it, and those of discarded trials; the
        warnings give their numbers.
        """
        inputs = list(inputs)
        places = {id(record): place for place, record in enumerate(self.records)}
        newest = max((places[id(record)] for record in inputs), default=0)
        first = max((place for mark, place in self._marks if mark == 'reset' and place <= newest), default=0)
        last = max((place for mark, place in self._marks if mark == 'start' and place > first),
                   default=len(self.records))
        used = [record for record in inputs if first <= places[id(record)] < last]
        if len(used) < len(inputs):
            self.warnings.append(f'{len(inputs) - len(used)} message(s) before the last reset or after the '
                                 'last start are left out, as the live calibration did not use them')
        discards = [(int(match[1]), int(match[2])) for mark, place in self._marks
                    if first <= place < last and (match := DISCARD.fullmatch(mark))]
        if not discards:
            return used
        discarded = _discarded(used, discards)
        self.warnings.append(f'{len(discarded)} message(s) of {len(discards)} trial(s) that were taken back '
                             'are left out')
        return [record for k, record in enumerate(used) if k not in discarded]


def _discarded(records: list[Record], discards: Iterable[tuple[int, int]]) -> set[int]:
    """
    Return the indices of the messages of discarded trials, each given by its first and last stamp [ns].

    The collector leaves out the same ones: all that are stamped within such a trial, and what comes after it
    before the next initial chain.
    """
    stamped = []
    for k, record in enumerate(records):
        if record.name == WRENCH:  # they may show the hand before the next trial
            continue
        with suppress(InputError):  # decoding again reports it later
            stamp = decode(record).header.stamp
            stamped.append((stamp.sec * NANOSECONDS + stamp.nanosec, record.name != INITIAL, k))
    stamped.sort()
    discarded: set[int] = set()
    for first, last in discards:
        follows = False  # whether the newest initial chain is that of the trial
        for stamp, later, k in stamped:
            follows = follows and later or first <= stamp <= last
            if follows and stamp >= first:
                discarded.add(k)
    return discarded


def full_name(name: str) -> str:
    """Return ``package/msg/Type``, also for the short form ``package/Type`` of some writers."""
    package, slash, kind = name.partition('/')
    return f'{package}/msg/{kind}' if slash and '/' not in kind else name


def unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """
    Return the content of a chunk.

    :param compression: as MCAP names it: empty, ``zstd`` or ``lz4``.
    :param size: of the content [bytes], as announced; no more is unpacked.
    :raises Exception: of any kind, where it is damaged, or has another size.
    """
    content = packed
    if compression == 'zstd':
        content = _zstd(packed, size)
    elif compression == 'lz4':
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression:
        raise ValueError(f'unknown compression {compression[:20]!r}')
    if len(content) != size:
        raise ValueError('its size is not as announced')
    return content


def unpacked_message(octets: bytes, allow: Callable[[int], None]) -> bytes:
    """
    Return the CDR bytes of a message, which rosbag2 may have compressed; damaged bytes unchanged.

    :param allow: called with the number of unpacked bytes; raises where they are too many.
    """
    if octets[:4] != ZSTD_MAGIC:
        return octets
    import zstandard

    size, content = zstandard.CONTENTSIZE_UNKNOWN, octets
    with suppress(Exception):  # damaged bytes can raise anything; decoding reports them later
        size = zstandard.get_frame_parameters(octets).content_size
        content = _zstd(octets, min(size, AT_ONCE))
    unpacked_whole = size == zstandard.CONTENTSIZE_UNKNOWN and content is not octets
    allow(len(content) if unpacked_whole else min(size, AT_ONCE))
    return content


def unpack_file(packed: Path, target: Path, allow: Callable[[int], None]) -> None:
    """
    Write the content of a file that rosbag2 compressed.

    :param allow: called with the number of bytes before they are written; raises where they are too many.
    """
    import zstandard

    with packed.open('rb') as source, target.open('xb') as sink:
        for piece in zstandard.ZstdDecompressor().read_to_iter(source, write_size=PIECE):
            allow(len(piece))
            sink.write(piece)


def _zstd(packed: bytes, size: int) -> bytes:
    import zstandard

    # The library allocates the memory that the frame announces.
    declared = zstandard.get_frame_parameters(packed).content_size
    if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise ValueError('its size is not as announced')
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1)) if size else b''
