# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Which trials and topics of a session are read: `--without`, `--remap`, and what `info` hints at."""

import html
import json
import re
import shlex

import pytest
from toy_command import one_worker
from toy_messages import MINUTE, session_messages, toy_trials
from toy_simulator import CountingToy

from dlo_calibration.cli import main as cli
from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import GoalRequest, Request, TrialRequest, write_request
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import ACTION, bag_types, GOAL, INITIAL, TRIAL_TYPES

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

TYPES = bag_types()
OWN = {INITIAL: '/before', ACTION: '/arm/done', GOAL: '/trackdlo/results_pc'}  # names in somebody's bag
REMAP = tuple(word for kind, topic in OWN.items() for word in ('--remap', f'{topic}:={kind}'))
FEW = ('--evaluations', '12', '--calibrate', 'flexibility', 'friction')


def recorded(path, names, count=3):
    """Record toy trials under other names, beside a topic of another program; return its folder."""
    hello = TYPES.build('std_msgs/msg/String', data='hello')
    with SessionWriter(path) as writer:
        for k, (kind, message) in enumerate(session_messages(TYPES, count)):
            writer.write(names[kind], TRIAL_TYPES[kind], encode(message, TRIAL_TYPES[kind]), (k + 1) * MINUTE)
        writer.write('/chatter', 'std_msgs/msg/String', encode(hello, 'std_msgs/msg/String'), MINUTE)
        return writer.path


@pytest.fixture
def session(tmp_path):
    """Give a session of three trials."""
    return recorded(tmp_path / 'session', {kind: f'/calibrator/{kind}' for kind in TRIAL_TYPES})


@pytest.fixture
def own(tmp_path):
    """Give the same session, recorded under other names."""
    return recorded(tmp_path / 'own', OWN)


@pytest.fixture
def act(capsys):
    """Give a function that executes a verb: its code, output and errors."""
    def act(*words, toy=None):
        code = cli.main(one_worker(words), lambda _: toy or CountingToy())
        return code, *capsys.readouterr()

    return act


def numbers(act, *words):
    """Return the numbers and names of the trials that `info` shows."""
    printed = json.loads(act('info', *words, '--json')[1])
    return [(trial['number'], trial['name']) for trial in printed['trials']]


@pytest.mark.long
def test_every_verb_leaves_trials_out_and_keeps_the_numbers_of_the_others(session, tmp_path, act):
    assert numbers(act, session, '--without', '2') == [(1, 'trial 1'), (3, 'trial 3')]
    assert numbers(act, session, '--without', '3,2') == numbers(
        act, session, '--without', '2', '--without', '3') == [(1, 'trial 1')]
    code, output, errors = act('fit', session, *FEW, '--without', '2', '--output', tmp_path / 'out', '--json')
    assert (code, json.loads(output)['trials']) == (0, 2)
    assert 'trial 2 is left out' in errors
    result = tmp_path / 'out' / 'result.xml'
    assert read_result(result).trials == ('trial 1', 'trial 3')
    scores = json.loads(act('validate', result, session, '--json')[1])['scores']
    remaining = json.loads(act('validate', result, session, '--without', '1', '--json')[1])['scores']
    assert remaining == scores[1:]
    act('plot', session, '--without', '2', '--output', tmp_path / 'drawn')
    assert {file.name for file in (tmp_path / 'drawn').iterdir()} == {'trial_1.png', 'trial_3.png'}
    moved = json.loads(act('simulate', result, session, '--without', '1,2', '--draws', '0', '--json')[1])
    assert {action['trial'] for action in moved['actions']} == {'trial 3'}


def repeated(act, folder):
    """Execute the command that a report repeats, in its folder; return the parameters."""
    page = (folder / 'report.html').read_text(encoding='utf-8')
    words = shlex.split(html.unescape(re.search('<pre><code>(.*?)</code>', page)[1]))[1:]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return json.loads(act(*words, '--json')[1])['parameters']


def request(path):
    """Write the toy trials as a request; return its path."""
    write_request(path, Request(tuple(
        TrialRequest(trial.name, trial.initial, trial.actions,
                     tuple(GoalRequest(goal.chain, goal.time) for goal in trial.goals))
        for trial in toy_trials(3))))
    return path


@pytest.mark.parametrize('source', [
    'session', *(pytest.param(name, marks=pytest.mark.long) for name in ('own', 'request'))])
