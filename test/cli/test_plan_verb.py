# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `plan`: what it prints and writes, how it is stopped, and what it refuses."""

import json
import os
import signal

from made_up_dlo import made_up_plan, straight
import numpy as np
from PIL import Image
import pytest

from dlo_calibration import Chain, Options, read_result
from dlo_calibration.cli import main as cli
from dlo_calibration.files.chain_file import read_chain_file, write_chain
from dlo_calibration.files.request import read_request, request_manipulations
from dlo_calibration.files.session import samples
from dlo_calibration.model.named_actions import GraspAndPlace
from dlo_calibration.planning.prediction import simulate
from dlo_calibration.writing import whole

ROPE = samples() / 'xml/dlo.xml'
MOVE = GraspAndPlace(start=0.0, point=2, to=(0.1, 0.12, 0.004), hand='hand_1')


@pytest.fixture(autouse=True)
def few_frames(monkeypatch):
    monkeypatch.setattr('dlo_calibration.simulation.motion.FRAME_RATE', 1)
    monkeypatch.setattr('dlo_calibration.report.animation.FRAME_RATE', 1)
    monkeypatch.setattr('dlo_calibration.report.animation.DOTS_PER_INCH', 40)


@pytest.fixture
def chains(tmp_path):
    """Give the arguments that name a start and a goal, which one move nearly makes."""
    goal, = simulate(read_result(ROPE), straight(), [MOVE], draws=0).steps
    write_chain(tmp_path / 'start.csv', straight())
    write_chain(tmp_path / 'goal.xml', Chain(goal.chain))
    return '--from', tmp_path / 'start.csv', '--to', tmp_path / 'goal.xml'


@pytest.fixture
def run(capsys):
    """Give a function that returns exit code, stdout and stderr of a command."""
    def run(*words):
        try:
            code = cli.main([str(word) for word in words])
        except SystemExit as end:  # argparse
            code = end.code
        return code, *capsys.readouterr()

    return run


def drawn(plan, *words, **_):
    """Stand for drawing a plan to a file, the last of the words."""
    with whole(words[-1]) as new:
        new.touch()


@pytest.fixture
def planned(monkeypatch):
    """Give a function that lets the verb find a made-up plan; it returns what the verb asks for."""
    def planned(during=lambda: None, **changes):
        asked = []

        def plan(*words, **rest):
            asked.append((*words, rest))
            during()
            return made_up_plan(**changes)

        monkeypatch.setattr('dlo_calibration.cli.plan.plan', plan)
        for name in ('write_plan_picture', 'write_plan_animation'):  # they have tests of their own
            monkeypatch.setattr(f'dlo_calibration.report.plan_drawing.{name}', drawn)
        return asked

    return planned


def test_a_plan_is_found_and_its_files_lead_to_the_goal(run, chains, tmp_path):
    folder = tmp_path / 'out'
    code, output, notes = run('plan', ROPE, *chains, '--actions', 1, '--draws', 2, '--tolerance', 2,
                              '--kinds', 'grasp_and_place', '--workers', 1, '--output', folder, '--json')
    assert code == 0, notes
    printed = json.loads(output)
    assert json.loads((folder / 'plan.json').read_text()) == printed
    assert printed['reached'] and printed['error_after_m'] < 0.012 < printed['error_before_m']
    step, = printed['actions']
    assert step['name'] == 'grasp_and_place'
    assert step['least_bend_radius_m'] > 0.02 and 0 < step['most_tension_n'] < 1
    assert 0 < step['most_tension_at_m'] < 0.6 and 0 < step['most_strain'] < 0.01
    assert step['hands'][0]['name'] == 'hand_1' and step['hands'][0]['waypoints'][0][0] == 0
    assert set(printed) >= {
        'score_after', 'rollouts', 'seconds', 'stop_reason', 'error_after_percent_of_length'}
    assert sorted(file.name for file in folder.iterdir()) == [
        'after_1.csv', 'plan.gif', 'plan.json', 'plan.png', 'plan.xml']
    description = read_result(ROPE)
    planned, = request_manipulations(read_request(folder / 'plan.xml'), Options())
    ends = simulate(description, planned.start, [action for step in planned.steps for action in step.actions],
                    options=description.file_options.options(), draws=0).steps
    assert np.allclose(ends[-1].chain, read_chain_file(folder / 'after_1.csv').points, atol=1e-4)
    assert np.allclose(ends[-1].chain, step['predicted'], atol=1e-4)
    assert Image.open(folder / 'plan.gif').n_frames > 1


def test_each_action_is_described_and_whether_the_goal_is_reached(run, chains, planned):
    planned(warnings=('The goal is longer than the DLO.',))
    code, output, _ = run('plan', ROPE, *chains)
    assert code == 0
    text = ' '.join(output.split())
    assert '1. grasp_and_place: hand_1 grips at 0.35 of the length, lifts 5 cm, carries it to' in text
    assert ('from the goal on average. It bends to a radius of 50 mm at 0.35 of the length, and bears up to '
            '1.5 N at 1.00 of the length, a strain of 1 %. 2. drag:') in text
    assert 'The goal is not reached: with 2 actions' in text
    assert text.endswith('The goal is longer than the DLO.')


@pytest.mark.long
def test_a_plan_around_the_posts_of_a_scene_says_what_the_hand_passes_and_names_the_scene(run, tmp_path):
    samples = ROPE.parents[1] / 'chains'
    code, output, notes = run(
        'plan', ROPE, '--from', samples / 'start.csv', '--to', samples / 'around_posts.csv', '--scene',
        samples / 'posts.urdf', '--draws', 0, '--workers', 1, '--output', tmp_path)
    assert code == 0, notes
    assert 'past (' in output and 'The goal is reached' in output
    assert 'scene' in str(read_request(tmp_path / 'plan.xml').file_options.refusal)  # of another folder
    assert (tmp_path / 'plan.png').is_file()


