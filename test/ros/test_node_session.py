# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the node knows and decides, without a graph."""

from dataclasses import replace
import errno
import os
from pathlib import Path
import re
import threading
import time

from exported_scene import write_scene
import pytest
from touched_scenes import AROUND_ONE, pegs, PHYSICAL
from toy_graph import PATIENCE, ToyGraph, TYPES, values, whole
from toy_messages import MINUTE, session_messages, toy_trials, trial_messages
from toy_simulator import CountingToy, Stoppable, ToySimulator
from wire import result_values
from wrong_input import with_point

from dlo_calibration import Chain
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation import EvaluationLog
from dlo_calibration.files import recording
from dlo_calibration.files.record import encode
from dlo_calibration.files.result import read_description, read_result
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import GOAL, INITIAL, INPUT_TYPES, OUTPUT_TYPES
from dlo_calibration.model.parameters import number
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.workspace.folder import calibration_digest

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

@pytest.fixture
def start(tmp_path):
    """Give a function that begins a session with the toy, and returns its graph."""
    graphs = []

    def start(toy=None, make=None, kind=ToyGraph, **options):
        toy = toy or ToySimulator()
        graphs.append(kind(tmp_path, make or (lambda _: toy), **options))
        return graphs[-1]

    yield start
    for graph in graphs:
        graph.session.close()


def folders(path):
    return sorted(path.glob('dlo_session_*'))


def score(command, folder):
    """Return the score that `fit` finds in a session, as a result message has it."""
    code, printed, _ = command('fit', folder, '--json')
    assert code == 0
    return repr(printed['score'])


def test_published_messages_are_on_the_disk_before_a_listener_gets_them(start, tmp_path):
    class Suspicious(ToyGraph):
        def publish(self, name, octets):
            folder, = folders(tmp_path)
            record = read_session(folder).records[-1] if self.heard['status'] else None
            assert record is None or (record.name, record.data) == (name, octets)
            super().publish(name, octets)

    graph = start(kind=Suspicious, evaluations=3)
    graph.send(session_messages(TYPES, 1))
    graph.calibrated()
    assert set(graph.heard) | {'advice'} == set(OUTPUT_TYPES)


def test_start_without_a_complete_trial_is_refused_and_says_what_is_missing(start):
    graph = start()
    done, answer = graph.session.request('start')
    assert not done
    assert 'initial_chain' in answer
    graph.send(session_messages(TYPES, 1)[:2])
    assert 'goal_chain' in graph.status['incomplete']
    done, answer = graph.session.request('start')
    assert not done
    assert 'goal_chain' in answer
    assert graph.status['last_refusal'] == answer == graph.logged['warn'][-1]
    graph.waiting = session_messages(TYPES, 1)[2:]  # sent before the request, and not heard yet
    assert whole(graph.calibrated())['trials'] == '1'


@pytest.mark.long
def test_messages_after_the_start_belong_to_the_next_calibration(start, tmp_path, command):
    graph = start(ToySimulator(0.002))
    graph.send(session_messages(TYPES, 1))
    graph.session.request('start')
    graph.send(session_messages(TYPES, 1, first=1))
    assert (graph.status['state'], graph.status['trials']) == ('calibrating', '2')
    graph.until(lambda: graph.status['state'] == 'done')
    first, = graph.heard['result']
    assert whole(first)['trials'] == '1'
    folder, = folders(tmp_path)
    assert score(command, folder) == whole(first)['score']
    second = graph.calibrated()
    assert whole(second)['trials'] == '2'
    assert score(command, folder) == whole(second)['score']
    assert {file.name for file in folder.glob('*.xml')} == {'result.xml', 'result_1.xml'}
    assert read_result(folder / 'result.xml').score == float(whole(second)['score'])
    assert read_result(folder / 'result_1.xml').score == float(whole(first)['score'])
    assert any(text.endswith('the one before is result_1.xml there') for text in graph.logged['info'])
    graph.session.close()
    assert {file.name for file in folder.glob('*.html')} == {'report.html', 'report_1.html'}


