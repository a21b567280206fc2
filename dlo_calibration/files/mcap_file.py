# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
MCAP file: read record by record, around damaged places.

A wrong bit costs at most the messages of its chunk.  A file is a chain of records: kind, length, content;
a wrong length would hide all later records.  The contents have lengths of their own, so the form of a record
can be checked; after damage, reading goes on at the next record in good form.

The reader of the library mcap would stop at the first damaged place, unpack a chunk to any size that its
compressed bytes declare, and list all messages of a chunk before it yields the first; its limit bounds only
the size of a record in the file.

The format is specified at https://mcap.dev/spec.
"""

from __future__ import annotations

from io import BytesIO
import re
import struct
from typing import BinaryIO, Iterator
from zlib import crc32

from dlo_calibration.files.bag import (
    AT_ONCE,
    Bag,
    full_name,
    LimitExceeded,
    NAME_LENGTH,
    unpacked,
    unpacked_message,
)
from dlo_calibration.files.record import Record
from dlo_calibration.files.recording import OUR_RECORD

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, \
    STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(1, 16)
HEAD = struct.Struct('<BQ')  # of every record: its kind, and the length of its content
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time

#: Content of each kind of record: numbers of bytes; I or Q: a length of that type, then that many bytes.
#: The data of a message follow its head.
FORMS: dict[int, tuple[int | str, ...]] = {
    HEADER: ('I', 'I'), FOOTER: (20,), SCHEMA: (2, 'I', 'I', 'I'), CHANNEL: (4, 'I', 'I', 'I'),
    MESSAGE: (MESSAGE_HEAD.size,), CHUNK: (28, 'I', 'Q'), MESSAGE_INDEX: (2, 'I'),
    CHUNK_INDEX: (32, 'I', 8, 'I', 16), ATTACHMENT: (16, 'I', 'I', 'Q', 4), ATTACHMENT_INDEX: (40, 'I', 'I'),
    STATISTICS: (42, 'I'), METADATA: ('I', 'I'), METADATA_INDEX: (16, 'I'), SUMMARY_OFFSET: (17,),
    DATA_END: (4,)}

#: A place where a record of less than 4 GB may begin.
CANDIDATE = re.compile(rb'(?=[\x01-\x0f].{4}\0{4})', re.DOTALL)
WINDOW = 2**20  # bytes that are searched at once
CANDIDATES = 1_000_000  # places that are checked in one file: a second or two
DESCRIPTION_SIZE = 2**20  # bytes read of a channel, a schema or one of our own records: names and options
CHUNK_HEAD = struct.Struct('<QQQII')  # times of the first and last message, size, CRC, length of a name
NAMED_PLACES = 3  # damaged places that a warning names


class McapRecords:
    """
    The places of the records in a stream.

    :param end: where they end [bytes].
    """

    def __init__(self, stream: BinaryIO, end: int) -> None:
        self._stream = stream
        self._candidates = 0
        self.end = end

    def bytes_at(self, place: int, count: int) -> bytes:
        """Return `count` bytes, or fewer at the end of the stream."""
        self._stream.seek(max(place, 0))
        return self._stream.read(count)

    def head(self, place: int) -> tuple[int, int] | None:
        """Return kind and length of the record at a place; None if no record can begin there."""
        octets = self.bytes_at(place, HEAD.size)
        if len(octets) < HEAD.size:
            return None
        kind, length = HEAD.unpack(octets)
        return (kind, length) if kind and place + HEAD.size + length <= self.end else None

    def description(self, place: int, length: int) -> bytes:
        """Return the content of a record that describes a topic or is one of our own."""
        return self.bytes_at(place + HEAD.size, min(length, DESCRIPTION_SIZE))

    def surplus(self, place: int, kind: int, length: int) -> int | None:
        """
        Return how many bytes a record has beyond the form of its kind; None if it lacks this form.

        Every record of today's format has 0, except messages.
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
        """Return whether a record in good form begins at a place, or the stream ends there."""
        if place == self.end:
            return True
        head = self.head(place)
        if head is None or head[0] not in FORMS:
            return False
        surplus = self.surplus(place, *head)
        return surplus is not None and (surplus == 0 or head[0] == MESSAGE)

    def next_sound(self, place: int) -> int | None:
        """Return the first place, from `place` on, where a record in good form begins and another follows."""
        for begin in range(place, self.end, WINDOW):
            for match in CANDIDATE.finditer(self.bytes_at(begin, WINDOW + HEAD.size - 1)):
                self._candidates += 1
                if self._candidates > CANDIDATES:
                    return None
                at = begin + match.start()
                head = self.head(at)
                if head is not None and self.sound(at) and self.sound(at + HEAD.size + head[1]):
                    return at
        return None