@pytest.mark.parametrize(('flags', 'words'), [
    (('--least-bend-radius', 5), 'bent more sharply than least_bend_radius, 5000 mm'),
    (('--most-tension', 0.001), 'pulled harder than most_tension, 0.001 N')])
def test_a_limit_that_no_action_keeps_to_is_named(run, chains, flags, words):
    code, output, _ = run('plan', ROPE, *chains, '--actions', 1, '--draws', 2, *flags, '--json')
    printed = json.loads(output)
    assert code == 0 and not printed['reached'] and printed['actions'] == []
    assert any(words in remark for remark in printed['remarks'])


def test_flags_are_the_options_of_the_plan_and_of_the_simulation(run, chains, planned):
    asked = planned()
    assert run('plan', ROPE, *chains, '--hands', 2, '--seed', 7, '--no-go', '0 0 0 1 1 1',
               '--nodes', 25)[0] == 0
    (calls, start, goal, options, rest), = asked
    assert (calls.length, len(start), len(goal)) == (read_result(ROPE).length, 21, 21)
    assert (options.hands, options.seed, options.no_go) == (2, 7, ('0 0 0 1 1 1',))
    of_result = read_result(ROPE).file_options.options()
    assert rest['simulation'].nodes == 25 != of_result.nodes
    assert rest['simulation'].time_step == of_result.time_step


def test_files_of_an_older_plan_with_more_actions_do_not_stay(run, chains, planned, tmp_path):
    planned()
    run('plan', ROPE, *chains, '--output', tmp_path / 'out')
    assert (tmp_path / 'out' / 'after_2.csv').is_file()
    (tmp_path / 'out' / 'notes.txt').write_text('mine')
    planned(actions=0)
    assert run('plan', ROPE, *chains, '--output', tmp_path / 'out')[0] == 0
    assert {file.name for file in (tmp_path / 'out').iterdir()} == {'notes.txt', 'plan.json', 'plan.png'}


def test_a_file_that_cannot_be_written_prevents_no_other_and_no_output(run, chains, planned, tmp_path):
    planned()
    (tmp_path / 'out' / 'plan.png').mkdir(parents=True)
    code, output, errors = run('plan', ROPE, *chains, '--output', tmp_path / 'out', '--json')
    assert code == 2
    assert len(json.loads(output)['actions']) == 2
    assert 'could not be written: plan.png' in errors.splitlines()[-1]
    assert (tmp_path / 'out' / 'plan.gif').is_file()


def test_the_plan_is_printed_before_the_drawings(run, chains, planned, tmp_path, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt(130)

    planned()
    monkeypatch.setattr('dlo_calibration.report.plan_drawing.write_plan_picture', stopped)
    code, output, _ = run('plan', ROPE, *chains, '--output', tmp_path / 'out', '--json')
    assert code == 130
    assert len(json.loads(output)['actions']) == 2
    assert {'plan.json', 'plan.xml', 'after_2.csv'} <= {file.name for file in (tmp_path / 'out').iterdir()}


@pytest.mark.parametrize('actions, code', [(2, 0), (0, 130)])
def test_a_plan_that_is_stopped_is_the_best_so_far(run, chains, planned, actions, code):
    asked = planned(lambda: os.kill(os.getpid(), signal.SIGINT), actions=actions)
    printed, output, _ = run('plan', ROPE, *chains)
    assert printed == code
    assert ('with 2 actions' in output) == (actions == 2)
    assert asked[0][-1]['should_stop']()


def test_the_document_has_null_for_unknown_numbers(run, chains, planned):
    planned(score_after=float('nan'))
    assert json.loads(run('plan', ROPE, *chains, '--json')[1])['score_after'] is None


@pytest.mark.parametrize('text, words', [
    ('0,0,0\n0.3,nan,0\n0.6,0,0\n', 'NaN'),
    ('0,0\n', 'a row x,y,z'),
    ('0,0,0\n', 'at least 3'),
    ('0,0,0.004\n300,0,0.004\n600,0,0.004\n', 'length'),
    ('0,0,0.5\n0.3,0,0.5\n0.6,0,0.5\n', 'above the table'),
])
def test_an_impossible_goal_is_refused_in_a_sentence(run, chains, tmp_path, text, words):
    (tmp_path / 'bad.csv').write_text(text)
    code, output, errors = run('plan', ROPE, *chains[:3], tmp_path / 'bad.csv', '--workers', 1,
                               '--output', tmp_path / 'out')
    assert (code, output) == (2, '')
    assert words in errors.splitlines()[-1]
    assert len([line for line in errors.splitlines() if line.startswith('dlo-calibration: ')]) == 1
    assert not list(tmp_path.glob('out/*'))


@pytest.mark.parametrize('words, complaint', [
    (('--hands', '3'), 'parameter hands: 3'),
    (('--reach-1', 'ball 1'), 'reach_1'),
    (('--picture', '1'), 'unrecognized arguments: --picture'),
])
def test_a_flag_that_cannot_be_used_is_refused_in_a_sentence(run, chains, words, complaint):
    code, output, errors = run('plan', ROPE, *chains, *words)
    assert (code, output) == (2, '')
    line, = errors.splitlines()
    assert complaint in line


def test_a_file_that_is_no_result_is_refused_in_a_sentence(run, chains, tmp_path):
    code, _, errors = run('plan', tmp_path / 'none.xml', *chains)
    assert code == 2
    assert 'none.xml' in errors and len(errors.splitlines()) == 1