def test_requests_that_do_not_fit_are_refused_and_stop_gives_the_best_so_far(start):
    graph = start(ToySimulator(0.01), evaluations=10000)
    graph.send(session_messages(TYPES, 1))
    assert not graph.session.request('stop')[0]
    assert graph.session.request('start')[0]
    for refused in ('start', 'reset'):
        done, answer = graph.session.request(refused)
        assert not done
        assert 'under way' in answer
    graph.until(lambda: graph.heard['progress'])
    assert graph.session.request('stop')[0]
    graph.until(lambda: graph.status['state'] == 'done')
    result = whole(graph.heard['result'][0])
    assert result['stop_reason'] == 'stopped on request'
    assert graph.status['detail'] == f"{result['headline']} stopped on request"
    assert 'the search has not reached a minimum (stopped on request)' in result['unusable']


@pytest.mark.long
def test_reset_forgets_the_trials_and_begins_another_session(start, tmp_path, command):
    graph = start()
    graph.send(session_messages(TYPES, 2))
    assert graph.status['trials'] == '2'
    assert graph.session.request('reset')[0]
    assert (graph.status['trials'], graph.status['last_refusal']) == ('0', '')
    graph.send(session_messages(TYPES, 1))
    live = graph.calibrated()
    first, second = folders(tmp_path)
    assert score(command, second) == whole(live)['score']
    assert len(read_session(first).messages) == 6


def bad_cloud():
    (_, cloud), *_ = session_messages(TYPES, 1, first=5)
    cloud.header.stamp.sec = cloud.header.stamp.nanosec = 0
    return encode(cloud, INPUT_TYPES[INITIAL])


def foreign_frame():
    (_, cloud), *_ = trial_messages(TYPES, toy_trials(1)[0], 9 * MINUTE, 'camera')
    return encode(cloud, INPUT_TYPES[INITIAL])


@pytest.mark.parametrize(('octets', 'words'), [
    (bad_cloud, ('stamp of zero', 'header.stamp')), (foreign_frame, ('camera', 'world')),
    pytest.param(lambda: b'\0\1\0\0broken', ('do not decode', 'sensor_msgs/msg/PointCloud2'),
                 marks=pytest.mark.long),
], ids=['stamp of zero', 'another frame', 'damaged bytes'])
def test_a_refusal_is_reported_once_and_the_trials_stay(start, octets, words):
    graph = start()
    graph.send(session_messages(TYPES, 1))
    graph.session.hear(INITIAL, octets())
    for word in ('initial_chain', *words):
        assert word in graph.status['last_refusal']
    assert graph.logged['warn'] == [graph.status['last_refusal']]
    assert whole(graph.calibrated())['trials'] == '1'
    assert graph.logged['warn'].count(graph.status['last_refusal']) == 1


@pytest.mark.parametrize('text', ['\x1b[2J\x9b31m\u202etxt.exe\r\n\ud800', 5_000_000 * 'x'])
def test_log_and_status_are_harmless_and_short_whatever_came(start, text):
    graph = start()
    graph.session.refuse(text)
    refusal = graph.status['last_refusal']
    assert graph.logged['warn'] == [refusal]
    graph.session.fail(text, 'in the log')
    for shown in (refusal, graph.status['detail']):
        assert 0 < len(shown) <= 300 and shown.isprintable()


def test_refusals_for_one_reason_are_counted(start):
    graph = start()
    bad = with_point(4, float('inf'))(TYPES)
    for k in range(37):
        bad.header.stamp.sec = 200 + k
        graph.send([(GOAL, bad)])
    assert graph.status['last_refusal'].startswith('goal_chain stamped 236 s: ')
    assert graph.status['last_refusal'].endswith(' (37 times)')
    assert len(graph.logged['warn']) == 1
    graph.elapsed = 2.0
    graph.session.tick()
    assert graph.logged['warn'][1:] == [graph.status['last_refusal']]


def test_a_stream_of_refusals_changes_the_status_at_most_once_a_second(start):
    graph = start(status_period=1.0)
    before = len(graph.heard['status'])
    bad = with_point(4, float('inf'))(TYPES)
    for k in range(50):
        bad.header.stamp.sec = 200 + k
        graph.send([(GOAL, bad)])
    assert len(graph.heard['status']) - before <= 1
    graph.elapsed += 1.0
    graph.session.tick()
    assert graph.status['last_refusal'].endswith(' (50 times)')
    graph.send(session_messages(TYPES, 1))  # a trial is reported at once
    assert graph.status['trials'] == '1'


