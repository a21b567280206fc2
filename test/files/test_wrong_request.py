# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Requests at the wrong time, messages that come alone, and disks that refuse: nodes of their own."""

import errno
import os
from pathlib import Path
import shutil
import subprocess
import sys

from hypothesis import given, HealthCheck
from hypothesis import strategies as st
from live_node import live_node, LOG_WARN, QUICK, robot_types
import pytest
from random_examples import drawing
from toy_messages import session_messages, write_session
from toy_simulator import ToySimulator
from wrong_input import mutations

from dlo_calibration import calibrate, InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import fit
from dlo_calibration.files import recording
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.messages.codec import bag_types, INITIAL

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

FILES = bag_types()
GOOD = session_messages(FILES, 2)


def goals_without_initial_chain(types):
    """Return goal chains and an action that come before any initial chain."""
    return [pair for pair in session_messages(types, 1) if pair[0] != INITIAL]


@pytest.mark.long
def test_goals_without_initial_chain_wait_visibly_and_are_refused_once_when_one_comes_later(
        ros_environment, tmp_path):
    with live_node(ros_environment, tmp_path) as robot:
        types = robot_types()
        robot.send(goals_without_initial_chain(types))
        wanted = 'an initial_chain before action stamped 60 s'
        robot.until(lambda: robot.status['incomplete'].startswith(wanted))
        answer = robot.call('start')
        assert not answer.success
        assert answer.message == ('~/start: no complete trial; expected an initial_chain before action '
                                  'stamped 60 s; send it, then call ~/start again')
        robot.send(session_messages(types, 1, first=1))
        robot.until_status(trials='1', incomplete='')
        refusal = robot.status['last_refusal']
        for word in ('action stamped 60 s and 1 more', 'no initial_chain before them',
                     'expected one stamped earlier (the first is initial_chain stamped 120 s)',
                     'stamp all messages with one clock'):
            assert word in refusal
        assert robot.call('start').success
        robot.until_result()
        warnings = [log.msg for log in robot.heard['log'] if log.level >= LOG_WARN]
        assert warnings == [answer.message, refusal]


def test_goals_without_initial_chain_in_a_file(tmp_path, command):
    orphans = goals_without_initial_chain(FILES)
    path = write_session(tmp_path / 'alone.mcap', orphans)
    code, about, errors = command('info', path, '--json')
    refusal, = about['refusals']
    assert (code, errors) == (0, [])
    for word in ('action stamped 60 s and 1 more', 'no initial_chain before them', 'there is none'):
        assert word in refusal
    code, result, errors = command('fit', path, '--json')
    assert (code, result, errors[0]) == (2, None, refusal)
    assert 'no complete trial; expected an initial_chain, an action and a goal_chain' in errors[1]
    assert len(errors) == 2
    path = write_session(tmp_path / 'followed.mcap', [*orphans, *session_messages(FILES, 1, first=1)], QUICK)
    code, result, errors = command('fit', path, '--json')
    refusal, = errors
    assert (code, result['trials']) == (0, 1)
    assert 'the first is initial_chain stamped 120 s' in refusal


def test_start_without_trials_is_refused_by_node_and_command(ros_environment, tmp_path, command):
    with live_node(ros_environment, tmp_path / 'out') as robot:
        answer = robot.call('start')
        assert not answer.success
        assert answer.message == (
            '~/start: no complete trial; expected an initial_chain, an action and a goal_chain; '
            'send it, then call ~/start again')
        robot.until_status(last_refusal=answer.message, state='collecting')
        robot.until(lambda: [log.msg for log in robot.heard['log'] if log.level >= LOG_WARN]
                    == [answer.message])
        robot.send(session_messages(robot_types(), 2))
        robot.until_status(trials='2')
        assert robot.call('start').success
        robot.until_result()
    path = write_session(tmp_path / 'session.mcap', GOOD[:1])
    code, output, errors = command('fit', path, '--json')
    assert (code, output, len(errors)) == (2, None, 1)
    for word in (str(path), 'no complete trial', 'an initial_chain, an action and a goal_chain', 'info'):
        assert word in errors[0]


def test_requests_at_the_wrong_time_are_refused_once(ros_environment, tmp_path):
    with live_node(ros_environment, tmp_path, ToySimulator(0.01), search='random',
                   evaluations=100000) as robot:
        expected = []

        def refused(name, came, remedy, again=''):
            answer = robot.call(name)
            assert not answer.success
            for word in (f'~/{name}: {came}; expected ', remedy):
                assert word in answer.message
            robot.until_status(last_refusal=answer.message + again)
            expected.append(answer.message + again)

        refused('stop', 'no calibration under way', 'call ~/start first')
        robot.send(session_messages(robot_types(), 1))
        robot.until_status(trials='1')
        assert robot.call('start').success
        refused('start', 'a calibration under way', 'wait for it, or call ~/stop first')
        refused('reset', 'a calibration under way', 'wait for it, or call ~/stop first')
        robot.until(lambda: robot.heard['progress'])
        assert robot.call('stop').success
        robot.until_result()
        refused('stop', 'no calibration under way', 'call ~/start first', again=' (2 times)')
        robot.until(lambda: [log.msg for log in robot.heard['log'] if log.level >= LOG_WARN
                             and not log.msg.startswith('Not usable')] == expected)


