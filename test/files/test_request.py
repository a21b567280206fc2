# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Requests: exact there and back, fitted as a session is, and refused by line where they are wrong."""

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
import json
from pathlib import Path
import re

from hypothesis import given, reject
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from toy_command import one_worker
from toy_messages import toy_trials
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import FileOptions, Options
from dlo_calibration.cli import main as cli
from dlo_calibration.errors import InputError
from dlo_calibration.files.chain_file import chain_xml, read_chain_file
from dlo_calibration.files.request import (
    GoalRequest,
    read_request,
    Request,
    request_of,
    request_trials,
    TrialRequest,
    write_request,
)
from dlo_calibration.files.result import read_description, read_result
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import (
    Drag,
    GraspAndPlace,
    LiftAndHold,
    NAMED_ACTIONS,
    PushDown,
    Release,
    TwoHands,
)

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples' / 'xml'
REQUESTS = sorted(file for file in SAMPLES.glob('*.xml') if 'calibration_request' in file.read_text(
    encoding='utf-8'))
ALONG = np.linspace(0, 0.6, 4)
INITIAL = Chain(np.column_stack([ALONG, 0 * ALONG, 0 * ALONG]))
RAISED = Chain(INITIAL.points + (0, 0, 0.1))
PATHS = Action((Hand('left_hand', (0, 1), np.array([1.0, 2.0]), np.array([[0, 0, 0], [0, 0.1, 0]]),
                     np.array([[0, 0, 0, 1], [0, 0, 1, 1]])),))
OPTIONS = {'mass': 0.1 + 0.2, 'calibrate': ['friction', 'flexibility'], 'damping': 1 / 3, 'table': False}


def request(*actions, goals=None, options=()):
    goals = goals or (GoalRequest(RAISED, 60.0),)
    trial = TrialRequest('trial 1', INITIAL, actions or (PATHS,), goals)
    return Request((trial,), FileOptions(dict(options)))


def returned(given):
    """Return a request after a journey through a document, which must stay the same."""
    request_read = request_of(given.document)
    assert request_read.document == given.document
    return request_read


def same_trials(first, second):
    for a, b in zip(first, second, strict=True):
        assert a.name == b.name
        for x, y in zip([a.initial, *(goal.chain for goal in a.goals)],
                        [b.initial, *(goal.chain for goal in b.goals)], strict=True):
            np.testing.assert_array_equal(x.points, y.points)
            np.testing.assert_array_equal(x.features, y.features)
            assert (x.hands is None) == (y.hands is None)
            np.testing.assert_array_equal(x.hands if x.hands is not None else [],
                                          y.hands if y.hands is not None else [])
        assert [(g.time, g.stable, g.held_by) for g in a.goals] == [
            (g.time, g.stable, g.held_by) for g in b.goals]
        for x, y in zip(a.hands, b.hands, strict=True):
            assert (x.name, x.grips) == (y.name, y.grips)
            for name in ('times', 'positions', 'orientations'):
                np.testing.assert_array_equal(getattr(x, name), getattr(y, name))
        assert (a.velocity is None) == (b.velocity is None)
        if a.velocity is not None:
            np.testing.assert_array_equal(a.velocity, b.velocity)
    return True


numbers = st.floats(-1e6, 1e6)
NOT_TEXT = ['Cc', 'Cs', 'Cn']
names = st.text(st.characters(exclude_categories=[*NOT_TEXT, 'Zs', 'Zl', 'Zp']), min_size=1, max_size=9)
texts = st.text(st.characters(exclude_categories=NOT_TEXT), max_size=20)
sizes = st.floats(1e-6, 1e5)
starts = st.floats(0, 100)


@st.composite
def chains(draw):
    x = np.cumsum(draw(st.lists(st.floats(0.01, 1), min_size=4, max_size=4)))
    points = np.column_stack([x, draw(st.lists(numbers, min_size=4, max_size=4)), [draw(numbers)] * 4])
    hands = draw(st.none() | st.lists(st.integers(0, 8), min_size=4, max_size=4))
    return Chain(points, hands, draw(st.lists(st.booleans(), min_size=4, max_size=4)))


