# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bombs: small files from which much comes out, given to every verb that reads them."""

from __future__ import annotations

from dataclasses import dataclass
import json
import os
from pathlib import Path
import socket
import sqlite3
import struct
from typing import Callable

import lz4.frame
from mcap.writer import CompressionType, Writer
import numpy as np
from tally import Ended, Tally, verb
from toy_messages import SECOND, session_messages, write_session
import zstandard

from dlo_calibration.files.record import encode, typestore
from dlo_calibration.files.recording import OUR_RECORD, SessionWriter
from dlo_calibration.messages.codec import bag_types, chain_cloud, GOAL, INITIAL, INPUT_TYPES
from dlo_calibration.model.chain import Chain

FULL = 4  # how many verbs each bomb is given to
VERBS = ('info', 'fit', 'validate', 'plot')
PATIENCE = 180.0  # s; more than any fit takes on a busy machine
LIMIT = 1e9  # bytes of memory
TYPES = bag_types()
GOOD = session_messages(TYPES, 2)
OTHER = 'sensor_msgs/msg/Image'


@dataclass(frozen=True)
class Bomb:
    """
    Something that is given as a session, or as a result.

    :param make: writes it to a path.
    :param good: whether it has the good trials besides, which must still be found.
    """

    name: str
    make: Callable[[Path], object]
    good: bool = True
    result: bool = False


# ---- MCAP


def begin(stream, **arguments):
    """Begin an MCAP file with the good messages; return its writer, and the numbers of its channels."""
    writer = Writer(stream, **arguments)
    writer.start(profile='ros2')
    channels = {}
    for kind, name in (*INPUT_TYPES.items(), ('image', OTHER)):
        definition = typestore().generate_msgdef(name, ros_version=2)[0].encode()
        channels[kind] = writer.register_channel(
            f'/calibrator/{kind}', 'cdr', writer.register_schema(name, 'ros2msg', definition))
    for k, (kind, message) in enumerate(GOOD):
        time = (k + 1) * SECOND
        writer.add_message(channels[kind], time, encode(message, INPUT_TYPES[kind]), time)
    writer.flush()
    return writer, channels


def chunk(packed, compression, size, crc=0):
    """Return a chunk record."""
    name = compression.encode()
    head = struct.pack('<QQQII', 0, 0, size, crc, len(name)) + name + struct.pack('<Q', len(packed))
    return struct.pack('<BQ', 6, len(head) + len(packed)) + head + packed


def with_chunk(make_chunk, count=1):
    """Return a maker of a file with the good messages, and then chunks."""
    def make(path):
        octets = make_chunk()
        with path.open('wb') as stream:
            writer, _ = begin(stream)
            writer.flush()
            for _ in range(count):
                stream.write(octets)
            writer.finish()
    return make


