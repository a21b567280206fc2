# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Files of strangers: special files, too much of everything, and messages that meet a defect of ours."""

import os
import sqlite3
import struct
import subprocess
import sys

from mcap.writer import Writer
import numpy as np
import pytest
from toy_messages import SECOND, session_messages, write_session
import zstandard

from dlo_calibration import reading
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files import bag
from dlo_calibration.files import session as session_module
from dlo_calibration.files.bag import AT_ONCE, unpacked
from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import OUR_RECORD, SessionWriter
from dlo_calibration.files.request import read_request
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.messages.codec import bag_types, GOAL, INPUT_TYPES, read

TYPES = bag_types()
GOOD = session_messages(TYPES, 2)


@pytest.fixture
def folder(tmp_path):
    """Give the folder of a good session."""
    return write_session(tmp_path / 'session', GOOD)


def with_images(path, count, size):
    """Write the good messages among others that this package does not use."""
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        channels = {kind: writer.register_channel(f'/{kind}', 'cdr',
                                                  writer.register_schema(name, 'ros2msg', b''))
                    for kind, name in {**INPUT_TYPES, 'camera': 'sensor_msgs/msg/Image'}.items()}
        for k in range(count):
            writer.add_message(channels['camera'], k + 1, bytes(size), 0)
        for k, (kind, message) in enumerate(GOOD):
            writer.add_message(channels[kind], (k + 1) * SECOND, encode(message, INPUT_TYPES[kind]), 0)
        writer.finish()
    return path


@pytest.mark.parametrize('width, height', [(0, 1), (1, 0)])
def test_an_empty_cloud_of_any_point_step_is_refused(width, height):
    message = session_messages(TYPES, 1)[0][1]
    message.width, message.height, message.data = width, height, np.zeros(0, np.uint8)
    for step in (0, 2**31 - 1, 2**31, 2**32 - 1):
        message.point_step = step
        with pytest.raises(InputError, match='0 point'):
            read(GOAL, message)


def test_an_unexpected_error_of_one_message_costs_no_other(folder, monkeypatch):
    def failing(kind, message):
        if kind == GOAL and message.header.stamp.sec == GOOD[-1][1].header.stamp.sec:
            raise ZeroDivisionError('oops')
        return read(kind, message)

    monkeypatch.setattr(session_module, 'read', failing)
    trials, refusals = session_trials(read_session(folder), Options())
    assert len(trials) == 1
    assert any('ZeroDivisionError' in text and 'please report it' in text for text in refusals)


def test_messages_of_other_topics_are_counted_not_kept(tmp_path, command):
    path = with_images(tmp_path / 'a.mcap', 40, 1000)
    session = read_session(path)
    assert len(session.records) == len(session.messages) == len(GOOD)
    code, about, _ = command('info', path, '--json')
    assert (code, about['messages']['/camera'], len(about['trials'])) == (0, 40, 2)


@pytest.mark.parametrize('name, value, words', [
    ('KEPT_MESSAGES', 4, 'more than 4 messages'), ('KEPT_OCTETS', 1500, 'topics of the calibrator'),
    ('UNPACKED_OCTETS', 1000, 'unpacks to more than'), ('MESSAGES_OF_ANY', 10, 'more than')])
def test_messages_before_a_limit_are_used(tmp_path, monkeypatch, name, value, words):
    for limit in ('UNPACKED_RATIO', 'KEPT_OF_ANY'):
        monkeypatch.setattr(bag, limit, 1)
    monkeypatch.setattr(bag, 'MESSAGE_OCTETS', 10**6 if name == 'MESSAGES_OF_ANY' else 1)
    monkeypatch.setattr(bag, name, value)
    with SessionWriter(tmp_path / 'a.mcap') as writer:
        for k in range(8):
            for kind, message in GOOD:
                octets = encode(message, INPUT_TYPES[kind])
                writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], octets, k + 1, flush=k == 0)
    session = read_session(writer.path)
    assert 0 < len(session.records) < 8 * len(GOOD)
    warning, = session.warnings
    assert words in warning and 'split the recording' in warning


@pytest.mark.parametrize('compression', ['zstd', 'lz4', ''])
def test_no_more_is_unpacked_than_announced(compression):
    import lz4.frame

    packed = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress, '': bytes}[compression](bytes(10**6))
    assert unpacked(packed, compression, 10**6) == bytes(10**6)
    for size in (0, 10, 10**6 - 1, 10**6 + 1, AT_ONCE + 1):
        with pytest.raises(ValueError):
            unpacked(packed, compression, size)


