# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sessions: written for others, read from anybody, whole or broken."""

import json
import os
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys

from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
import pytest
from random_examples import drawing
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
import yaml

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import OUR_RECORD, RecordingError, SessionWriter
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.messages.codec import (
    ACTION,
    action_trajectory,
    ActionMessage,
    bag_types,
    chain_cloud,
    GOAL,
    INITIAL,
    read,
    TRIAL_TYPES,
)
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.ros.diagnostics import status

TYPES = bag_types()
STORE = get_typestore(Stores.ROS2_JAZZY)
SECOND = 10**9
START = 1_700_000_000 * SECOND
SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples'
STATUS = 'diagnostic_msgs/msg/DiagnosticArray'


def chain_points(trial, shift=0.0):
    along = np.linspace(0, 0.6, 7)
    return np.column_stack([along, 0 * along + 0.01 * trial + shift, 0.004 + 0 * along])


def trial_messages(trial):
    """Yield (kind, message, log time) of one trial; every trial has chains of its own."""
    start = START + trial * 60 * SECOND
    points = chain_points(trial)
    pose = np.tile((0.0, 0.0, 0.0, 1.0), (2, 1, 1))
    yield INITIAL, chain_cloud(TYPES, Chain(points), start, 'world'), start
    yield ACTION, action_trajectory(TYPES, ActionMessage(
        start + SECOND, 'world', ('left_hand',), [0.0, 1.0], [[points[0]], [points[0] + (0, 0.1, 0)]],
        pose)), start + SECOND
    yield GOAL, chain_cloud(TYPES, Chain(chain_points(trial, 0.05)), start + 3 * SECOND, 'world'), \
        start + 3 * SECOND


MESSAGES = [message for trial in range(3) for message in trial_messages(trial)]


def write(writer, messages=MESSAGES, namespace='/calibrator', **rest):
    for kind, message, log_time in messages:
        writer.write(f'{namespace}/{kind}', TRIAL_TYPES[kind], encode(message, TRIAL_TYPES[kind]),
                     log_time, **rest)


def content(messages):
    """Return what messages say, comparable; never their bytes, whose padding is arbitrary."""
    said = []
    for kind, message in messages:
        decoded = read(kind, message)
        arrays = (decoded.times, decoded.positions) if kind == ACTION else (decoded.chain.points,)
        said.append((kind, decoded.stamp, [array.tolist() for array in arrays]))
    return said


EXPECTED = content([(kind, message) for kind, message, _ in MESSAGES])


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """Give the folder of a session of three trials and a status, with options."""
    with SessionWriter(tmp_path_factory.mktemp('out') / 'session', {'mass': 0.03}) as writer:
        write(writer)
        said = status(TYPES, START, {'state': 'done', 'trials': 3, 'detail': ''}, None)
        writer.write('/calibrator/status', STATUS, encode(said, STATUS), MESSAGES[-1][2])
    return writer.path


def mcap(folder):
    file, = folder.glob('*.mcap')
    return file


# What others read


@pytest.mark.parametrize('what', ['folder', 'file'])
def test_rosbags_reads_what_we_write(session, what):
    with Reader(session if what == 'folder' else mcap(session)) as reader:
        messages = list(reader.messages())
        assert {(c.topic, c.msgtype, c.msgcount) for c in reader.connections} == {
            *((f'/calibrator/{kind}', name, 3) for kind, name in TRIAL_TYPES.items()),
            ('/calibrator/status', STATUS, 1)}
        assert (reader.start_time, reader.message_count) == (START, 10)
    assert [time for _, time, _ in messages[:-1]] == [time for _, _, time in MESSAGES]
    decoded = [(c.topic.rsplit('/')[-1], STORE.deserialize_cdr(raw, c.msgtype))
               for c, _, raw in messages[:-1]]
    assert content(decoded) == EXPECTED


