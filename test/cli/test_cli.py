# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: what it prints, where, and how it ends."""

import copy
import csv
import errno
import hashlib
import html
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from toy_command import one_worker
from toy_messages import session_messages, toy_trials, TRUTH, write_session
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration import stages
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import fit
from dlo_calibration.cli import main as cli
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session
from dlo_calibration.inference.slices import simulate_slices
from dlo_calibration.messages.codec import bag_types, GOAL, INITIAL
from dlo_calibration.model.parameters import PAPER_PARAMETERS
from dlo_calibration.workspace import folder as calibration_folder

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

FIT_KEYS = {
    'parameters', 'score', 'scores', 'mean_error_m', 'rms_error_m', 'max_error_m', 'mean_abs_error_m',
    'error_percent_of_length', 'trials', 'evaluations', 'simulations', 'seconds', 'engine', 'search', 'seed',
    'stop_reason', 'choice', 'warnings', 'confirmation', 'cross_validated_error_m', 'default_error_m',
    'noise_m', 'residual_std_m', 'correlations', 'undetermined', 'advice'}
PARAMETER_KEYS = {'value', 'std', 'lower', 'upper', 'physical_value', 'physical_lower', 'physical_upper',
                  'physical_unit', 'identifiable', 'verdict', 'note'}
PATIENCE = 60.0
TYPES = bag_types()


@pytest.fixture
def session(tmp_path):
    """Give a session of two trials in one file, recorded with options."""
    return write_session(tmp_path / 'recorded.mcap', session_messages(TYPES, 2), {'evaluations': 20})


@pytest.fixture
def run(capsys):
    """Give a function that returns exit code, stdout and stderr of a command with the toy."""
    def run(*words, toy=None):
        try:
            code = cli.main(one_worker(words), lambda options: toy or ToySimulator())
        except SystemExit as end:  # argparse
            code = end.code
        output, errors = capsys.readouterr()
        return code, output, errors

    return run


def only_json(output):
    """Return the one JSON document of an output, which holds finite numbers only."""
    def refuse(constant):
        raise AssertionError(constant)

    return json.loads(output, parse_constant=refuse)


@pytest.mark.long
def test_fit_prints_one_document_with_every_key(run, session):
    code, output, _ = run('fit', session, '--json')
    printed = only_json(output)
    assert code == 0
    assert set(printed) >= FIT_KEYS
    assert list(printed['parameters']) == list(PAPER_PARAMETERS)
    assert all(set(estimate) == PARAMETER_KEYS for estimate in printed['parameters'].values())
    assert (printed['trials'], printed['evaluations']) == (2, 20)
    assert printed['simulations'] > 40  # what was examined around the result counts
    assert (printed['engine'], printed['search'], printed['seed']) == ('toy', 'least_squares', 1)
    assert len(printed['scores']) == 2
    assert printed['score'] == pytest.approx(sum(printed['scores']) / 2)
    assert printed['mean_error_m'] <= printed['rms_error_m'] <= printed['max_error_m']
    assert printed['error_percent_of_length'] == pytest.approx(
        100 * printed['mean_error_m'], rel=0.01)  # of 1 m


def test_fit_gives_what_the_library_gives(run, session):
    printed = only_json(run('fit', session, '--json')[1])
    result = calibrate(toy_trials(2), Options.of({'evaluations': 20}), make_simulator=new_toy)
    values = {name: estimate['value'] for name, estimate in printed['parameters'].items()}
    assert values == pytest.approx(result.values)


def test_flags_come_before_recorded_options_and_say_so(run, session):
    code, output, errors = run('fit', session, '--json', '--evaluations', 5, '--seed', 9)
    assert code == 0
    assert (only_json(output)['evaluations'], only_json(output)['seed']) == (5, 9)
    assert 'evaluations: 5 instead of 20' in errors


@pytest.mark.long
def test_correlations_are_between_the_parameters_by_name(run, session):
    printed = only_json(run('fit', session, '--json', '--evaluations', 150)[1])
    names = list(PAPER_PARAMETERS)
    assert list(printed['correlations']) == names
    for name in names:
        assert list(printed['correlations'][name]) == names
        assert printed['correlations'][name][name] == pytest.approx(1)
        for other in names:
            assert printed['correlations'][name][other] == pytest.approx(printed['correlations'][other][name])


def test_every_key_of_the_document_is_documented():
    text = (Path(__file__).parents[2] / 'doc/messages.md').read_text(encoding='utf-8')
    assert {key for key in FIT_KEYS | PARAMETER_KEYS if f'`{key}`' not in text} == set()


