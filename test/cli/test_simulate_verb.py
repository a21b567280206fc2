# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `simulate`: what it says and writes, and what it refuses."""

import json
import re

from made_up_dlo import LENGTH, straight
import numpy as np
from PIL import Image
import pytest

from dlo_calibration import Action, Chain, Hand
from dlo_calibration.cli import main as cli
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.request import Request, TrialRequest, write_request
from dlo_calibration.files.session import samples
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, Release

SAMPLES = samples()
RESULT = SAMPLES / 'xml/dlo.xml'
PLACE = GraspAndPlace(point=0, to=(0.1, 0.2, 0.004))


@pytest.fixture
def run(capsys):
    """Give a function that returns exit code, stdout and stderr of the verb."""
    def run(*words):
        try:
            code = cli.main(['simulate', *map(str, words)])
        except SystemExit as end:  # argparse
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def request_of(tmp_path):
    """Give a function that writes a request without goals, with one trial for each list of actions."""
    def request_of(*trials, start=None, name='one'):
        path = tmp_path / 'request.xml'
        write_request(path, Request(tuple(
            TrialRequest(name, start or straight(), tuple(actions), ()) for actions in trials)))
        return path

    return request_of


def few_frames(monkeypatch):
    """Make small animations, as drawing one takes long."""
    monkeypatch.setattr('dlo_calibration.report.animation.DOTS_PER_INCH', 40)
    monkeypatch.setattr('dlo_calibration.report.animation.FRAME_RATE', 1)
    monkeypatch.setattr('dlo_calibration.report.plan_drawing.MOST_FRAMES', 4)


def test_each_action_is_described_in_a_sentence(run, request_of):
    code, output, notes = run(RESULT, request_of([
        PLACE, LiftAndHold(point=20, start=9.0), Release(start=19.0)]), '--draws', 1)
    text = ' '.join(output.split())
    assert (code, notes) == (0, '')
    assert ('1. grasp_and_place: left_hand grips at 0.00 of the length, lifts 5 cm, carries it to (0.100, '
            '0.200, 0.004) m and opens; then the first point is at (0.1') in text
    assert '2. lift_and_hold: left_hand grips at 1.00 of the length, lifts 10 cm' in text
    assert 'm and holds it; then' in text and '3. release: left_hand opens; then' in text
    assert 'mm wide on average.' in text


def test_a_rope_that_a_hand_holds_up_bears_its_weight(run, request_of):
    up = straight().points[:, ::-1] * (1, 1, -1) + (0, 0, 1)
    hand = Hand('hand', (0,), [0.0, 2.0], [up[0]] * 2)
    request = request_of([Action((hand,))], start=Chain(up))
    code, output, _ = run(RESULT, request, '--json', '--draws', 2, '--no-table')
    action, = json.loads(output)['actions']
    assert code == 0
    assert action['most_tension_n'] == pytest.approx(0.03 * 9.81, rel=0.02)  # of dlo.xml: 30 g
    assert action['most_tension_at_m'] == 0.0
    lower, upper = action['most_tension_lower_upper_n']
    assert lower <= action['most_tension_n'] <= upper < 0.4
    assert action['most_strain'] > 0 and action['least_bend_radius_m'] > 0.01
    output = ' '.join(run(RESULT, request, '--draws', 0, '--no-table')[1].split())
    assert re.search(r'and bears up to 0\.29\d N at 0\.00 of the length, a strain of 0\.\d+ %\.', output)


def test_json_has_the_actions_of_all_trials(run, request_of):
    trials = [PLACE], [Drag(point=10, direction=(0, 1, 0), distance=0.1)]
    code, output, _ = run(RESULT, request_of(*trials), '--json', '--draws', 2, '--seed', 3)
    printed = json.loads(output)
    assert code == 0
    assert {key: printed[key] for key in ('draws', 'seed', 'engine', 'remarks')} == {
        'draws': 2, 'seed': 3, 'engine': 'compiled', 'remarks': []}
    assert [(action['trial'], action['name']) for action in printed['actions']] == [
        ('one', 'grasp_and_place'), ('one', 'drag')]
    lower, upper = np.array(printed['actions'][1]['predicted_lower_upper_m'])
    predicted = np.array(printed['actions'][1]['predicted'])
    assert predicted.shape == (21, 3) and (lower <= predicted).all() and (predicted <= upper).all()
    assert predicted[10, 1] == pytest.approx(0.1, abs=0.01)


