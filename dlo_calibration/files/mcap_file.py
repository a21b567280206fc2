# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
McapFile: reads an MCAP file record by record, around damaged places.

A wrong bit costs at most the messages of the chunk that it is in.  Records are read by
hand, not with the library mcap: it ends at the first damaged place, and makes a chunk
or a table as large as the file says.
"""

from __future__ import annotations

from dataclasses import dataclass
import struct
from typing import BinaryIO, Callable, Iterator, Mapping
from zlib import crc32

from dlo_calibration.files.intake import full_name, Intake, LimitExceeded, NAME_LENGTH, Record
from dlo_calibration.files.mcap_form import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    FORMS,
    HEAD,
    MAGIC,
    McapForm,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    SCHEMA,
    STATISTICS,
)
from dlo_calibration.files.recording import OUR_RECORD
from dlo_calibration.files.unpacking import AT_ONCE, unpacked, unpacked_message

DESCRIPTION_SIZE = 2**20  # bytes read of a channel, a schema or one of our own records: names and options
CHUNK_HEAD = struct.Struct('<QQQII')  # times of the first and last message, size, CRC, length of a name
TOLD = 3  # damaged places that are named
LEFT_OUT = 10  # topics likewise


@dataclass
class _Channel:
    """A topic of the file; `wanted`: this package uses its messages, so that they are kept."""

    topic: str
    type: str
    encoding: str
    wanted: bool


class McapFile:
    """
    An MCAP file, and what was found in it.

    :param size: of the stream [bytes].
    :param name: of the file, for the descriptions of problems.
    :param intake: takes the messages.
    :param take_entries: called with the entries of each metadata record of our own.
    """

    def __init__(self, stream: BinaryIO, size: int, name: str, intake: Intake,
                 take_entries: Callable[[Mapping[str, str]], None]) -> None:
        self._form = McapForm(stream, size)
        self._name, self._intake, self._take_entries = name, intake, take_entries
        self._schemas: dict[int, list[str]] = {}
        self._channels: dict[int, _Channel] = {}
        self._promised: int | None = None  # number of messages by the file's statistics
        self._messages = 0
        self._strange: set[int] = set()  # channels that are not described
        self._damage: list[str] = []  # the first damaged places
        self._damaged = 0
        self._left_out: list[str] = []  # a text for each topic of another encoding

    def read(self) -> None:
        """
        Read all that can be read; what cannot is described in the problems of the intake.

        :raises ValueError: where it is no MCAP file.
        :raises LimitExceeded: where more comes out of it than of any real recording.
        """
        if self._form.bytes_at(0, len(MAGIC)) != MAGIC:
            if not self._form.sound(len(MAGIC)):
                raise ValueError('it does not begin as an MCAP file does')
            self._note('its first bytes')
        self._intake.open(self._form.end)
        self._read_summary()
        try:
            self._read_records()
        except LimitExceeded:
            self._promised = None  # what is missing then is not damaged
            raise
        finally:
            self._describe()

    def _note(self, damage: str) -> None:
        self._damaged += 1
        if len(self._damage) < TOLD:
            self._damage.append(damage)

    def _read_summary(self) -> None:
        """Read the descriptions of topics that are repeated after the messages."""
        place = self._form.end - HEAD.size - 20
        if self._form.head(place) != (FOOTER, 20):
            return
        place, = struct.unpack('<Q', self._form.bytes_at(place + HEAD.size, 8))
        while 0 < place < self._form.end and self._form.sound(place):
            head = self._form.head(place)
            if head is None:
                return
            kind, length = head
            if kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, self._content(place, length))
            elif kind == STATISTICS:
                self._promised, = struct.unpack('<Q', self._form.bytes_at(place + HEAD.size, 8))
            place += HEAD.size + length

    def _content(self, place: int, length: int) -> bytes:
        return self._form.bytes_at(place + HEAD.size, min(length, DESCRIPTION_SIZE))

    def _read_records(self) -> None:
        for place, kind, length in self._records():
            if kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, self._content(place, length))
            elif kind == CHUNK:
                self._read_chunk(place, length)
            elif kind == MESSAGE:
                self._read_message(place, length)
            elif kind == METADATA:
                self._read_metadata(self._content(place, length))
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
                found = form.next_sound(place + 1)
            else:
                kind, length = head
                following = place + HEAD.size + length
                whole = surplus == 0 and kind != MESSAGE
                found = following if whole or form.sound(following) else form.next_sound(place + 1)
                # A sound one behind the following place: this length is right, the following record damaged.
                if whole or found is not None and found >= following:
                    yield place, kind, length
                if whole and kind in (DATA_END, FOOTER):
                    return
                if found == following:
                    place = found
                    continue
            if found is None:
                break
            self._note(f'records at byte {place}')
            place = found
        self._note('the file ends too early')

    def _read_chunk(self, place: int, length: int) -> None:
        _, _, size, crc, name = CHUNK_HEAD.unpack(self._form.bytes_at(place + HEAD.size, CHUNK_HEAD.size))
        at = place + HEAD.size + CHUNK_HEAD.size
        try:
            if length > AT_ONCE or size > AT_ONCE:
                raise ValueError(f'more than {AT_ONCE} bytes at once')
            compression = self._form.bytes_at(at, name).decode()
            content = unpacked(self._form.bytes_at(at + name + 8, length - CHUNK_HEAD.size - name - 8),
                               compression, size)
            if crc and crc32(content) != crc:
                raise ValueError('its checksum differs')
        except Exception as error:  # damaged bytes can raise anything
            text = ' '.join(f'{error}'.split())[:100]
            self._note(f'the chunk at byte {place}: {text}')
            return
        self._intake.unpack(len(content))
        if not self._take_content(content, crc != 0):
            self._note(f'records in the chunk at byte {place}')

    def _take_content(self, content: bytes, sure: bool) -> bool:
        """Read the records of a chunk; return whether they fill it. `sure`: it had a checksum."""
        place, size = 0, len(content)
        while place + HEAD.size <= size:
            kind, length = HEAD.unpack_from(content, place)
            begin = place + HEAD.size
            place = begin + length
            if place > size:
                return False
            if kind == MESSAGE and length >= MESSAGE_HEAD.size:
                number, _, log_time, _ = MESSAGE_HEAD.unpack_from(content, begin)
                channel = self._count(number, log_time)
                if channel is not None:
                    self._keep(channel, content[begin + MESSAGE_HEAD.size:place], log_time)
            elif kind in (SCHEMA, CHANNEL):
                self._describe_topic(kind, content[begin:min(place, begin + DESCRIPTION_SIZE)], sure)
            elif kind in FORMS:  # others are not allowed in a chunk; unknown ones are
                return False
        return place == size

    def _read_message(self, place: int, length: int) -> None:
        at = place + HEAD.size
        number, _, log_time, _ = MESSAGE_HEAD.unpack(self._form.bytes_at(at, MESSAGE_HEAD.size))
        self._intake.unpack(length)
        channel = self._count(number, log_time)
        if channel is not None and length > AT_ONCE:
            self._note(f'a message of {length} bytes at byte {place}')
        elif channel is not None:
            octets = self._form.bytes_at(at + MESSAGE_HEAD.size, length - MESSAGE_HEAD.size)
            self._keep(channel, octets, log_time)

    def _count(self, number: int, log_time: int) -> _Channel | None:
        """Count a message of a channel; return the channel if the message is to be kept."""
        self._messages += 1
        channel = self._channels.get(number)
        if channel is None:
            self._strange.add(number)
            return None
        if channel.encoding != 'cdr':
            return None
        self._intake.count(channel.topic, channel.type, log_time)
        return channel if channel.wanted else None

    def _keep(self, channel: _Channel, octets: bytes, log_time: int) -> None:
        try:
            octets = unpacked_message(octets)
        except Exception:  # damaged bytes can raise anything; they do not decode, which is told then
            pass
        self._intake.keep(Record(channel.topic, channel.type, octets, log_time))

    def _describe_topic(self, kind: int, content: bytes, sure: bool = False) -> None:
        """
        Take a schema or a channel; of two with one number, one that is not damaged.

        :param sure: it had a checksum; else, the one that this package uses is taken for undamaged.
        """
        try:
            if kind == SCHEMA:
                number, = struct.unpack_from('<H', content)
                name = full_name(_text(content, 2)[0])
                if len(name) > NAME_LENGTH:
                    raise ValueError('a name that is too long')
                names = self._schemas.get(number, [])
                if sure or name not in names and len(names) < 2:
                    self._schemas[number] = [name] if sure else [*names, name]
                return
            number, schema = struct.unpack_from('<HH', content)
            topic, at = _text(content, 4)
            encoding, _ = _text(content, at)
            if max(len(topic), len(encoding)) > NAME_LENGTH:
                raise ValueError('a name that is too long')
        except (struct.error, ValueError):
            self._note('the description of a topic')
            return
        known = self._channels.get(number)
        choice = [_Channel(topic, name, encoding, encoding == 'cdr' and self._intake.uses(topic, name))
                  for name in self._schemas.get(schema, [''])]
        found = next((one for one in choice if one.wanted), choice[0])
        if known is None or sure or found.wanted and not known.wanted:
            self._channels[number] = found
            if encoding != 'cdr' and known is None:
                self._left_out.append(f'topic {topic} is left out: its messages are {encoding!r}, not cdr')

    def _read_metadata(self, content: bytes) -> None:
        """Pass the entries of a record of our own on."""
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
            self._take_entries(entries)

    def _check_whole(self, end: int, expected: int) -> None:
        """Compare the checksum of the records up to `end`, if there is one and no other damage was found."""
        if not expected or self._damage:
            return
        found, piece = 0, 2**20
        for place in range(0, end, piece):
            found = crc32(self._form.bytes_at(place, min(piece, end - place)), found)
        if found != expected:
            self._note('its checksum differs')

    def _describe(self) -> None:
        """Describe what is left out, and in one problem what is damaged or missing."""
        more = len(self._left_out) - LEFT_OUT
        self._intake.problems += self._left_out[:LEFT_OUT]
        if more > 0:
            self._intake.problems.append(f'{more} more topics are left out likewise')
        if self._strange:
            self._note(f'messages of {len(self._strange)} topic(s) without a description')
        missing = (self._promised or 0) - self._messages
        if not self._damage and missing <= 0:
            return
        places = '; '.join(self._damage) or 'messages are missing'
        more = self._damaged - TOLD
        count = f'{self._messages} of its {self._promised}' if missing > 0 else f'{self._messages}'
        self._intake.problems.append(
            f'{self._name} is cut or damaged ({places}{f"; and {more} more" if more > 0 else ""}); '
            f'{count} message(s) were read')


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return the text at a place in a record, and the place after it."""
    begin = at + 4
    end = begin + struct.unpack_from('<I', content, at)[0]
    if end > len(content):
        raise ValueError('a text that is too long')
    return content[begin:end].decode(), end
