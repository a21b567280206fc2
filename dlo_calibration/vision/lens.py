# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Lens: the camera matrix and the distortion, from a calibration of the camera.

Pixels are (u, v), u to the right and v down from the middle of the upper left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.reading import parse_yaml, read_octets

MAXIMUM_OCTETS = 10**5  # of a file; those of camera_calibration have 1000
SAME_ASPECT = 0.005  # pictures whose aspect ratios differ by less are scaled ones; a row may be missing
#: Distortion models of sensor_msgs/CameraInfo -> the numbers of coefficients that each may have.
MODELS = {'plumb_bob': (4, 5), 'rational_polynomial': (8,), 'equidistant': (4,), 'fisheye': (4,)}
FISHEYE = ('equidistant', 'fisheye')
EXPECTED = 'the YAML file of a camera calibration (camera_calibration, or sensor_msgs/CameraInfo)'


@dataclass(frozen=True, eq=False)
class Lens:
    """
    The projection of directions to the pixels of a camera.

    :param size: width and height of the picture [px].
    :param matrix: (3, 3) camera matrix [px].
    :param coefficients: (n,) of the distortion, in OpenCV's order; empty: no distortion.
    :param fisheye: True: the coefficients are those of the equidistant model.
    """

    size: tuple[int, int]
    matrix: Floats
    coefficients: Floats
    fisheye: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, 'matrix', frozen_array(self.matrix))
        object.__setattr__(self, 'coefficients', frozen_array(self.coefficients))

    def resized(self, size: tuple[int, int]) -> Lens:
        """
        Return the lens of the same camera for pictures of another size.

        :raises InputError: where the pictures have another aspect ratio.
        """
        (width, height), (wide, high) = self.size, size
        if abs(wide * height / (width * high) - 1.0) > SAME_ASPECT:
            turned = abs(high * height / (width * wide) - 1.0) <= SAME_ASPECT
            raise InputError('camera calibration', f'pictures of {width} x {height} pixels',
                             f'the aspect ratio of the photograph, {wide} x {high} pixels',
                             'hold the camera as in the calibration' if turned
                             else 'calibrate the camera with pictures like the photograph')
        scale = np.array([wide / width, high / height, 1.0])
        matrix = self.matrix * scale[:, None]
        matrix[:2, 2] += (scale[:2] - 1.0) / 2.0  # the origin is the middle of a pixel, not its corner
        return Lens(size, matrix, self.coefficients, self.fisheye)

    def distorted(self, pixels: ArrayLike) -> Floats:
        """Return where pixels (n, 2) of a camera with this matrix and no distortion are in the picture."""
        return self._distorted(self._normal(np.asarray(pixels, float).reshape(-1, 2)))

    def undistorted(self, pixels: ArrayLike) -> Floats:
        """
        Return where pixels (n, 2) of the picture were without distortion.

        Pixels at which the distortion has no inverse become not a number.
        """
        seen = np.asarray(pixels, float).reshape(-1, 2)
        if not self.coefficients.any() and not self.fisheye or not len(seen):
            return seen.copy()
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        directions = undistort(
            np.ascontiguousarray(seen[:, None]), self.matrix, self.coefficients).reshape(-1, 2)
        # OpenCV stops after a fixed number of steps; more steps reach full precision.
        with np.errstate(all='ignore'):
            for _ in range(20):
                error = self._normal(self._distorted(directions)) - self._normal(seen)
                if not np.nanmax(np.abs(error), initial=0.0) > 1e-10:
                    break
                directions = directions - error
            unsolved = ~(np.abs(error).max(axis=1) < 1e-5)  # a hundredth of a pixel
            ideal: Floats = directions @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        ideal[unsolved] = np.nan
        return ideal

    def _normal(self, pixels: Floats) -> Floats:
        """Return x, y (n, 2) of the directions (x, y, 1) that pixels (n, 2) show."""
        (skewed, skew, across), (_, high, down) = self.matrix[:2]
        y = (pixels[:, 1] - down) / high
        return np.stack([(pixels[:, 0] - across - skew * y) / skewed, y], axis=1)

    def _distorted(self, directions: Floats) -> Floats:
        if not len(directions):
            return directions.copy()
        points = np.ascontiguousarray(directions[:, None])
        if self.fisheye:
            pixels = cv2.fisheye.distortPoints(points, self.matrix, self.coefficients)
        else:
            zero = np.zeros(3)
            pixels, _ = cv2.projectPoints(cv2.convertPointsToHomogeneous(points), zero, zero, self.matrix,
                                         self.coefficients if len(self.coefficients) else None)
        return np.asarray(pixels, float).reshape(-1, 2)


