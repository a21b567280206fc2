# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""From the photographs in a folder to trials; a change costs only what depends on it."""

import io
import json

from curve_views import curve, DIAMETER, drawn, view
import numpy as np
from PIL import Image
import pytest

from dlo_calibration.capture import measurement
from dlo_calibration.capture.document import Document
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.trials import Drafter
from dlo_calibration.errors import InputError

SCALE = view(0.3)
SHAPES = curve(), curve(1.1, 0.3)
CORNERS = np.array([(-0.2, -0.15), (0.2, -0.15), (0.2, 0.15), (-0.2, 0.15), (0.0, 0.2)])
PLACES = SCALE.to_pixels(np.column_stack([CORNERS, np.zeros(5)]))
POINTS = {'kind': 'points', 'points': [{'pixel': pixel, 'table': place} for pixel, place in zip(
    PLACES.tolist(), CORNERS.tolist(), strict=True)]}


def png(pixels):
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, 'PNG', compress_level=1)
    return stream.getvalue()


@pytest.fixture(scope='module')
def photographs():
    return [png(drawn(shape, SCALE)) for shape in SHAPES]


@pytest.fixture
def project(tmp_path, photographs):
    opened = Project(tmp_path)
    for octets in photographs:
        opened.add_photograph(octets, 'rope.png')
    plain = opened.document.plain()
    for entry, shape in zip(plain['photographs'], SHAPES, strict=True):
        entry['clicks'] = (SCALE.to_pixels(shape[[1, 100, 200, 300, 398]]) + (3.0, -2.0)).tolist()
    plain['photographs'][0]['scale'] = POINTS
    plain['photographs'][1]['scale'] = {'kind': 'same', 'photograph': plain['photographs'][0]['id']}
    plain['trials'][0]['steps'] = [{'kind': 'drag', 'fraction': 0.4}]
    opened.change(Document.of(plain), opened.revision)
    yield opened
    opened.close()


def change(project, edit):
    plain = project.document.plain()
    edit(plain)
    project.change(Document.of(plain), project.revision)


@pytest.fixture
def traced(monkeypatch):
    """Return a list that grows with the clicks of each trace."""
    seen = []

    class Tracer(measurement.Tracer):
        def trace(self, clicks, **rest):
            seen.append(np.asarray(clicks).tolist())
            return super().trace(clicks, **rest)

    monkeypatch.setattr(measurement, 'Tracer', Tracer)
    return seen


@pytest.mark.long
def test_photographs_become_a_trial_and_only_changed_clicks_are_traced_again(project, traced):
    drafter = Drafter(project)
    drafts = drafter.draft()
    trial, = drafts.complete
    for chain, shape in ((trial.initial, SHAPES[0]), (trial.goals[0].chain, SHAPES[1])):
        nearest = np.linalg.norm(chain.points[:, None] - shape[None], axis=2).min(axis=1)
        assert nearest.max() < 3e-3  # m; a pixel is 0.9 mm
        assert chain.length == pytest.approx(0.5, abs=5e-3)
    assert drafts.diameter == pytest.approx(DIAMETER, rel=0.35)
    plain = json.loads(json.dumps(drafts.plain(), allow_nan=False))
    shown = list(plain['photographs'].values())
    assert [len(photograph['trace']['chain']) for photograph in shown] == [21, 21]
    np.testing.assert_allclose(shown[0]['scale']['pixels'], PLACES, atol=0.01)
    assert shown[1]['scale']['pixels'] == []  # they belong to the other photograph
    for photograph, measured in zip(shown, drafts.photographs.values(), strict=True):
        lattice, scale = photograph['scale']['lattice'], measured.scale  # the page's map to the table
        for row in (0, -1):
            pixels = [(u, lattice['rows'][row]) for u in lattice['columns']]
            np.testing.assert_allclose(lattice['table'][row], scale.to_table(pixels)[:, :2], atol=1e-5)
    assert plain['trials'][0]['complete'] is True
    assert len(traced) == 2

    assert drafter.draft().plain() == drafts.plain()
    change(project, lambda plain: plain['trials'][0]['steps'][0].update(fraction=0.6))
    change(project, lambda plain: plain['dlo'].update(diameter=0.01, mass=0.03, points=31))
    again = drafter.draft()
    assert again.complete[0].initial.points[0, 2] == pytest.approx(0.005)
    assert len(again.complete[0].initial) == 31
    assert again.options['mass'] == 0.03
    assert len(traced) == 2

    change(project, lambda plain: plain['photographs'][1]['clicks'].pop(2))
    drafter.draft()
    assert traced[2:] == [[list(click) for click in project.document.photographs[1].clicks]]


@pytest.mark.parametrize('edit, problem, text', [
    (lambda start: start.update(clicks=[[5, 5], [99999, 5]]), 'trace_problem', 'click 2'),
    pytest.param(lambda start: start.update(scale={'kind': 'board'}), 'scale_problem', 'board',
                 marks=pytest.mark.long),
])
def test_a_fault_in_one_photograph_leaves_the_other(project, edit, problem, text):
    change(project, lambda plain: edit(plain['photographs'][0]))
    plain = Drafter(project).draft().plain()
    start, goal = plain['photographs'].values()
    assert text in start[problem]
    assert goal['trace'] is not None
    assert plain['trials'][0]['complete'] is False
    assert any(start[problem] in warning['text'] for warning in plain['trials'][0]['warnings'])


@pytest.mark.long
def test_a_prepared_photograph_is_used(project, monkeypatch):
    made = []

    class Tracer(measurement.Tracer):
        def __init__(self, pixels):
            made.append(pixels)
            super().__init__(pixels)

    monkeypatch.setattr(measurement, 'Tracer', Tracer)
    drafter = Drafter(project)
    drafter.prepare(project.document.photographs[0].id)
    assert len(made) == 1
    assert len(drafter.draft().complete) == 1
    assert len(made) == 2
    with pytest.raises(InputError):
        drafter.prepare('aaaaaaaa')


def test_a_defect_in_one_photograph_leaves_the_others(project, monkeypatch):
    def trace(self, clicks, **rest):
        raise ZeroDivisionError

    monkeypatch.setattr(measurement.Tracer, 'trace', trace)
    plain = Drafter(project).draft().plain()
    for photograph in plain['photographs'].values():
        assert 'ZeroDivisionError' in photograph['trace_problem']
        assert photograph['scale'] is not None


def test_a_file_that_became_unreadable_is_reported(project):
    identity = project.document.photographs[0].id
    project.path(identity).write_bytes(b'damaged')
    project.close()
    opened = Project(project.folder)
    plain = Drafter(opened).draft().plain()
    opened.close()
    assert 'photograph rope.png' in plain['photographs'][identity]['problem']
    assert plain['trials'][0]['warnings'][0]['level'] == 'error'
