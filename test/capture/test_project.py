# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a project: written, opened again, damaged, and made by a stranger."""

import io
import json
import os

import numpy as np
from PIL import Image
import pytest

from dlo_calibration.capture.document import Document
from dlo_calibration.capture.project import MOST_FILES, OldRevision, Project
from dlo_calibration.errors import InputError

LENS = """
image_width: 200
image_height: 150
camera_name: telephone
camera_matrix: {rows: 3, cols: 3, data: [180.0, 0.0, 100.0, 0.0, 180.0, 75.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0.0, 0.0, 0.0, 0.0]}
"""


def picture(kind='PNG', size=(200, 150)):
    stream = io.BytesIO()
    Image.new('RGB', size, 'white').save(stream, kind)
    return stream.getvalue()


@pytest.fixture
def project(tmp_path):
    opened = Project(tmp_path / 'rope')
    yield opened
    opened.close()


def reopened(project):
    project.close()
    opened = Project(project.folder)
    opened.close()
    return opened


def test_what_was_done_is_there_when_the_folder_is_opened_reopened(project):
    first = project.add_photograph(picture('JPEG'), 'start.jpg')
    second = project.add_photograph(picture(), 'goal.png')
    project.set_lens(LENS.encode(), 'my camera.yaml')
    plain = project.document.plain()
    plain['photographs'][0]['clicks'] = [[1, 2], [3.5, 4]]
    project.change(Document.of(plain), project.revision)
    opened = reopened(project)
    assert opened.document == project.document
    assert [(trial.start, trial.goal) for trial in opened.document.trials] == [(first, second)]
    np.testing.assert_array_equal(opened.photograph(second).pixels, project.photograph(second).pixels)
    assert (opened.path(first).suffix, opened.path(second).suffix) == ('.jpg', '.png')
    assert opened.lens.size == (200, 150)
    assert opened.warnings == []
    opened.remove_lens()
    assert reopened(opened).lens is None


def test_a_change_of_an_old_revision_is_refused(project):
    old = project.revision
    project.add_photograph(picture(), 'start.png')
    with pytest.raises(OldRevision):
        project.change(Document(), old)
    assert len(project.document.photographs) == 1


def test_a_removed_photograph_can_be_restored(project):
    project.add_photograph(picture(), 'start.png')
    before = project.document
    project.change(Document(), project.revision)
    project = reopened(project)
    project.change(before, project.revision)
    assert reopened(project).document == before


def test_a_document_with_an_unknown_photograph_is_refused(project):
    plain = {'photographs': [{'id': 'aaaaaaaa'}]}
    with pytest.raises(InputError, match='photograph aaaaaaaa'):
        project.change(Document.of(plain), project.revision)
    assert project.document == Document()


def test_the_next_photograph_has_the_board_too(project):
    first = project.add_photograph(picture(), 'start.png')
    assert project.document.by_id[first].scale is None
    plain = project.document.plain()
    plain['photographs'][0]['scale'] = {'kind': 'board', 'ruler': 0.098}
    project.change(Document.of(plain), project.revision)
    second = project.add_photograph(picture(), 'goal.png')
    assert project.document.by_id[second].scale == project.document.by_id[first].scale


@pytest.mark.parametrize('octets', [b'', b'a text file', picture('JPEG')[:300], picture('GIF')])
def test_a_file_that_is_no_photograph_is_not_saved(project, octets):
    with pytest.raises(InputError):
        project.add_photograph(octets, 'start.jpg')
    assert project.document == Document()
    assert list((project.folder / 'photographs').iterdir()) == []


def test_a_name_is_only_shown(project):
    first = project.add_photograph(picture(), '../../etc/\x1b[31mpasswd' + 'x' * 1000)
    assert project.path(first).parent == project.folder / 'photographs'
    shown = project.document.by_id[first].name
    assert len(shown) <= 255
    assert '\x1b' not in shown


@pytest.mark.parametrize('identity', ['../secret', 'aaaaaaaa/', 'AAAAAAAA', '', 'aaaaaaaa\n', 'a' * 8 + '\0'])
def test_an_id_is_no_path(project, identity):
    (project.folder / 'secret.png').write_bytes(picture())
    with pytest.raises(InputError):
        project.path(identity)


def test_a_link_in_place_of_a_photograph_is_not_followed(project, tmp_path):
    (tmp_path / 'private.png').write_bytes(picture())
    (project.folder / 'photographs' / 'aaaaaaaa.png').symlink_to(tmp_path / 'private.png')
    with pytest.raises(InputError):
        project.photograph('aaaaaaaa')


@pytest.mark.parametrize('make', [
    lambda path, elsewhere: os.mkfifo(path), lambda path, elsewhere: path.symlink_to(elsewhere),
], ids=['FIFO', 'link'])
@pytest.mark.parametrize('name', [
    '.lock', 'project.json', 'lens.yaml', 'photographs', 'photographs/aaaaaaaa.png', 'session.mcap',
    'request.xml', 'result', 'result/result.json', 'result/unfinished', 'result/unfinished/evaluations.log'])
def test_a_folder_with_a_link_or_a_fifo_is_not_opened(tmp_path, name, make):
    (tmp_path / 'elsewhere').mkdir()
    path = tmp_path / 'rope' / name
    path.parent.mkdir(parents=True)
    make(path, tmp_path / 'elsewhere')
    with pytest.raises(InputError) as refusal:
        Project(tmp_path / 'rope')
    assert str(refusal.value).startswith(str(path))
    assert list((tmp_path / 'elsewhere').iterdir()) == []


def test_a_bad_lens_leaves_the_good_one(project):
    project.set_lens(LENS.encode(), 'good.yaml')
    for octets in (b'no: lens', b'x' * (2**20 + 1), b'\xff\xfe'):
        with pytest.raises(InputError, match='camera calibration bad.yaml'):
            project.set_lens(octets, 'bad.yaml')
    assert project.lens_name == 'good.yaml'
    assert reopened(project).lens is not None


DAMAGED = {
    'text': b'no document', 'cut': b'{"version": 1, "photogr', 'nothing': b'', 'octets': b'\xff\xfe\x00',
    'deep': b'[' * 100_000, 'nan': b'{"dlo": {"mass": NaN}}', 'digits': b'[' + b'9' * 10_000 + b']',
    'lost': json.dumps({'photographs': [{'id': 'aaaaaaaa'}]}).encode(), 'large': b' ' * (4 * 2**20) + b'{}',
    'other': b'{"version": 99}'}


@pytest.mark.parametrize('octets', DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_document_is_renamed_and_reported(project, octets):
    (project.folder / 'project.json').write_bytes(octets)
    opened = reopened(project)
    assert opened.document == Document()
    assert 'project_damaged_1.json' in opened.warnings[0]
    assert (project.folder / 'project_damaged_1.json').read_bytes() == octets
    opened.add_photograph(picture(), 'new.png')
    assert reopened(opened).warnings == []


def test_a_folder_is_open_in_one_process_only(project):
    with pytest.raises(InputError, match='another capture'):
        Project(project.folder)


def test_a_full_folder_is_refused(project):
    for number in range(MOST_FILES):
        (project.folder / 'photographs' / f'{number:08}.jpg').touch()
    with pytest.raises(InputError, match='another folder'):
        project.add_photograph(picture(), 'one more.png')