@pytest.mark.parametrize('damaged', ['chunks', 'messages'])
def test_damaged_content_counts_as_unpacked_too(tmp_path, monkeypatch, damaged):
    monkeypatch.setattr(bag, 'UNPACKED_OCTETS', 10**6)
    monkeypatch.setattr(bag, 'UNPACKED_RATIO', 1)
    packed = zstandard.compress(bytes(10**5))
    path = with_images(tmp_path / 'a.mcap', 0, 0)
    head = struct.pack('<QQQII', 0, 0, 10**5, 1, 4) + b'zstd' + struct.pack('<Q', len(packed)) + packed
    if damaged == 'messages':  # they end too early
        message = struct.pack('<HIQQ', 1, 0, 1, 1) + packed[:-4]
        record = struct.pack('<BQ', 5, len(message)) + message
    else:  # their checksum differs
        record = struct.pack('<BQ', 6, len(head)) + head
    octets = path.read_bytes()
    end = octets.index(b'\x0f\4\0\0\0\0\0\0\0')
    path.write_bytes(octets[:end] + record * 20 + octets[end:])
    assert any('unpacks to more than 1 MB' in warning for warning in read_session(path).warnings)


@pytest.mark.parametrize('make, came', [
    (os.mkfifo, 'a FIFO'), (lambda path: path.symlink_to('/dev/zero'), 'a device')])
@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.xml'])
def test_a_path_that_is_no_file_is_refused_at_once(tmp_path, make, came, suffix):
    path = tmp_path / f'given{suffix}'
    make(path)
    with pytest.raises(InputError, match=came):
        (read_request if suffix == '.xml' else read_session)(path)


def test_special_files_and_links_out_of_a_folder_are_left_out(folder, tmp_path):
    os.mkfifo(folder / 'a.mcap')
    (tmp_path / 'b.mcap').write_bytes(b'private')
    (folder / 'b.mcap').symlink_to(tmp_path / 'b.mcap')
    (folder / 'metadata.yaml').unlink()
    session = read_session(folder)
    assert len(session.messages) == len(GOOD)
    for name in ('a.mcap', 'b.mcap'):
        assert any(name in warning for warning in session.warnings)


def test_a_link_within_a_folder_is_followed(folder):
    path, = folder.glob('*.mcap')
    path.rename(folder / 'real')
    path.symlink_to('real')
    assert len(read_session(folder).messages) == len(GOOD)


@pytest.mark.parametrize('text', [
    'a: &a [x]\nb: &b [*a, *a]\nrosbag2_bagfile_information: {relative_file_paths: [*b]}',
    '[' * 3000, f'rosbag2_bagfile_information: {{x: "{"y" * 10**6}"}}',
    'rosbag2_bagfile_information: {relative_file_paths: a}'], ids=['aliases', 'nested', 'large', 'no list'])
def test_metadata_that_is_no_rosbag2s_is_left_out(folder, text):
    (folder / 'metadata.yaml').write_text(text)
    session = read_session(folder)
    assert len(session.messages) == len(GOOD)
    warning, = session.warnings
    assert 'metadata.yaml cannot be read' in warning


def test_metadata_with_more_events_than_the_limit_is_left_out(folder, monkeypatch):
    monkeypatch.setattr(reading, 'MAXIMUM_EVENTS', 50)
    session = read_session(folder)
    assert len(session.messages) == len(GOOD)
    assert any('metadata.yaml cannot be read' in warning for warning in session.warnings)


@pytest.mark.parametrize('text', ['[' * 50_000, '{"seed": 1', '3', f'{{"x": "{"y" * 10**5}"}}'])
def test_recorded_options_that_cannot_be_read_are_left_out(tmp_path, text):
    with SessionWriter(tmp_path / 'session') as writer:
        for k, (kind, message) in enumerate(GOOD):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], encode(message, INPUT_TYPES[kind]), k + 1)
        writer._writer.add_metadata(OUR_RECORD, {'options': text})
    session = read_session(writer.path)
    assert (len(session.messages), session.file_options) == (len(GOOD), None)
    warning, = session.warnings
    assert 'options' in warning