@st.composite
def hands(draw):
    count = draw(st.integers(1, 4))
    times = draw(starts) + np.cumsum(draw(st.lists(st.floats(1e-3, 10), min_size=count, max_size=count)))
    turns = draw(st.lists(st.just((0, 0, 0, 1)) | st.tuples(*[st.floats(0.3, 1)] * 4), min_size=count,
                          max_size=count))
    rows = st.lists(st.tuples(numbers, numbers, numbers), min_size=count, max_size=count)
    return Hand(draw(names), (draw(st.integers(0, 3)),), times, np.array(draw(rows)), np.array(turns, float))


one_hand = {'point': st.integers(-4, 3), 'speed': sizes, 'hand': names, 'start': starts,
            'hold': st.booleans()}
by_fraction = {**one_hand, 'point': st.none(), 'fraction': st.floats(0, 1)}
vectors = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.1, 10))
there = {'to': vectors}
that_far = {'direction': vectors, 'distance': sizes}
actions = st.one_of(
    st.builds(GraspAndPlace, **one_hand, **there, height=sizes), st.builds(Drag, **by_fraction, **that_far),
    st.builds(LiftAndHold, **by_fraction, height=sizes), st.builds(PushDown, **one_hand, distance=sizes),
    st.builds(TwoHands, points=st.just((0, -1)), motion=st.just('apart'), distance=sizes, speed=sizes,
              moving=st.sampled_from(['both', 'first', 'second']), height=st.just(0.0) | sizes, start=starts),
    st.builds(TwoHands, fractions=st.just((0.0, 1.0)), motion=st.just('apart'),
              hands=st.just(('a', 'b')), hold=st.booleans()),
    hands().map(lambda hand: Action((hand,))))


@drawing(15)
@given(initial=chains(), goal=chains(), several=st.lists(actions, min_size=1, max_size=3), name=texts,
       of_object=st.none() | texts, time=st.floats(0, 1e6), held_by=st.none() | st.lists(names, max_size=2),
       velocity=st.none() | st.tuples(numbers, numbers, numbers), mass=st.none() | st.floats(0, 1000))
def test_any_request_comes_back_exactly(initial, goal, several, name, of_object, time, held_by, velocity,
                                        mass):
    goals = (GoalRequest(goal, time, False, held_by if held_by is None else tuple(held_by)),)
    try:
        trial = TrialRequest(name, initial, tuple(several), goals,
                             None if velocity is None else [velocity] * 4)
    except InputError:  # times so near to each other that they are the same number, ...
        reject()
    given_request = Request((trial, trial), FileOptions({} if mass is None else {'mass': mass}), of_object)
    again = returned(given_request)
    assert (again.name, again.file_options) == (of_object, given_request.file_options)
    assert [action for action in again.trials[0].actions if not isinstance(action, Action)] == [
        action for action in several if not isinstance(action, Action)]
    assert same_trials([requested.trial() for requested in again.trials], [trial.trial()] * 2)


def test_options_come_back_as_the_calibrator_takes_them():
    again = returned(request(options=OPTIONS))
    assert dict(again.file_options.values) == OPTIONS
    assert again.file_options.options() == Options.of(OPTIONS)


def test_all_options_come_back():
    assert returned(request(options=Options().flat())).file_options.options() == Options()


def test_trials_of_a_session_make_a_request():
    trials = toy_trials(3)
    again = returned(Request(tuple(TrialRequest.of(trial) for trial in trials)))
    assert same_trials(request_trials(again, Options())[0], trials)


def test_action_is_done_on_the_latest_chain_before_it():
    trial = request(LiftAndHold(point=1, hand='right_hand'), PushDown(point=0, start=5.0),
                    goals=(GoalRequest(RAISED, 3.0), GoalRequest(RAISED, 9.0))).trials[0].trial()
    assert trial.actions[0].hands[0].positions[0, 2] == 0.0
    assert trial.actions[1].hands[0].positions[0, 2] == 0.1


def test_hands_hold_in_the_goals_as_the_actions_say():
    times = (3.0, 6.0, 9.0)
    trial = request(LiftAndHold(point=1), Release(start=4.0), Drag(point=0, to=(0, 0.1, 0), start=7.0),
                    goals=tuple(GoalRequest(RAISED, time) for time in times)).trials[0].trial()
    assert [goal.held_by for goal in trial.goals] == [('left_hand',), (), ()]
    said = GoalRequest(RAISED, 3.0, held_by=())
    assert request(LiftAndHold(point=1), goals=(said,)).trials[0].trial().goals[0].held_by == ()