@pytest.mark.long
def test_node_survives_mutated_bytes_and_calibrates_good_trials(ros_environment, tmp_path):
    with live_node(ros_environment, tmp_path) as robot:
        types = robot_types()

        @drawing(3)
        @given(messages=st.lists(mutations('world'), min_size=1, max_size=12))
        def check(messages):
            robot.send(session_messages(types, 2))
            for kind, octets in messages:
                robot.publishers[kind].publish(octets)
            results = len(robot.heard['result'])
            if robot.call('start').success:
                robot.until_result(results + 1)
            assert 'defect' not in robot.status['last_refusal']
            assert robot.call('reset').success

        check()
        robot.send(session_messages(types, 2))
        robot.until_status(trials='2')
        results = len(robot.heard['result'])
        assert robot.call('start').success
        robot.until_result(results + 1)
        assert not [log.msg for log in robot.heard['log'] if 'defect' in log.msg]


# ---- disks that refuse


def whole_result(robot):
    """Return what the result says of the calibration as a whole."""
    from ros_robot import whole

    return whole(robot.until_result())


class FullDisk:
    """A file that takes `room` bytes more."""

    def __init__(self, stream, room):
        self._stream, self._room = stream, room

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, octets):
        self._room -= len(octets)
        if self._room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._stream.write(octets)


@pytest.mark.parametrize('room', [
    0, 1500, 12000, *(pytest.param(room, marks=pytest.mark.long) for room in (100, 3000, 8000))])
def test_a_full_disk_gives_one_warning_and_the_calibration_goes_on(ros_environment, tmp_path, monkeypatch,
                                                                   room):
    create = recording._create

    def on_full_disk(path):
        folder, file, stream = create(path)
        return folder, file, FullDisk(stream, room)

    monkeypatch.setattr(recording, '_create', on_full_disk)
    with live_node(ros_environment, tmp_path) as robot:
        for k in range(4):
            robot.send(session_messages(robot_types(), 1, first=k))
            robot.until_status(trials=str(k + 1))
        assert robot.call('start').success
        assert whole_result(robot)['trials'] == '4'
        robot.until(lambda: robot.status['last_refusal'])
        robot.until(lambda: any('cannot be written' in log.msg for log in robot.heard['log']))
        # A search with so few evaluations reaches no minimum, and reports that, too.
        errors = [log.msg for log in robot.heard['log'] if log.level >= LOG_WARN
                  and not log.msg.startswith('Not usable')]
    text, = errors
    assert robot.status['last_refusal'] == text
    for word in ('session', str(tmp_path), 'cannot be written', os.strerror(errno.ENOSPC)):
        assert word in text


def no_folder(path):
    """Put a file where the folder should be."""
    path.write_text('')


def closed_folder(path):
    """Make a folder that nobody but root may write into."""
    path.mkdir()
    path.chmod(0o500)
    if os.access(path, os.W_OK):
        pytest.skip('root may write anywhere')


@pytest.mark.parametrize('make', [no_folder, closed_folder])
def test_a_folder_that_cannot_be_written_gives_one_warning_and_the_calibration_goes_on(
        ros_environment, tmp_path, make):
    make(tmp_path / 'out')
    with live_node(ros_environment, tmp_path / 'out') as robot:
        robot.until(lambda: str(tmp_path / 'out') in robot.status['last_refusal'])
        robot.send(session_messages(robot_types(), 1))
        robot.until_status(trials='1')
        assert robot.call('start').success
        robot.until_result()
        assert 'choose another place' in robot.status['last_refusal']


def test_a_folder_that_goes_away_gives_a_warning_and_the_calibration_goes_on(ros_environment, tmp_path):
    with live_node(ros_environment, tmp_path) as robot:
        robot.send(session_messages(robot_types(), 1))
        robot.until_status(trials='1')
        folder, = tmp_path.glob('dlo_session_*')
        shutil.rmtree(folder)
        assert robot.call('start').success
        robot.until_result()
        robot.until(lambda: str(folder) in robot.status['last_refusal'])