def read_lens(path: Path) -> Lens:
    """
    Read a camera calibration: the YAML of camera_calibration, or a CameraInfo of ``ros2 topic echo``.

    :raises InputError: where it cannot be read.
    """
    thing = f'camera file {path}'
    octets = read_octets(path, thing, EXPECTED, MAXIMUM_OCTETS)
    try:
        if len(octets) > MAXIMUM_OCTETS:
            raise ValueError('too large')
        document = parse_yaml(octets)
        document.get('camera_matrix', document.get('k'))
    except Exception as error:  # damaged YAML can raise anything
        raise InputError(thing, 'another kind of file', EXPECTED,
                         'name the file that the calibration wrote') from error
    return lens_of(document, thing)


def lens_of(document: dict[str, Any], thing: str) -> Lens:
    """
    Return the lens of a camera calibration's entries, named as in its YAML or in sensor_msgs/CameraInfo.

    :param thing: what it is called in errors.
    :raises InputError: where they are not those of a camera.
    """
    size = (_numbers(document, thing, ('image_width', 'width'), (1,)),
            _numbers(document, thing, ('image_height', 'height'), (1,)))
    width, height = (int(side[0]) for side in size)
    matrix = _numbers(document, thing, ('camera_matrix', 'k', 'K'), (9,)).reshape(3, 3)
    model = str(document.get('distortion_model') or '')
    names = ('distortion_coefficients', 'd', 'D')
    if model and model not in MODELS:
        raise InputError(thing, f'the distortion model {model}', f'one of {", ".join(MODELS)}',
                         'calibrate the camera with one of these models')
    coefficients = _numbers(document, thing, names, MODELS[model] if model else (0, 4, 5, 8))
    plain = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]], bool)  # entries that can be other than 0
    low, high = 0.1 * max(width, height), 100.0 * max(width, height)
    if (not 1 <= width <= 10**5 or not 1 <= height <= 10**5 or matrix[~plain].any() or matrix[2, 2] != 1.0
            or not low < matrix[0, 0] < high or not low < matrix[1, 1] < high
            or not 0.0 < matrix[0, 2] < width or not 0.0 < matrix[1, 2] < height
            or not np.abs(coefficients).max(initial=0.0) < 1e6):
        raise InputError(thing, 'numbers that no camera has', EXPECTED,
                         'check its image_width, image_height and camera_matrix')
    return Lens((width, height), matrix, coefficients, model in FISHEYE)


def _numbers(document: dict[str, Any], thing: str, names: tuple[str, ...], counts: tuple[int, ...]) -> Floats:
    """Return the numbers (n,) under the first of `names` in a document; n is in `counts`."""
    name = next((name for name in names if name in document), names[0])
    value = document.get(name)
    value = value.get('data') if isinstance(value, dict) else value
    listed = value if isinstance(value, list) else [] if value is None else [value]
    try:
        numbers = [float(entry) for entry in listed]
    except (TypeError, ValueError):
        numbers = [math.nan]
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        allowed = ' or '.join(map(str, counts))
        raise InputError(f'{thing}, {name}', f'{len(listed)} entries' if listed else 'nothing',
                         f'{allowed} finite numbers', 'name the file that the calibration wrote')
    return np.array(numbers)