@pytest.mark.parametrize('release, held_by', [(True, ()), (False, ('left_hand',))])
def test_option_release_counts_for_explicit_paths(release, held_by):
    trials, _ = request_trials(request(), Options(release=release))
    assert trials[0].goals[0].held_by == held_by


def test_goal_of_another_length_is_refused_and_the_other_trials_stay():
    observed = request().trials[0]
    long = replace(observed, name='long', goals=(GoalRequest(Chain(INITIAL.points * 2), 60.0),))
    trials, refusals = request_trials(Request((observed, long)), Options())
    assert [trial.name for trial in trials] == ['trial 1']
    assert re.search("'long'.*100 %.*length_tolerance", refusals[0])


TEXT = request(LiftAndHold(point=1), PushDown(point=0, start=20.0), PATHS,
               TwoHands(points=(0, 3), start=30.0, motion='apart'), options=OPTIONS).document.decode()


@pytest.mark.parametrize('old, new, match', [
    ('version="2"', 'version="3"', "<calibration_request>.*version.*'3'"),
    ('<object mass="', '<object mass="-', '<object>.*mass'),
    ('<object mass="', '<object mass="heavy', '<object>.*mass.*a finite number'),
    ('<object ', '<object colour="red" ', '<object>.*colour'),
    ('<settings>', '<settings colour="red">', '<settings>.*colour'),
    ('name="damping" value="0.3', 'name="damping" value="500.3', '<option>.*damping.*0 to 100'),
    ('name="damping"', 'name="dumping"', '<option>.*dumping'),
    ('name="damping"', 'name="table"', '<option>.*table'),
    ('value="friction flexibility"', 'value="friction weight"', '<option>.*weight'),
    ('<trial name="trial 1">', '<trial>', "<trial>.*'name'"),
    ('<point x="0.0"', '<point x="one"', '<point>.*x.*one.*a finite number'),
    ('<point x="0.0"', '<dot x="0.0"', 'Opening|<dot>'),
    ('<lift_and_hold point="1"', '<lift_and_hold', '<lift_and_hold>.*point None'),
    ('<lift_and_hold point="1"', '<lift_and_hold point="1.5"', '<lift_and_hold>.*point.*1.5.*an integer'),
    ('<lift_and_hold point="1"', '<lift_and_hold point="1" fraction="0.5"', '<lift_and_hold>.*fraction 0.5'),
    ('<lift_and_hold point="1"', '<lift_and_hold depth="1" point="1"', '<lift_and_hold>.*depth'),
    ('speed="0.1"', 'speed="0"', '<lift_and_hold>.*speed 0'),
    ('speed="0.1"', 'speed="1e999"', '<lift_and_hold>.*speed.*1e999'),
    ('hand="left_hand" height', 'hand="left hand" height', '<lift_and_hold>.*hand'),
    ('hold="true"', 'hold="yes"', '<lift_and_hold>.*hold.*yes'),
    ('<push_down ', '<push_up ', 'Opening|<push_up>'),
    ('points="0 3"', 'points="0 3 2"', '<two_hands>.*points'),
    ('points="0 3"', 'points="0 x"', '<two_hands>.*points'),
    ('motion="apart"', 'motion="up"', "<two_hands>.*motion.*'up'.*'apart', 'together'"),
    ('grips="0 1"', 'grips=""', '<hand>.*no gripped point'),
    ('grips="0 1"', 'grips="0 a"', '<hand>.*grips'),
    ('<waypoint time="1.0"', '<waypoint', "<waypoint>.*'time'"),
    ('<waypoint time="1.0"', '<waypoint time="1.0" qx="0"', '<waypoint>.*only qx'),
    ('<goal_chain time="60.0"', '<goal_chain', "<goal_chain>.*'time'"),
    ('<goal_chain time="60.0"', '<goal_chain time="1e300"', '<goal_chain>.*a time of 1e.300 s'),
    ('<goal_chain time="60.0"', '<goal_chain time="60.0" held_by="a" colour="x"', '<goal_chain>.*colour'),
    ('stable="true"', 'stable="maybe"', '<goal_chain>.*stable.*maybe'),
])
def test_a_wrong_element_is_refused_with_its_line(old, new, match):
    assert old in TEXT
    line = TEXT[:TEXT.index(old)].count('\n') + 1
    with pytest.raises(InputError, match=match) as caught:
        request_of(TEXT.replace(old, new, 1).encode(), 'request x.xml')
    if 'Opening' not in match:
        assert str(caught.value).startswith(f'request x.xml, line {line}, element <')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('old, new, match', [
    ('<waypoint time="1.0"', '<waypoint time="3.0"', '<hand>.*time 2 s of waypoint 1 after 3 s; '),
    ('grips="0 1"', 'grips="0 9"', "<trial>.*'left_hand' gripping points"),
    ('point="0"', 'point="9"', '<trial>.*push_down.*point 9.*-4 to 3'),
    ('<point x="0.6"', '<point x="0.4"', '<initial_chain>.*coincident'),
    ('<point x="0.6"', '<point x="1e9"', '<initial_chain>.*1e.09 m in point .*at most 1e.08 m'),
    ('<waypoint time="1.0"', '<waypoint time="1e300"', '<hand>.*a waypoint at 1e.300 s'),
    ('<waypoint time="1.0" x="', '<waypoint time="1.0" x="9999999999', '<hand>.*in waypoint 0.*1e.08 m'),
    ('name="table" value="false"', 'name="mass" value="1"', '<settings>.*mass.*<object>'),
    ('time="60.0"', 'time="1.5"', '<trial>.*stable goal.*moves'),
])
def test_contradicting_elements_are_refused_by_the_element_that_has_it(old, new, match):
    assert old in TEXT
    with pytest.raises(InputError, match=rf'^request, line \d+, element {match}'):
        request_of(TEXT.replace(old, new, 1).encode())


