# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""`fit --resume`: what a killed `fit --output` leaves, and how it goes on."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys

import killed_command
import pytest
from toy_command import one_worker
from toy_messages import session_messages, write_session
from toy_simulator import CountingToy

from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.workspace.folder import EVALUATIONS, REPORT, REQUEST, RESULT, SESSION

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

FLAGS = ('--calibrate', 'flexibility', 'friction', '--evaluations', '25', '--seed', '3')
FINISHED = {RESULT, SESSION, REPORT, EVALUATIONS}


@pytest.fixture
def session(tmp_path):
    """Give a session of two trials, recorded with options."""
    return write_session(tmp_path / 'recorded.mcap', session_messages(bag_types(), 2),
                         {'workers': 1, 'nodes': 31})


@pytest.fixture
def act(capsys):
    """Give a function that executes a verb: its code, its output and errors, and its engine."""
    def act(*words, toy=None):
        toy = toy or CountingToy()
        code = cli.main(one_worker(words), lambda _: toy)
        return code, *capsys.readouterr(), toy

    return act


class Killed(BaseException):
    """Stands for kill -9, where a process of its own would take too long."""


def die():
    raise Killed


@pytest.fixture
def abandon(act):
    """Give a function that executes a verb up to a simulation, at which it is abandoned."""
    def abandon(simulation, *words):
        with pytest.raises(Killed):
            act(*words, toy=CountingToy(last=simulation, die=die))

    return abandon


