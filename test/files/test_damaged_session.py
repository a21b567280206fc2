# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Damaged recordings: whatever is not damaged is read."""

from collections import Counter
import random
import shutil

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
import pytest
from rosbags.rosbag2 import Writer as BagWriter
from toy_messages import SECOND, session_messages, write_session

from dlo_calibration.files.record import encode, typestore
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES

GOOD = [(kind, encode(message, INPUT_TYPES[kind])) for kind, message in session_messages(bag_types(), 8)]
FLIPS = 60
CHUNKED = (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE)


def write_mcap(path, chunking, compression=CompressionType.NONE):
    """Write a file as others do: several messages in a chunk, or no chunks."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=1500, compression=compression, use_chunking=chunking)
        writer.start(profile='ros2')
        channels = {}
        for kind, name in INPUT_TYPES.items():
            schema = writer.register_schema(name, 'ros2msg', b'')
            channels[kind] = writer.register_channel(f'/{kind}', 'cdr', schema)
        for k, (kind, octets) in enumerate(GOOD):
            writer.add_message(channels[kind], (k + 1) * SECOND, octets, (k + 1) * SECOND)
        writer.finish()
    return path


def missing(session):
    """Return how many of the good messages a session has not."""
    return sum((Counter(GOOD) - Counter((record.name, record.data) for record in session.records)).values())


@pytest.fixture(scope='module', params=['ours', *CHUNKED, None], ids=str)
def recording(request, tmp_path_factory):
    """Give the bytes of a good file, and how many messages one of its chunks has."""
    folder = tmp_path_factory.mktemp('good')
    if request.param == 'ours':
        path, = write_session(folder / 'session', session_messages(bag_types(), 8)).glob('*.mcap')
        return path.read_bytes(), 1
    path = write_mcap(folder / 'a.mcap', request.param is not None, request.param or CompressionType.NONE)
    if request.param is None:
        return path.read_bytes(), 1
    with path.open('rb') as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert len(chunks) > 3
    sizes = Counter()
    for chunk in chunks:  # messages are at a second each
        sizes[chunk.chunk_start_offset] = (chunk.message_end_time - chunk.message_start_time) // SECOND + 1
    return path.read_bytes(), max(sizes.values())


def test_a_wrong_bit_costs_at_most_its_chunk(recording, tmp_path):
    octets, allowed = recording
    dice, path, warned = random.Random(5), tmp_path / 'flipped.mcap', 0
    for _ in range(FLIPS):
        flipped = bytearray(octets)
        place = dice.randrange(len(octets))
        flipped[place] ^= 1 << dice.randrange(8)
        path.write_bytes(flipped)
        session = read_session(path)
        assert missing(session) <= allowed, place
        warned += bool(session.warnings)
    assert warned  # an undamaged file has no warning


@pytest.mark.parametrize('piece', [b'', bytes(100), b'\xff' * 100, b'\x06' * 9, b'\x05\x16' + bytes(7)],
                         ids=['one byte less', 'zeros', 'ones', 'heads', 'empty message'])
def test_bytes_that_came_in_between_cost_at_most_their_chunk(recording, tmp_path, piece):
    octets, allowed = recording
    path = tmp_path / 'longer.mcap'
    place = octets.index(GOOD[8][1]) if GOOD[8][1] in octets else len(octets) // 3
    path.write_bytes(octets[:place] + piece + octets[place + (not piece):])
    session = read_session(path)
    assert missing(session) <= allowed
    assert any(path.name in warning and 'damaged' in warning for warning in session.warnings)


def test_lost_messages_are_counted(tmp_path):
    path = write_mcap(tmp_path / 'a.mcap', True, CompressionType.ZSTD)
    with path.open('rb') as stream:
        second = make_reader(stream).get_summary().chunk_indexes[1]
    octets = bytearray(path.read_bytes())
    octets[second.chunk_start_offset + second.chunk_length - 5] ^= 16
    path.write_bytes(octets)
    session = read_session(path)
    warning, = session.warnings
    assert f'chunk at byte {second.chunk_start_offset}' in warning
    assert f'{len(GOOD) - missing(session)} of its {len(GOOD)} message(s) were read' in warning
    assert 0 < missing(session) < len(GOOD)


def test_a_damaged_part_of_a_folder_costs_no_other_part(tmp_path):
    folder = write_session(tmp_path / 'session', session_messages(bag_types(), 2))
    (folder / 'other.mcap').write_bytes(b'no recording')
    (folder / 'metadata.yaml').unlink()
    session = read_session(folder)
    assert len(session.messages) == 6
    assert any('other.mcap' in warning or 'does not begin' in warning for warning in session.warnings)


def test_a_damaged_page_of_a_database_costs_its_rows_only(tmp_path):
    with BagWriter(tmp_path / 'bag', version=9) as writer:
        topics = {kind: writer.add_connection(f'/{kind}', name, typestore=typestore())
                  for kind, name in INPUT_TYPES.items()}
        for k, (kind, octets) in enumerate(GOOD):
            writer.write(topics[kind], (k + 1) * SECOND, octets)
    path, = (tmp_path / 'bag').glob('*.db3')
    whole = path.read_bytes()
    page = int.from_bytes(whole[16:18], 'big')
    at = next(place for place in range(page, len(whole), page)
              if whole[place] == 13 and GOOD[9][1] in whole[place:place + page])  # 13: a page of rows
    path.write_bytes(whole[:at] + b'\xff' * page + whole[at + page:])
    inside = sum(octets in whole[at:at + page] for _, octets in GOOD)
    session = read_session(path)
    assert 0 < missing(session) <= inside + 1 < len(GOOD)
    assert any('bag.db3' in warning and 'damaged' in warning for warning in session.warnings)


def test_a_cut_session_without_its_summary_is_read_around_damage(tmp_path):
    folder = write_session(tmp_path / 'session', session_messages(bag_types(), 8))
    path, = folder.glob('*.mcap')
    with path.open('rb') as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    octets = bytearray(path.read_bytes()[:chunks[-1].chunk_start_offset])
    octets[chunks[7].chunk_start_offset + 3] ^= 1  # its length
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(octets)
    assert missing(read_session(cut)) == 2
    shutil.rmtree(folder)