def test_late_subscribers_get_the_status_when_a_session_is_played(session):
    with Reader(session) as reader:
        durability = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert durability['/calibrator/status'] == 'TRANSIENT_LOCAL'
    assert durability['/calibrator/action'] == 'VOLATILE'


def test_mcap_file_has_the_profile_schemas_and_metadata_of_rosbag2(session):
    about = yaml.safe_load((session / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    with mcap(session).open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == 'ros2'
        inside = {record.name: record.metadata for record in reader.iter_metadata()}
    assert {(s.name, s.encoding) for s in summary.schemas.values()} == {
        (name, 'ros2msg') for name in (*TRIAL_TYPES.values(), STATUS)}
    for channel in summary.channels.values():
        assert channel.message_encoding == 'cdr'
        assert yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['reliability'] == 'reliable'
    assert yaml.safe_load(inside['rosbag2']['serialized_metadata']) == about
    assert about['version'] == 9 and about['storage_identifier'] == 'mcap'
    assert about['relative_file_paths'] == [mcap(session).name]


def test_mcap_ros2_reads_what_we_write(session):
    read_ros2_messages = pytest.importorskip('mcap_ros2.reader').read_ros2_messages
    messages = [(m.channel.topic.rsplit('/')[-1], m.ros_msg) for m in read_ros2_messages(str(mcap(session)))]
    assert content(messages[:-1]) == EXPECTED
    assert messages[-1][1].status[0].name == 'status'


# What we read


@pytest.mark.parametrize('what', ['folder', 'file'])
def test_own_session_round_trip(session, what):
    recorded = read_session(session if what == 'folder' else mcap(session))
    assert content(recorded.messages) == EXPECTED
    assert recorded.file_options.values == {'mass': 0.03}
    assert recorded.warnings == ()
    assert [message.status[0].name for message in recorded.outputs('status')] == ['status']


@pytest.mark.parametrize('storage', StoragePlugin)
@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize('version', [8, 9])
def test_bag_by_rosbags(tmp_path, storage, mode, version):
    writer = Writer(tmp_path / 'bag', version=version, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {kind: writer.add_connection(f'/robot/{kind}', name, typestore=STORE)
                  for kind, name in TRIAL_TYPES.items()}
        for kind, message, log_time in MESSAGES:
            writer.write(topics[kind], log_time, encode(message, TRIAL_TYPES[kind]))
    recorded = read_session(tmp_path / 'bag')
    assert content(recorded.messages) == EXPECTED
    assert recorded.file_options is None and recorded.warnings == ()


def test_db3_file_without_its_folder(tmp_path):
    with Writer(tmp_path / 'bag', version=9) as writer:
        topics = {kind: writer.add_connection(f'/{kind}', name, typestore=STORE)
                  for kind, name in TRIAL_TYPES.items()}
        for kind, message, log_time in MESSAGES:
            writer.write(topics[kind], log_time, encode(message, TRIAL_TYPES[kind]))
    assert content(read_session(tmp_path / 'bag' / 'bag.db3').messages) == EXPECTED


@pytest.mark.parametrize('chunked', [True, False])
@pytest.mark.parametrize('short', [True, False])
def test_file_by_mcap(tmp_path, chunked, short):
    path = tmp_path / 'by_others.mcap'
    with path.open('wb') as stream:
        writer = McapWriter(stream, use_chunking=chunked, compression=CompressionType.NONE)
        writer.start()
        channels = {}
        for kind, name in TRIAL_TYPES.items():
            schema = writer.register_schema(name.replace('/msg', '') if short else name, 'ros2msg', b'')
            channels[kind] = writer.register_channel(f'/{kind}', 'cdr', schema)
        other = writer.register_channel('/camera/goal_chain', 'json', 0)
        writer.add_message(other, START, b'{}', START)
        for kind, message, log_time in MESSAGES:
            writer.add_message(channels[kind], log_time, encode(message, TRIAL_TYPES[kind]), log_time)
        writer.finish()
    recorded = read_session(path)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert '/camera/goal_chain' in warning and 'json' in warning


def test_bag_that_was_split(tmp_path, session):
    folder = tmp_path / 'bag'
    folder.mkdir()
    for part, messages in enumerate((MESSAGES[4:], MESSAGES[:4])):
        with SessionWriter(folder / f'bag_{part}.mcap') as writer:
            write(writer, messages)
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': {
        'relative_file_paths': ['bag_0.mcap', 'bag_1.mcap', 'bag_2.mcap']}}))
    recorded = read_session(folder)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert 'bag_2.mcap' in warning


