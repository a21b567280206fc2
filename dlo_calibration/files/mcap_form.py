# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
McapForm: where the records of an MCAP file are, also after a damaged place.

A file is a chain of records: kind, length, content.  One wrong length would hide all that
follows.  The contents have lengths of their own, so that a record can be checked by its
form, and the next one can be found by searching for a record in good form.
The format is specified at https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
from typing import BinaryIO, Iterator, Union

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, \
    STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(1, 16)
HEAD = struct.Struct('<BQ')  # of every record: its kind, and the length of its content
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time

#: Content of each kind of record: numbers of bytes, and I or Q where a length of that type, with so
#: many bytes after it, stands.  What follows the head of a message fills it.
FORMS: dict[int, tuple[Union[int, str], ...]] = {
    HEADER: ('I', 'I'), FOOTER: (20,), SCHEMA: (2, 'I', 'I', 'I'), CHANNEL: (4, 'I', 'I', 'I'),
    MESSAGE: (MESSAGE_HEAD.size,), CHUNK: (28, 'I', 'Q'), MESSAGE_INDEX: (2, 'I'),
    CHUNK_INDEX: (32, 'I', 8, 'I', 16), ATTACHMENT: (16, 'I', 'I', 'Q', 4), ATTACHMENT_INDEX: (40, 'I', 'I'),
    STATISTICS: (42, 'I'), METADATA: ('I', 'I'), METADATA_INDEX: (16, 'I'), SUMMARY_OFFSET: (17,),
    DATA_END: (4,)}

#: A place where a record of less than 4 GB may begin.
CANDIDATE = re.compile(rb'(?=[\x01-\x0f].{4}\0{4})', re.DOTALL)
WINDOW = 2**20  # bytes that are searched at once
CANDIDATES = 1_000_000  # places that are looked at in one file: a second or two


class McapForm:
    """
    The places of the records in a stream.

    :param size: of the stream [bytes].
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self._candidates = 0
        self.end = size - len(MAGIC) if self.bytes_at(size - len(MAGIC), len(MAGIC)) == MAGIC else size

    def bytes_at(self, place: int, count: int) -> bytes:
        """Return `count` bytes, or fewer at the end of the stream."""
        self._stream.seek(max(place, 0))
        return self._stream.read(count)

    def head(self, place: int) -> tuple[int, int] | None:
        """Return kind and length of the record at a place; None where none can be."""
        octets = self.bytes_at(place, HEAD.size)
        if len(octets) < HEAD.size:
            return None
        kind, length = HEAD.unpack(octets)
        return (kind, length) if kind and place + HEAD.size + length <= self.end else None

    def surplus(self, place: int, kind: int, length: int) -> int | None:
        """
        Return how many bytes a record has after the content that its kind needs.

        It is 0 for every record of today's format, except messages; None: it is not in the form of its kind.
        """
        at, stop = place + HEAD.size, place + HEAD.size + length
        for part in FORMS.get(kind, ()):
            if isinstance(part, str):
                code = '<' + part
                octets = self.bytes_at(at, struct.calcsize(code))
                if len(octets) < struct.calcsize(code):
                    return None
                at += len(octets) + struct.unpack(code, octets)[0]
            else:
                at += part
            if at > stop:
                return None
        return stop - at

    def sound(self, place: int) -> bool:
        """Tell whether a record in good form begins at a place, or the stream ends there."""
        if place == self.end:
            return True
        head = self.head(place)
        if head is None or head[0] not in FORMS:
            return False
        surplus = self.surplus(place, *head)
        return surplus is not None and (surplus == 0 or head[0] == MESSAGE)

    def next_sound(self, place: int) -> int | None:
        """Return the first place, from `place` on, where a record in good form begins and another follows."""
        for at in self._find(place):
            self._candidates += 1
            if self._candidates > CANDIDATES:
                return None
            if self.sound(at):
                head = self.head(at)
                if head is not None and self.sound(at + HEAD.size + head[1]):
                    return at
        return None

    def _find(self, place: int) -> Iterator[int]:
        """Yield the places where a record may begin."""
        while place < self.end:
            window = self.bytes_at(place, WINDOW + HEAD.size - 1)
            for match in CANDIDATE.finditer(window):
                yield place + match.start()
            place += WINDOW