@pytest.mark.parametrize('name', ['result.xml', 'session.mcap', 'report.html', 'evaluations.csv'])
def test_fit_on_a_disk_that_fills_up_prints_the_result_and_one_line(tmp_path, command, monkeypatch, name):
    path = write_session(tmp_path / 'session.mcap', GOOD, QUICK)
    done, replace = [], os.replace

    def refuse(new, where):
        if Path(where).name == name and done:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(where))
        replace(new, where)

    monkeypatch.setattr(os, 'replace', refuse)
    monkeypatch.setattr(fit, 'calibrate',
                        lambda *args, **rest: done.append(1) or calibrate(*args, **rest))
    code, result, errors = command('fit', path, '--json', '--output', tmp_path / 'out')
    assert (code, result['trials']) == (2, 2)
    error, = errors
    assert f'could not be written: {name}: {os.strerror(errno.ENOSPC)}; ' in error
    assert name not in {file.name for file in (tmp_path / 'out').iterdir()}


# ---- killed and damaged

WRITER = """
import os, random, signal, sys, time
from pathlib import Path
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.session import read_session
source = read_session(sys.argv[1]).records
for turn in range(int(sys.argv[3])):
    folder = Path(sys.argv[2]) / f'{turn:02d}'
    acknowledged = os.open(f'{folder}.written', os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    child = os.fork()
    if child == 0:
        with SessionWriter(folder) as writer:
            for k in range(100000):
                one = source[k % len(source)]
                writer.write(one.topic, one.type, one.data, k + 1)
                os.write(acknowledged, b'.')
    while os.fstat(acknowledged).st_size < 3 * turn:
        pass
    time.sleep(random.Random(turn).uniform(0.0, 0.002))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
"""
TURNS = 10


@pytest.mark.long
def test_killed_at_any_moment_a_session_reads_up_to_its_last_complete_message(tmp_path):
    source = write_session(tmp_path / 'source', GOOD)
    whole = read_session(source).records
    subprocess.run([sys.executable, '-c', WRITER, source, tmp_path, str(TURNS)], check=True,
                   env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    counts = []
    for turn in range(TURNS):
        folder = tmp_path / f'{turn:02d}'
        written = len((tmp_path / f'{turn:02d}.written').read_bytes())
        try:
            records = read_session(folder).records
        except InputError as error:
            assert str(folder) in str(error)
            records = ()
        assert written <= len(records) <= written + 1
        for k, record in enumerate(records):
            original = whole[k % len(whole)]
            assert (record.topic, record.data, record.log_time) == (original.topic, original.data, k + 1)
        counts.append(len(records))
    assert all(count >= 3 * turn for turn, count in enumerate(counts))  # the moments were different ones


@pytest.mark.long
def test_a_node_killed_while_it_records_loses_no_trial_of_its_status(ros_environment, tmp_path, command):
    import ros_robot

    pairs = session_messages(ros_robot.TYPES, 8)
    with ros_robot.child(ros_environment, tmp_path / 'out') as process, \
            ros_robot.robot_of(ros_environment) as robot:
        robot.matched()
        for k, pair in enumerate(pairs):
            robot.send([pair])
            if k >= 8:
                break
            robot.executor.spin_once(timeout_sec=0.001)
        robot.until(lambda: robot.status['incomplete'] or robot.status['trials'] != '0')
        process.kill()
        process.wait()
        reported = [ros_robot.values(message.status[0]) for message in robot.heard['status']]
    folder, = (tmp_path / 'out').glob('dlo_session_*')
    session = read_session(folder)
    recorded = [ros_robot.values(message.status[0]) for message in session.outputs('status')]
    assert reported and all(status in recorded for status in reported)
    trials, _ = session_trials(session, Options())
    assert len(trials) >= int(reported[-1]['trials'])
    assert command('fit', folder, '--json', '--evaluations', 4, '--workers', 1)[0] == (0 if trials else 2)


@pytest.fixture(scope='module')
def recorded_octets(tmp_path_factory):
    """Give the bytes of a recording of good trials."""
    folder = write_session(tmp_path_factory.mktemp('good') / 'session', GOOD, QUICK)
    file, = folder.glob('*.mcap')
    return file.read_bytes()


@pytest.mark.long
@drawing(8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1), octets=st.binary(max_size=9))
def test_cut_or_damaged_file_ends_in_a_result_or_one_line(
        recorded_octets, tmp_path_factory, command, place, octets):
    """Without `octets` it is cut; with them, they stand in place of others."""
    at = int(place * (len(recorded_octets) - 1))
    damaged = recorded_octets[:at] + (octets + recorded_octets[at + len(octets):] if octets else b'')
    path = tmp_path_factory.mktemp('damaged') / 'session.mcap'
    path.write_bytes(damaged)
    code, about, errors = command('info', path, '--json')
    assert (code, len(errors)) in ((0, 0), (2, 1))
    if code == 2:
        assert str(path) in errors[0]
        assert command('fit', path, '--json') == (2, None, errors)
        return
    code, result, errors = command('fit', path, '--json')
    assert code == (0 if about['trials'] else 2)
    assert errors[:len(about['problems'])] == about['problems']
    if damaged != recorded_octets:
        assert about['problems'] or about['trials']
    if code == 2:
        assert str(path) in errors[-1]
