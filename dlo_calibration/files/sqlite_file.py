# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
SQLite file: reads the .db3 files of rosbag2, around damaged pages.

SQLite evaluates views, virtual tables and generated columns while it reads, and a single function in them can
take hours that no signal ends.  So a file that defines more than plain tables and indices is refused.
"""

from __future__ import annotations

from bisect import bisect_left
from contextlib import closing
from itertools import count
from pathlib import Path
import re
import sqlite3
from typing import Iterator
from urllib.parse import quote

from dlo_calibration.errors import InputError
from dlo_calibration.files.bag import AT_ONCE, Bag, full_name, LimitExceeded, NAME_LENGTH, unpacked_message
from dlo_calibration.files.record import Record

DEFINITION = re.compile(r'CREATE\s+(TABLE|UNIQUE\s+INDEX|INDEX)\b', re.IGNORECASE)
COMPUTED = re.compile(r'\b(AS|ROWID)\b', re.IGNORECASE)  # in all views and generated columns, not rosbag2's
DEFINITION_LENGTH = 10_000  # characters of a definition, or of a topic; rosbag2's have a few hundred
MOST_TOPICS = 10_000
PAGES = 100  # damaged pages that are skipped; a file with more is hardly a recording
STEPS = 10**7  # of SQLite's machine for a file of any size: a second or two
STEPS_PER_BYTE = 4  # of a larger file: a message takes 50 steps, and 16 bytes at least
STEPS_AT_ONCE = 10**5  # between two calls of Python, which looks at signals


def read_sqlite(path: Path, file: Path, bag: Bag) -> None:
    """
    Read all readable messages; the warnings of the bag describe the damage.

    :param file: of the session, for warnings and errors; `path` is this file, or its unpacked content.
    :raises sqlite3.Error: where it is no database of rosbag2.
    :raises InputError: where it defines anything to be evaluated.
    :raises LimitExceeded: where it contains more than any real recording.
    """
    size = path.stat().st_size
    bag.open(size)
    calls, most = count(), (STEPS + STEPS_PER_BYTE * size) // STEPS_AT_ONCE
    # Immutable: no journal of somebody else is played back, and nothing is written.
    with closing(sqlite3.connect(f'file:{quote(str(path))}?mode=ro&immutable=1', uri=True)) as connection:
        connection.text_factory = lambda octets: octets.decode(errors='replace')
        connection.set_progress_handler(lambda: next(calls) > most, STEPS_AT_ONCE)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, DEFINITION_LENGTH)
        if _whole(path):  # in a cut file, it would read missing pages as zeros
            connection.execute('PRAGMA writable_schema = ON')  # reads on where an index is damaged
        try:
            _require_plain_tables(connection, file)
            topics = _topics(connection, bag)
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, AT_ONCE)
            _read_messages(connection, topics, file.name, bag)
        except sqlite3.OperationalError as error:
            if next(calls) <= most:
                raise
            raise LimitExceeded(f'it takes longer to read than any recording of {size} bytes') from error


def _whole(path: Path) -> bool:
    """Return whether a file has as many pages as its header says."""
    with path.open('rb') as stream:
        head = stream.read(100)
    if len(head) < 100:
        return False
    size = int.from_bytes(head[16:18], 'big')
    return path.stat().st_size >= (65536 if size == 1 else size) * int.from_bytes(head[28:32], 'big')


def _require_plain_tables(connection: sqlite3.Connection, file: Path) -> None:
    """
    Refuse a database that defines anything to be evaluated; loading a definition evaluates nothing.

    :raises InputError: where it does.
    """
    for definition, in connection.execute("SELECT sql FROM sqlite_master WHERE sql <> ''"):
        if not DEFINITION.match(definition) or COMPUTED.search(definition):
            raise InputError(f'recording {file}',
                             f'a database that may compute its content ({definition[:40]} ...)',
                             'no more than the tables of rosbag2', 'record it again, or name another file')


def _topics(connection: sqlite3.Connection, bag: Bag) -> dict[int, tuple[str, str, bool]]:
    """Return name, type, and whether the encoding is cdr, of each topic, by its id."""
    topics = {}
    for number, topic, kind, encoding in connection.execute(
            'SELECT id, name, type, serialization_format FROM topics NOT INDEXED LIMIT ?', (MOST_TOPICS,)):
        topic = str(topic)[:NAME_LENGTH]
        topics[number] = topic, full_name(str(kind)[:NAME_LENGTH]), encoding == 'cdr'
        if encoding != 'cdr':
            bag.leave_out(topic, encoding)
    return topics


def _read_messages(connection: sqlite3.Connection, topics: dict[int, tuple[str, str, bool]], name: str,
                   bag: Bag) -> None:
    wanted = [number for number, (topic, kind, cdr) in topics.items() if cdr and bag.uses(topic, kind)]
    messages, damaged = 0, 0
    for row in _rows(connection, wanted):
        number, log_time, octets = row or (None, None, None)
        if number not in topics or log_time is None:
            damaged += 1
            continue
        topic, kind, cdr = topics[number]
        messages += 1
        if cdr:
            bag.unpack(len(octets or b''))
            bag.count(topic, kind, log_time)
        if isinstance(octets, bytes):
            bag.keep(Record(topic, kind, unpacked_message(octets, bag.unpack), log_time))
    if damaged:
        bag.warnings.append(f'{name} is cut or damaged (in {damaged} or more places); '
                            f'{messages} message(s) were read')


def _rows(connection: sqlite3.Connection, wanted: list[int]
          ) -> Iterator[tuple[int | None, int | None, bytes | None] | None]:
    """
    Yield for each message its topic's number, its time, and its bytes if the topic is wanted.

    None stands for a damaged page, whose messages are missing.
    """
    # The type of a value is read without the value, which might be large.
    integers = ', '.join(f"CASE WHEN typeof({column}) = 'integer' THEN {column} END"
                         for column in ('topic_id', 'timestamp'))
    choice = ', '.join(str(int(number)) for number in wanted)
    query = (f"SELECT rowid, {integers}, CASE WHEN typeof(topic_id) = 'integer' AND topic_id IN ({choice}) "
             'THEN data END FROM messages NOT INDEXED WHERE rowid >= ? ORDER BY rowid')
    start = 1
    for _ in range(PAGES):
        try:
            for row in connection.execute(query, (start,)):
                start = row[0] + 1
                yield row[1:]
            return
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            yield None
        following = _after(connection, query, start)
        if following is None:
            return
        start = following


def _after(connection: sqlite3.Connection, query: str, start: int) -> int | None:
    """Return the first row id behind a damaged page at which reading can go on; None: there is none."""
    def readable(rowid: int) -> bool:
        """Return whether the first row from `rowid` on is undamaged."""
        try:
            connection.execute(query, (rowid,)).fetchone()
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            return False
        return True

    step = 1
    while not readable(start + step):
        step *= 2
        if start + step >= 2**62:
            return None
    first = start + step // 2 + 1  # the last row that was tried is damaged
    return first + bisect_left(range(first, start + step), True, key=readable)
