# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A photograph of a DLO that hangs is a whole trial of a project, as it is one of `trace`."""

import io

from hung_loops import GAP, LENGTH, loop, MASS, picture, pixels, view
import numpy as np
from PIL import Image
import pytest

from dlo_calibration import read_session
from dlo_calibration.capture.document import Document
from dlo_calibration.capture.hanging import COUNT, NODES, with_ends
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.trials import Drafter
from dlo_calibration.cli.main import main
from dlo_calibration.errors import InputError
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.session import trial_records

CAMERA = view()
SHAPE, ENDS = loop()
CLICKS = np.round(pixels(CAMERA, SHAPE[[0, 100, 200, -1]]), 2).tolist()
IN_CLAMPS = np.round(pixels(CAMERA, ENDS + 4 * (ENDS - SHAPE[[0, -1]])), 2).tolist()


@pytest.fixture(scope='module')
def photograph():
    stream = io.BytesIO()
    Image.fromarray(picture(CAMERA)).save(stream, 'PNG', compress_level=1)
    return stream.getvalue()


@pytest.fixture
def project(tmp_path, photograph):
    """Give a project with a photograph of a loop."""
    opened = Project(tmp_path / 'project')
    opened.add_photograph(photograph, 'loop.png')
    yield opened
    opened.close()


def changed(project, scale, clicks=CLICKS):
    """Give the first photograph a scale and clicks, and the DLO its mass; return the drafts."""
    plain = project.document.plain()
    plain['photographs'][0].update(scale={'kind': 'hanging', **scale}, clicks=clicks)
    plain['dlo']['mass'] = MASS
    project.change(Document.of(plain), project.revision)
    return Drafter(project).draft()


def test_it_is_the_trial_that_trace_makes_of_it(project, photograph, tmp_path):
    drafts = changed(project, {'length': LENGTH, 'clamps': IN_CLAMPS})
    trial, = drafts.complete
    (tmp_path / 'loop.png').write_bytes(photograph)
    clicks, clamps = (' '.join(f'{u:.2f},{v:.2f}' for u, v in pairs) for pairs in (CLICKS, IN_CLAMPS))
    assert main(['trace', str(tmp_path / 'loop.png'), '--points', clicks, '--hanging', '--length',
                 str(LENGTH), '--clamps', clamps, '--mass', str(MASS), '--output',
                 str(tmp_path / 'loop.mcap')]) == 0
    traced = read_session(tmp_path / 'loop.mcap')
    assert len(trial.initial) == COUNT
    assert np.array_equal(trial.initial.points, traced.trials[0].initial.points)
    assert trial.clamped == traced.trials[0].clamped
    write_records(tmp_path / 'saved.mcap', trial_records(drafts.complete), drafts.options)
    saved = read_session(tmp_path / 'saved.mcap').options
    assert (saved.nodes, saved.mass, saved.table) == (NODES, with_ends(MASS), traced.options.table)
    assert saved.values['self_collision'] == pytest.approx(traced.options.values['self_collision'], abs=0.5)


def test_the_simulated_dlo_is_drawn_where_the_photograph_shows_it(project):
    photograph, = changed(project, {'length': LENGTH, 'clamps': IN_CLAMPS}).photographs.values()
    shown = photograph.trial_scale.to_pixels(photograph.hanging.chain.points[1:-1])
    known = pixels(CAMERA, SHAPE[np.linspace(0, len(SHAPE) - 1, len(shown)).round().astype(int)])
    assert np.linalg.norm(shown - known, axis=1).max() < 4.0
    assert photograph.plain['trace']['length'] == pytest.approx(LENGTH, rel=0.01)


def test_the_distance_of_the_clamps_gives_the_scale_too(project):
    photograph, = changed(project, {'gap': GAP}).photographs.values()
    assert photograph.plain['trace']['length'] == pytest.approx(LENGTH, rel=0.03)


def test_what_is_missing_is_said(project):
    for given, clicks, remedy in (({'length': LENGTH}, [], 'add_click'), ({}, CLICKS, 'set_scale')):
        draft, = changed(project, given, clicks).trials
        assert draft.trial is None
        assert remedy in [warning.remedy for warning in draft.warnings if warning.level == 'error']


@pytest.mark.long
def test_a_further_photograph_is_a_repeat(project, photograph):
    changed(project, {'length': LENGTH, 'clamps': IN_CLAMPS})
    project.add_photograph(photograph, 'again.png')
    first, second = project.document.photographs
    assert [trial.start for trial in project.document.trials] == [first.id, second.id]
    assert second.scale.length == LENGTH and second.scale.clamps == ()
    plain = project.document.plain()
    plain['photographs'][1]['clicks'] = CLICKS
    project.change(Document.of(plain), project.revision)
    assert len(Drafter(project).draft().complete) == 2
    plain['photographs'][1]['scale'] = {'kind': 'same', 'photograph': first.id}
    with pytest.raises(InputError, match='a scale of its own'):
        Document.of(plain)
