# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The tracer finds the middle line of a DLO in rendered photographs, whose truth is known."""

import dataclasses
from itertools import product
import math

import numpy as np
from photographs import Camera, Hand, Look, photograph, Sheet
import pytest
from rendered_scenes import distances, scene

from dlo_calibration.errors import InputError
from dlo_calibration.vision import path
from dlo_calibration.vision.middle_line import best_columns, straighten
from dlo_calibration.vision.tracer import Tracer

SIZE = (1200, 900)  # px
OFF = 3.0  # px: 10 in a photograph of 12 megapixels
PLAIN = {'hand': 0, 'loops': 0, 'ground': 'plain', 'pattern': 'plain', 'tilt': 0.3}
DARK, LIGHT = (0.12, 0.12, 0.14), (0.93, 0.93, 0.90)


def picture(example):
    return photograph(example.camera, example.curve, example.radius, example.look, example.seed)


def trace_errors(example):
    """Return the trace of a scene, the distances of 21 points and those of all pixels [mm]."""
    trace = Tracer(picture(example)).trace(example.clicks)
    points, off = distances(example, trace.pixels)
    return trace, 1e3 * points, 1e3 * off


@pytest.mark.parametrize('changed', [
    {'radius': 0.0015, 'colour': LIGHT, 'ground_colour': DARK},
    {'highlight': 1.0, 'colour': (0.3, 0.05, 0.05), 'shadow': 0.7, 'lamp': (0.5, 0.6)},
    *(pytest.param(changed, marks=pytest.mark.long) for changed in (
        {'radius': 0.010, 'colour': DARK, 'ground_colour': LIGHT},
        {'tilt': math.radians(40), 'ground': 'wood', 'ground_contrast': 0.2}, {'ground': 'checked'},
        {'pattern': 'striped', 'ground': 'cloth', 'second_colour': (0.95, 0.9, 0.3)})),
], ids=lambda changed: ', '.join(changed))
def test_the_line_is_the_middle_of_the_dlo(changed):
    size = (1600, 1200) if 'tilt' in changed else SIZE  # as much of it is far away
    example = scene(11, size, off=OFF, **{**PLAIN, 'radius': 0.004, **changed})
    trace, points, off = trace_errors(example)
    # The end of a thick DLO that is seen obliquely looks longer than its axis.
    oblique = 2e3 * example.radius * (1 / math.cos(example.camera.tilt) - 1)
    assert points[1:-1].mean() < 1.0 + oblique / 2
    assert off.max() < 2.0 + oblique
    assert trace.sure.mean() > 0.9
    seen = 2 * example.radius * example.camera.focal_length / example.camera.distance
    assert seen / 1.4 < trace.width < seen * 1.4


@pytest.mark.long
def test_points_are_evenly_spaced_from_the_first_click_to_the_last():
    example = scene(5, SIZE, off=OFF, **PLAIN)
    pixels = picture(example)
    trace, back = Tracer(pixels).trace(example.clicks), Tracer(pixels).trace(example.clicks[::-1])
    steps = np.linalg.norm(np.diff(trace.pixels, axis=0), axis=1)
    assert 0.5 < steps.min() and steps.max() < 1.1 * steps.min() < 4
    ends = example.camera.project(example.curve[[0, -1]])
    assert np.linalg.norm(trace.pixels[[0, -1]] - ends, axis=1).max() < 6
    assert np.linalg.norm(back.pixels[[-1, 0]] - ends, axis=1).max() < 6
    assert not trace.pixels.flags.writeable and not trace.sure.flags.writeable


@pytest.mark.long
def test_a_loop_is_followed_straight_on_and_its_crossing_is_reported():
    example = scene(11, SIZE, off=OFF, **{**PLAIN, 'loops': 1, 'radius': 0.003})
    trace, points, _ = trace_errors(example)
    assert points.mean() < 1.0
    (crossing,) = trace.crossings
    seen = example.camera.project(example.curve)
    flat = example.curve[:, :2]
    distance = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    distance[np.abs(np.subtract.outer(np.arange(len(flat)), np.arange(len(flat)))) < 60] = 1
    first, second = sorted(np.unravel_index(np.argmin(distance), distance.shape))
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    assert np.linalg.norm(crossing.pixel - seen[first]) < 8
    assert abs(crossing.first - arc[first]) < 15
    assert abs(crossing.second - arc[second]) < 15
    assert crossing.first_above is not True  # the later part lies above


