# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The scale gives the point on or above the table that a pixel shows; impossible points are refused."""

import math

import numpy as np
import pytest
from sheet_views import LENGTH, on_table, overhead, SIZE

from dlo_calibration.errors import InputError
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import grid

CORNERS = np.array([[-0.25, -0.18], [0.25, -0.18], [0.25, 0.18], [-0.25, 0.18]])  # m
SIX = np.concatenate([CORNERS, [[0.0, 0.15], [0.03, -0.14]]])
EIGHT = np.concatenate([SIX, [[-0.2, 0.02], [0.22, 0.05]]])
#: The corners of a board that lies on one side [m].
BOARD = np.array([[0.1 + 0.025 * column, -0.09 + 0.025 * row] for row in range(8) for column in range(6)])
INSIDE = np.array([[x, y] for x in np.linspace(-0.22, 0.22, 5) for y in np.linspace(-0.15, 0.15, 5)])  # m
VIEWS = [(0.0, 10.0), (15.0, 100.0), (40.0, 200.0), (40.0, -60.0)]  # tilt and turn [degrees]


def scale_seen_by(camera, places, lens=None, focal_length=None, noise=0.0, seed=0):
    """Return the scale from the pixels at which a camera sees places (k, 2) on the table."""
    errors = np.random.default_rng(seed).normal(size=(len(places), 2)) * noise
    pixels = camera.to_pixels(on_table(places)) + errors
    return scale_from_points(pixels, places, camera.size, lens, focal_length)


def misplaced(scale, camera, height, places=INSIDE):
    """Return the errors (n,) of a scale for points at a height above places (n, 2) [m]."""
    truth = on_table(places, height)
    return np.linalg.norm(scale.to_table(camera.to_pixels(truth), height) - truth, axis=1)


def refusal(camera, pixels, places):
    with pytest.raises(InputError) as caught:
        scale_from_points(pixels, places, camera.size, focal_length=LENGTH)
    assert str(caught.value).startswith('scale')
    return str(caught.value)


@pytest.mark.parametrize('places', [CORNERS, BOARD], ids=['corners', 'board'])
@pytest.mark.parametrize('coefficients', [(), (-0.15, 0.05, 0.001, -0.001, 0.01)], ids=['straight', 'bent'])
@pytest.mark.parametrize('tilt, turn', VIEWS)
def test_a_calibrated_camera_is_found_exactly(tilt, turn, coefficients, places):
    camera = overhead(tilt, turn, coefficients=coefficients)
    scale = scale_seen_by(camera, places, camera.lens)
    assert scale.residual < 1e-6
    assert scale.focal_length_known
    assert scale.camera == pytest.approx(camera.camera, abs=1e-4)
    assert math.acos(-scale.rotation[2, 2]) == pytest.approx(math.radians(tilt), abs=1e-3)
    for height in (0.0, 0.01, 0.2):
        assert misplaced(scale, camera, height).max() < 1e-5


def test_a_fisheye_camera_is_found_exactly():
    camera = overhead(30.0)
    camera = type(camera)(Lens(SIZE, camera.lens.matrix, [-0.02, 0.005, 0.0, 0.0], True), camera.rotation,
                          camera.translation, camera.residuals, True)
    assert misplaced(scale_seen_by(camera, CORNERS, camera.lens), camera, 0.01).max() < 1e-5


def test_each_point_has_its_height():
    """At a crossing, the upper strand lies higher."""
    camera = overhead(30.0)
    scale = scale_seen_by(camera, EIGHT, camera.lens)
    heights = np.linspace(0.0, 0.05, len(INSIDE))
    truth = on_table(INSIDE, heights)
    assert scale.to_table(camera.to_pixels(truth), heights) == pytest.approx(truth, abs=1e-6)
    assert scale.to_pixels(truth) == pytest.approx(camera.to_pixels(truth), abs=1e-2)


def test_a_point_above_the_table_is_shifted_away_from_the_camera():
    """Seen under 40 degrees, a point seems to lie its height * tan(40 degrees) farther away."""
    camera = overhead(40.0)
    shift = camera.to_table(camera.to_pixels([[0.0, 0.0, 0.01]]))[0]
    assert np.linalg.norm(shift) == pytest.approx(0.0102 * math.tan(math.radians(40.0)), rel=0.02)


@pytest.mark.parametrize('tilt, turn', VIEWS)
@pytest.mark.parametrize('places', [CORNERS, BOARD], ids=['corners', 'board'])
def test_small_errors_of_marks_do_little_harm(tilt, turn, places):
    """Marks are 0.8 px off (2 px of 12 megapixels), and the focal length in the file by 3 %."""
    camera = overhead(tilt, turn)
    scale = scale_seen_by(camera, places, focal_length=1.03 * LENGTH, noise=0.8 if len(places) == 4 else 0.1)
    assert scale.residual < 8e-4
    missed = misplaced(scale, camera, 0.005)
    assert np.median(missed) < 7e-4
    assert missed.max() < 2.5e-3