def test_fit_for_people_has_both_units_and_says_what_is_not_identifiable(run, session):
    code, output, _ = run('fit', session, '--evaluations', 3, '--calibrate', 'flexibility', 'damping')
    assert code == 0
    for word in ('flexibility', 'N m^2', 'not identifiable', 'difference score', 'mean error'):
        assert word in output
    assert '\x1b' not in output  # no colours into a pipe


def test_fit_writes_result_session_and_report_that_repeat_it(run, tmp_path, monkeypatch):
    monkeypatch.setattr(stages, 'simulate_slices', simulate_slices)  # the page has its slices here
    session = write_session(tmp_path / 'recorded', session_messages(TYPES, 2), {'evaluations': 20})
    folder = tmp_path / 'new' / 'out'
    first = only_json(run('fit', session, '--json', '--output', folder, '--evaluations', 8)[1])
    assert {file.name for file in folder.iterdir()} == {
        'result.xml', 'session.mcap', 'report.html', 'evaluations.csv'}
    again = only_json(run('fit', folder / 'session.mcap', '--json', '--evaluations', 8)[1])
    assert again['parameters'] == first['parameters']
    report = (folder / 'report.html').read_text()
    assert report.count('seen from above: the measured and the simulated chain">') == 2
    assert 'Along flexibility' in report
    assert '--evaluations 8' in report
    assert not re.search('(src|href)="(?!#|data:)', report)  # it needs nothing else
    for file in (next(session.glob('*.mcap')), folder / 'session.mcap'):
        assert file.name in report
        assert hashlib.sha256(file.read_bytes()).hexdigest() in report
    with (folder / 'evaluations.csv').open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert [row['evaluation'] for row in rows] == [str(k) for k in range(1, 9)]
    best = min(rows, key=lambda row: float(row['score']))
    assert float(best['score']) == first['score']
    assert float(best['friction']) == first['parameters']['friction']['value']


def test_fit_prints_its_result_though_the_disk_is_full(run, session, tmp_path, monkeypatch):
    def full(*_):
        raise InputError('file result.xml', 'No space left on device', 'room for it', 'make room')

    monkeypatch.setattr(calibration_folder, 'write_result', full)
    code, output, errors = run('fit', session, '--json', '--output', tmp_path / 'out', '--evaluations', 3)
    assert code == 2
    assert 'No space left on device' in errors
    assert only_json(output)['evaluations'] == 3


@pytest.mark.long
def test_a_file_that_cannot_be_written_costs_no_other_and_no_older_one(run, session, tmp_path, monkeypatch):
    folder = tmp_path / 'out'
    assert run('fit', session, '--output', folder, '--evaluations', 2)[0] == 0
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    (folder / 'evaluations.csv').unlink()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(shutil, 'copyfile', full)
        patch.setattr('dlo_calibration.files.result.csv.writer', full)
        code, output, errors = run('fit', session, '--json', '--output', folder, '--evaluations', 3)
    assert code == 2
    assert only_json(output)['evaluations'] == 3
    last = errors.splitlines()[-1]
    assert 'evaluations.csv, session.mcap (an older one is there): No space left on device' in last
    assert 'result.xml, report.html could be' in last
    assert read_result(folder / 'result.xml').evaluations == 3
    assert (folder / 'session.mcap').read_bytes() == before['session.mcap']
    assert {file.name for file in folder.iterdir()} == {'result.xml', 'session.mcap', 'report.html'}


