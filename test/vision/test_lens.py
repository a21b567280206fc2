# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Camera calibrations are read as ROS writes them; distortion is removed and applied exactly."""

import os

import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.vision.lens import Lens, read_lens

FILE = """\
image_width: 1280
image_height: 960
camera_name: telephone
camera_matrix:
  rows: 3
  cols: 3
  data: [1000.0, 0.0, 640.0, 0.0, 1010.0, 470.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.05, 0.001, -0.002, 0.01]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""
ECHO = """\
header:
  stamp:
    sec: 1
    nanosec: 2
  frame_id: camera
height: 960
width: 1280
distortion_model: plumb_bob
d:
- -0.1
- 0.05
- 0.001
- -0.002
- 0.01
k:
- 1000.0
- 0.0
- 640.0
- 0.0
- 1010.0
- 470.0
- 0.0
- 0.0
- 1.0
binning_x: 0
---
header: {}
"""
PLACES = np.array([[640.0, 470.0], [0.0, 0.0], [1279.0, 959.0], [100.0, 900.0], [900.0, 20.0]])  # px


def lens_of(text, folder):
    path = folder / 'camera.yaml'
    path.write_text(text, encoding='utf-8')
    return read_lens(path)


def refusal(text, folder):
    with pytest.raises(InputError) as caught:
        lens_of(text, folder)
    assert 'camera.yaml' in str(caught.value)
    return str(caught.value)


def plumb_bob(lens, pixels):
    """Brown's model, as REP 104 and sensor_msgs/CameraInfo describe it."""
    k1, k2, p1, p2, k3 = lens.coefficients
    x, y = ((pixels - lens.matrix[:2, 2]) / np.diag(lens.matrix)[:2]).T
    square = x**2 + y**2
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    bent = np.stack([x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
                     y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y], axis=1)
    return bent * np.diag(lens.matrix)[:2] + lens.matrix[:2, 2]


@pytest.mark.parametrize('text', [FILE, ECHO], ids=['camera_calibration', 'CameraInfo'])
def test_a_calibration_is_read(text, tmp_path):
    lens = lens_of(text, tmp_path)
    assert lens.size == (1280, 960)
    assert lens.matrix.tolist() == [[1000.0, 0.0, 640.0], [0.0, 1010.0, 470.0], [0.0, 0.0, 1.0]]
    assert lens.coefficients.tolist() == [-0.1, 0.05, 0.001, -0.002, 0.01]
    assert lens.distorted(PLACES) == pytest.approx(plumb_bob(lens, PLACES), abs=1e-6)


@pytest.mark.parametrize('model, coefficients', [
    ('plumb_bob', [-0.3, 0.1, 0.001, -0.002, 0.0]),
    ('rational_polynomial', [0.5, -0.1, 0.0005, -0.0005, 0.01, 0.6, -0.05, 0.02]),
    ('equidistant', [-0.02, 0.01, -0.005, 0.001]),
    ('plumb_bob', [0.0] * 5),
])
def test_distortion_is_removed_exactly(model, coefficients, tmp_path):
    text = FILE.replace('plumb_bob', model).replace('[-0.1, 0.05, 0.001, -0.002, 0.01]', str(coefficients))
    lens = lens_of(text, tmp_path)
    ideal = lens.undistorted(PLACES)
    assert lens.distorted(ideal) == pytest.approx(PLACES, abs=1e-3)
    assert ideal[0] == pytest.approx(PLACES[0], abs=1e-6)
    assert (np.abs(ideal - PLACES).max() > 5.0) == any(coefficients)


def test_a_fisheye_lens_sees_angles():
    """Without coefficients, the distance from the middle is the angle times the focal length."""
    matrix = [[500.0, 0.0, 1000.0], [0.0, 500.0, 1000.0], [0.0, 0.0, 1.0]]
    lens = Lens((2000, 2000), matrix, np.zeros(4), True)
    seen = np.array([[1000.0 + 500.0 * np.radians(50.0), 1000.0]])
    ideal = np.array([[1000.0 + 500.0 * np.tan(np.radians(50.0)), 1000.0]])
    assert lens.undistorted(seen) == pytest.approx(ideal, abs=1e-4)
    assert lens.distorted(ideal) == pytest.approx(seen, abs=1e-4)