@pytest.mark.long
def test_a_part_can_be_traced():
    example = scene(8, SIZE, off=OFF, **PLAIN)
    inner = example.camera.project(example.curve[[150, 300, 450]])
    trace = Tracer(picture(example)).trace(inner + 3)
    assert np.linalg.norm(trace.pixels[[0, -1]] - inner[[0, -1]], axis=1).max() < 8


@pytest.mark.long
def test_under_a_hand_the_line_is_not_sure():
    example = scene(8, SIZE, off=OFF, **{**PLAIN, 'radius': 0.003})
    middle = example.curve[330, :2]
    away = middle / np.linalg.norm(middle)
    hand = Hand(tuple(middle - 0.03 * away), math.atan2(away[1], away[0]))
    example = dataclasses.replace(example, look=dataclasses.replace(example.look, hands=(hand,)))
    trace, _, off = trace_errors(example)
    assert 0.01 < (~trace.sure).mean() < 0.4
    assert off[trace.sure].max() < 2.0
    hidden = example.camera.project([[*middle, 0.04]])
    nearest = np.argmin(np.linalg.norm(trace.pixels - hidden, axis=1))
    assert not trace.sure[nearest]


@pytest.mark.long
def test_the_same_clicks_give_the_same_line_also_after_others():
    example = scene(8, SIZE, off=OFF, **PLAIN)
    tracer = Tracer(picture(example))
    before = tracer.trace(example.clicks)
    moved = tracer.trace(example.clicks + 2)
    again = tracer.trace(example.clicks)
    np.testing.assert_array_equal(before.pixels, again.pixels)
    assert abs(len(moved.pixels) - len(before.pixels)) < 10


EMPTY = np.full((300, 400, 3), 180, dtype=np.uint8)


@pytest.mark.parametrize('clicks, words', [
    ([(100, 100)], 'two'), ([], 'two'), ([(1, 2, 3), (4, 5, 6)], 'two'), ([(50, 50), (50, 50)], 'one place'),
    ([(50, 50), (500, 50)], 'click 2'), ([(50, 50), (np.nan, 50)], 'click 2'),
    ([(-5, 50), (50, 60)], 'click 1')])
def test_clicks_that_cannot_be_used_are_refused_in_one_sentence(clicks, words):
    with pytest.raises(InputError, match=words):
        Tracer(EMPTY).trace(clicks)


@pytest.mark.parametrize('ground', [pytest.param('plain', marks=pytest.mark.long), 'wood', None])
def test_a_photograph_without_a_dlo_is_refused(ground):
    if ground is None:
        pixels = np.full((900, 1200, 3), 128, dtype=np.uint8)
    else:
        pixels = photograph(Camera(size=(1200, 900), focal_length=900.0), None, 0.0, Look(ground=ground), 1)
    with pytest.raises(InputError, match='DLO'):
        Tracer(pixels).trace([(200, 200), (600, 500), (1000, 400)])


def test_a_search_that_takes_too_long_ends_in_a_refusal(monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    monkeypatch.setattr(path, 'MAXIMUM_STATES', 50)
    with pytest.raises(InputError, match='DLO'):
        Tracer(pixels).trace([(20, 20), (150, 100), (280, 180)])


@pytest.mark.parametrize('shape', [(40, 60), (1, 1), (3, 2000)])
def test_a_tiny_photograph_is_traced_or_refused(shape):
    pixels = np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)
    try:
        trace = Tracer(pixels).trace([(0, 0), (shape[1] - 1, shape[0] - 1)])
    except InputError:
        return
    assert np.isfinite(trace.pixels).all()


@pytest.mark.parametrize('away', [(500.0, 0.0), (-500.0, 0.0), (0.0, 500.0), (0.0, -500.0)])
def test_beside_the_picture_are_the_colours_of_its_edge(away):
    pixels = np.full((30, 40, 3), (200, 30, 90), np.uint8)
    line = np.column_stack([np.linspace(5, 35, 20), np.linspace(5, 25, 20)])
    inside, beside = (straighten(pixels, points, np.ones(20), np.linspace(-1, 1, 5)).lab
                      for points in (line, line + away))
    assert beside == pytest.approx(inside)