@pytest.mark.long
def test_a_discarded_trial_is_left_out_by_the_replay_too(start, tmp_path, command):
    graph = start()
    assert graph.session.request('discard_last') == (
        False, '~/discard_last: no trial; expected one; there is nothing to take back')
    graph.send(session_messages(TYPES, 2))
    assert graph.session.request('discard_last') == (True, 'trial 2 is taken back; 1 trial(s) are left')
    assert graph.status['trials'] == '1'
    _, _, (_, goal) = session_messages(TYPES, 1, first=1)
    goal.header.stamp.sec += 5  # the tracker goes on
    graph.send([(GOAL, goal)])
    assert graph.status['last_refusal'].startswith('~/discard_last')
    graph.send(session_messages(TYPES, 1, first=2)[:2])
    answer = graph.session.request('discard_last')[1]
    assert answer == 'the incomplete trial is taken back; 1 trial(s) are left'
    graph.send(session_messages(TYPES, 1, first=3))
    live = graph.calibrated()
    assert whole(live)['trials'] == '2'
    folder, = folders(tmp_path)
    assert score(command, folder) == whole(live)['score']
    assert '6 message(s) of 2 trial(s) that were taken back are left out' in read_session(folder).warnings


def test_no_trial_is_discarded_while_it_calibrates(start):
    graph = start(ToySimulator(0.01), evaluations=1000)
    graph.send(session_messages(TYPES, 1))
    assert graph.session.request('start')[0]
    done, answer = graph.session.request('discard_last')
    assert not done and answer.startswith('~/discard_last: a calibration under way')
    assert graph.status['trials'] == '1'
    graph.session.request('stop')


def test_goals_of_a_tracker_before_the_first_initial_chain_are_counted_and_no_refusal(start):
    graph = start()
    goal = session_messages(TYPES, 1)[2][1]
    seconds = goal.header.stamp.sec
    for k in range(5):
        goal.header.stamp.sec = seconds - 40 + k
        graph.send([(GOAL, goal)])
    graph.send(session_messages(TYPES, 1))
    goal.header.stamp.sec = session_messages(TYPES, 1)[0][1].header.stamp.sec - 1
    goal.header.stamp.nanosec = 900_000_000  # it comes later than the initial chain
    graph.send([(GOAL, goal)])
    assert (graph.status['last_refusal'], graph.status['trials']) == ('', '1')
    early, late = (text for text in graph.logged['info'] if text.startswith('goal_chain'))
    assert late.endswith('s: came before the first initial chain; not used')
    assert early.endswith('and 4 more: came before the first initial chain; not used')


def test_a_tracker_that_goes_on_leaves_the_state_done(start):
    graph = start(evaluations=3)
    graph.send(session_messages(TYPES, 1))
    graph.calibrated()
    goal = session_messages(TYPES, 1)[2][1]
    goal.header.stamp.sec += 5
    graph.send([(GOAL, goal)])
    assert graph.status['state'] == 'done'
    graph.send(session_messages(TYPES, 1, first=1)[:1])
    graph.until(lambda: graph.status['state'] == 'collecting')


def test_starts_by_itself_once_the_last_trial_is_quiet_and_only_once(start):
    graph = start(start_after_trials=2)
    graph.send(session_messages(TYPES, 2))
    assert graph.status['state'] == 'collecting'
    graph.elapsed += 1.0
    graph.until(lambda: graph.heard['result'])
    assert whole(graph.heard['result'][0])['trials'] == '2'
    graph.send(session_messages(TYPES, 1, first=2))
    graph.elapsed += 1.0
    graph.session.tick()
    assert graph.status['state'] == 'collecting'


def test_starts_by_itself_at_once_when_one_more_trial_is_complete(start):
    graph = start(start_after_trials=1)
    graph.send(session_messages(TYPES, 2))
    assert graph.status['state'] == 'calibrating'