class McapFile:
    """
    An MCAP file, and its content read so far.

    :param size: of the stream [bytes].
    :param name: of the file, for warnings.
    :param bag: takes the messages, and the entries of our own metadata records.
    """

    def __init__(self, stream: BinaryIO, size: int, name: str, bag: Bag) -> None:
        self._form = form = McapRecords(stream, size)
        if form.bytes_at(size - len(MAGIC), len(MAGIC)) == MAGIC:
            form.end -= len(MAGIC)
        self._name, self._bag = name, bag
        self._schemas: dict[int, list[str]] = {}
        self._channels: dict[int, tuple[str, str, str]] = {}  # topic, type and encoding of each
        self._promised: int | None = None  # number of messages by the file's statistics
        self._messages = 0
        self._undescribed: set[int] = set()  # channels without a description
        self._damage: list[str] = []  # the first damaged places
        self._damaged = 0

    def read(self) -> None:
        """
        Read all readable messages; the warnings of the bag describe the damage.

        :raises ValueError: where it is no MCAP file.
        :raises LimitExceeded: where it contains more than any real recording.
        """
        if self._form.bytes_at(0, len(MAGIC)) != MAGIC:
            if not self._form.sound(len(MAGIC)):
                raise ValueError('it does not begin as an MCAP file does')
            self._note('its first bytes')
        self._bag.open(self._form.end)
        self._read_summary()
        try:
            self._read_records()
        except LimitExceeded:
            self._promised = None  # messages are missing then without damage
            raise
        finally:
            self._describe()

    def _note(self, damage: str) -> None:
        self._damaged += 1
        if len(self._damage) < NAMED_PLACES:
            self._damage.append(damage)

    def _read_summary(self) -> None:
        """Read the descriptions of topics that are repeated after the messages."""
        place = self._form.end - HEAD.size - 20
        if self._form.head(place) != (FOOTER, 20):
            return
        place, = struct.unpack('<Q', self._form.bytes_at(place + HEAD.size, 8))
        while 0 < place < self._form.end and self._form.sound(place) and (head := self._form.head(place)):
            kind, length = head
            if kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, self._form.description(place, length))
            elif kind == STATISTICS:
                self._promised, = struct.unpack('<Q', self._form.bytes_at(place + HEAD.size, 8))
            place += HEAD.size + length

    def _read_records(self) -> None:
        for place, kind, length in self._records():
            if kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, self._form.description(place, length))
            elif kind == CHUNK:
                self._read_chunk(place, length)
            elif kind == MESSAGE:
                self._bag.unpack(length)
                self._read_message(self._form, place, length)
            elif kind == METADATA:
                self._read_metadata(self._form.description(place, length))
            elif kind == DATA_END:
                self._check_whole(place, *struct.unpack('<I', self._form.bytes_at(place + HEAD.size, 4)))
            elif kind not in FORMS:
                self._note(f'a record of the unknown kind {kind} at byte {place}')

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """Yield place, kind and length of the records up to the end of the messages."""
        place, form = len(MAGIC), self._form
        while place < form.end:
            head = form.head(place)
            surplus = None if head is None else form.surplus(place, *head)
            if head is None or surplus is None:
                resumed = form.next_sound(place + 1)
            else:
                kind, length = head
                following = place + HEAD.size + length
                whole = surplus == 0 and kind != MESSAGE
                resumed = following if whole or form.sound(following) else form.next_sound(place + 1)
                # A sound record after the following one: only the following one is damaged.
                if whole or resumed is not None and resumed >= following:
                    yield place, kind, length
                if whole and kind in (DATA_END, FOOTER):
                    return
                if resumed == following:
                    place = resumed
                    continue
            if resumed is None:
                break
            self._note(f'records at byte {place}')
            place = resumed
        self._note('the file ends too early')

    def _read_chunk(self, place: int, length: int) -> None:
        _, _, size, crc, name = CHUNK_HEAD.unpack(self._form.bytes_at(place + HEAD.size, CHUNK_HEAD.size))
        at = place + HEAD.size + CHUNK_HEAD.size
        try:
            if length > AT_ONCE or size > AT_ONCE:
                raise ValueError(f'more than {AT_ONCE} bytes at once')
            self._bag.unpack(size)  # counted first: a damaged chunk takes as long
            compression = self._form.bytes_at(at, name).decode()
            content = unpacked(self._form.bytes_at(at + name + 8, length - CHUNK_HEAD.size - name - 8),
                               compression, size)
            if crc and crc32(content) != crc:
                raise ValueError('its checksum differs')
        except LimitExceeded:
            raise
        except Exception as error:  # damaged bytes can raise anything
            text = ' '.join(f'{error}'.split())[:100]
            self._note(f'the chunk at byte {place}: {text}')
            return
        if not self._read_content(McapRecords(BytesIO(content), size), crc != 0):
            self._note(f'records in the chunk at byte {place}')

    def _read_content(self, form: McapRecords, verified: bool) -> bool:
        """Read the records of a chunk; return whether they fill it.  `verified`: it had a checksum."""
        place = 0
        while (head := form.head(place)) is not None:
            kind, length = head
            if kind == MESSAGE and length >= MESSAGE_HEAD.size:
                self._read_message(form, place, length)
            elif kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, form.description(place, length), verified)
            elif kind in FORMS:  # others are not allowed in a chunk; unknown ones are
                return False
            place += HEAD.size + length
        return place == form.end

    def _read_message(self, form: McapRecords, place: int, length: int) -> None:
        """Count a message of the file or of a chunk; keep it if this package uses it."""
        at = place + HEAD.size
        number, _, log_time, _ = MESSAGE_HEAD.unpack(form.bytes_at(at, MESSAGE_HEAD.size))
        self._messages += 1
        if number not in self._channels:
            self._undescribed.add(number)
            return
        topic, name, encoding = self._channels[number]
        if encoding != 'cdr':
            return
        self._bag.count(topic, name, log_time)
        if not self._bag.uses(topic, name):
            return
        if length > AT_ONCE:
            self._note(f'a message of {length} bytes at byte {place}')
            return
        octets = form.bytes_at(at + MESSAGE_HEAD.size, length - MESSAGE_HEAD.size)
        self._bag.keep(Record(topic, name, unpacked_message(octets, self._bag.unpack), log_time))

    def _describe_topic(self, kind: int, content: bytes, verified: bool = False) -> None:
        """
        Add a schema or a channel; of two with the same number, the undamaged one counts.

        :param verified: it had a checksum; without one, the description that this package uses counts.
        """
        try:
            if kind == SCHEMA:
                number, = struct.unpack_from('<H', content)
                name = full_name(_text(content, 2)[0])
                if len(name) > NAME_LENGTH:
                    raise ValueError('a name that is too long')
                names = self._schemas.get(number, [])
                if verified or name not in names and len(names) < 2:
                    self._schemas[number] = [name] if verified else [*names, name]
                return
            number, schema = struct.unpack_from('<HH', content)
            topic, at = _text(content, 4)
            encoding, _ = _text(content, at)
            if max(len(topic), len(encoding)) > NAME_LENGTH:
                raise ValueError('a name that is too long')
        except (struct.error, ValueError):
            self._note('the description of a topic')
            return
        names = self._schemas.get(schema, [''])
        used = [name for name in names if self._wanted(topic, name, encoding)]
        new = number not in self._channels
        if new or verified or used and not self._wanted(*self._channels[number]):
            self._channels[number] = topic, [*used, *names][0], encoding
            if encoding != 'cdr' and new:
                self._bag.leave_out(topic, encoding)

    def _wanted(self, topic: str, name: str, encoding: str) -> bool:
        return encoding == 'cdr' and self._bag.uses(topic, name)

    def _read_metadata(self, content: bytes) -> None:
        """Give the entries of one of our own metadata records to the bag."""
        try:
            name, at = _text(content, 0)
            if name != OUR_RECORD:
                return
            end = at + 4 + struct.unpack_from('<I', content, at)[0]
            at, entries = at + 4, {}
            while at < end:
                key, at = _text(content, at)
                entries[key], at = _text(content, at)
        except (struct.error, ValueError):
            self._note('recorded options or marks')
        else:
            self._bag.take_entries(entries)

    def _check_whole(self, end: int, expected: int) -> None:
        """Compare the checksum of the records up to `end`, if there is one and there is no other damage."""
        if not expected or self._damage:
            return
        checksum, piece = 0, 2**20
        for place in range(0, end, piece):
            checksum = crc32(self._form.bytes_at(place, min(piece, end - place)), checksum)
        if checksum != expected:
            self._note('its checksum differs')

    def _describe(self) -> None:
        """Describe in one warning what is damaged or missing."""
        if self._undescribed:
            self._note(f'messages of {len(self._undescribed)} topic(s) without a description')
        missing = (self._promised or 0) - self._messages
        if not self._damage and missing <= 0:
            return
        places = '; '.join(self._damage) or 'messages are missing'
        more = self._damaged - NAMED_PLACES
        count = f'{self._messages} of its {self._promised}' if missing > 0 else f'{self._messages}'
        self._bag.warnings.append(
            f'{self._name} is cut or damaged ({places}{f"; and {more} more" if more > 0 else ""}); '
            f'{count} message(s) were read')


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return the text at a place in a record, and the place after it."""
    begin = at + 4
    end = begin + struct.unpack_from('<I', content, at)[0]
    if end > len(content):
        raise ValueError('a text that is too long')
    return content[begin:end].decode(), end