def test_a_straight_line_is_located_to_a_fraction_of_a_pixel():
    v = np.arange(600)[:, None] + np.zeros(900)
    middle = 300.3 + 0.05 * np.arange(900)
    inside = np.clip(12.5 - np.abs(v - middle), 0, 1)
    inside[:, :100] = inside[:, 800:] = 0
    pixels = (200 - 150 * inside[..., None] + np.zeros(3)).astype(np.uint8)
    trace = Tracer(pixels).trace([(102, 303), (797, 342)])
    u, v = trace.pixels.T
    assert np.abs(v - (300.3 + 0.05 * u))[5:-5].max() < 0.3
    assert abs(u[0] - 99.5) < 1.5 and abs(u[-1] - 799.5) < 1.5
    assert trace.crossings == ()
    assert 23 < trace.width < 27


def test_no_other_columns_have_a_larger_sum():
    scores = np.random.default_rng(2).normal(size=(2, 6, 5)).astype(np.float32)
    for matrix, chosen, mean in zip(scores, *best_columns(scores, 0.15), strict=True):
        sums = {columns: matrix[range(6), columns].sum(dtype=float) - 0.15 * (np.diff(columns) ** 2).sum()
                for columns in product(range(5), repeat=6) if np.abs(np.diff(columns)).max() <= 2}
        best = max(sums, key=sums.get)
        assert tuple(chosen) == best
        assert mean == pytest.approx(sums[best] / 6)


@pytest.mark.long
@pytest.mark.parametrize('more', [1, 2])
def test_clicks_that_are_off_by_a_hundredth_of_the_picture_change_nothing(more):
    example = scene(11, SIZE, off=0.0, **{**PLAIN, 'radius': 0.004})
    ends = example.camera.project(example.curve[[0, -1]])
    between = example.camera.project(example.curve[np.linspace(0, len(example.curve) - 1, 6 * more + 1)
                                                   .astype(int)[1:-1]])
    angles = np.random.default_rng(more).uniform(0, 2 * np.pi, len(between) + 2)
    clicks = np.concatenate([ends[:1], between, ends[1:]])
    rough = clicks + 0.01 * SIZE[0] * np.column_stack([np.cos(angles), np.sin(angles)])
    tracer = Tracer(picture(example))
    lines = [tracer.trace(given).pixels for given in (clicks, rough)]
    points, off = distances(example, lines[1])
    assert 1e3 * points[1:-1].mean() < 1.0 and 1e3 * off.max() < 2.0
    assert np.linalg.norm(lines[0][[0, -1]] - lines[1][[0, -1]], axis=1).max() < 2.0


@pytest.mark.parametrize('turned', [0.1, pytest.param(0.2, marks=pytest.mark.long)])
def test_the_edge_of_a_sheet_beside_an_end_does_not_lead_the_line_astray(turned):
    arc = np.linspace(0.0, 0.6, 601)
    curve = np.column_stack([arc, 0.02 * np.sin(9 * arc), np.full(601, 0.004)])
    turn = math.atan2(*np.diff(curve[-2:, 1::-1], axis=0)[0]) - turned
    along = np.array([math.cos(turn), math.sin(turn)])
    corner = curve[-1, :2] - 0.2 * along - 0.216 * np.array([-along[1], along[0]])
    sheet = Sheet(np.full((40, 40), 240, np.uint8), (0.3, 0.2), tuple(corner), turn)
    camera = Camera((1280, 720), 1300.0, 0.2, 0.0, 0.0, 1.1, (0.3, 0.0))
    look = Look(ground_colour=(0.42, 0.43, 0.45), colour=DARK, sheets=(sheet,), noise=2.5)
    line = Tracer(photograph(camera, curve, 0.004, look)).trace(camera.project(curve[::150]) + (1, -2)).pixels
    assert np.linalg.norm(line[[0, -1]] - camera.project(curve[[0, -1]]), axis=1).max() < OFF