def test_an_interrupt_before_the_first_evaluation_leaves_no_files(run, session, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(fit, 'calibrate', interrupted)
    code, _, errors = run('fit', session, '--output', tmp_path / 'out')
    assert (code, errors) == (130, 'dlo-calibration: interrupted\n')
    assert [path for path in (tmp_path / 'out').iterdir() if path.suffix != '.mcap'] == []


@pytest.mark.long
def test_validate_simulates_the_result_and_fits_nothing(run, session, tmp_path):
    fitted = only_json(run('fit', session, '--json', '--output', tmp_path / 'out')[1])
    code, output, _ = run('validate', tmp_path / 'out' / 'result.xml', session, '--json')
    printed = only_json(output)
    assert code == 0
    assert set(printed) >= FIT_KEYS
    assert printed['parameters'] == fitted['parameters']
    assert (printed['score'], printed['scores']) == (fitted['score'], fitted['scores'])
    assert printed['mean_error_m'] == fitted['mean_error_m']
    assert (printed['evaluations'], printed['simulations']) == (1, 2)


@pytest.mark.long
def test_check_says_that_the_same_session_agrees(run, session, tmp_path):
    run('fit', session, '--output', tmp_path / 'out')
    code, output, _ = run('check', tmp_path / 'out' / 'result.xml', session, '--json')
    printed = only_json(output)
    assert code == 0
    assert printed['verdict'] in ('agrees', 'cannot tell')
    assert 0 < printed['probability_of_agreement'] <= 1
    assert set(printed['parameters']['flexibility']) >= {'value', 'change', 'lower', 'upper', 'changed'}
    assert printed['mean_error_m'] >= 0
    _, words, warnings = run('check', tmp_path / 'out' / 'result.xml', session)
    assert words.startswith(('Agrees.', 'Cannot tell.'))
    assert 'one from which the result was found' in warnings


def test_validate_on_another_session_uses_the_results_parameters(run, session, tmp_path):
    run('fit', session, '--output', tmp_path / 'out')
    other = write_session(tmp_path / 'other.mcap', session_messages(TYPES, 1, first=4), {'seed': 5})
    printed = only_json(run('validate', tmp_path / 'out' / 'result.xml', other, '--json')[1])
    assert printed['trials'] == 1
    assert printed['seed'] == 1


def test_info_shows_the_content_of_a_session(run, session):
    code, output, _ = run('info', session, '--json')
    printed = only_json(output)
    assert code == 0
    assert [trial['name'] for trial in printed['trials']] == ['trial 1', 'trial 2']
    trial = printed['trials'][0]
    assert (trial['points'], trial['stable_goals'], trial['timed_goals']) == (11, 1, 0)
    assert trial['length_m'] == pytest.approx(1.0)
    assert [hand['name'] for hand in trial['hands']] == ['left_hand']
    assert printed['frames'] == ['world']
    assert printed['refusals'] == printed['problems'] == []
    assert printed['calibrate'] == list(PAPER_PARAMETERS)
    for_people = run('info', session)[1]
    assert 'left_hand' in for_people
    assert 'Calibrated' not in for_people and 'evaluations 20' in for_people


def test_info_says_how_many_chains_a_goal_averages(run, tmp_path):
    messages = session_messages(TYPES, 1)
    (_, goal), = (pair for pair in messages if pair[0] == GOAL)
    later = []
    for k in range(1, 40):
        copied = copy.deepcopy(goal)
        copied.header.stamp.sec += k
        later.append((GOAL, copied))
    code, output, _ = run('info', write_session(tmp_path / 'stream.mcap', [*messages, *later]), '--json')
    trial, = only_json(output)['trials']
    assert (code, trial['stable_goals'], trial['timed_goals']) == (0, 1, 0)
    assert trial['averaged_chains'] > 5
    assert f"mean of {trial['averaged_chains']}" in run('info', tmp_path / 'stream.mcap')[1]


@pytest.mark.long
def test_the_goals_of_a_tracker_that_is_on_already_are_a_note_and_no_refusal(run, session, tmp_path):
    messages = session_messages(TYPES, 2)
    (_, goal), *_ = (pair for pair in messages if pair[0] == GOAL)
    earlier = []
    for k in range(5):
        copied = copy.deepcopy(goal)
        copied.header.stamp.sec -= 40 - k
        earlier.append((GOAL, copied))
    path = write_session(tmp_path / 'stream.mcap', [*earlier, *messages])
    printed, note = only_json(run('info', path, '--json')[1]), 'came before the first initial chain; not used'
    assert (len(printed['trials']), printed['refusals'], printed['problems']) == (2, [], [])
    assert [text.endswith(f'and 4 more: {note}') for text in printed['notes']] == [True]
    assert re.search(f'note: goal_chain .* and 4 more: {note}', ' '.join(run('info', path)[1].split()))
    run('fit', session, '--output', tmp_path / 'out')
    errors = run('validate', tmp_path / 'out/result.xml', path)[2]
    assert note in errors and 'send the chain before' not in errors


def test_info_shows_the_warnings_about_a_session(run, tmp_path):
    pairs = session_messages(TYPES, 2)
    pairs[5][1].header.frame_id = 'camera'
    path = write_session(tmp_path / 'wrong.mcap', pairs)
    code, output, _ = run('info', path, '--json')
    printed = only_json(output)
    assert code == 0
    assert len(printed['trials']) == 1
    assert any('camera' in text for text in printed['refusals'])
    assert 'camera' in run('fit', path, '--json', '--evaluations', 2)[2]


def test_session_without_complete_trial_is_refused_by_fit_and_described_by_info(run, tmp_path):
    path = write_session(tmp_path / 'half.mcap', session_messages(TYPES, 1)[:1])
    assert run('info', path)[0] == 0
    code, output, errors = run('fit', path, '--json')
    assert (code, output) == (2, '')
    assert 'no complete trial' in errors


@pytest.mark.parametrize('words', [
    [], ['paint'], ['fit'], ['fit', 'SESSION', '--masss', '1'], ['fit', 'SESSION', '--mass', 'heavy'],
    ['fit', 'SESSION', '--mass', '-1'], ['fit', 'SESSION', '--search', 'magic'],
    ['fit', 'SESSION', '--calibrate', 'colour'], ['fit', 'SESSION', '--calibrate', 'friction,friction'],
    ['fit', 'SESSION', '--evaluations', '-1'], ['fit', 'nowhere'], ['info', 'nowhere'], ['info', 'TEXT'],
    ['validate', 'nowhere', 'SESSION'], ['check', 'TEXT', 'SESSION'], ['validate', 'TEXT', 'SESSION'],
    ['fit', 'SESSION', '--output', 'TEXT'], ['fit', 'SESSION', '--eval', '3'],
], ids=' '.join)
@pytest.mark.parametrize('as_json', [False, True], ids=['', 'json'])
def test_unusable_input_ends_with_one_line_and_exit_code_2(run, session, tmp_path, words, as_json):
    text = tmp_path / 'text'
    text.write_text('nothing of ours')
    names = {'SESSION': session, 'TEXT': text}
    code, output, errors = run(*(names.get(word, word) for word in words), *(['--json'] if as_json else []))
    assert (code, output) == (2, '')
    assert len(errors.splitlines()) == 1
    assert errors.startswith('dlo-calibration')


def test_trials_that_cannot_be_simulated_end_with_one_line(run, session):
    code, output, errors = run('fit', session, '--json', toy=ToySimulator(fail_below=101))
    assert (code, output) == (2, '')
    assert 'diverged' in errors


def test_every_option_is_a_flag_with_either_hyphen(run, session):
    flat = Options().flat()
    for hyphen in '_-':
        words = []
        for declaration in Options.declarations():
            if declaration.choices or declaration.name in ('evaluations', 'output_directory'):
                continue
            name, value = declaration.name.replace('_', hyphen), flat[declaration.name]
            if isinstance(value, bool):
                words.append(f'--{name}' if value else f'--no-{name}')
            else:
                words += [f'--{name}', value]
        code, _, errors = run('info', session, *words)
        assert code == 0, errors


def test_lists_are_given_as_words_or_with_commas(run, session):
    for words in (['flexibility', 'friction'], ['flexibility,friction']):
        printed = only_json(run('fit', session, '--json', '--calibrate', *words)[1])
        assert list(printed['parameters']) == ['flexibility', 'friction']


def test_an_option_that_is_no_parameter_of_the_search_stays_at_its_value(run, session):
    flags = [f for name in ('elasticity', 'friction', 'self_collision') for f in (f'--{name}', TRUTH[name])]
    flags += ['--calibrate', 'flexibility', '--evaluations', 200]
    printed = only_json(run('fit', session, '--json', *flags)[1])
    assert printed['parameters']['flexibility']['value'] == pytest.approx(TRUTH['flexibility'], abs=1)


@pytest.mark.long
def test_stiffness_is_per_weight_unless_the_mass_is_given(run, session):
    def unit(*flags):
        printed = only_json(run('fit', session, '--json', *flags)[1])
        return printed['parameters']['flexibility']['physical_unit']

    assert unit() == 'N m^2 per N/m'
    assert unit('--mass', '0.05') == 'N m^2'


PROGRAM = """
import pathlib, sys, threading
from without_drawings import leave_out_drawings, leave_out_slices
from toy_simulator import Stoppable, ToySimulator
from dlo_calibration.cli import main as cli
from dlo_calibration.report import terminal

class Bar(terminal.SearchBar):
    def take(self, evaluation):
        super().take(evaluation)
        pathlib.Path(sys.argv[2]).touch()

terminal.SearchBar = Bar
leave_out_drawings()
leave_out_slices()
toy = Stoppable() if sys.argv[1] == 'for ever' else ToySimulator(0.01)

def tell():
    toy.begun.wait()
    pathlib.Path(sys.argv[2]).touch()

if sys.argv[1] == 'for ever':
    threading.Thread(target=tell, daemon=True).start()
sys.exit(cli.main(sys.argv[3:], lambda options: toy))
"""


@pytest.mark.parametrize(('workers', 'rollout', 'code'), [
    pytest.param(1, 'short', 0, marks=pytest.mark.long), (2, 'short', 0),
    pytest.param(2, 'for ever', 130, marks=pytest.mark.long)])
def test_interrupt_gives_the_best_so_far_or_nothing(session, tmp_path, workers, rollout, code):
    evaluated = tmp_path / 'evaluated'
    process = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, rollout, str(evaluated), 'fit', str(session), '--json',
         '--search', 'random', '--evaluations', '100000', '--workers', str(workers),
         '--output', str(tmp_path / 'out')],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    begun = time.monotonic()
    while not evaluated.exists():
        assert time.monotonic() - begun < PATIENCE and process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == code, errors
    assert 'Traceback' not in errors
    if code:
        assert output == ''
    else:
        assert only_json(output)['stop_reason'] == 'stopped on request'
        assert read_session(tmp_path / 'out' / 'session.mcap').messages[0][0] == INITIAL


