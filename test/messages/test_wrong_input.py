# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Input that is wrong, at both doors: topics of a live node, and files; then input mutated at random."""

from contextlib import contextmanager
import functools
import itertools
from types import SimpleNamespace

from hypothesis import given, HealthCheck
from hypothesis import strategies as st
from live_node import live_node, LOG_WARN, QUICK
import numpy as np
import pytest
from random_examples import drawing
from toy_messages import SECOND, session_messages, write_session
from toy_simulator import new_toy
from trial_contents import contents
from wrong_input import fuzzed_pairs, LATE, made, mutated_fields, mutations, WRONG

from dlo_calibration import calibrate, InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.files.record import decode, encode, Record
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES, read
from dlo_calibration.messages.collector import TrialCollector

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

FILES = bag_types()
GOOD = session_messages(FILES, 2)
SCORES = {}  # of what was calibrated


# ---- the doors


class Topics:
    """The topics and services of a live node with two good trials; one for the whole module."""

    def __init__(self, robot, graph):
        self.robot = robot
        self.graph = graph
        self.types = graph.TYPES
        self.robot.send(session_messages(self.types, 2))
        self.robot.until_status(trials='2')
        self.score = self.calibrated()

    def calibrated(self):
        """Calibrate the trials that there are; return the best score."""
        results = self.robot.heard['result']
        count = len(results)
        answer = self.robot.call('start')
        assert answer.success, answer.message
        self.robot.until(lambda: len(results) > count, 'no result')
        self.robot.until_status(state='done')
        return self.graph.whole(results[-1])['score']

    @contextmanager
    def refusing(self):
        """Give an object whose `text` is the one refusal of what happens meanwhile, in status and log."""
        mark = len(self.robot.heard['status']), len(self.robot.heard['log'])
        trials = self.robot.status['trials']
        caught = SimpleNamespace(text=None)
        yield caught

        def texts():
            statuses = self.robot.heard['status'][mark[0]:]
            said = (self.graph.values(message.status[0])['last_refusal'] for message in statuses)
            return [text for text, _ in itertools.groupby(said)]

        def warnings():
            return [log.msg for log in self.robot.heard['log'][mark[1]:]
                    if log.level >= LOG_WARN and 'Not usable' not in log.msg]

        self.robot.until(warnings, 'no refusal')
        self.robot.until(lambda: texts() and texts()[-1] == warnings()[-1], 'no refusal in status')
        assert self.robot.status['trials'] == trials == '2'
        caught.text, = warnings()  # one for all that happened
        assert self.robot.status['last_refusal'] == caught.text


@pytest.fixture(scope='module')
def topics(shared_ros_environment, tmp_path_factory):
    import ros_robot

    with live_node(shared_ros_environment, tmp_path_factory.mktemp('node')) as robot:
        topics = Topics(robot, ros_robot)
        yield topics
        assert topics.calibrated() == topics.score  # after all that was refused


@functools.cache
def good_score():
    """Return the best score that the good trials have in a file."""
    collector = TrialCollector(Options())
    for kind, message in GOOD:
        collector.add(read(kind, message))
    return score_of(collector.trials)


def score_of(trials):
    """Calibrate trials, each set of them once."""
    key = repr(contents(trials))
    if key not in SCORES:
        SCORES[key] = calibrate(trials, Options.of(QUICK), make_simulator=new_toy).best.score
    return SCORES[key]


# ---- messages


@pytest.mark.parametrize('case', WRONG, ids=lambda case: case.name)
def test_wrong_message_on_a_topic_is_refused_once_and_the_trials_stay(topics, case):
    with topics.refusing() as refusal:
        topics.robot.send([(case.kind, made(case, topics.types))])
    for word in case.words():
        assert word in refusal.text


# In a file, in the order of stamps, that goal is one of a tracker that was on already.
@pytest.mark.parametrize('case', [case for case in WRONG if case.name != 'backward stamp, goal'],
                         ids=lambda case: case.name)
def test_wrong_message_in_a_file_is_refused_once_and_the_trials_calibrate(tmp_path, command, case):
    path = write_session(tmp_path / 'session.mcap', [*GOOD, (case.kind, made(case, FILES))], QUICK)
    session = read_session(path)
    trials, (refusal,) = session_trials(session, Options())
    assert (len(trials), session.warnings) == (2, ())
    for word in case.words():
        assert word in refusal
    assert score_of(trials) == good_score()
    code, about, errors = command('info', path, '--json')
    assert (code, about['refusals'], len(about['trials']), errors) == (0, [refusal], 2, [])


def test_a_fit_prints_a_refusal_once_and_uses_the_other_trials(tmp_path, command):
    case = WRONG[0]
    path = write_session(tmp_path / 'session.mcap', [*GOOD, (case.kind, made(case, FILES))], QUICK)
    code, result, (error,) = command('fit', path, '--json')
    assert (code, result['score']) == (0, good_score())
    assert all(word in error for word in case.words())


def test_live_and_replayed_refusals_are_the_same(topics, tmp_path):
    case = next(case for case in WRONG if case.name == 'fewer points')
    with topics.refusing() as live:
        topics.robot.send([(case.kind, made(case, topics.types))])
    path = write_session(tmp_path / 'session.mcap', [*GOOD, (case.kind, made(case, FILES))])
    refusal, = session_trials(read_session(path), Options())[1]
    assert live.text in (refusal, f'{refusal} (2 times)')  # where another test had it refused before


# ---- parameters

