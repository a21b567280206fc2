# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A result with a rest shape of nine knots, thirty parameters in all, is readable in every form."""

import base64
from dataclasses import replace
import io
import json
import re

from lxml import etree
import numpy as np
import pytest
from rest_shape_result import rest_shape_result, rest_shape_space
from toy_messages import toy_trials
from toy_simulator import new_toy, ToySimulator
from wire import result_values

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import plain
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.files.result import description_document, read_description, write_evaluations
from dlo_calibration.inference.missing_parameters import MissingParameter
from dlo_calibration.inference.slices import MOST_LINES, simulate_slices
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.model.parameters import BY_NAME, knot_names
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.report.bending_drawing import (
    _best_axes,
    _moved_onto,
    moment_panels,
    rest_shape_panels,
)
from dlo_calibration.report.page import MOST_CORRELATIONS, Origin, page_of
from dlo_calibration.report.sentences import sentences
from dlo_calibration.report.terminal import print_result
from dlo_calibration.ros import diagnostics
from dlo_calibration.writing import write_file


@pytest.fixture(scope='module')
def result():
    """Return a result with thirty parameters."""
    result = rest_shape_result()
    assert len(result.parameters) == 30
    return result


@pytest.fixture(scope='module')
def straight():
    """Return a result of a DLO without rest shape and friction between strands."""
    return calibrate(toy_trials(1), Options.of({'workers': 1, 'evaluations': 10}), make_simulator=new_toy)


def test_the_result_file_has_every_parameter(result, tmp_path):
    document = description_document(result)
    description = read_description(document)
    assert description.physical() == result.physical()
    assert description.space.knots == 9
    assert description.correlations == result.correlations
    assert description.parameters['rest_curvature_y4'] == result.parameters['rest_curvature_y4']
    assert description_document(description) == document
    write_evaluations(tmp_path / 'evaluations.csv', result)
    assert 'rest_curvature_y9' in (tmp_path / 'evaluations.csv').read_text().splitlines()[0]


def test_a_result_file_without_rest_shape_and_friction_is_read(straight):
    root = etree.fromstring(description_document(straight))
    parameters = root.find('parameters')
    for element in parameters.findall('fixed'):
        if element.get('name').startswith('bending_'):
            parameters.remove(element)
    description = read_description(etree.tostring(root))
    assert description.physical() == straight.physical()
    assert not description.physical()['bending_friction']


def test_json_and_message_have_every_component(result):
    document = json.loads(json.dumps(plain(result), allow_nan=False))
    message = diagnostics.result(bag_types(), result, stamp=1)
    values = result_values(message)
    for name in knot_names(9):
        assert document['parameters'][name]['value'] == result.values[name] == values[name]['value']
    assert len(message.status) == 31


def test_the_table_has_a_line_for_each_knot(result):
    stream = io.StringIO()
    print_result(result, stream)
    lines = stream.getvalue().splitlines()
    assert [line for line in lines if 'rest_curvature 4' in line and '4.99, 3.99 1/m' in line]
    assert sum('rest_curvature' in line.split('│')[1] for line in lines if '│ ' in line) == 9
    assert all(len(line) <= 110 for line in lines)


def test_sentences_say_where_it_is_curved_and_what_it_keeps(result):
    texts = sentences(result)
    shape, = (text for text in texts if text.startswith('When nothing bends it'))
    assert 'most at 38 % of its length, by 6.38 1/m (a radius of 157 mm)' in shape
    assert 'Of the 18 components of this rest shape, rest_curvature_x1 to rest_curvature_y9, ' \
           '17 are known well, 1 only roughly.' in texts
    bend, = (text for text in texts if text.startswith('Bent far and released'))
    assert '2.01 1/m (a radius of 497 mm)' in bend and 'more than 0.299 1/m' in bend
    assert not any(text.startswith('rest_curvature') for text in texts)
    assert len(texts) < 25
    missing = replace(result, missing_parameters=(MissingParameter('marker_mass', 0.3),))
    words, = (text for text in sentences(missing) if 'name marker_mass in calibrate, beside' in text)
    assert 'rest_curvature' not in words


def test_a_sentence_says_how_askew_it_stands_in_its_clamps(result):
    askew = {'clamp_bend_x1': 80.0, 'clamp_bend_y1': 10.0, 'clamp_bend_x2': 40.0}  # 0.3, -0.4, -0.1 rad
    stands = replace(result, space=replace(result.space, fixed={**result.space.fixed, **askew}))
    assert 'It stands askew in its clamps: by 28.6 degrees in the first and 5.73 degrees in the second.' \
        in sentences(stands)
    unknown = {name: replace(next(iter(result.parameters.values())), verdict=NOT_IDENTIFIABLE)
               for name in ('clamp_bend_x1', 'clamp_bend_y1')}
    assert 'It stands askew in its clamps: by 5.73 degrees in the second.' in sentences(
        replace(stands, estimates={**result.parameters, **unknown}))
    assert not any('askew' in text for text in sentences(result))


