# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Foxglove's readers (from npm) read the same messages from a session as we do; needs npm and the network."""

import json
import os
from pathlib import Path
import shutil
import subprocess

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores

from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import bag_types, OUTPUT_TYPES
from dlo_calibration.ros.diagnostics import status

SAMPLES = Path(__file__).resolve().parent.parent / 'msg_samples'
HERE = Path(__file__).parent / 'foxglove'
STORE = get_typestore(Stores.ROS2_JAZZY)
PATIENCE = 300  # s


@pytest.fixture(scope='module')
def foxglove(tmp_path_factory):
    """Give a function that reads a file with Foxglove's libraries, installed in a temporary folder."""
    for program in ('node', 'npm'):
        if shutil.which(program) is None:
            pytest.skip(f'{program} is not installed')
    folder = tmp_path_factory.mktemp('foxglove')
    for file in ('package.json', 'package-lock.json', 'read.mjs'):
        shutil.copy(HERE / file, folder)
    installed = subprocess.run(['npm', 'ci', '--ignore-scripts', '--no-audit', '--no-fund'], cwd=folder,
                               capture_output=True, text=True, timeout=PATIENCE)
    if installed.returncode:
        pytest.skip(f'npm cannot install the readers: {installed.stderr.strip().splitlines()[-1:]}')

    def read(how, path):
        done = subprocess.run(['node', 'read.mjs', how, str(path)], cwd=folder, capture_output=True,
                              text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return read


def plain(message):
    """Convert a message of the library rosbags to types that JSON has."""
    if hasattr(message, '__msgtype__'):
        return {name: plain(value) for name, value in vars(message).items()
                if not name.startswith('__') and not name.isupper()}  # those are constants of the type
    if hasattr(message, 'tolist'):
        return message.tolist()
    return [plain(item) for item in message] if isinstance(message, (list, tuple)) else message


def expected(folder):
    """Return the messages of a session as rosbags reads them."""
    with Reader(folder) as reader:
        return [{'topic': connection.topic, 'type': connection.msgtype,
                 'message': plain(STORE.deserialize_cdr(data, connection.msgtype))}
                for connection, _, data in reader.messages()]


@pytest.mark.parametrize('sample', sorted(path.name for path in SAMPLES.glob('object?')))
def test_foxglove_reads_what_rosbags_reads(foxglove, sample):
    file, = (SAMPLES / sample).glob('*.mcap')
    reading = foxglove('indexed', file)
    assert reading['profile'] == 'ros2'
    assert reading['messages'] == expected(SAMPLES / sample)


def test_foxglove_reads_what_the_node_tells(foxglove, tmp_path):
    kind = OUTPUT_TYPES['status']
    content = {'state': 'failed', 'trials': 3, 'last_refusal': '\u00fc', 'detail': 'why'}
    said = status(bag_types(), 5, content, None)
    with SessionWriter(tmp_path / 'session', {'seed': 3}) as writer:
        for k in range(3):
            writer.write('/calibrator/status', kind, encode(said, kind), k + 1)
        writer.write_mark('start')
    messages = foxglove('indexed', writer.file)['messages']
    assert len(messages) == 3
    assert messages == expected(writer.path)
    assert foxglove('streamed', writer.file)['messages'] == messages


def test_foxglove_reads_a_killed_session_up_to_its_last_message(foxglove, tmp_path):
    writer = SessionWriter(tmp_path / 'session')
    for record in read_session(SAMPLES / 'object1').records:
        writer.write(record.topic, record.type, record.data, record.log_time)
    killed = tmp_path / 'killed.mcap'
    shutil.copy(writer.file, killed)  # as it is on the disk while it is recorded: without index
    os.truncate(killed, killed.stat().st_size - 150)  # in the last chunk, which an index of it follows
    writer.close()
    messages = foxglove('streamed', killed)['messages']
    assert messages == expected(SAMPLES / 'object1')[:-1]