@pytest.mark.parametrize('factor', [0.75, 1.0, 1.5])
def test_an_unknown_focal_length_is_found_in_a_tilted_view(factor):
    camera = overhead(40.0, distance=0.8 * factor, length=factor * LENGTH)
    scale = scale_seen_by(camera, EIGHT, noise=0.1)
    assert scale.lens.matrix[0, 0] == pytest.approx(factor * LENGTH, rel=0.03)
    assert not scale.focal_length_known
    assert any('found from the points' in warning for warning in scale.warnings)
    assert misplaced(scale, camera, 0.01).max() < 5e-4


def test_an_unknown_focal_length_cannot_be_found_from_above():
    scale = scale_seen_by(overhead(0.0), CORNERS)
    assert any('ordinary telephone' in warning for warning in scale.warnings)
    assert any('10 mm above the table' in warning for warning in scale.warnings)
    assert misplaced(scale, overhead(0.0), 0.0).max() < 5e-4


def test_a_poor_fit_is_reported():
    camera = overhead(20.0)
    places = EIGHT.copy()
    places[6] += (0.006, 0.006)  # m
    warnings = scale_from_points(camera.to_pixels(on_table(EIGHT)), places, SIZE, camera.lens).warnings
    assert any('point 7 by' in warning for warning in warnings)


def test_a_calibrated_camera_causes_no_warning_about_its_lens():
    camera = overhead(20.0)
    assert scale_seen_by(camera, EIGHT, camera.lens).warnings == ()
    (warning,) = scale_seen_by(camera, CORNERS, camera.lens).warnings
    assert 'Four points' in warning


def test_the_many_corners_of_a_board_show_the_distortion():
    camera = overhead(25.0, coefficients=(-0.08, 0.0, 0.0, 0.0))
    places = BOARD - (0.16, 0.0)
    truth = on_table(BOARD - (0.16, 0.0))
    straight = Lens(SIZE, camera.lens.matrix, np.zeros(0))
    pixels = camera.to_pixels(truth) + np.random.default_rng(1).normal(scale=0.1, size=(len(truth), 2))
    ignored = misplaced(scale_from_points(pixels, places, SIZE, straight), camera, 0.0).max()
    corrected = misplaced(scale_from_points(pixels, places, SIZE, focal_length=LENGTH), camera, 0.0).max()
    assert corrected < 0.5 * ignored


def test_the_uncertainty_agrees_with_the_errors():
    """The mean square of error by uncertainty is 1; the priors make it somewhat less."""
    camera = overhead(20.0)
    ratios = []
    for seed in range(30):
        scale = scale_seen_by(camera, EIGHT, camera.lens, noise=0.8, seed=seed)
        pixels = camera.to_pixels(on_table(INSIDE, 0.005))
        ratios.append(misplaced(scale, camera, 0.005) / scale.uncertainty(pixels, 0.005))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_the_uncertainty_of_heights_shrinks_with_a_known_focal_length():
    camera = overhead(10.0)
    middle = [[SIZE[0] / 2.0, SIZE[1] / 2.0]]
    from_points, calibrated = (scale_seen_by(camera, CORNERS, lens).uncertainty(middle, 0.01, above=0.0)[0]
                    for lens in (None, camera.lens))
    assert calibrated < 0.7 * from_points


@pytest.mark.parametrize('tilt', [0.0, 40.0])
def test_a_pixel_has_the_size_of_its_square_on_the_table(tilt):
    camera = overhead(tilt, distance=1.0)
    size = camera.metres_per_pixel([[(SIZE[0] - 1) / 2.0, (SIZE[1] - 1) / 2.0]])[0]
    assert size == pytest.approx(1.0 / LENGTH / math.sqrt(math.cos(math.radians(tilt))), rel=1e-3)


def test_places_above_the_horizon_are_refused():
    camera = overhead(80.0)
    with pytest.raises(InputError, match='above the horizon'):
        camera.to_table([[800.0, 0.0]])


@pytest.mark.parametrize('count', [0, 3, 1001])
def test_too_few_and_too_many_points_are_refused(count):
    assert f'{count} points' in refusal(overhead(), np.full((count, 2), 5.0), np.zeros((count, 2)))


def test_pixels_and_places_of_different_numbers_are_refused():
    assert 'shape' in refusal(overhead(), np.zeros((5, 2)), np.zeros((4, 2)))