@pytest.mark.long
def test_failure_of_the_engine_reaches_status_and_the_session_goes_on(start):
    toy = ToySimulator(crash=True)
    graph = start(toy)
    graph.send(session_messages(TYPES, 1))
    assert graph.session.request('start')[0]
    graph.until(lambda: graph.status['state'] == 'failed')
    assert graph.status['detail'] == 'RuntimeError: the toy is broken'
    assert graph.logged['error'][0] == 'calibration failed: RuntimeError: the toy is broken'
    assert 'Traceback' in graph.logged['error'][1]
    toy.crash = False
    graph.calibrated()


def test_a_scene_that_cannot_be_used_is_refused_at_the_start(start):
    graph = start(make=make_simulator, scene='nowhere.urdf')
    graph.send(session_messages(TYPES, 1))
    done, answer = graph.session.request('start')
    assert not done
    assert answer.startswith('scene nowhere.urdf: ')
    assert (graph.status['state'], graph.status['last_refusal']) == ('collecting', answer)


def test_obstacles_are_shown_with_the_trials(start, tmp_path):
    graph = start(make=make_simulator, scene=write_scene(tmp_path))
    graph.send(session_messages(TYPES, 1))
    graph.elapsed += 2.0
    graph.session.tick()
    names = {marker.ns for marker in graph.heard['markers'][-1].markers}
    assert {'scene/obstacles', 'trial_1/goal'} <= names


@pytest.mark.long
def test_trials_around_a_peg_are_fitted_with_the_scene_that_the_node_is_given(start, tmp_path):
    """The DLO was dragged around a peg: without it, no parameters lead there."""
    peg = ('<robot name="peg"><link name="table"><collision><origin xyz="0.4 0.05 0.05"/><geometry>'
           '<cylinder length="0.1" radius="0.01"/></geometry></collision></link></robot>')
    (tmp_path / 'peg.urdf').write_text(peg)
    chains = CompiledSimulator(obstacles=pegs((0.4, 0.05))).simulate(AROUND_ONE, PHYSICAL).chains
    seen = replace(AROUND_ONE, goals=tuple(replace(goal, chain=Chain(points)) for goal, points in zip(
        AROUND_ONE.goals, chains, strict=True)))
    errors = {}
    for scene in ('', str(tmp_path / 'peg.urdf')):
        graph = start(make=make_simulator, scene=scene, engine='compiled', evaluations=15, mass=0.03,
                      calibrate=('flexibility', 'friction'))
        graph.send(trial_messages(TYPES, seen, MINUTE))
        graph.calibrated()
        errors[scene] = float(whole(graph.heard['result'][-1])['score'])
        graph.session.close()
    without, with_it = errors.values()
    assert with_it < 0.3 * without


def test_a_scene_that_cannot_be_used_ends_a_start_by_itself(start):
    graph = start(make=make_simulator, scene='nowhere.urdf', start_after_trials=1)
    graph.send(session_messages(TYPES, 1))
    graph.elapsed += 1.0
    graph.session.tick()
    assert graph.status['state'] == 'failed'
    assert graph.status['detail'].startswith('scene nowhere.urdf: ')
    assert graph.status['detail'] == graph.status['last_refusal']


def test_disk_that_refuses_is_reported_and_the_session_goes_on(start, tmp_path):
    taken = tmp_path / 'file'
    taken.write_text('not a folder')
    graph = start(output_directory=str(taken))
    assert str(taken) in graph.status['last_refusal']
    graph.send(session_messages(TYPES, 1))
    graph.calibrated()


class FullDisk:
    """The file of a session on a disk that is full as long as `full` says so."""

    def __init__(self, stream, full):
        self._stream, self._full = stream, full

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, octets):
        if self._full:
            self._stream.write(octets[:7])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._stream.write(octets)