def zeros(size):
    """Return that many zeros, some 128 kB, in a frame of zstd: blocks of one repeated byte."""
    block = 2**17
    assert size % block == 0
    blocks = [struct.pack('<I', (k == size // block - 1) | 1 << 1 | block << 3)[:3] + b'\0'
              for k in range(size // block)]
    return struct.pack('<IBBQ', 0xfd2fb528, 0xc0, 0x38, size) + b''.join(blocks)


def image_chunk(size):
    """Return a chunk of one message on the camera's topic."""
    head = struct.pack('<BQHIQQ', 5, 22 + size, 4, 0, 0, 0)
    return chunk(zstandard.ZstdCompressor(level=3).compress(head + bytes(size)), 'zstd', len(head) + size)


def flood(kind, count, octets=b''):
    """Return a maker of a file with the good messages, and then many messages of a kind."""
    def make(path):
        with path.open('wb') as stream:
            writer, channels = begin(stream)
            one = struct.pack('<BQHIQQ', 5, 22 + len(octets), channels[kind], 0, 99 * SECOND, 0) + octets
            each = min(count, 10**8 // len(one))
            packed = zstandard.ZstdCompressor(level=3).compress(one * each)
            for _ in range(count // each):
                stream.write(chunk(packed, 'zstd', len(one) * each))
            writer.finish()
    return make


def tiny():
    """Return the bytes of the smallest usable chain."""
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    cloud = chain_cloud(TYPES, Chain(points), 200 * SECOND, 'world')
    return encode(cloud, INPUT_TYPES[INITIAL])


def channels(path):
    """Write as many topics as there can be, with long names."""
    with path.open('wb') as stream:
        writer, _ = begin(stream, compression=CompressionType.ZSTD)
        for k in range(60_000):
            writer.register_channel(f'/{"x" * 250}{k}', 'json', 1)
        writer.finish()


def unchunked(path, kind=5, length=2**40):
    """Write a file that ends with a record that says it is long."""
    with path.open('wb') as stream:
        writer, _ = begin(stream, use_chunking=False)
        writer.finish()
    octets = path.read_bytes()
    place = octets.index(b'\x0f\x04\0\0\0\0\0\0\0')
    path.write_bytes(octets[:place] + struct.pack('<BQ', kind, length) + octets[place:])


def damaged(path):
    """Write a file in which a record seems to begin at every byte."""
    unchunked(path)
    with path.open('ab') as stream:
        stream.write(b'\x05\x16\0\0\0\0\0\0\0' * 3_000_000)


def entries(**texts):
    """Return a maker of a session with a record of our own."""
    def make(path):
        with SessionWriter(path, {'seed': 1}) as writer:
            for k, (kind, message) in enumerate(GOOD):
                octets = encode(message, INPUT_TYPES[kind])
                writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], octets, k + 1)
            writer._writer.add_metadata(OUR_RECORD, texts)
    return make


def arrays(path):
    """Write a session with a message whose arrays say they are long."""
    octets = bytearray(encode(GOOD[1][1], INPUT_TYPES['action']))
    octets[20:28] = b'\xff' * 8
    flood('action', 1, bytes(octets))(path)


# ---- folders


def with_metadata(text):
    """Return a maker of a folder with a good session and this metadata.yaml."""
    def make(path):
        folder = write_session(path, GOOD)
        (folder / 'metadata.yaml').write_text(text)
    return make


ALIASES = 'a0: &a0 [x]\n' + ''.join(f'a{k + 1}: &a{k + 1} [{f"*a{k}," * 9}]\n' for k in range(30))
PLAIN = 'rosbag2_bagfile_information:\n  topics:\n' + '    - {name: x, type: y}\n' * 90_000


def special(path):
    """Make a folder whose recordings are a FIFO, and links to a device and out of the folder."""
    folder = write_session(path, GOOD)
    os.mkfifo(folder / 'a.mcap')
    (folder / 'b.mcap').symlink_to('/dev/zero')
    (folder / 'c.mcap').symlink_to('/etc/passwd')
    (folder / 'metadata.yaml').unlink()


def bound_socket(path):
    """Make a socket."""
    here = Path.cwd()
    os.chdir(path.parent)  # the names of sockets are short
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(path.name)
    os.chdir(here)


# ---- .db3


def database(path, *statements):
    """Write a database with the good messages, and execute statements on it."""
    with sqlite3.connect(path) as connection:
        connection.executescript("""
            CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)""")
        numbers = {kind: k for k, kind in enumerate(INPUT_TYPES)}
        connection.executemany('INSERT INTO topics VALUES (?, ?, ?, ?)', [
            (k, f'/{kind}', INPUT_TYPES[kind], 'cdr') for kind, k in numbers.items()])
        connection.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)', [
            (numbers[kind], k + 1, encode(message, INPUT_TYPES[kind]))
            for k, (kind, message) in enumerate(GOOD)])
        for statement in statements:
            connection.execute(statement)
    connection.close()


COUNT = 'WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c{}) SELECT '


def view(path):
    """Write a database whose messages are computed, without end."""
    database(path, 'ALTER TABLE messages RENAME TO others',
             f"CREATE VIEW messages AS {COUNT.format('')} x AS id, 2 AS topic_id, 9 AS timestamp, "
             "zeroblob(1000) AS data FROM c")


def computed(path):
    """Write a database whose rows are computed to be large."""
    database(path, 'ALTER TABLE messages RENAME TO others',
             'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
             'data BLOB AS (zeroblob(900000000)))',
             'INSERT INTO messages (topic_id, timestamp) VALUES (1, 1)')


def packed_file(path):
    """Write a good database, packed, with room for 8 GB behind it."""
    whole = path.with_suffix('.plain')
    database(whole)
    octets = whole.read_bytes()
    path.write_bytes(zstandard.ZstdCompressor().compress(octets) + zeros(8 * 2**30))


# ---- XML


def xml(root, inner):
    """Return a maker of a document."""
    whole = f'<{root} version="1">{inner}</{root}>' if root else inner
    return lambda path: path.write_text(f'<?xml version="1.0"?>\n{whole}')


POINTS = '<point x="0.123456789" y="1" z="0"/>' * 499_000
REQUEST = ('<object/><settings/><trial name="t"><initial_chain>{}</initial_chain><hand_paths><hand name="h" '
           'grips="0"><waypoint time="0" x="0" y="0" z="0"/></hand></hand_paths><goal_chain time="1">{}'
           '</goal_chain></trial>')
LONG = 'x' * 30_000_000
ENTITIES = ('<!DOCTYPE a [<!ENTITY e0 "x">' + ''.join(
    f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(12)) + ']><calibration_request>&e12;'
    '</calibration_request>')

BOMBS = {
    'one_chunk.mcap': Bomb('8 GB in a chunk', with_chunk(lambda: chunk(zeros(8 * 2**30), 'zstd', 8 * 2**30))),
    'empty.mcap': Bomb('3 million empty messages', flood(GOAL, 3_000_000)),
    'aliases': Bomb('aliases in YAML', with_metadata(ALIASES)),
    'plain': Bomb('2 MB of YAML', with_metadata(PLAIN)),
    'many_chunks.mcap': Bomb('8 GB in many chunks', with_chunk(lambda: image_chunk(10**8), 80)),
    'fifo.mcap': Bomb('a FIFO', os.mkfifo, good=False),
    'lying.mcap': Bomb('a chunk larger than it says',
                       with_chunk(lambda: chunk(zeros(2**31), 'zstd', 1000))),
    'lz4.mcap': Bomb('a chunk of lz4 larger than it says',
                     with_chunk(lambda: chunk(lz4.frame.compress(bytes(10**9)), 'lz4', 1000))),
    'others.mcap': Bomb('messages of another topic', flood('image', 30_000_000)),
    'tiny.mcap': Bomb('the smallest chains', flood(INITIAL, 400_000, tiny())),
    'large.mcap': Bomb('large messages', flood(GOAL, 30, bytes(10**7))),
    'channels.mcap': Bomb('60,000 topics', channels),
    'message.mcap': Bomb('a message of a terabyte', unchunked),
    'attachment.mcap': Bomb('an attachment of a terabyte', lambda path: unchunked(path, 9)),
    'damaged.mcap': Bomb('a record at every byte', damaged),
    'arrays.mcap': Bomb('arrays of 4 billion', arrays),
    'nested.mcap': Bomb('nested options', entries(options='[' * 90_000)),
    'options.mcap': Bomb('large options', entries(options=json.dumps({'x': 'y' * 10**7}))),
    'lists': Bomb('nested YAML', with_metadata('[' * 500_000)),
    'special': Bomb('special files in a folder', special),
    'socket.mcap': Bomb('a socket', bound_socket, good=False),
    'device.mcap': Bomb('a device', lambda path: path.symlink_to('/dev/zero'), good=False),
    'view.db3': Bomb('rows without end', view, good=False),
    'computed.db3': Bomb('large computed rows', computed, good=False),
    'packed.db3.zstd': Bomb('8 GB in a packed file', packed_file, good=False),
    'packed.mcap.zstd': Bomb('8 GB of zeros', lambda path: path.write_bytes(zeros(8 * 2**30)),
                             good=False),
    'points.xml': Bomb('half a million points',
                       xml('calibration_request', REQUEST.format(POINTS, POINTS[:180])), good=False),
    'deep.xml': Bomb('a million levels', xml('calibration_request', '<a>' * 10**6), good=False),
    'attribute.xml': Bomb('a long attribute', xml('calibration_request', f'<object name="{LONG}"/>'),
                          good=False),
    'entities.xml': Bomb('entities', xml(None, ENTITIES), good=False),
    'fifo.xml': Bomb('a FIFO as a request', os.mkfifo, good=False),
    'result.xml': Bomb('half a million points in a result',
                       xml('dlo', f'<chain>{POINTS}</chain>'), good=False, result=True),
    'fifo_result.xml': Bomb('a FIFO as a result', os.mkfifo, good=False, result=True),
}


def words(name: str, given: Path, result: Path, folder: Path) -> list[object]:
    """Return the command line of a verb for a session."""
    return {'info': ['info', given, '--json'],
            'fit': ['fit', given, '--json', '--evaluations', 2, '--workers', 1, '--calibrate', 'friction',
                    '--engine', 'compiled'],
            'validate': ['validate', result, given, '--json'],
            'plot': ['plot', given, '--output', folder / 'plot.png']}[name]


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Give every bomb to `amount` verbs; one verb gets the first bomb only."""
    tally = Tally()
    good = write_session(folder / 'good', GOOD, {'seed': seed})
    result = folder / 'good_result.xml'
    if amount > 2:
        ended = verb(*words('fit', good, result, folder), '--output', folder / 'fitted', folder=folder,
                     limit=PATIENCE)
        assert ended.code == 0, ended.err
        result = folder / 'fitted' / 'result.xml'
    for name, bomb in list(BOMBS.items())[:1 if amount == 1 else None]:
        path = folder / name
        make(bomb, path)
        for each in ('validate',) if bomb.result else VERBS[:amount]:
            given = (good, path) if bomb.result else (path, result)
            command = words(each, *given, folder)
            ended = verb(*command, folder=folder, limit=PATIENCE)
            judge(tally, f'{name} {each}', ended, bomb.good, each)
        if path.is_dir():
            for one in path.iterdir():
                one.unlink()
        else:
            path.unlink()
    return tally


def make(bomb: Bomb, path: Path) -> None:
    """Make a bomb in another process: what that needs would count as memory of all that begin later."""
    child = os.fork()
    if not child:
        bomb.make(path)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


def judge(tally: Tally, what: str, ended: Ended, good: bool, name: str) -> None:
    """Count what became of a bomb; say what is wrong."""
    tally.tried += 1
    tally.refused += ended.code == 2
    tally.remember(peak=ended.peak, silence=ended.seconds)
    wrong = []
    if ended.code not in (0, 2) or 'Traceback' in ended.err or ended.peak > LIMIT:
        tally.died += 1
        wrong.append('died')
    elif ended.code == 2 and (len(ended.err.splitlines()) != 1 or len(ended.err) > 2000):
        tally.died += 1
        wrong.append('more than a line')
    if good and (ended.code != 0 or name == 'info' and len(json.loads(ended.out)['trials']) < 2):
        tally.lost += 1
        wrong.append('good trials are lost')
    if wrong or ended.seconds > 15:
        print(f'{what}: {"; ".join(wrong) or "slow"}; code {ended.code}, {ended.peak / 1e6:.0f} MB, '
              f'{ended.seconds:.1f} s: {ended.err[-300:]}')