@pytest.mark.parametrize('places, words', [
    (np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.1, 0.1]]), 'on one line'),
    (np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [0.15, 0.001]]), 'on one line'),
    (np.array([[0.0, 0.0], [0.0, 0.0], [0.2, 0.0], [0.1, 0.1]]), 'on one line'),
    (np.zeros((4, 2)), 'extent of 0 m'),
    (1000.0 * CORNERS, 'give their places in metres'),
    (CORNERS * [[1.0, math.nan]], 'point 1: no finite number'),
])
def test_places_that_determine_no_scale_are_refused(places, words):
    camera = overhead()
    pixels = camera.to_pixels(on_table(CORNERS))
    pixels = np.concatenate([pixels, [[800.0, 650.0]]])[:len(places)]
    assert words in refusal(camera, pixels, places)


def test_pixels_on_one_line_are_refused():
    assert 'on one line' in refusal(overhead(), [[10, 10], [200, 200], [300, 300], [200, 400]], CORNERS)


def test_an_image_that_stands_beside_another_one_is_refused():
    pixels = np.array([[266.0, 393.0], [757.0, 388.0], [700.0, 180.0], [150.0, 180.0]])
    places = np.array([[-0.277, 0.251], [0.589, 0.26], [0.701, 0.788], [-0.696, 0.788]])
    scale_from_points(pixels, places, (848, 480))
    with pytest.raises(InputError, match='neither cut nor beside another one'):
        scale_from_points(pixels, places, (1696, 480))


def test_pixels_outside_are_refused():
    camera = overhead()
    pixels = camera.to_pixels(on_table(CORNERS))
    pixels[2] = SIZE[0] + 3, 10
    assert 'point 3: the pixel 1603,10' in refusal(camera, pixels, CORNERS)


@pytest.mark.parametrize('change', [[-1.0, 1.0], [1.0, -1.0]])
@pytest.mark.parametrize('places', [CORNERS, EIGHT], ids=['four', 'eight'])
def test_a_table_seen_as_in_a_mirror_is_refused(places, change):
    camera = overhead()
    message = refusal(camera, camera.to_pixels(on_table(places)), places * change)
    assert 'mirror' in message
    assert 'change the sign of y' in message


@pytest.mark.parametrize('places', [CORNERS, SIX, EIGHT, BOARD], ids=['four', 'six', 'eight', 'board'])
@pytest.mark.parametrize('first, second', [(1, 2), pytest.param(3, 4, marks=pytest.mark.long)])
def test_exchanged_points_are_named(places, first, second):
    camera = overhead(25.0)
    pixels = camera.to_pixels(on_table(places))
    rows = np.arange(len(places))
    rows[[first - 1, second - 1]] = second - 1, first - 1
    message = refusal(camera, pixels, places[rows])
    assert f'points {first} and {second} seem to be exchanged' in message


@pytest.mark.parametrize('wrong', [0, 4, 7])
def test_the_point_with_a_wrong_place_is_named(wrong):
    camera = overhead(25.0)
    places = EIGHT.copy()
    places[wrong] += (0.05, 0.03)  # m
    message = refusal(camera, camera.to_pixels(on_table(EIGHT)), places)
    assert f'look at point {wrong + 1} first' in message
    assert 'mm (rms)' in message


def test_a_calibration_of_another_camera_is_refused():
    camera = overhead()
    lens = Lens((1000, 1000), [[900.0, 0.0, 500.0], [0.0, 900.0, 500.0], [0.0, 0.0, 1.0]], np.zeros(5))
    with pytest.raises(InputError, match='aspect ratio'):
        scale_from_points(camera.to_pixels(on_table(CORNERS)), CORNERS, SIZE, lens)


@pytest.mark.parametrize('tilt, turn', [*VIEWS, (75.0, 20.0)])
def test_the_grid_lies_on_the_table(tilt, turn):
    camera = overhead(tilt, turn, coefficients=(-0.1, 0.02, 0.0, 0.0))
    lines = grid(camera)
    assert {label[:2] for label, _ in lines} == {'x ', 'y '}
    values = sorted({float(label[2:]) for label, _ in lines if label[0] == 'x'})
    assert 3 < len(values) < 20
    assert np.diff(values) == pytest.approx(np.full(len(values) - 1, values[1] - values[0]))
    for label, line in lines:
        assert ((line > -1.0) & (line < SIZE)).all()
        assert camera.to_table(line)[:, 'xy'.index(label[0])] == pytest.approx(float(label[2:]), abs=1e-4)


def test_the_grid_of_a_picture_without_a_table_is_empty():
    camera = overhead(0.0)
    upwards = type(camera)(camera.lens, np.diag([1.0, -1.0, -1.0]) @ camera.rotation, camera.translation,
                           camera.residuals, True)
    assert grid(type(camera)(camera.lens, upwards.rotation, [0.0, 0.0, -1.0], camera.residuals, True)) == []