def test_a_full_disk_is_reported_and_the_result_is_still_published(
        start, tmp_path, monkeypatch):
    full, create, replace = [], recording._create, os.replace

    def refuse(new, path):
        if full and Path(path).suffix == '.html':
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(new, path)

    monkeypatch.setattr(os, 'replace', refuse)
    monkeypatch.setattr(recording, '_create',
                        lambda path: (*(made := create(path))[:2], FullDisk(made[2], full)))
    graph = start(evaluations=3)
    folder, = folders(tmp_path)
    graph.send(session_messages(TYPES, 1))
    before = len(read_session(folder).messages)
    full.append('yes')
    message = graph.calibrated()
    for name, row in ((status.name, values(status)) for status in message.status):
        assert name == 'calibration' or any(
            f'{name} {number(float(row["value"]))} ({number(float(row["lower"]))} to ' in text
            for text in graph.logged['info']), name
    assert read_result(folder / 'result.xml').score == float(whole(message)['score'])
    assert {file.name for file in folder.iterdir()} >= {'result.xml', 'evaluations.csv', 'metadata.yaml'}
    assert len(read_session(folder).messages) == before
    graph.until(lambda: any('report.html' in text for text in graph.logged['error']))
    # As there is room again, a reset begins a session that is recorded.
    full.clear()
    assert graph.session.request('reset')[0]
    text = graph.logged['error'][-1]
    assert text.startswith(f'session {folder} is incomplete; could not be written: messages from ')
    assert f'report.html: {os.strerror(errno.ENOSPC)}' in text
    graph.send(session_messages(TYPES, 1))
    graph.calibrated()
    count = len(graph.logged['error'])
    graph.session.close()
    assert len(graph.logged['error']) == count
    _, second = folders(tmp_path)
    assert {file.name for file in second.iterdir()} == {
        'result.xml', 'evaluations.csv', 'report.html', 'metadata.yaml', f'{second.name}_0.mcap'}
    assert read_session(second).warnings == ()


def test_missing_parts_of_a_session_are_reported_when_the_node_ends(start, tmp_path):
    taken = tmp_path / 'file'
    taken.write_text('not a folder')
    graph = start(output_directory=str(taken))
    graph.session.close()
    assert 'is incomplete; could not be written: everything' in graph.logged['error'][-1]


def test_nothing_is_written_where_recording_is_off(start, tmp_path):
    graph = start(record=False)
    graph.send(session_messages(TYPES, 1))
    graph.calibrated()
    graph.session.close()
    assert not folders(tmp_path)


def test_changed_options_count_at_the_next_start_and_in_the_replay(start, tmp_path, command):
    graph = start(grip_tolerance=0.0)
    pairs = trial_messages(TYPES, toy_trials(1)[0], MINUTE)
    for point in pairs[1][1].points:
        point.transforms[0].translation.z += 0.01  # the hand closes 1 cm above the point
    graph.send(pairs)
    assert 'grip_tolerance' in graph.status['last_refusal']
    graph.set.update(grip_tolerance=0.05, evaluations=12)
    live = whole(graph.calibrated())
    assert live['evaluations'] == '12'
    assert score(command, folders(tmp_path)[0]) == live['score']


def test_description_of_the_dlo_is_the_text_of_the_result_file(start, tmp_path):
    graph = start(mass=0.03)
    graph.send(session_messages(TYPES, 1))
    live = result_values(graph.calibrated())
    text, = (message.data for message in graph.heard['dlo_description'])
    parameters = read_description(text).parameters
    assert {name: estimate.physical_value for name, estimate in parameters.items()} == {
        name: estimate['physical_value'] for name, estimate in live.items()}
    folder, = folders(tmp_path)
    assert text == (folder / 'result.xml').read_text(encoding='utf-8')


@pytest.mark.long
def test_markers_show_trials_at_intervals_and_then_the_simulation(start):
    graph = start()

    def shown():
        return {marker.ns for marker in graph.heard['markers'][-1].markers}

    graph.send(session_messages(TYPES, 1))
    graph.send(session_messages(TYPES, 1, first=1))
    assert len(graph.heard['markers']) == 1
    assert 'trial_2/goal' not in shown()
    graph.elapsed += 1.3
    graph.session.tick()
    assert {f'trial_{k}/{name}' for k in (1, 2) for name in ('initial', 'goal', 'hands')} <= shown()
    assert not any(space.endswith('/simulated') for space in shown())
    graph.calibrated()
    graph.session.tick()  # between the two, services are answered
    assert {'trial_1/simulated', 'trial_2/simulated'} <= shown()
    graph.send(session_messages(TYPES, 1, first=2))
    graph.elapsed += 1.4
    graph.session.tick()
    assert 'trial_3/goal' in shown() and 'trial_1/simulated' in shown()
    assert 'trial_3/simulated' not in shown()
    graph.session.request('reset')
    assert not any(shown())