PARAMETERS = [
    ('mass', -1.0, 'parameter mass: -1 kg; expected 0 to 1000 kg; choose a value in that range'),
    ('evaluations', -1, 'parameter evaluations: -1; expected 0 to 1e+06; choose a value in that range'),
    ('friction', 100.5, 'parameter friction: 100.5; expected 0 to 100; choose a value in that range'),
    ('mass', 'heavy', "parameter mass: 'heavy'; expected a number; give it that type"),
    ('search', 'magic', "parameter search: 'magic'; expected one of "),
    ('calibrate', ['colour'], "parameter calibrate: 'colour'; expected one of "),
    ('masss', 1.0, "parameter: 'masss'; expected one of mass, "),
]


@pytest.mark.parametrize(('name', 'value', 'text'), PARAMETERS)
def test_wrong_parameter_is_refused_once_by_the_live_node(topics, name, value, text):
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    client = topics.robot.node.create_client(SetParameters, '/calibrator/set_parameters')
    topics.robot.until(client.service_is_ready)
    before = topics.robot.calibrator.options()
    with topics.refusing() as refusal:
        future = client.call_async(SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]))
        topics.robot.until(future.done)
    answer, = future.result().results
    assert (answer.successful, answer.reason) == (False, refusal.text)
    assert refusal.text.startswith(text)
    assert topics.robot.calibrator.options() == before
    topics.robot.node.destroy_client(client)


@pytest.mark.parametrize(('name', 'value', 'text'), PARAMETERS)
def test_wrong_parameter_is_refused_once_by_the_command_line(tmp_path, command, name, value, text):
    path = write_session(tmp_path / 'session.mcap', GOOD, QUICK)
    words = value if isinstance(value, list) else [value]
    code, output, (error,) = command('fit', path, '--json', f'--{name}', *words)
    assert (code, output) == (2, None)
    if name == 'masss' or value == 'heavy':  # argparse knows
        assert f'--{name}' in error or '--mass' in error
        assert error.endswith('see dlo-calibration fit --help') or error.endswith('--help')
    else:
        assert text in error


@pytest.mark.parametrize(('name', 'value', 'text'), PARAMETERS)
def test_wrong_parameter_in_a_recording_is_left_out_with_one_warning(tmp_path, command, name, value, text):
    path = write_session(tmp_path / 'session.mcap', GOOD, {**QUICK, name: value})
    flags = (word for name in QUICK for word in (f'--{name}', *np.atleast_1d(QUICK[name])))
    code, result, errors = command('fit', path, '--json', *flags)
    refusal, = errors
    assert f'left out: {text}' in refusal
    assert (code, result['score']) == (0, good_score())


# ---- mutations


def collected(messages):
    """Collect messages after the good ones; a refusal must leave the trials as they are."""
    collector = TrialCollector(Options())
    for kind, message in GOOD:
        collector.add(read(kind, message))
    for kind, make in messages:
        before = contents(collector.trials)
        try:
            collector.add(read(kind, make()))
        except InputError as error:
            assert all((error.thing, error.came, error.expected, error.remedy))
            assert contents(collector.trials) == before
        collector.take_refusals()
        str(collector.refusals), str(collector.loose_end), str(collector.incomplete)
    return collector


@pytest.mark.long
@drawing(25)
@given(messages=st.lists(mutations('world'), min_size=1, max_size=6))
def test_mutated_bytes_are_collected_or_refused(messages):
    collector = collected([
        (kind, functools.partial(decode, Record(f'/{kind}', INPUT_TYPES[kind], octets, LATE)))
        for kind, octets in messages])
    if collector.trials:
        score_of(collector.trials)


@drawing(25)
@given(data=st.data())
def test_mutated_fields_are_collected_or_refused(data):
    originals = fuzzed_pairs(FILES, 'world')
    which = data.draw(st.lists(st.integers(0, len(originals) - 1), min_size=1, max_size=6))
    messages = [(originals[k][0], data.draw(mutated_fields(lambda k=k: fuzzed_pairs(FILES, 'world')[k][1])))
                for k in which]
    collector = collected([(kind, lambda message=message: message) for kind, message in messages])
    if collector.trials:
        score_of(collector.trials)


@pytest.mark.long
@drawing(5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(messages=st.lists(mutations('camera'), min_size=1, max_size=12))
def test_mutated_bytes_on_topics_leave_the_good_trials(topics, messages):
    for kind, octets in messages:
        topics.robot.publishers[kind].publish(octets)
    assert topics.calibrated() == topics.score
    assert topics.robot.status['trials'] == '2'


@pytest.mark.long
@drawing(8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(messages=st.lists(mutations('world'), min_size=1, max_size=6), good_last=st.booleans())
def test_mutated_bytes_in_a_file_end_in_a_result_or_one_line(tmp_path_factory, command, messages, good_last):
    path = tmp_path_factory.mktemp('mutated') / 'session.mcap'
    good = [(kind, encode(message, INPUT_TYPES[kind])) for kind, message in GOOD]
    with SessionWriter(path, QUICK) as writer:
        for k, (kind, octets) in enumerate([*messages, *good] if good_last else [*good, *messages]):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], octets, (k + 1) * SECOND, flush=False)
    code, about, errors = command('info', path, '--json')
    assert (code, errors) == (0, [])
    code, result, errors = command('fit', path, '--json')
    assert code == (0 if about['trials'] else 2)
    assert (result is None) == (code == 2)
    assert [line for line in errors if 'Traceback' in line] == []
