# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Files of strangers: special files, too much of everything, and messages that meet a defect of ours."""

import os
import struct

from mcap.writer import Writer
import numpy as np
import pytest
from toy_messages import SECOND, session_messages, write_session
import zstandard

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files import intake, yaml
from dlo_calibration.files import session as session_module
from dlo_calibration.files.bag import encode
from dlo_calibration.files.recording import OUR_RECORD, SessionWriter
from dlo_calibration.files.request import read_request
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.files.unpacking import AT_ONCE, unpacked
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
    found = read_session(path)
    assert len(found.records) == len(found.messages) == len(GOOD)
    code, about, _ = command('info', path, '--json')
    assert (code, about['messages']['/camera'], len(about['trials'])) == (0, 40, 2)


@pytest.mark.parametrize('name, value, words', [
    ('KEPT_MESSAGES', 4, 'more than 4 messages'), ('KEPT_OCTETS', 1500, 'topics of the calibrator'),
    ('UNPACKED_OCTETS', 1000, 'unpacks to more than'), ('MESSAGES_OF_ANY', 10, 'more than')])
def test_what_comes_before_a_limit_is_used(tmp_path, monkeypatch, name, value, words):
    for limit in ('UNPACKED_RATIO', 'KEPT_OF_ANY'):
        monkeypatch.setattr(intake, limit, 1)
    monkeypatch.setattr(intake, 'MESSAGE_OCTETS', 10**6 if name == 'MESSAGES_OF_ANY' else 1)
    monkeypatch.setattr(intake, name, value)
    with SessionWriter(tmp_path / 'a.mcap') as writer:
        for k in range(8):
            for kind, message in GOOD:
                octets = encode(message, INPUT_TYPES[kind])
                writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], octets, k + 1, flush=k == 0)
    found = read_session(writer.path)
    assert 0 < len(found.records) < 8 * len(GOOD)
    problem, = found.problems
    assert words in problem and 'split the recording' in problem


@pytest.mark.parametrize('compression', ['zstd', 'lz4', ''])
def test_no_more_is_unpacked_than_announced(compression):
    import lz4.frame

    packed = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress, '': bytes}[compression](bytes(10**6))
    assert unpacked(packed, compression, 10**6) == bytes(10**6)
    for size in (0, 10, 10**6 - 1, 10**6 + 1, AT_ONCE + 1):
        with pytest.raises(ValueError):
            unpacked(packed, compression, size)


@pytest.mark.parametrize('make, came', [
    (os.mkfifo, 'a FIFO'), (lambda path: path.symlink_to('/dev/zero'), 'a device')])
@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.xml'])
def test_what_is_no_file_is_refused_at_once(tmp_path, make, came, suffix):
    path = tmp_path / f'given{suffix}'
    make(path)
    with pytest.raises(InputError, match=came):
        (read_request if suffix == '.xml' else read_session)(path)


def test_special_files_and_links_out_of_a_folder_are_left_out(folder, tmp_path):
    os.mkfifo(folder / 'a.mcap')
    (tmp_path / 'b.mcap').write_bytes(b'private')
    (folder / 'b.mcap').symlink_to(tmp_path / 'b.mcap')
    (folder / 'metadata.yaml').unlink()
    found = read_session(folder)
    assert len(found.messages) == len(GOOD)
    for name in ('a.mcap', 'b.mcap'):
        assert any(name in problem for problem in found.problems)


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
    found = read_session(folder)
    assert len(found.messages) == len(GOOD)
    problem, = found.problems
    assert 'metadata.yaml cannot be read' in problem


def test_metadata_with_more_events_than_the_limit_is_left_out(folder, monkeypatch):
    monkeypatch.setattr(yaml, 'MAXIMUM_EVENTS', 50)
    found = read_session(folder)
    assert len(found.messages) == len(GOOD)
    assert any('metadata.yaml cannot be read' in problem for problem in found.problems)


@pytest.mark.parametrize('text', ['[' * 50_000, '{"seed": 1', '3', f'{{"x": "{"y" * 10**5}"}}'])
def test_recorded_options_that_cannot_be_read_are_left_out(tmp_path, text):
    with SessionWriter(tmp_path / 'session') as writer:
        for k, (kind, message) in enumerate(GOOD):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], encode(message, INPUT_TYPES[kind]), k + 1)
        writer._writer.add_metadata(OUR_RECORD, {'options': text})
    found = read_session(writer.path)
    assert (len(found.messages), found.recorded) == (len(GOOD), None)
    problem, = found.problems
    assert 'options' in problem


def test_undecodable_messages_are_told_once_for_each_topic(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        for k, (kind, message) in enumerate(GOOD):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], encode(message, INPUT_TYPES[kind]), k + 1)
        for k in range(50):
            octets = b'\0\1\0\0' + struct.pack('<I', k)
            writer.write(f'/calibrator/{GOAL}', INPUT_TYPES[GOAL], octets, 100 + k)
    found = read_session(writer.path)
    assert len(found.messages) == len(GOOD)
    problem, = found.problems
    assert '49 more' in problem and GOAL in problem


def test_decoded_messages_are_not_kept(folder):
    messages = read_session(folder).messages
    assert messages[0][1] is not messages[0][1]
    assert len(messages[1:3]) == 2 and messages[1:3][0][0] == messages[1][0]
