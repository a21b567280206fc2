# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Somebody else's files do not choose this machine's processes, schedulers, folders or other files."""

import inspect
import os
from pathlib import Path

import pytest
from toy_messages import session_messages, toy_trials, write_session
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import (
    file_options,
    FileOptions,
    MACHINE,
    OBSERVATION,
    Options,
    SEARCH,
)
from dlo_calibration.cli import fit
from dlo_calibration.cli import main as cli
from dlo_calibration.errors import InputError
from dlo_calibration.files import recording, xml
from dlo_calibration.files.request import Request, TrialRequest, write_request
from dlo_calibration.files.result import read_result, write_result
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import bag_types

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

TYPES = bag_types()
DECLARED = list(Options.declarations())
OF_THE_MACHINE = {
    'workers': 61, 'scheduler': 'tcp://attacker.example:8786', 'start_after_trials': 3,
    'output_directory': '/tmp/attacker', 'record': False, 'answer_limit': 86400.0}


def hostile(declaration):
    """Return a value that an attacker might choose; it is not the default."""
    if declaration.name in OF_THE_MACHINE:
        return OF_THE_MACHINE[declaration.name]
    return declaration.maximum if declaration.default != declaration.maximum else declaration.minimum


def session_file(folder, options):
    return write_session(folder / 'session', session_messages(TYPES, 2), {'evaluations': 3, **options})


def request_file(folder, options):
    trials = tuple(TrialRequest.of(trial) for trial in toy_trials(2))
    write_request(folder / 'request.xml', Request(trials, FileOptions({'evaluations': 3, **options})))
    return folder / 'request.xml'


def result_file(folder, options):
    result = calibrate(toy_trials(2), Options(evaluations=3, workers=1), make_simulator=new_toy)
    write_result(folder / 'result.xml', result, {**Options(evaluations=3).flat(), **options})
    return folder / 'result.xml'


@pytest.fixture
def as_an_attacker(monkeypatch):
    """Let this package write files that it does not write."""
    monkeypatch.setattr(recording, 'recordable', dict)
    monkeypatch.setattr(xml, 'recordable', dict)


class Reached(list):
    """The options that reached a calibration or a simulator."""

    def calibrate(self, trials, options, **_):
        """Take part in no calibration, but end it at once."""
        self.append(options)
        raise InputError('the test', 'enough', 'nothing', 'look')

    def make(self, options):
        """Return a toy."""
        self.append(options)
        return ToySimulator()


@pytest.fixture
def reached(monkeypatch):
    seen = Reached()
    monkeypatch.setattr(fit, 'calibrate', seen.calibrate)
    return seen


def test_every_option_says_what_it_belongs_to():
    assert {declaration.of for declaration in DECLARED} == {OBSERVATION, SEARCH, MACHINE}
    assert {option.name for option in DECLARED if option.of == MACHINE} == set(OF_THE_MACHINE)
    assert inspect.signature(type(DECLARED[0])).parameters['of'].default is inspect.Parameter.empty


@pytest.mark.long
@pytest.mark.parametrize('write', [session_file, request_file, result_file])
def test_options_of_the_machine_never_come_from_a_file(write, tmp_path, as_an_attacker, reached, capsys):
    """All at once: the test above makes sure that these are all."""
    evil = write(tmp_path, OF_THE_MACHINE)
    if write is result_file:
        session = write_session(tmp_path / 'of_mine.mcap', session_messages(TYPES, 1))
        lines = [['validate', evil, session], ['plot', session, evil, '--output', tmp_path]]
    else:
        lines = [['fit', evil], ['info', evil], ['info', evil, '--json']]
    for line in lines:
        cli.main([str(word) for word in line], reached.make)
        printed = capsys.readouterr()
        sentence, = [text for text in (printed.out + printed.err).replace('\n ', ' ').split('\n')
                     if 'as only the command line or the node may set them' in text]
        if '--json' not in line:
            assert 'workers' in sentence
    assert reached
    for options in reached:
        for name in OF_THE_MACHINE:
            assert options.flat()[name] == Options().flat()[name]
        assert options.evaluations == 3  # an option of the search is taken
    assert not Path('/tmp/attacker').exists()


@pytest.mark.parametrize('name', OF_THE_MACHINE)
def test_each_option_of_the_machine_is_left_out_and_named_in_one_line(name):
    given = file_options({name: OF_THE_MACHINE[name], 'seed': 7}, None)
    assert dict(given.values) == {'seed': 7}
    warning, = given.warnings
    assert name in warning
    assert file_options({name: Options().flat()[name]}, None).warnings == ()  # as former versions recorded it


@pytest.mark.parametrize('declaration', [
    option for option in DECLARED if option.of != MACHINE and option.minimum is not None
], ids=lambda option: option.name)
def test_the_other_options_are_taken_within_their_ranges(declaration):
    assert dict(file_options({declaration.name: hostile(declaration)}, None).values) == {
        declaration.name: hostile(declaration)}
    given = file_options({declaration.name: 2 * declaration.maximum + 1}, None)
    assert dict(given.values) == {} and declaration.name in given.warnings[0]