def test_undecodable_messages_give_one_warning_for_each_topic(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        for k, (kind, message) in enumerate(GOOD):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], encode(message, INPUT_TYPES[kind]), k + 1)
        for k in range(50):
            octets = b'\0\1\0\0' + struct.pack('<I', k)
            writer.write(f'/calibrator/{GOAL}', INPUT_TYPES[GOAL], octets, 100 + k)
    session = read_session(writer.path)
    assert len(session.messages) == len(GOOD)
    warning, = session.warnings
    assert '49 more' in warning and GOAL in warning


def test_decoded_messages_are_not_kept(folder):
    session = read_session(folder)
    assert session.messages[0][1] is not session.messages[0][1]


#: Two functions that take hours, each in one step of SQLite; then definitions of the messages that call them.
ENDLESS = "instr(zeroblob(100000000), CAST(zeroblob(50000000) || x'01' AS BLOB))"
ENDLESS_TEXT = 'instr(hex(zeroblob(60000000)), hex(zeroblob(30000000)) || 1)'
TABLE = 'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB{})'
ROW = 'SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp'
COMPUTED = {
    'generated': TABLE.format(f' AS ({ENDLESS})'),
    'text': TABLE.format(f' GENERATED ALWAYS AS ({ENDLESS_TEXT})'),
    'stored': TABLE.format(f' AS ({ENDLESS}) STORED'),
    'view': f'CREATE VIEW messages AS {ROW}, {ENDLESS} AS data',
    'recursive': 'CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) '
                 f"{ROW}, x'00' AS data FROM c",
    'virtual': 'CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)',
    'sorted': 'CREATE TABLE messages(rowid TEXT, topic_id INTEGER, timestamp INTEGER, data BLOB)',
}


def database(path, definition=None):
    """Write a database, forge the definition of its messages, and return the page where they begin."""
    with sqlite3.connect(path) as connection:
        connection.executescript(f"""
            PRAGMA page_size = 4096;
            CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
            INSERT INTO topics VALUES (1, '/action', '{INPUT_TYPES['action']}', 'cdr');
            {TABLE.format('')};
            INSERT INTO messages(topic_id, timestamp) VALUES (1, 1);
            PRAGMA writable_schema = ON""")
        connection.execute("UPDATE sqlite_master SET sql = coalesce(?, sql) WHERE name = 'messages'",
                           (definition,))
        root, = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    connection.close()
    return root


#: Prints why each file cannot be read, or its warnings.
READ = """
import sys
from dlo_calibration.errors import InputError
from dlo_calibration.files.session import read_session
for path in sys.argv[1:]:
    try:
        print(read_session(path, any_topics=True).warnings)
    except InputError as error:
        print(error)
"""


def read_in_time(*paths):
    """Return a line about each file; fail where reading takes long: nothing in this process could end it."""
    done = subprocess.run([sys.executable, '-c', READ, *paths], capture_output=True, text=True, timeout=60,
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}, check=True)
    return done.stdout.splitlines()


def test_a_database_that_computes_its_messages_is_refused_and_evaluates_nothing(tmp_path):
    for name, definition in COMPUTED.items():
        database(tmp_path / f'{name}.db3', definition)
    for text in read_in_time(*(tmp_path / f'{name}.db3' for name in COMPUTED)):
        assert 'may compute its content' in text and 'the tables of rosbag2' in text


@pytest.mark.long
def test_a_small_database_with_endless_rows_is_left_after_seconds(tmp_path):
    path, levels, size = tmp_path / 'a.db3', 8, 4096
    root = database(path)
    octets = bytearray(path.read_bytes())
    row = octets[(root - 1) * size:root * size]
    page = len(octets) // size
    for k in range(levels):  # each page leads 300 times to the next one, the last one to the rows
        following = page + k + 1
        cells = b''.join(struct.pack('>IB', following, 1) for _ in range(300))
        head = struct.pack('>BHHHBI', 5, 0, 300, size - len(cells), 0, following)
        places = struct.pack('>300H', *(size - len(cells) + 5 * n for n in range(300)))
        branch = (head + places).ljust(size - len(cells), b'\0') + cells
        if k == 0:
            octets[(root - 1) * size:root * size] = branch
        else:
            octets += branch
    octets += row
    octets[28:32] = struct.pack('>I', len(octets) // size)
    path.write_bytes(octets)
    text, = read_in_time(path)
    assert 'is not read to its end' in text