@pytest.mark.long
def test_status_says_whether_a_trial_added_information(start, tmp_path, command):
    graph = start(seed=3)
    graph.send(session_messages(TYPES, 1))
    graph.elapsed += 1.0
    graph.until(lambda: graph.status['last_trial'])
    assert graph.status['last_trial'].startswith('trial 1 makes flexibility more certain (')
    assert graph.heard['status'][-1].status[0].message.endswith(graph.status['last_trial'])
    assert float(graph.status['std_after_flexibility']) < 0.5 * float(graph.status['std_before_flexibility'])
    graph.send(trial_messages(TYPES, toy_trials(1)[0], 2 * MINUTE))  # the same again
    graph.elapsed += 1.0
    graph.until(lambda: graph.status['last_trial'].startswith('trial 2'))
    assert graph.status['last_trial'].startswith('trial 2 adds nothing new: repeat it only to average noise')
    live = graph.calibrated()
    folder, = folders(tmp_path)
    assert score(command, folder) == whole(live)['score']
    assert graph.session.request('reset')[0]
    assert (graph.status['last_trial'], graph.status['trials']) == ('', '0')


def test_information_about_a_trial_that_comes_after_a_newer_trial_is_dropped(start):
    graph = start(seed=3)
    graph.send(session_messages(TYPES, 1))
    graph.elapsed += 1.0
    graph.until(lambda: graph.status['last_trial'].startswith('trial 1'))
    graph.send(session_messages(TYPES, 1, first=1))
    assert (graph.status['trials'], graph.status['last_trial']) == ('2', '')
    graph.elapsed += 1.0
    graph.until(lambda: graph.status['last_trial'].startswith('trial 2'))
    graph.session._live_information.events.put(TrialInformation.unknown('trial 1', ('friction',), 'late'))
    graph.session.tick()
    assert graph.status['last_trial'].startswith('trial 2')


def test_start_and_result_name_the_same_number_of_evaluations(start):
    graph = start(search='random', evaluations=7)
    graph.send(session_messages(TYPES, 2))
    assert 'at most 7 evaluations' in graph.session.request('start')[1]
    graph.until(lambda: graph.heard['result'])
    assert whole(graph.heard['result'][0])['stop_reason'] == 'budget of 7 evaluations spent'


def test_a_reset_deletes_information_that_is_being_computed(start):
    toy = Stoppable()
    graph = start(toy)
    graph.send(session_messages(TYPES, 1))
    graph.elapsed += 1.0
    information = graph.session._live_information
    graph.until(toy.begun.is_set)
    assert graph.session.request('reset')[0]
    graph.until(lambda: not information.alive)
    assert (graph.status['last_trial'], graph.status['trials']) == ('', '0')


def back(pairs, seconds=5):
    """Return the pairs, stamped earlier."""
    for _, message in pairs:
        message.header.stamp.sec -= seconds
    return pairs


@pytest.mark.long
def test_a_clock_that_went_back_begins_another_session_and_trials_never_mix(start, tmp_path, command):
    graph = start()
    graph.send(session_messages(TYPES, 2))
    graph.send(back(session_messages(TYPES, 1), 50))  # within the first trial
    first, second = folders(tmp_path)
    refusal = graph.status['last_refusal']
    assert refusal.startswith('the clock went back by ')
    assert refusal.endswith(f'the 2 trial(s) of the former one are in {first}')
    assert graph.logged['warn'] == [refusal]
    assert (graph.status['state'], graph.status['trials']) == ('collecting', '1')
    live = graph.calibrated()
    assert whole(live)['trials'] == '1'
    assert score(command, second) == whole(live)['score']
    assert (len(read_session(first).trials), len(read_session(second).trials)) == (2, 1)