def test_messages_come_in_log_order(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES[::-1])
    assert content(read_session(writer.path).messages) == EXPECTED


@pytest.mark.parametrize('text', ['', '{', 'rosbag2_bagfile_information: 3', '- 1', '\0'])
def test_folder_whose_metadata_file_is_damaged(tmp_path, session, text):
    folder = tmp_path / 'copy'
    shutil.copytree(session, folder)
    (folder / 'metadata.yaml').write_text(text)
    recorded = read_session(folder)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert 'metadata.yaml' in warning


def test_undecodable_message_is_left_out_alone(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES[:2])
        writer.write('/calibrator/goal_chain', TRIAL_TYPES[GOAL], b'\0\1\0\0\xff\xff', START + 2 * SECOND)
        write(writer, MESSAGES[2:])
    recorded = read_session(writer.path)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert 'goal_chain' in warning


# Broken files


@pytest.fixture(scope='module', params=['flushed', 'one chunk', 'not compressed', 'not chunked', 'sqlite'])
def whole_file(request, tmp_path_factory):
    """Give the bytes of a recording of MESSAGES, and the suffix of its file."""
    folder = tmp_path_factory.mktemp('whole')
    if request.param == 'sqlite':
        with Writer(folder / 'bag', version=9) as writer:
            topics = {kind: writer.add_connection(f'/{kind}', name, typestore=STORE)
                      for kind, name in TRIAL_TYPES.items()}
            for kind, message, log_time in MESSAGES:
                writer.write(topics[kind], log_time, encode(message, TRIAL_TYPES[kind]))
        return (folder / 'bag' / 'bag.db3').read_bytes(), '.db3'
    if request.param in ('flushed', 'one chunk'):
        with SessionWriter(folder / 'session.mcap', {'seed': 3}) as writer:
            write(writer, flush=request.param == 'flushed')
        return writer.path.read_bytes(), '.mcap'
    with Writer(folder / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {kind: writer.add_connection(f'/{kind}', name, typestore=STORE)
                  for kind, name in TRIAL_TYPES.items()}
        for kind, message, log_time in MESSAGES:
            writer.write(topics[kind], log_time, encode(message, TRIAL_TYPES[kind]))
    if request.param == 'not compressed':
        return (folder / 'bag' / 'bag.mcap').read_bytes(), '.mcap'
    with (folder / 'plain.mcap').open('wb') as stream:
        writer = McapWriter(stream, use_chunking=False)
        writer.start()
        for kind, message, log_time in MESSAGES:
            schema = writer.register_schema(TRIAL_TYPES[kind], 'ros2msg', b'')
            writer.add_message(writer.register_channel(f'/{kind}', 'cdr', schema), log_time,
                               encode(message, TRIAL_TYPES[kind]), log_time)
        writer.finish()
    return (folder / 'plain.mcap').read_bytes(), '.mcap'


def read_or_refuse(path):
    """Read a session; None where it is refused as it should be."""
    try:
        recorded = read_session(path)
    except InputError as error:
        assert str(path) in str(error) and '\n' not in str(error)
        return None
    session_trials(recorded, Options())
    return recorded


@drawing(15)
@given(place=st.floats(0, 1))
def test_cut_anywhere_gives_the_messages_before_the_cut(whole_file, tmp_path_factory, place):
    octets, suffix = whole_file
    path = tmp_path_factory.mktemp('cut') / f'cut{suffix}'
    path.write_bytes(octets[:int(place * (len(octets) - 1))])
    recorded = read_or_refuse(path)
    if recorded is not None:
        said = content(recorded.messages)
        assert said == EXPECTED[:len(said)]
        assert len(said) == len(EXPECTED) or recorded.warnings


@drawing(15)
@given(place=st.floats(0, 1), octets=st.binary(min_size=1, max_size=9))
@example(place=0.125, octets=b'\0')  # in the definitions of a database
def test_damaged_anywhere_is_read_or_refused(whole_file, tmp_path_factory, place, octets):
    damaged, suffix = bytearray(whole_file[0]), whole_file[1]
    at = int(place * (len(damaged) - len(octets)))
    damaged[at:at + len(octets)] = octets
    path = tmp_path_factory.mktemp('damaged') / f'damaged{suffix}'
    path.write_bytes(damaged)
    read_or_refuse(path)


@drawing(15)
@given(octets=st.binary(max_size=300), header=st.booleans())
def test_any_bytes_are_refused(tmp_path_factory, octets, header):
    path = tmp_path_factory.mktemp('any') / 'any.mcap'
    path.write_bytes(b'\x89MCAP0\r\n' * header + octets)
    assert read_or_refuse(path) is None


def test_cut_session_says_so(tmp_path, session):
    folder = tmp_path / 'copy'
    shutil.copytree(session, folder)
    file = mcap(folder)
    with file.open('rb') as stream:
        sixth = make_reader(stream).get_summary().chunk_indexes[5]
    os.truncate(file, sixth.chunk_start_offset + sixth.chunk_length // 2)
    recorded = read_session(folder)
    assert content(recorded.messages) == EXPECTED[:5]
    assert recorded.file_options.values == {'mass': 0.03}
    warning, = recorded.warnings
    assert 'cut' in warning and file.name in warning


@pytest.mark.parametrize('make', [
    lambda path: None,
    lambda path: path.mkdir(),
    lambda path: path.write_text('a text'),
    lambda path: path.write_bytes(b''),
    lambda path: (path.mkdir(), (path / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}')),
    lambda path: (path.mkdir(), (path / 'a.db3').write_text('no database')),
], ids=['nothing', 'empty folder', 'text', 'empty file', 'recording gone', 'no database'])
def test_a_path_that_is_no_session_is_refused(tmp_path, make):
    make(tmp_path / 'given')
    assert read_or_refuse(tmp_path / 'given') is None


def test_recording_of_something_else_is_refused_with_what_it_holds(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        message = TYPES.build('std_msgs/msg/String', data='hello')
        writer.write('/chatter', 'std_msgs/msg/String', encode(message, 'std_msgs/msg/String'), START)
    with pytest.raises(InputError, match='/chatter .*std_msgs/msg/String.*initial_chain'):
        read_session(writer.path)


# Namespaces


def test_topics_of_any_namespace_are_read(tmp_path):
    for namespace in ('', '/a/deep/one'):
        with SessionWriter(tmp_path / 'session') as writer:
            write(writer, namespace=namespace)
        assert content(read_session(writer.path).messages) == EXPECTED


def test_each_kind_may_come_from_another_namespace(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        for pair in MESSAGES:
            write(writer, [pair], '/robot' if pair[0] == ACTION else '/tracker')
    assert content(read_session(writer.path).messages) == EXPECTED


def test_two_calibrators_are_refused_until_one_is_named(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES, '/left/calibrator')
        write(writer, MESSAGES[:3], '/right/calibrator')
    with pytest.raises(InputError, match='/left/calibrator, /right/calibrator'):
        read_session(writer.path)
    assert content(read_session(writer.path, '/right/calibrator').messages) == EXPECTED[:3]
    assert content(read_session(writer.path, 'left/calibrator/').messages) == EXPECTED
    with pytest.raises(InputError, match='/centre'):
        read_session(writer.path, '/centre')


def test_namespace_that_has_all_topics_is_preferred(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer)
        write(writer, MESSAGES[:1], '/second_camera')
    recorded = read_session(writer.path)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert '/calibrator' in warning


def test_topic_of_another_type_is_left_out_and_named(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer)
        message = TYPES.build('std_msgs/msg/String', data='grasp')
        writer.write('/planner/action', 'std_msgs/msg/String', encode(message, 'std_msgs/msg/String'), START)
    recorded = read_session(writer.path)
    assert content(recorded.messages) == EXPECTED
    warning, = recorded.warnings
    assert '/planner/action' in warning and 'std_msgs/msg/String' in warning


# Options and marks


def test_the_last_recorded_options_are_read(tmp_path):
    options = Options.of({'mass': 0.1 + 0.2, 'calibrate': ['friction'], 'table': False, 'damping': 12.5})
    with SessionWriter(tmp_path / 'session', Options().flat()) as writer:
        write(writer)
        writer.write_options(options.flat())
    assert read_session(writer.path).options == options


def test_recorded_options_of_the_first_scale_are_converted(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer)
        writer._writer.add_metadata(OUR_RECORD, {'options': '{"flexibility": 50.0, "friction": 50.0}'})
    options = read_session(writer.path).options
    assert BY_NAME['flexibility'].physical(options.values['flexibility']) == pytest.approx(10**-3.25)
    assert options.values['friction'] == 50.0


def test_a_replay_uses_the_messages_of_the_calibration(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES[:3])
        writer.write_mark('reset')
        write(writer, MESSAGES[3:6])
        writer.write_mark('start')
        write(writer, MESSAGES[6:])
    recorded = read_session(writer.path)
    assert content(recorded.messages) == EXPECTED[3:6]
    warning, = recorded.warnings
    assert '6 message(s)' in warning


def test_reset_after_a_calibration_begins_anew(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES[:3])
        writer.write_mark('start')
        writer.write_mark('reset')
        write(writer, MESSAGES[3:])
    assert content(read_session(writer.path).messages) == EXPECTED[3:]


def test_a_reset_at_the_end_leaves_the_calibrated_trials(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, MESSAGES[:3])
        writer.write_mark('start')
        write(writer, MESSAGES[3:4])
        writer.write_mark('reset')
    assert content(read_session(writer.path).messages) == EXPECTED[:3]


# Writing


def test_nothing_is_overwritten(tmp_path):
    names = []
    for suffix in ('', '.mcap'):
        for _ in range(3):
            with SessionWriter(tmp_path / 'deep' / f'session{suffix}') as writer:
                write(writer)
            names.append(writer.path.name)
    assert names == ['session', 'session_2', 'session_3', 'session.mcap', 'session_2.mcap', 'session_3.mcap']
    for name in names:
        assert content(read_session(tmp_path / 'deep' / name).messages) == EXPECTED


def test_killed_process_loses_nothing_that_was_written(tmp_path, session):
    program = f"""
import os, signal
from pathlib import Path
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.session import read_session
source = read_session({str(session)!r})
writer = SessionWriter(Path({str(tmp_path)!r}) / 'killed', source.file_options.values)
for record in source.records:
    writer.write(record.topic, record.type, record.data, record.log_time)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, '-c', program], cwd=SAMPLES.parent)
    assert done.returncode == -signal.SIGKILL
    recorded = read_session(tmp_path / 'killed')
    assert content(recorded.messages) == EXPECTED
    assert recorded.file_options.values == {'mass': 0.03}
    assert len(recorded.warnings) == 1


def test_place_that_cannot_be_written(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='file'):
        SessionWriter(tmp_path / 'file' / 'session')


def test_full_disk_is_one_kind_of_error_and_what_was_written_stays(tmp_path):
    writer = SessionWriter(tmp_path / 'session')
    write(writer, MESSAGES[:3])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (writer.file.stat().st_size + 10, before[1]))
    try:
        with pytest.raises(RecordingError, match='session'):
            write(writer, MESSAGES[3:])
        with pytest.raises(RecordingError):
            write(writer, MESSAGES[3:])
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    recorded = read_session(writer.path)
    assert content(recorded.messages) == EXPECTED[:3]
    assert recorded.warnings


def test_a_session_that_cannot_begin_leaves_nothing(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(RecordingError, match='session'):
            SessionWriter(tmp_path / 'session')
        with pytest.raises(RecordingError, match='session'):
            SessionWriter(tmp_path / 'session.mcap')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_closing_twice_is_harmless(tmp_path):
    writer = SessionWriter(tmp_path / 'session')
    write(writer)
    writer.close()
    writer.close()
    assert read_session(writer.path).warnings == ()


def test_writing_after_closing_is_a_recording_error(tmp_path):
    writer = SessionWriter(tmp_path / 'session')
    writer.close()
    with pytest.raises(RecordingError):
        write(writer)


# Trials


def test_trials_of_a_session(session):
    trials, refusals = session_trials(read_session(session), Options())
    assert [trial.name for trial in trials] == ['trial 1', 'trial 2', 'trial 3']
    assert refusals == ()
    for k, trial in enumerate(trials):
        np.testing.assert_array_equal(trial.initial.points, chain_points(k))
        np.testing.assert_array_equal(trial.goals[0].chain.points, chain_points(k, 0.05))


def test_one_bad_message_costs_no_trial(tmp_path):
    cloud = chain_cloud(TYPES, Chain(chain_points(0)), START + 4 * SECOND, 'world')
    cloud.data = cloud.data.copy()
    cloud.data[:8] = np.frombuffer(np.array(np.inf).tobytes(), np.uint8)
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, [*MESSAGES[:3], (GOAL, cloud, START + 4 * SECOND), *MESSAGES[3:]])
    trials, refusals = session_trials(read_session(writer.path), Options())
    assert len(trials) == 3
    refusal, = refusals
    assert f'goal_chain stamped {START // SECOND + 4} s' in refusal and 'infinity' in refusal


@pytest.mark.parametrize('number', range(1, 6))
def test_sample_sessions_are_usable(number):
    recorded = read_session(SAMPLES / f'object{number}')
    trials, refusals = session_trials(recorded, recorded.options)
    assert (recorded.warnings, refusals) == ((), ())
    assert [len(trial.hands) for trial in trials] == [1, 1, 1, 2]
    assert [goal.held_by for trial in trials for goal in trial.goals] == [
        (), (), ('left_hand',), ('left_hand', 'right_hand')]


def shifted(messages, seconds, log_time):
    """Return messages of a clock that went back, recorded later."""
    records = []
    for kind, message, _ in messages:
        message = STORE.deserialize_cdr(encode(message, TRIAL_TYPES[kind]), TRIAL_TYPES[kind])
        message.header.stamp.sec -= seconds
        records.append((kind, message, log_time))
    return records


def test_trials_before_and_after_the_clock_went_back_never_mix(tmp_path):
    later = MESSAGES[-1][2] + SECOND
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, [*MESSAGES, *shifted(MESSAGES[3:6], 58, later)])  # 2 s after the beginning of trial 1
    trials, refusals = session_trials(read_session(writer.path), Options())
    assert [trial.name for trial in trials] == ['trial 1', 'trial 2', 'trial 3', 'trial 4']
    assert [len(trial.goals) for trial in trials] == [1, 1, 1, 1]
    refusal, = refusals
    assert refusal.startswith('the clock went back by ')


def test_a_recording_that_was_played_twice_gives_each_trial_once(tmp_path):
    with SessionWriter(tmp_path / 'session') as writer:
        write(writer, [*MESSAGES, *shifted(MESSAGES, 0, MESSAGES[-1][2] + SECOND)])
    trials, refusals = session_trials(read_session(writer.path), Options())
    assert len(trials) == 3
    assert any('9 message(s) after the clock went back repeat earlier ones' in text for text in refusals)
