# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `plot`: which files it writes, and what it says."""

import json

import numpy as np
from PIL import Image, ImageColor
import pytest
from toy_messages import session_messages, toy_trials, write_session
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate, Options
from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import write_result
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.report.figure import SIMULATED


@pytest.fixture
def session(tmp_path):
    return write_session(tmp_path / 'recorded.mcap', session_messages(bag_types(), 2),
                         {'evaluations': 3})


@pytest.fixture
def run(capsys):
    """Give a function that returns exit code, stdout and stderr of a command with the toy."""
    def run(*words):
        try:
            code = cli.main([str(word) for word in words], lambda options: ToySimulator())
        except SystemExit as end:  # argparse
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def result(tmp_path):
    options = Options.of({'evaluations': 3, 'workers': 1})
    write_result(tmp_path / 'result.xml', calibrate(toy_trials(2), options, make_simulator=new_toy),
                 options.flat())
    return tmp_path / 'result.xml'


def written(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.mark.long
def test_session_alone_gives_a_picture_per_trial(run, session, tmp_path):
    code, output, notes = run('plot', session, '--output', tmp_path / 'pictures')
    assert (code, output) == (0, '')
    assert written(tmp_path / 'pictures') == ['trial_1.png', 'trial_2.png']
    assert str(tmp_path / 'pictures' / 'trial_2.png') in notes


@pytest.mark.long
def test_result_is_drawn_too(run, session, result, tmp_path):
    run('plot', session, '--output', tmp_path / 'measured')
    code, output, _ = run('plot', session, result, '--output', tmp_path / 'both', '--json')
    assert code == 0
    assert json.loads(output) == {
        'pictures': [str(tmp_path / 'both' / f'trial_{k}.png') for k in (1, 2)],
        'films': [str(tmp_path / 'both' / f'trial_{k}.svg') for k in (1, 2)], 'animations': []}
    measured, both = (np.asarray(Image.open(tmp_path / name / 'trial_1.png').convert('RGB')).astype(int)
                      for name in ('measured', 'both'))

    def simulated(image):
        return (np.abs(image - ImageColor.getrgb(SIMULATED)).sum(axis=2) < 30).sum()

    assert simulated(measured) == 0 < simulated(both)


@pytest.mark.long
def test_animation_is_a_gif_per_trial(run, session, result, tmp_path, monkeypatch):
    monkeypatch.setattr('dlo_calibration.simulation.motion.FRAME_RATE', 2)
    monkeypatch.setattr('dlo_calibration.report.animation.FRAME_RATE', 2)
    monkeypatch.setattr('dlo_calibration.report.animation.DOTS_PER_INCH', 40)
    code, output, _ = run('plot', session, result, '--animation', '--output', tmp_path / 'films', '--json')
    assert code == 0
    assert written(tmp_path / 'films') == [
        'trial_1.gif', 'trial_1.png', 'trial_1.svg', 'trial_2.gif', 'trial_2.png', 'trial_2.svg']
    for path in json.loads(output)['animations']:
        assert Image.open(path).n_frames > 2


def test_a_picture_that_cannot_be_written_prevents_no_other(run, session, tmp_path):
    (tmp_path / 'out' / 'trial_1.png').mkdir(parents=True)
    (tmp_path / 'elsewhere').write_text('precious')
    (tmp_path / 'out' / 'trial_2.png').symlink_to(tmp_path / 'elsewhere')
    code, _, errors = run('plot', session, '--output', tmp_path / 'out')
    assert code == 2
    assert 'could not be written: trial_1.png' in errors.splitlines()[-1]
    assert 'trial_2.png could be' in errors.splitlines()[-1]
    assert (tmp_path / 'out' / 'trial_2.png').read_bytes().startswith(b'\x89PNG')
    assert (tmp_path / 'elsewhere').read_text() == 'precious'


def test_pictures_go_to_the_working_directory_by_default(run, session, tmp_path, monkeypatch):
    monkeypatch.setattr('dlo_calibration.report.drawing.session_picture',
                        lambda trials, chains, path, obstacles: path.touch())
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    assert run('plot', session)[0] == 0
    assert written(tmp_path / 'here') == ['trial_1.png', 'trial_2.png']


@pytest.mark.parametrize(('words', 'said'), [
    (['--animation'], 'RESULT.xml'),
    (['--output', '{session}'], 'choose another place'),
    (['{session}'], 'recorded.mcap'),
], ids=['animation of nothing', 'folder that is a file', 'result that is none'])
def test_unusable_input_ends_with_one_line(run, session, words, said):
    code, output, errors = run('plot', session, *(word.format(session=session) for word in words))
    assert (code, output, errors.count('\n')) == (2, '', 1)
    assert said in errors


def test_session_without_trials_is_refused(run, tmp_path):
    initial, *_ = session_messages(bag_types(), 1)
    code, _, errors = run('plot', write_session(tmp_path / 'short.mcap', [initial]))
    assert code == 2
    assert 'no complete trial' in errors