@pytest.mark.long
def test_a_calibration_goes_on_when_the_clock_goes_back_and_its_result_lies_with_its_trials(
        start, tmp_path, command):
    graph = start(ToySimulator(0.002))
    graph.send(session_messages(TYPES, 2))
    graph.session.request('start')
    graph.send(back(session_messages(TYPES, 1)))
    assert (graph.status['state'], graph.status['trials']) == ('calibrating', '1')
    graph.until(lambda: graph.status['state'] == 'done')
    live, = graph.heard['result']
    assert whole(live)['trials'] == '2'
    assert 'of the session before the clock went back' in graph.status['detail']
    first, second = folders(tmp_path)
    assert (first / 'result.xml').exists() and not (second / 'result.xml').exists()
    assert score(command, first) == whole(live)['score']
    assert len(read_session(first).outputs('result')) == 1
    assert read_session(first).warnings == ()
    assert whole(graph.calibrated())['trials'] == '1'
    assert (second / 'result.xml').exists()


def test_initial_chains_of_a_clock_that_went_back_are_forgotten_without_another_session(start, tmp_path):
    graph = start()
    stream = [session_messages(TYPES, 1, first=k)[0] for k in (3, 4)]
    graph.send(stream)
    graph.send(session_messages(TYPES, 1))
    assert graph.status['trials'] == '1'
    folder, = folders(tmp_path)
    graph.session.close()
    assert len(read_session(folder).trials) == 1


@pytest.mark.long
def test_log_times_never_go_back_though_the_clock_of_the_machine_does(start, tmp_path, monkeypatch):
    graph = start()
    graph.send(session_messages(TYPES, 1))
    monkeypatch.setattr(time, 'time_ns', lambda: 1_000_000_000)
    monkeypatch.setattr(time, 'time', lambda: 1.0)
    live = graph.calibrated()
    folder, = folders(tmp_path)
    session = read_session(folder)
    assert session.records[-1].name == 'status'
    assert whole(live)['trials'] == str(len(session.trials)) == '1'


def unfinished(path):
    return list(path.glob('dlo_unfinished_*'))


@pytest.mark.long
def test_another_session_goes_on_with_the_same_trials_and_options(start, tmp_path):
    """Whoever sends the trials of an interrupted session again need not wait for its evaluations again."""
    toys, results = [CountingToy() for _ in range(3)], []
    reached, going_on = threading.Event(), threading.Event()

    def wait():
        reached.set()
        assert going_on.wait(PATIENCE)

    toys[0].last, toys[0].die = 60, wait
    for toy, record in zip(toys, (True, True, False), strict=True):
        graph = start(toy, evaluations=60, search='random', record=record)
        graph.send(session_messages(TYPES, 2))
        assert graph.session.request('start')[0]
        if toy.last:
            assert reached.wait(PATIENCE)
            assert len(unfinished(tmp_path)) == 1
            graph.until(lambda graph=graph: graph.heard['progress'])  # a result needs one evaluation
            assert graph.session.request('stop')[0]
            going_on.set()
        else:
            match = re.fullmatch(r'goes on after (\d+) evaluations of an interrupted calibration',
                                graph.status['detail'])
            assert bool(match) == record
            assert not match or int(match[1]) >= int(whole(results[0])['evaluations'])
        graph.until(lambda graph=graph: graph.status['state'] == 'done')
        results.append(graph.heard['result'][-1])
        assert any('goes on after' in text for text in graph.logged['warn']) == (toy is toys[1])
        assert len(unfinished(tmp_path)) == (toy is toys[0])
        graph.session.close()
    assert 'stopped on request' in whole(results[0])['stop_reason']
    assert repr(result_values(results[1])) == repr(result_values(results[2]))


@pytest.mark.long
def test_without_a_log_it_calibrates_all_the_same_and_says_so(start, tmp_path):
    graph = start()
    graph.send(session_messages(TYPES, 1))
    options = graph.options().of_calibration
    trials, _ = session_trials(read_session(folders(tmp_path)[0]), options)
    digest = calibration_digest(trials, options)
    with EvaluationLog(tmp_path / f'dlo_unfinished_{digest}.log'):
        graph.calibrated()
    assert any('another calibration is using' in text for text in graph.logged['error'])
