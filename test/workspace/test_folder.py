# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a calibration: begun, interrupted, resumed, complete; for any caller."""

import ast
from contextlib import closing, ExitStack
import errno
import os
from pathlib import Path

import pytest
from toy_messages import session_messages, write_session
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.log import Entry, EVALUATION
from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.model.chain import frozen_array
from dlo_calibration.workspace import folder as folder_module
from dlo_calibration.workspace.folder import CalibrationFolder, EVALUATIONS, FILES, REPORT, RESULT, SESSION
from dlo_calibration.workspace.source import read_source, Selection

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

OPTIONS = {'workers': 1, 'search': 'random', 'evaluations': 6, 'calibrate': ['flexibility', 'friction']}


@pytest.fixture
def source(tmp_path):
    """Give a session of two trials."""
    return source_with(tmp_path)


def source_with(tmp_path, **options):
    path = write_session(tmp_path / 'recorded.mcap', session_messages(bag_types(), 2))
    return read_source(Selection(path, {**OPTIONS, **options}), lambda _: None)


def result_of(source, log=None):
    return calibrate(source.trials, source.options, make_simulator=new_toy, log=log)


def names(path):
    return {file.name for file in path.iterdir()}


def interrupted(path, source):
    """Leave a calibration with one evaluation in a folder."""
    with closing(CalibrationFolder(path)) as folder:
        folder.begin(source, lambda _: None)
        folder.log.add(f'{EVALUATION}-1', Entry(frozen_array([1.0])))


def test_a_complete_result_leaves_nothing_unfinished(source, tmp_path):
    with closing(CalibrationFolder(tmp_path / 'out')) as folder:
        folder.begin(source, lambda _: None)
        assert names(tmp_path / 'out') == {'unfinished'}
        attempts = folder.complete(result_of(source, folder.log), new_toy, lambda: False, stopped=False,
                                   responsive=False)
    assert not attempts.failure
    assert names(tmp_path / 'out') == {RESULT, SESSION, REPORT, EVALUATIONS}
    assert read_result(tmp_path / 'out' / RESULT).evaluations == 6


def test_the_log_stays_if_a_file_cannot_be_written(source, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(folder_module, 'write_result', full)
    with closing(CalibrationFolder(tmp_path / 'out')) as folder:
        folder.begin(source, lambda _: None)
        attempts = folder.complete(result_of(source, folder.log), new_toy, lambda: False, stopped=False,
                                   responsive=False)
    assert attempts.failure == f'{RESULT}: No space left on device'
    assert CalibrationFolder.is_unfinished(tmp_path / 'out')


def test_a_resumed_calibration_has_the_selection_of_the_interrupted_one(tmp_path):
    source = source_with(tmp_path, seed=7)
    interrupted(tmp_path / 'out', source)
    with closing(CalibrationFolder(tmp_path / 'out')) as folder:
        selection = folder.resume(Selection(CalibrationFolder.input_of(tmp_path / 'out'), {'workers': 3}))
        assert selection.path == tmp_path / 'out' / 'unfinished' / SESSION
        assert (selection.options['seed'], selection.options['workers']) == (7, 3)
        warnings = []
        folder.begin(read_source(selection, warnings.append), warnings.append)
        assert folder.log.evaluations == 1
    assert any(text.startswith('goes on after 1 evaluations') for text in warnings)


def test_another_calibration_is_discarded_only_on_request(source, tmp_path):
    interrupted(tmp_path / 'out', source)
    other = source_with(tmp_path, seed=8)
    with closing(CalibrationFolder(tmp_path / 'out')) as folder:
        with pytest.raises(InputError, match='1 evaluations of another calibration'):
            folder.begin(other, lambda _: None)
        folder.begin(other, lambda _: None, instead=True)
        assert folder.log.evaluations == 0
    assert not CalibrationFolder.is_unfinished(tmp_path / 'out')


def test_two_calibrations_do_not_share_a_folder(source, tmp_path):
    with ExitStack() as stack:
        stack.enter_context(closing(CalibrationFolder(tmp_path)))
        with pytest.raises(InputError, match='another calibration is using'):
            CalibrationFolder(tmp_path)


@pytest.mark.long
def test_the_names_of_result_files_stand_in_one_place():
    package = Path(folder_module.__file__).parents[1]
    places = {file.relative_to(package).as_posix() for file in package.rglob('*.py')
              for node in ast.walk(ast.parse(file.read_text(encoding='utf-8')))
              if isinstance(node, ast.Constant) and node.value in FILES}
    assert places == {'workspace/folder.py'}