def test_module_is_the_command(session):
    done = subprocess.run(
        [sys.executable, '-m', 'dlo_calibration', 'info', str(session), '--json'],
        capture_output=True, text=True, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    assert done.returncode == 0
    assert done.stderr == ''
    assert len(only_json(done.stdout)['trials']) == 2


@pytest.mark.long
def test_output_folder_may_be_that_of_the_session(run, session, tmp_path):
    copy = tmp_path / 'out' / 'session.mcap'
    run('fit', session, '--output', tmp_path / 'out')
    before = copy.read_bytes()
    assert run('fit', copy, '--output', tmp_path / 'out')[0] == 0
    assert Path(copy).read_bytes() == before


SCENE = ('<robot name="box"><link name="box"><collision><origin xyz="5 0 0"/><geometry>'
         '<box size="1 1 1"/></geometry></collision></link></robot>')


@pytest.mark.long
@pytest.mark.pybullet
def test_a_session_with_a_scene_is_repeated_with_it(tmp_path, monkeypatch, capsys):
    """The scene is found in the session's folder, from anywhere, and named in the report."""
    monkeypatch.chdir(tmp_path)
    session = write_session(tmp_path / 'recorded', session_messages(TYPES, 1),
                            {'scene': 'my scene.urdf', 'calibrate': ['flexibility'], 'evaluations': 2,
                             'settle_limit': 0.2, 'nodes': 8, 'time_step': 0.01})
    scene = session / 'my scene.urdf'
    scene.write_text(SCENE, encoding='utf-8')
    documents = []
    for words in ([str(session), '--output', 'out'], ['out/session.mcap', '--scene', str(scene)]):
        assert cli.main(['fit', *words, '--workers', '1', '--json']) == 0
        documents.append(json.loads(capsys.readouterr().out))
    first, again = ({key: value for key, value in document.items() if key != 'seconds'}
                    for document in documents)
    assert first == again
    assert (first['engine'], first['confirmation']['engine']) == ('compiled', 'bullet')
    assert read_result('out/result.xml').file_options.refusal is not None  # not in its folder
    assert f"--scene '{scene}'" in html.unescape(Path('out/report.html').read_text(encoding='utf-8'))
    assert cli.main(['validate', 'out/result.xml', str(session), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['score'] == first['score']
    scene.unlink()
    assert cli.main(['fit', str(session)]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith('dlo-calibration: recorded scene my scene.urdf: no such file ')
    assert 'give it with --scene' in error


def test_a_mesh_that_is_not_closed_ends_with_one_line(session, tmp_path, capsys):
    (tmp_path / 'mesh.obj').write_text('v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n', encoding='utf-8')
    scene = tmp_path / 'mesh.urdf'
    scene.write_text('<robot name="m"><link name="m"><collision><geometry><mesh filename="mesh.obj"/>'
                     '</geometry></collision></link></robot>', encoding='utf-8')
    assert cli.main(['fit', str(session), '--scene', str(scene)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        'dlo-calibration: scene: a mesh that is not closed: 3 of 3 edges are open; expected closed meshes; '
        'close it in the program that made it, or use engine bullet')