def test_an_interrupted_fit_goes_on_with_the_same_trials(source, session, own, tmp_path, act):
    path, selected = {'session': (session, ()), 'own': (own, REMAP),
                      'request': (request(tmp_path / 'request.xml'), ())}[source]
    words = ('fit', path, *FEW, *selected, '--without', '2')
    act(*words, '--output', tmp_path / 'whole')
    whole, out = (tmp_path / 'whole' / 'result.xml'), tmp_path / 'out'

    def die():
        raise MemoryError

    with pytest.raises(MemoryError):
        act(*words, '--output', out, toy=CountingToy(last=9, die=die))
    code, _, errors = act('fit', '--resume', out, '--without', '1')
    assert (code, 'expected 2, as at the beginning' in errors) == (2, True)
    code, _, errors = act('fit', '--resume', out)
    assert code == 0, errors
    assert 'goes on after' in errors
    assert read_result(out / 'result.xml').values == read_result(whole).values
    again = json.loads(act('fit', '--resume', out, '--json')[1])
    assert (again['trials'], again['score']) == (2, pytest.approx(read_result(whole).score))
    values = {name: estimate['value'] for name, estimate in repeated(act, out).items()}
    assert values == read_result(whole).values


@pytest.mark.long
def test_topics_with_other_names_are_read_and_written_with_ours(session, own, tmp_path, act):
    assert numbers(act, own, *REMAP) == numbers(act, session)
    expected = json.loads(act('fit', session, *FEW, '--json')[1])['parameters']
    printed = json.loads(act('fit', own, *FEW, *REMAP, '--output', tmp_path, '--json')[1])['parameters']
    assert printed == expected
    assert len(read_session(tmp_path / 'session.mcap').trials) == 3
    assert json.loads(act('validate', tmp_path / 'result.xml', own, *REMAP, '--json')[1])['trials'] == 3


def test_a_remapped_topic_is_read_instead_of_one_of_that_name(tmp_path, act):
    names = {kind: f'/calibrator/{kind}' for kind in TRIAL_TYPES}
    path = recorded(tmp_path / 'session', names, 1)
    wrong = {**names, INITIAL: '/calibrator/goal_chain', GOAL: '/tracker'}  # goals are elsewhere
    other = recorded(tmp_path / 'other', wrong, 1)
    words = ('--remap', '/tracker:=goal_chain', '--remap', 'calibrator/goal_chain:=~/initial_chain')
    remapped, named = (json.loads(act('info', *words, '--json')[1])['trials'][0]
                       for words in ((path,), (other, *words)))
    assert remapped == named


def test_info_names_the_topics_that_it_does_not_know_and_how_to_use_them(own, act):
    code, output, errors = act('info', own, '--json')
    printed = json.loads(output)
    assert (code, errors, printed['trials']) == (0, '', [])
    unknown = {entry['topic']: entry for entry in printed['unknown_topics']}
    assert {topic: (entry['type'], entry['messages']) for topic, entry in unknown.items()} == {
        '/chatter': ('std_msgs/msg/String', 1), **{
            topic: (TRIAL_TYPES[kind], 3) for kind, topic in OWN.items()}}
    assert unknown['/chatter']['hint'] == ''
    assert '--remap /trackdlo/results_pc:=goal_chain' in unknown['/trackdlo/results_pc']['hint']
    assert '--remap /arm/done:=action' in unknown['/arm/done']['hint']
    assert '--remap /arm/done:=action' in act('info', own)[1]
    code, _, errors = act('fit', own)
    assert (code, '--remap TOPIC:=goal_chain' in errors) == (2, True)


@pytest.mark.parametrize('words, part', [
    (('--without', '4'), 'trial 4; expected 1 to 3; see the numbers with dlo-calibration info'),
    (('--without', '0'), 'trial 0; expected 1 to 3'),
    (('--without', '1,2,3'), 'all trials; expected at least one of the 3 that stays'),
    (('--without', 'trial'), "'trial'; expected numbers of trials, e.g. 2,5"),
    (('--remap', '/tracker:=goal_chain'), 'topic /tracker to read as goal_chain: no such topic; '),
    (('--remap', '/chater:=goal_chain'), 'did you mean /chatter?'),
    (('--remap', '/chatter:=goal_chain'), 'a std_msgs/msg/String; expected a sensor_msgs/msg/Point'),
    (('--remap', '/chatter:=goalchain'), 'did you mean goal_chain?'),
    (('--remap', '/chatter'), 'write it like /trackdlo/results_pc:=goal_chain'),
    (('--remap', '/chatter:=action', '--remap', '/x:=action'), 'action twice; expected each once')])
def test_unknown_trials_and_topics_are_refused(words, part, session, act):
    code, output, errors = act('info', session, *words)
    assert (code, output, errors.count('\n')) == (2, '', 1)
    assert part in errors