def test_unequal_numbers_of_points_are_refused():
    text = re.sub(r'(<goal_chain.*?>)\s*<point .*?/>', r'\1', TEXT, count=1, flags=re.DOTALL)
    with pytest.raises(InputError, match='<trial>.*a goal of 3 points'):
        request_of(text.encode())


@pytest.mark.parametrize('make, match', [
    (lambda: Request(()), 'no trial'),
    (lambda: request(options={'weight': 1}), 'weight'),
    (lambda: request(LiftAndHold(point=1, hand='left hand')), "a hand named 'left hand'"),
    (lambda: request(LiftAndHold(point=1, hand='')), "a hand named ''"),
    (lambda: request(LiftAndHold(point=1, hand='\x00')), 'a hand named'),
    (lambda: request(goals=(GoalRequest(RAISED, 60.0, held_by=('a b',)),)), "a hand named 'a b'")])
def test_a_request_that_cannot_be_written_is_refused_when_built(make, match):
    with pytest.raises(InputError, match=match):
        make()


def test_path_without_file_and_place_that_cannot_be_written_are_refused(tmp_path):
    with pytest.raises(InputError, match='missing.xml'):
        read_request(tmp_path / 'missing.xml')
    with pytest.raises(InputError, match='request.xml'):
        write_request(tmp_path / 'missing' / 'request.xml', request())


@pytest.fixture
def command(capsys):
    """Give a function that returns exit code, stdout and stderr of a command with the toy."""
    def act(*words):
        code = cli.main(one_worker(words), lambda options: ToySimulator())
        return code, *capsys.readouterr()

    return act


@pytest.fixture
def file(tmp_path):
    """Give the path of a request with the toy's trials."""
    path = tmp_path / 'asked.xml'
    write_request(path, Request(tuple(TrialRequest.of(trial) for trial in toy_trials(2)),
                                FileOptions({'evaluations': 20, 'mass': 0.2})))
    return path


@pytest.mark.long
def test_fit_of_a_request_gives_what_the_library_gives(command, file):
    code, output, _ = command('fit', file, '--json')
    printed = json.loads(output)
    result = calibrate(toy_trials(2), Options.of({'evaluations': 20, 'mass': 0.2}), make_simulator=new_toy)
    assert code == 0
    assert {name: estimate['value'] for name, estimate in printed['parameters'].items()} == result.values
    assert (printed['trials'], printed['evaluations'], printed['score']) == (2, 20, result.best.score)