def test_a_pixel_that_no_direction_reaches_becomes_not_a_number():
    """With strong barrel distortion, no direction is seen farther from the middle than 0.77 focal lengths."""
    lens = Lens((4000, 100), [[1000.0, 0.0, 2000.0], [0.0, 1000.0, 50.0], [0.0, 0.0, 1.0]],
                [-0.25, 0.0, 0.0, 0.0])
    assert np.isnan(lens.undistorted([[3500.0, 50.0]])).all()
    assert np.isfinite(lens.undistorted([[2600.0, 50.0]])).all()


def test_a_calibration_serves_photographs_of_other_sizes(tmp_path):
    lens = lens_of(FILE, tmp_path)
    large = lens.resized((2560, 1920))
    # Pixel (0, 0) of the small picture is the middle of four pixels of the large one.
    ideal = 2.0 * lens.undistorted(PLACES) + 0.5
    assert large.undistorted(2.0 * PLACES + 0.5) == pytest.approx(ideal, abs=1e-6)
    with pytest.raises(InputError, match='aspect ratio'):
        lens.resized((1920, 1080))
    with pytest.raises(InputError, match='hold the camera as in the calibration'):
        lens.resized((960, 1280))


def test_a_calibration_without_distortion_has_none(tmp_path):
    text = FILE.replace('plumb_bob', "''").replace('[-0.1, 0.05, 0.001, -0.002, 0.01]', '[]')
    lens = lens_of(text, tmp_path)
    assert np.array_equal(lens.undistorted(PLACES), PLACES)
    assert lens.distorted(PLACES) == pytest.approx(PLACES)


@pytest.mark.parametrize('old, new, words', [
    ('plumb_bob', 'thin_prism', 'distortion model thin_prism'),
    ('[-0.1, 0.05, 0.001', '[-0.1', 'distortion_coefficients'),
    ('[1000.0, 0.0, 640.0,', '[1000.0, 0.0,', 'camera_matrix'),
    ('[1000.0,', '[.nan,', 'camera_matrix'),
    ('[1000.0,', '[-1000.0,', 'numbers that no camera has'),
    ('[1000.0,', '[1.0,', 'numbers that no camera has'),
    ('640.0', '64000.0', 'numbers that no camera has'),
    ('-0.1', '1e300', 'numbers that no camera has'),
    ('image_width: 1280', '', 'image_width'),
    ('image_width: 1280', 'image_width: 1e400', 'image_width'),
    ('image_width: 1280', 'image_width: 0', 'numbers that no camera has'),
    ('image_width: 1280', 'image_width: {}', 'image_width'),
    ('camera_matrix', 'matrix', 'camera_matrix'),
])
def test_a_calibration_with_impossible_values_is_refused(old, new, words, tmp_path):
    assert old in FILE
    assert words in refusal(FILE.replace(old, new), tmp_path)


@pytest.mark.parametrize('text', [
    '', 'no calibration', '- 1\n- 2\n', 'a: [', '%YAML:1.0\n---\n', '\0', 'a: &a [1]\nb: *a\n', '[' * 5000,
    '? [a]\n: b\n', 'a: 1\n' * 30000,
], ids=['empty', 'text', 'list', 'unfinished', 'OpenCV', 'binary', 'alias', 'deep', 'key', 'long'])
def test_a_file_that_is_no_calibration_is_refused(text, tmp_path):
    assert 'camera calibration' in refusal(text, tmp_path)


def test_a_path_without_a_file_is_refused(tmp_path):
    with pytest.raises(InputError, match='No such file'):
        read_lens(tmp_path / 'camera.yaml')
    os.mkfifo(tmp_path / 'camera.yaml')
    with pytest.raises(InputError, match='a FIFO'):
        read_lens(tmp_path / 'camera.yaml')