def killed(simulation, *words):
    """Execute a verb in a process that is killed at a simulation."""
    done = subprocess.run(
        [sys.executable, killed_command.__file__, str(simulation), *one_worker(words)],
        capture_output=True, text=True, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    assert done.returncode == -signal.SIGKILL, done.stderr


def names(folder):
    return {path.name for path in folder.iterdir()}


def content(folder):
    """Return what a folder tells, without the time that it took."""
    result = (folder / RESULT).read_text(encoding='utf-8')
    seconds = f'seconds="{read_result(folder / RESULT).seconds!r}"'
    assert seconds in result
    return [result.replace(seconds, ''), *((folder / name).read_bytes() for name in (
        SESSION, EVALUATIONS))]


@pytest.mark.long
def test_a_killed_fit_goes_on_to_the_same_files(session, tmp_path, act):
    code, _, _, whole = act('fit', session, '--output', tmp_path / 'whole', *FLAGS)
    assert code == 0
    out = tmp_path / 'out'
    killed(30, 'fit', session, '--output', out, *FLAGS)
    assert 'unfinished' in names(out)
    code, output, errors, toy = act('fit', '--resume', out)
    assert code == 0
    assert 'goes on after ' in errors
    assert toy.count <= whole.count - 29 + 1  # the kill costs at most the first trial of an evaluation
    assert content(out) == content(tmp_path / 'whole')
    assert names(out) == FINISHED
    code, output, errors, toy = act('fit', '--resume', out)
    assert (code, output, toy.count) == (0, '', 0)
    said = f'nothing to resume: the calibration is finished, and its result is {out / RESULT}\n'
    assert errors == said
    code, output, errors, toy = act('fit', '--resume', out, '--json')
    assert (code, errors, toy.count) == (0, said, 2)  # the trials once, and no search
    files, file = json.loads(output), read_result(out / RESULT)
    assert {name: estimate['value'] for name, estimate in files['parameters'].items()} == file.values
    assert (files['score'], files['evaluations'], files['seconds']) == (file.score, 25, file.seconds)
    assert (files['stop_reason'], files['warnings']) == (file.stop_reason, list(file.warnings))


def test_the_same_command_goes_on_and_another_calibration_is_not_lost(session, tmp_path, act, abandon):
    out = tmp_path / 'out'
    abandon(30, 'fit', session, '--output', out, *FLAGS)
    code, _, errors, _ = act('fit', session, '--output', out, *FLAGS, '--seed', 4)
    assert code == 2
    assert errors.splitlines()[-1].startswith(f'dlo-calibration: folder {out}: 14 evaluations of another')
    code, _, errors, toy = act('fit', session, '--output', out, *FLAGS)
    assert code == 0
    assert 'goes on after 14 evaluations of an interrupted calibration' in errors
    assert names(out) == FINISHED


@pytest.mark.parametrize('words, part', [
    (('--seed', 4), 'option seed beside --resume: 4; expected 3, as at the beginning; leave it out'),
    (('--nodes', 21), 'option nodes beside --resume: 21; expected 31'),
    (('--output', 'x'), 'argument --output: not allowed with argument --resume')])
def test_other_options_are_refused_and_those_of_the_machine_are_not(words, part, session, tmp_path, act,
                                                                     abandon, capsys):
    out = tmp_path / 'out'
    abandon(10, 'fit', session, '--output', out, *FLAGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        try:
            code, _, errors, _ = act('fit', '--resume', out, *words)
        except SystemExit as end:
            code, errors = end.code, capsys.readouterr().err
    assert code == 2
    assert part in errors
    assert act('fit', '--resume', out, '--record', '--seed', 3)[0] == 0
    assert names(out) == FINISHED


@pytest.mark.long
def test_a_session_that_is_named_again_must_have_the_same_trials(session, tmp_path, act, abandon):
    out = tmp_path / 'out'
    abandon(10, 'fit', session, '--output', out, *FLAGS)
    other = write_session(tmp_path / 'other.mcap', session_messages(bag_types(), 1), {'workers': 1})
    code, _, errors, _ = act('fit', other, '--resume', out)
    assert code == 2
    assert 'of another calibration' in errors
    assert act('fit', session, '--resume', out)[0] == 0


@pytest.mark.parametrize('damage', [
    b'', b'\0' * 5000, b'calibration AAAA e30= 0000\n', b'x' * 10**6])
def test_a_log_that_is_no_log_is_refused_in_one_line(damage, session, tmp_path, act, abandon):
    out = tmp_path / 'out'
    abandon(10, 'fit', session, '--output', out, *FLAGS)
    log = out / 'unfinished' / 'evaluations.log'
    before = log.read_bytes()
    log.write_bytes(damage)
    code, _, errors, _ = act('fit', '--resume', out)
    assert code == 2
    assert errors.startswith('dlo-calibration: log ')
    assert ': no calibration; expected a log that ' in errors
    assert errors.endswith(', with the options of the beginning\n')
    assert errors.count('\n') == 1
    log.write_bytes(before)
    assert act('fit', '--resume', out)[0] == 0


def test_without_its_first_line_the_same_command_still_uses_the_evaluations(session, tmp_path, act, abandon):
    out = tmp_path / 'out'
    abandon(30, 'fit', session, '--output', out, *FLAGS)
    log = out / 'unfinished' / 'evaluations.log'
    log.write_bytes(b'x' + log.read_bytes())
    code, _, errors, _ = act('fit', session, '--output', out, *FLAGS)
    assert code == 0
    assert 'goes on after 14 evaluations' in errors


def test_an_empty_folder_or_no_session_is_refused_in_one_line(tmp_path, act):
    assert act('fit', '--resume', tmp_path)[:3] == (2, '', (
        f'dlo-calibration: folder {tmp_path}: no interrupted calibration; expected one that fit --output '
        'began; check the folder, or begin with fit SESSION --output\n'))
    assert act('fit')[:3] == (2, '', 'dlo-calibration: fit: no SESSION; expected a session or a request; '
                              'name it, or --resume DIR\n')


@pytest.mark.long
def test_ctrl_c_gives_a_result_and_keeps_what_is_needed_to_go_on(session, tmp_path, act):
    whole = act('fit', session, '--output', tmp_path / 'whole', *FLAGS)
    out = tmp_path / 'out'
    toy = CountingToy(last=20, die=lambda: signal.raise_signal(signal.SIGINT))
    code, output, errors, _ = act('fit', session, '--output', out, *FLAGS, toy=toy)
    assert code == 0
    assert 'stopped on request' in output
    assert (f'it goes on with: dlo-calibration fit --resume {out}\n') in errors
    assert names(out) == FINISHED | {'unfinished'}
    assert act('fit', '--resume', out)[0] == whole[0] == 0
    assert content(out) == content(tmp_path / 'whole')
    assert names(out) == FINISHED


def test_a_request_is_resumed_from_its_copy(tmp_path, act, abandon):
    request = tmp_path / 'mine.xml'
    sample = Path(__file__).resolve().parents[2] / 'msg_samples' / 'xml' / 'named_actions.xml'
    request.write_bytes(sample.read_bytes())
    out = tmp_path / 'out'
    abandon(30, 'fit', request, '--output', out, *FLAGS, '--workers', 1)
    request.unlink()
    assert act('fit', '--resume', out)[0] == 0
    assert names(out) == FINISHED | {REQUEST}


def test_a_failed_simulation_leaves_nothing_to_resume(session, tmp_path, act):
    toy = CountingToy()
    toy.fail_below = 101.0
    code, _, errors, _ = act('fit', session, '--output', tmp_path / 'out', *FLAGS, toy=toy)
    assert (code, 'none of 25 evaluations could be simulated' in errors) == (2, True)
    assert 'unfinished' not in names(tmp_path / 'out')