@pytest.mark.long
def test_fit_of_a_request_writes_its_files_and_validate_takes_it(command, file, tmp_path):
    code, output, errors = command('fit', file, '--json', '--evaluations', 5, '--output', tmp_path / 'out')
    assert code == 0
    assert 'evaluations: 5 instead of 20' in errors
    assert {file.name for file in (tmp_path / 'out').iterdir()} == {
        'result.xml', 'request.xml', 'session.mcap', 'report.html', 'evaluations.csv'}
    assert (tmp_path / 'out' / 'request.xml').read_bytes() == file.read_bytes()
    assert read_result(tmp_path / 'out' / 'result.xml').mass == 0.2
    code, again, _ = command('validate', tmp_path / 'out' / 'result.xml', file, '--json')
    assert code == 0
    assert json.loads(again)['scores'] == json.loads(output)['scores']
    # what a robot would have sent
    code, replayed, _ = command('fit', tmp_path / 'out' / 'session.mcap', '--json')
    assert code == 0
    assert json.loads(replayed)['score'] == pytest.approx(json.loads(output)['score'], rel=1e-6)


def test_info_says_what_is_in_a_request(command, file):
    code, output, _ = command('info', file, '--json')
    printed = json.loads(output)
    assert (code, [trial['name'] for trial in printed['trials']]) == (0, ['trial 1', 'trial 2'])
    assert printed['options'] == {'evaluations': 20, 'mass': 0.2}
    assert command('info', file)[0] == 0


def test_request_that_cannot_be_used_takes_one_line(command, file):
    text = file.read_text(encoding='utf-8')
    file.write_text(text.replace('<settings>', '<settings a="">'), encoding='utf-8')
    code, output, errors = command('fit', file, '--json')
    assert (code, output) == (2, '')
    assert re.fullmatch(r'dlo-calibration: request .*asked.xml, line 4, element <settings>.*\n', errors)


def test_examples_of_the_document_are_what_it_says(tmp_path):
    text = (SAMPLES.parents[1] / 'doc' / 'formats.md').read_text(encoding='utf-8')
    described, asked, to_simulate, chain = re.findall('```xml\n(.*?)```', text, re.DOTALL)
    assert read_description(described).parameters['flexibility'].identifiable
    request_read = request_of(asked.encode())
    assert {action.name for trial in request_read.trials for action in trial.actions} == {
        'lift_and_hold', 'release', 'hand_paths'}
    only, = request_of(to_simulate.encode()).trials
    assert [step.name for step in only.manipulation().steps] == [
        'grasp_and_place', 'lift_and_hold', 'release']
    (tmp_path / 'chain.xml').write_text(chain, encoding='utf-8')
    read = read_chain_file(tmp_path / 'chain.xml')
    assert (len(read), chain_xml(read).decode()) == (3, chain)
    assert all(f'`{name}`' in text for name in NAMED_ACTIONS)


def test_samples_use_every_named_action_and_both_ways():
    used = {action.name for file in REQUESTS for trial in read_request(file).trials
            for action in trial.actions}
    assert used == {*NAMED_ACTIONS, 'hand_paths'}


@pytest.mark.parametrize('file', REQUESTS, ids=lambda file: file.name)
def test_sample_is_written_as_this_package_writes(file):
    request_read = read_request(file)
    assert request_read.document == file.read_bytes()
    trials, refusals = request_trials(request_read, request_read.file_options.options())
    assert len(trials) == len(request_read.trials) and refusals == ()


def test_script_writes_the_requests():
    spec = spec_from_file_location('make_xml', SAMPLES.parent / 'make_xml.py')
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.measured().document == (SAMPLES / 'named_actions.xml').read_bytes()


def test_other_samples_are_descriptions():
    others = {file for file in SAMPLES.iterdir() if file.is_file()} - set(REQUESTS)
    assert others == {SAMPLES / 'dlo.xml'}
    assert read_result(SAMPLES / 'dlo.xml').parameters['flexibility'].identifiable


@pytest.mark.parametrize('file', [
    pytest.param(file, marks=pytest.mark.long if file.stem == 'push_and_release' else (), id=file.name)
    for file in REQUESTS])
def test_sample_is_explained_by_its_parameters(file, capsys):
    code = cli.main(['validate', str(SAMPLES / 'dlo.xml'), str(file), '--json', '--workers', '1'])
    printed = json.loads(capsys.readouterr().out)
    assert code == 0
    assert printed['error_percent_of_length'] < 2


@pytest.mark.long
def test_sample_is_fitted(capsys):
    code = cli.main(['fit', str(SAMPLES / 'named_actions.xml'), '--json', '--evaluations', '3',
                     '--engine', 'compiled', '--workers', '1'])
    printed = json.loads(capsys.readouterr().out)
    assert (code, printed['trials'], printed['evaluations']) == (0, 4, 3)
    assert printed['score'] < 100
