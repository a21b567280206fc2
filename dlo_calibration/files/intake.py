# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Intake: what is kept of a recording while its files are read, and how much may come out of them.

Files come from strangers: a few bytes may unpack to any number of messages.  Only messages
that this package uses are kept; all others are counted and dropped as they come.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
import stat
from typing import Mapping

from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import INPUT_TYPES

#: What the node sends, name -> type; recorded with its inputs.
OUTPUT_TYPES: Mapping[str, str] = {
    'progress': 'diagnostic_msgs/msg/DiagnosticArray',
    'result': 'diagnostic_msgs/msg/DiagnosticArray',
    'dlo_description': 'std_msgs/msg/String',
    'status': 'diagnostic_msgs/msg/DiagnosticArray',
    'markers': 'visualization_msgs/msg/MarkerArray',
}
USED_TYPES: Mapping[str, str] = {**INPUT_TYPES, **OUTPUT_TYPES}

KEPT_MESSAGES = 300_000  # nearly three hours of a tracker at 30 Hz
KEPT_OCTETS = 200 * 10**6  # of them; a tracker's chain of 21 points has 700 bytes
KEPT_OF_ANY = 20_000  # of a file of any size; of more, each takes MESSAGE_OCTETS at least
UNPACKED_OCTETS = 2 * 10**9  # of all messages, or UNPACKED_RATIO times the files: images pack 10 to 1
UNPACKED_RATIO = 100
MESSAGES_OF_ANY = 200_000  # of all topics, likewise
MESSAGE_OCTETS = 16  # of a file, for each message: its stamp, its entry in an index
NAME_LENGTH = 255  # of a topic or a type, as ROS allows


@dataclass(frozen=True, slots=True)
class Record:
    """
    One recorded message.

    :param type: full name, ``package/msg/Type``.
    :param data: CDR bytes, with the encapsulation header.
    :param log_time: time of the recording [ns].
    :param stands_for: the input topic as which the user wants it to be read; empty: its own name counts.
    """

    topic: str
    type: str
    data: bytes
    log_time: int
    stands_for: str = ''

    @property
    def name(self) -> str:
        """The last component of the topic's name, or the input topic for which it stands."""
        return self.stands_for or self.topic.rsplit('/', 1)[-1]

    @property
    def namespace(self) -> str:
        """The topic's name without its last component."""
        return self.topic.rpartition('/')[0]


class LimitExceeded(Exception):
    """More comes out of a recording than any real one contains."""


class Intake:
    """
    What was read so far from the files of one recording.

    :param records: the messages on topics that this package uses, as they came.
    :param counts: number of messages by (topic, type), also of those that are not kept.
    :param problems: one text for each defect.
    :param remap: topic -> name of the input topic as which it is read.
    """

    def __init__(self, remap: Mapping[str, str]) -> None:
        self.remap = remap
        self.records: list[Record] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        self.problems: list[str] = []
        self._first, self._last = 2**64, -2**64  # log times of all messages [ns]
        self._kept = 0
        self._size = 0
        self._messages = 0
        self._unpacked = 0

    @property
    def duration(self) -> float:
        """Time from the first to the last message of all topics [s]."""
        return max(self._last - self._first, 0) / 1e9

    def open(self, size: int) -> None:
        """Take notice of the next file, of `size` [bytes]."""
        self._size += size

    def unpack(self, octets: int) -> None:
        """Take notice of so many bytes that a file unpacks to."""
        self._unpacked += octets
        limit = max(UNPACKED_OCTETS, UNPACKED_RATIO * self._size)
        if self._unpacked > limit:
            raise LimitExceeded(f'it unpacks to more than {limit / 1e6:.0f} MB, and has {self._size} bytes')

    def count(self, topic: str, kind: str, log_time: int) -> None:
        """Take notice of a message of any topic, recorded at `log_time` [ns]."""
        self.counts[topic, kind] += 1
        self._messages += 1
        self._first, self._last = min(self._first, log_time), max(self._last, log_time)
        if self._messages > max(MESSAGES_OF_ANY, self._size // MESSAGE_OCTETS):
            raise LimitExceeded(f'it has more than {self._messages - 1} messages in {self._size} bytes')

    def keep(self, record: Record) -> None:
        """Keep a message; what the node sent takes at most half of the room."""
        limit = min(KEPT_MESSAGES, max(KEPT_OF_ANY, self._size // MESSAGE_OCTETS))
        if record.type in OUTPUT_TYPES.values() and (
                2 * len(self.records) >= limit or 2 * self._kept > KEPT_OCTETS):
            return
        self._kept += len(record.data)
        if len(self.records) >= limit or self._kept > KEPT_OCTETS:
            raise LimitExceeded(f'it has more than {limit} messages or {KEPT_OCTETS / 1e6:.0f} MB '
                                'on the topics of the calibrator')
        self.records.append(replace(record, stands_for=self.remap.get(record.topic, '')))

    def uses(self, topic: str, kind: str) -> bool:
        """Tell whether this package uses the messages on a topic, of type `kind`."""
        return USED_TYPES.get(self.remap.get(topic) or topic.rsplit('/', 1)[-1]) == kind


def full_name(name: str) -> str:
    """Return ``package/msg/Type``, also for the short form ``package/Type`` of some writers."""
    package, slash, kind = name.partition('/')
    return f'{package}/msg/{kind}' if slash and '/' not in kind else name


def require_file(path: Path, thing: str, expected: str) -> None:
    """
    Refuse what would block or never end when it is read: a FIFO, a socket, a device, a folder.

    :raises InputError: where `path` is no regular file; OSError where it cannot be looked at.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        kinds = {stat.S_ISFIFO: 'a FIFO', stat.S_ISSOCK: 'a socket', stat.S_ISDIR: 'a folder',
                 stat.S_ISCHR: 'a device', stat.S_ISBLK: 'a device'}
        came = next((name for test, name in kinds.items() if test(mode)), 'something that is no file')
        raise InputError(thing, came, expected, 'name a file')