def test_friction_between_strands_gives_a_sentence_only_where_it_is_known(result, without_drawings):
    def bend(**verdicts):
        changed = {name: replace(result.parameters[name], verdict=verdict)
                   for name, verdict in verdicts.items()}
        uncertain = replace(result, estimates={**result.parameters, **changed})
        words = ''.join(text for text in sentences(uncertain) if text.startswith('Bent far'))
        return words, moment_panels(uncertain)

    assert bend(bending_friction=NOT_IDENTIFIABLE) == ('', [])
    assert ' may keep a curvature ' in bend(bending_friction=WEAK)[0]
    words, drawn = bend(bending_friction=IDENTIFIABLE, bending_slip=NOT_IDENTIFIABLE)
    assert ' keeps a curvature ' in words and 'slip' not in words and drawn


def test_a_dlo_that_locks_says_at_which_radius(result, without_drawings):
    fixed = {**result.space.fixed, 'locking': BY_NAME['locking'].value(0.1)}
    locks = replace(result, space=replace(result.space, fixed=fixed))
    for dlo, expected in ((result, False), (locks, True)):
        words, = (text for text in sentences(dlo) if text.startswith('Bent far'))
        assert words.endswith(' Bent to a radius of 100 mm, it is twice as stiff.') is expected


def test_draws_are_whole_ropes_within_the_scale(result):
    posterior = Posterior.of(read_description(description_document(result)))
    draws = posterior.draws(200, seed=3)
    assert all(set(draw) == set(result.physical()) for draw in draws)
    for name in knot_names(9):
        values = [draw[name] for draw in draws]
        inside = result.parameters[name]
        share = np.mean([inside.physical_lower <= value <= inside.physical_upper for value in values])
        assert 0.8 < share <= 1 and max(map(abs, values)) <= 25
    drawn = np.array([[draw[name] for name in ('rest_curvature_x2', 'rest_curvature_y2')] for draw in draws])
    expected = result.correlations['rest_curvature_x2']['rest_curvature_y2']
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(expected, abs=0.2)


def test_the_page_stays_small(result, tmp_path, without_drawings):
    evaluator = Evaluator(result.trials, result.space, ToySimulator())
    slices = simulate_slices(evaluator, result.best, result.std, result.examination, seconds=60)
    assert len(slices.lines) == MOST_LINES and slices.complete
    write_file(tmp_path / 'page.html', page_of(result, Origin('s', 'a command', Options()), slices))
    page = (tmp_path / 'page.html').read_text(encoding='utf-8')
    assert 'rest_curvature 9' in page and 'The shape when nothing bends it' in page
    assert 'The bend that it keeps' in page
    assert 'class="cells"' not in page and page.count('<tr><td>') > MOST_CORRELATIONS
    assert len(page) < 2e5


def test_drawings_are_images(result):
    for drawing in (*rest_shape_panels(result), *moment_panels(result)):
        svg = base64.b64decode(drawing.source.partition(',')[2])
        assert etree.fromstring(svg) is not None and len(svg) < 2e5


def test_drawings_show_what_there_is(result, straight, without_drawings):
    shape, _ = rest_shape_panels(result)
    assert re.search(r'1000 mm long: its ends are \d+ mm apart', shape.words)
    moment, = moment_panels(result)
    assert 'mN m,' in moment.words and '2.01 1/m of curvature stay' in moment.words
    moment, = moment_panels(replace(result, space=rest_shape_space(mass=0.0)))
    assert 'mN m per N/m,' in moment.words
    assert rest_shape_panels(straight) == moment_panels(straight) == []


def test_a_shape_is_drawn_from_its_side_without_a_mirror():
    """A helix that is turned like a right-handed screw stays so, and draws that are the same lie on it."""
    angles = np.linspace(0, 8, 200)
    helix = np.stack([np.cos(angles), np.sin(angles), 0.2 * angles], axis=1)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    for curve in (helix, helix[:, ::-1], helix @ turn):
        axes = _best_axes(curve)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) > 0
        seen = (curve - curve.mean(axis=0)) @ axes
        np.testing.assert_allclose(_moved_onto(curve @ turn.T + 3, seen), seen, atol=1e-9)
        assert (np.diff(seen.std(axis=0)) <= 0).all()
