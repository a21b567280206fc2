# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""SqliteFile: reads the .db3 files of rosbag2, around damaged pages."""

from __future__ import annotations

from pathlib import Path
import sqlite3
from typing import Iterator
from urllib.parse import quote

from dlo_calibration.files.intake import full_name, Intake, NAME_LENGTH, Record
from dlo_calibration.files.unpacking import AT_ONCE, unpacked_message

PAGES = 100  # damaged ones that are gone around; more are hardly a recording
STEPS = 10**9  # of SQLite's machine for one file: a minute or two; a real recording takes 50 for a message


def read_sqlite(path: Path, name: str, intake: Intake) -> None:
    """
    Read all messages that can be read; what cannot is described in the problems of the intake.

    :param name: of the file, for the descriptions of problems.
    :raises sqlite3.Error: where it is no database of rosbag2.
    :raises LimitExceeded: where more comes out of it than of any real recording.
    """
    intake.open(path.stat().st_size)
    # Immutable: no journal of somebody else is played back, and nothing is written.
    connection = sqlite3.connect(f'file:{quote(str(path))}?mode=ro&immutable=1', uri=True)
    try:
        connection.text_factory = lambda octets: octets[:NAME_LENGTH].decode(errors='replace')
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, AT_ONCE)
        connection.execute('PRAGMA trusted_schema = OFF')
        if _whole(path):  # SQLite takes the pages that a cut file lacks for zeros then
            connection.execute('PRAGMA writable_schema = ON')  # reads on where an index is damaged
        connection.set_progress_handler(lambda: 1, STEPS)
        _read(connection, name, intake)
    finally:
        connection.close()


def _whole(path: Path) -> bool:
    """Tell whether a file has as many pages as its header says."""
    with path.open('rb') as stream:
        head = stream.read(100)
    if len(head) < 100:
        return False
    size = int.from_bytes(head[16:18], 'big')
    return path.stat().st_size >= (65536 if size == 1 else size) * int.from_bytes(head[28:32], 'big')


def _read(connection: sqlite3.Connection, name: str, intake: Intake) -> None:
    tables = connection.execute(
        "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0 "
        "AND name IN ('topics', 'messages')")
    if len(tables.fetchall()) != 2:  # a view could compute rows without end
        raise sqlite3.DatabaseError('it has not the tables of rosbag2')
    topics = {number: (str(topic), full_name(str(kind)), encoding) for number, topic, kind, encoding in
              connection.execute('SELECT id, name, type, serialization_format FROM topics LIMIT 10000')}
    others = [(topic, encoding) for topic, _, encoding in topics.values() if encoding != 'cdr']
    if others:
        topic, encoding = others[0]
        more = f', and {len(others) - 1} more topics' if len(others) > 1 else ''
        intake.problems.append(f'topic {topic} is left out: its messages are {encoding!r}, not cdr{more}')
    count, pages = 0, 0
    for row in _rows(connection, [number for number, (topic, kind, encoding) in topics.items()
                                  if encoding == 'cdr' and intake.uses(topic, kind)]):
        if row is None:
            pages += 1
            continue
        number, log_time, octets = row
        if number not in topics or not isinstance(log_time, int):
            pages += 1
            continue
        topic, kind, encoding = topics[number]
        count += 1
        if encoding == 'cdr':
            intake.unpack(0 if octets is None else len(octets))
            intake.count(topic, kind, log_time)
        if isinstance(octets, bytes):
            try:
                octets = unpacked_message(octets)
            except Exception:  # damaged bytes can raise anything; they do not decode, which is told then
                pass
            intake.keep(Record(topic, kind, octets, log_time))
    if pages:
        intake.problems.append(f'{name} is cut or damaged (in {pages} or more places); '
                               f'{count} message(s) were read')


def _rows(connection: sqlite3.Connection, wanted: list[int]
          ) -> Iterator[tuple[int, int, bytes | None] | None]:
    """
    Yield number of the topic, time, and bytes if the topic is wanted, of each message.

    None stands for a damaged page, whose messages are missing.
    """
    query = ('SELECT rowid, topic_id, timestamp, CASE WHEN topic_id IN '
             f'({",".join(str(int(number)) for number in wanted)}) THEN data END '
             'FROM messages NOT INDEXED WHERE rowid >= ? ORDER BY rowid')
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
    def readable(rowid: int) -> bool | None:
        """Whether there is a readable row from this one on; None: there is no row at all."""
        try:
            return True if connection.execute(query, (rowid,)).fetchone() else None
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            return False

    good = 1
    while readable(start + good) is False:
        good *= 2
        if start + good >= 2**62:
            return None
    bad = good // 2
    while good - bad > 1:
        middle = (good + bad) // 2
        if readable(start + middle) is False:
            bad = middle
        else:
            good = middle
    return start + good