def test_the_command_line_chooses_the_machine_whatever_the_file_says(tmp_path, as_an_attacker, reached):
    cli.main(['fit', str(session_file(tmp_path, OF_THE_MACHINE)), '--workers', '2'], reached.make)
    assert reached[-1].workers == 2 and reached[-1].scheduler == ''


def test_no_file_of_ours_records_the_machine(tmp_path):
    chosen = {**OF_THE_MACHINE, 'seed': 7}
    assert read_session(session_file(tmp_path, chosen)).file_options.values == {'evaluations': 3, 'seed': 7}
    for file in (result_file(tmp_path, chosen), request_file(tmp_path, chosen)):
        text = file.read_text(encoding='utf-8')
        assert 'name="seed"' in text and not any(f'name="{name}"' in text for name in OF_THE_MACHINE)
    description = read_result(tmp_path / 'result.xml')  # nothing about options:
    assert description.file_options.warnings == (f'do not use this result: {description.unusable}',)


# ---- scenes

def scene_in(folder, name='scene.urdf'):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text('<robot/>', encoding='utf-8')
    return folder / name


@pytest.mark.parametrize('name', ['scene.urdf', 'deep/scene.urdf', './deep/../scene.urdf'])
def test_a_scene_in_the_folder_of_the_file_is_found_from_anywhere(name, tmp_path, monkeypatch):
    path = scene_in(tmp_path / 'given', name)
    elsewhere = tmp_path / 'elsewhere'
    scene_in(elsewhere)
    monkeypatch.chdir(elsewhere)
    assert file_options({'scene': name}, tmp_path / 'given').options().scene == str(path.resolve())
    monkeypatch.chdir(tmp_path)
    assert file_options({'scene': name}, Path('given')).options().scene == str(path.resolve())
    assert file_options({'scene': str(path)}, tmp_path / 'given').options().scene == str(path.resolve())


def test_a_scene_that_was_elsewhere_is_found_in_the_folder_of_the_file(tmp_path):
    path = scene_in(tmp_path / 'given')
    given = file_options({'scene': '/home/another/scene.urdf'}, tmp_path / 'given')
    assert given.values['scene'] == str(path)


@pytest.mark.parametrize('name', [
    'outside', '../secret.urdf', 'link.urdf', 'linked/secret.urdf', 'pipe', '.', '/dev/zero',
    '/proc/self/mem', 'nowhere.urdf', '//server/share/scene.urdf', 'http://server/scene.urdf', 'a\0b', 'loop',
    5000 * 'x'], ids=lambda name: ascii(name[:20]))
def test_a_file_elsewhere_is_not_taken_as_a_scene(name, tmp_path):
    folder, secret = tmp_path / 'given', tmp_path / 'secret.urdf'
    folder.mkdir()
    secret.write_text('<robot/>', encoding='utf-8')
    (folder / 'link.urdf').symlink_to(secret)
    (folder / 'linked').symlink_to(tmp_path)
    (folder / 'loop').symlink_to('loop')
    os.mkfifo(folder / 'pipe')
    given = file_options({'scene': str(secret) if name == 'outside' else name}, folder)
    assert 'scene' not in given.values
    assert given.warnings == (str(given.refusal),)
    assert len(given.warnings[0]) <= 500 and given.warnings[0].endswith('or give it with --scene')
    with pytest.raises(InputError):
        given.options()


@pytest.mark.parametrize('write', [session_file, request_file, result_file])
def test_a_foreign_scene_is_refused_until_it_is_given(write, tmp_path, reached, capsys):
    secret = scene_in(tmp_path / 'elsewhere')
    (tmp_path / 'given').mkdir()
    file = write(tmp_path / 'given', {'scene': str(secret)})
    line = ['fit', str(file)]
    if write is result_file:
        line = ['validate', str(file), str(write_session(tmp_path / 'mine.mcap', session_messages(TYPES, 1)))]
    assert cli.main(line, reached.make) == 2
    errors = capsys.readouterr().err.splitlines()
    assert reached == [] and [text for text in errors if 'scene' in text] == errors[-1:]
    assert errors[-1].startswith(f'dlo-calibration: recorded scene {secret}: no such file in the folder')
    cli.main([*line, '--scene', str(secret)], reached.make)
    assert reached[0].scene == str(secret)
    if write is not result_file:
        assert cli.main(['info', str(file)], reached.make) == 0
        assert '--scene' in capsys.readouterr().out


def test_a_library_user_is_refused_too(tmp_path):
    session = read_session(session_file(tmp_path, {'scene': '/etc/hostname'}))
    assert len(session.trials) == 2
    with pytest.raises(InputError, match='recorded scene /etc/hostname'):
        session.options  # noqa: B018


def test_a_session_in_one_file_finds_its_scene_beside_it(tmp_path):
    folder = session_file(tmp_path, {'scene': 'scene.urdf'})
    file = next(folder.glob('*.mcap')).rename(tmp_path / 'alone.mcap')
    assert read_session(file).file_options.refusal is not None
    assert read_session(file).file_options.values == {'evaluations': 3}
    path = scene_in(tmp_path)
    assert read_session(file).options.scene == str(path)