@pytest.mark.long
def test_folder_gets_pictures_animations_and_chains(run, request_of, tmp_path, monkeypatch):
    few_frames(monkeypatch)
    folder = tmp_path / 'new' / 'folder'
    code, output, notes = run(RESULT, request_of([PLACE, Drag(point=20, to=(0.5, -0.1, 0.004))]), '--draws',
                              1, '--output', folder, '--json')
    assert code == 0 and str(folder) in notes
    assert sorted(path.name for path in folder.iterdir()) == [
        'simulation.json', 'trial_1.gif', 'trial_1.png',
        *(f'trial_1_after_{k}.{kind}' for k in (1, 2) for kind in ('csv', 'xml'))]
    assert json.loads((folder / 'simulation.json').read_text()) == json.loads(output)
    for k in (1, 2):
        for kind in ('csv', 'xml'):
            np.testing.assert_array_equal(read_chain_file(folder / f'trial_1_after_{k}.{kind}').points,
                                          json.loads(output)['actions'][k - 1]['predicted'])
    with Image.open(folder / 'trial_1.gif') as film:
        assert film.n_frames >= 4
    colours = np.asarray(Image.open(folder / 'trial_1.png').convert('RGB')).reshape(-1, 3)
    assert colours.std() > 10


def test_a_recorded_session_is_simulated_where_its_hands_were(run):
    code, output, _ = run(RESULT, SAMPLES / 'object1', '--json', '--draws', 0)
    printed = json.loads(output)['actions']
    assert code == 0
    assert [trial['trial'] for trial in printed] == [f'trial {k}' for k in range(1, 5)]
    assert [trial['held_by'] for trial in printed] == [[], [], ['left_hand'], ['left_hand', 'right_hand']]


@pytest.mark.parametrize(('words', 'what'), [
    (['--draws', '-1'], '--draws: -1; expected 0 to 10000'),
    (['--seed', '-1'], '--seed: -1'),
    (['--nodes', '1'], 'nodes: 1'),
    (['--pictures', '5'], 'unrecognized arguments: --pictures'),
])
def test_bad_flags_are_refused_in_one_line(run, request_of, words, what):
    code, output, notes = run(RESULT, request_of([PLACE]), *words)
    assert (code, output) == (2, '') and what in notes and notes.count('\n') == 1


@pytest.mark.parametrize(('actions', 'what'), [
    ([Drag(point=30, to=(0.1, 0.1, 0.0))], "trial 'one', action drag: point 30; expected -21 to 20"),
    ([Release()], "trial 'one', action release: hand 'left_hand', which holds nothing"),
    ([Action((Hand('h', (0,), [0.0, 1e9], [[0, 0, 0], [0, 0, 1]]),))], 'divide its path'),
])
def test_impossible_actions_are_refused_with_their_trial(run, request_of, actions, what):
    code, output, notes = run(RESULT, request_of(actions))
    assert (code, output) == (2, '') and what in notes and notes.count('\n') == 1


def test_a_session_without_actions_is_refused_in_one_line(run, request_of, tmp_path):
    path = request_of([PLACE])
    bad = tmp_path / 'bad.xml'
    for result, asked, what in ((tmp_path / 'no.xml', path, 'no.xml'), (path, path, '<dlo>'),
                                (RESULT, RESULT, '<calibration_request>'), (RESULT, tmp_path, str(tmp_path))):
        code, output, notes = run(result, asked)
        assert (code, output) == (2, '') and what in notes and notes.count('\n') == 1
    bad.write_text(path.read_text().replace('<grasp_and_place', '<grab'))
    code, _, notes = run(RESULT, bad)
    assert code == 2 and 'grab' in notes
    bad.write_text('\n'.join(line for line in path.read_text().splitlines() if 'grasp_' not in line))
    code, _, notes = run(RESULT, bad)
    assert code == 2 and '<trial>' in notes and 'grasp_and_place' in notes


def test_a_chain_of_another_length_gives_a_warning(run, request_of):
    start = Chain(straight().points * (2, 1, 1))
    code, _, notes = run(RESULT, request_of([PLACE], start=start), '--draws', 0)
    assert code == 0 and f'its chain is {2 * LENGTH:g} m long, 99 % from the 0.602 m' in notes


def test_more_points_than_a_dlo_has_are_refused(run, request_of):
    path = request_of([PLACE], start=straight(1000))
    point = re.search('<point [^>]*/>', path.read_text())[0]
    path.write_text(path.read_text().replace(point, f'{point}{point}', 1))
    code, output, notes = run(RESULT, path)
    assert (code, output) == (2, '') and '1001 points; expected at most 1000; leave some' in notes


@pytest.mark.long
def test_many_points_and_any_name(run, request_of, tmp_path, monkeypatch):
    few_frames(monkeypatch)
    path = request_of([PLACE], start=straight(500), name='../$_{\u202e[red]')
    code, output, _ = run(RESULT, path, '--draws', 1, '--output', tmp_path / 'out')
    assert code == 0 and '\\u202e[red]' in output
    assert len(read_chain_file(tmp_path / 'out/trial_1_after_1.csv')) == 500
    assert not list(tmp_path.glob('*.png'))


@pytest.mark.pybullet
def test_without_a_screen_the_window_is_one_clear_error(run, request_of, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    code, output, notes = run(RESULT, request_of([PLACE]), '--draws', 0, '--gui')
    assert code == 2 and '1. grasp_and_place' in output
    assert 'no screen' in notes and '--output' in notes and notes.count('\n') == 1
