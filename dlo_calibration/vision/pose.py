# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Pose: where the camera stood, and its focal length, from points on the table.

The estimate is maximum a posteriori.  The prior is the focal length from a file or of an ordinary camera, and
nearly no distortion: a few points, which determine the lens poorly, leave it there, and a board's many
corners correct it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import itertools
import math
from typing import Any, Callable, Iterator

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.photograph import FILM_DIAGONAL
from dlo_calibration.vision.scale import Scale

#: Main cameras of telephones have 35 mm equivalents of 23 to 28 mm (e.g. 26 mm in the specifications of
#: Apple's iPhone 12 and 15), webcams with a diagonal angle of view of 78 degrees (Logitech C920) 27 mm.
ORDINARY_LENGTH = 26.0  # mm
#: Standard deviations of the focal length's logarithm.  Exif's has whole millimetres, and the picture may
#: have been stabilised or corrected, which cuts some per cent of it.
DEVIATION_ORDINARY, DEVIATION_FILE = 0.25, 0.03
DEVIATION_DISTORTION = 0.05  # of the first radial coefficient; cameras correct most of it
MARKING = 0.0005  # of the picture's longer side: deviation of a person's marks, 2 px of 4000
MARKS = 2.0  # weight of the above, in points, beside the residuals of the points
MOST_RESIDUAL = 0.01  # of the points' extent; beyond it, something is wrong
HEIGHT = 0.01  # m above the table, for which a warning gives the error from the unknown focal length
NOTICEABLE = 2e-4  # m, such an error
POOR = 2e-3  # m, a residual that careful marks stay below
FEWEST = 4  # points that determine how a plane is seen (Hartley and Zisserman, Multiple View Geometry, 4.1)
MOST = 1000
SMALLEST, LARGEST = 0.01, 20.0  # m, extent of the points on the table
PLACED = 'the pixel and the place on the table of four points or more'
#: Smallest singular value but one of the homography's equations, of the largest: 0.36 for the corners of a
#: square, 0 where no four of the points are in general position.
GENERAL = 0.01


def scale_from_points(pixels: ArrayLike, table: ArrayLike, size: tuple[int, int], lens: Lens | None = None,
                      focal_length: float | None = None) -> Scale:
    """
    Return the scale of a photograph from points on its table.

    :param pixels: (k, 2) where the points are seen, k >= 4 [px].
    :param table: (k, 2) where they are on the table [m].
    :param size: width and height of the photograph [px].
    :param lens: of the camera, calibrated; or else
    :param focal_length: from the photograph's file [px].
    :raises InputError: where they cannot be right.
    """
    marked, places = _check_points(pixels, table, size)
    lens = None if lens is None else lens.resized(size)
    problem = _Problem(marked, places, size, lens, focal_length)
    for row in np.flatnonzero(np.isnan(problem.ideal).any(axis=1)):
        raise InputError(f'scale, point {row + 1}', 'a pixel so far outside that its direction is unknown',
                         'one that the camera calibration covers', 'mark a point nearer to the middle')
    _check_sides(problem.ideal, places, lambda: _exchanged(problem))
    scale, _ = problem.fit()
    if not np.isfinite(scale.residual):
        raise InputError('scale', 'points that no camera in front of the table sees so',
                         'an image as the camera made it, neither cut nor beside another one',
                         'take the image itself, check that all places are in metres, or give --camera')
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    if not scale.residual <= MOST_RESIDUAL * extent:
        raise InputError(
            'scale', f'points that miss their places on the table by {1e3 * scale.residual:.1f} mm (rms)',
            f'at most {1e3 * MOST_RESIDUAL * extent:.1f} mm', _remedy(problem, scale.residuals))
    return replace(scale, warnings=tuple(_warnings(scale, len(marked))))


def scale_from_length(line: ArrayLike, length: float, size: tuple[int, int], lens: Lens | None = None,
                      focal_length: float | None = None) -> Scale:
    """
    Return the scale of a photograph that looks squarely at a plane, from one length in this plane.

    The plane's x points to the right in the photograph, its y up, and its origin is the line's first point.

    :param line: (k, 2) along what has the length, k >= 2 [px].
    :param length: [m].
    :param size: width and height of the photograph [px].
    :param lens: of the camera, calibrated; or else
    :param focal_length: from the photograph's file [px].
    :raises InputError: where the length is out of range.
    """
    if not SMALLEST <= length <= LARGEST:
        raise InputError('scale', f'a length of {length:.3g} m', f'{SMALLEST:g} m to {LARGEST:g} m',
                         'give it in metres')
    known = lens is not None or focal_length is not None
    lens = _plain_lens(size, focal_length or _ordinary(size)) if lens is None else lens.resized(size)
    ideal = lens.undistorted(line)
    pixels = float(np.linalg.norm(np.diff(ideal, axis=0), axis=1).sum())
    if not pixels > 1.0:
        raise InputError('scale', 'a length between two clicks at one place', 'clicks apart', 'move one')
    distance = lens.matrix[0, 0] * length / pixels  # from the camera
    return Scale(lens, np.diag([1.0, -1.0, -1.0]), distance * np.linalg.solve(lens.matrix, [*ideal[0], 1.0]),
                 np.zeros(1), known)


def _ordinary(size: tuple[int, int]) -> float:
    """Return the focal length of an ordinary camera [px]."""
    return ORDINARY_LENGTH / FILM_DIAGONAL * math.hypot(*size)


def _plain_lens(size: tuple[int, int], length: float, first: float = 0.0) -> Lens:
    """Return the lens with a focal length [px], and a first radial coefficient of distortion."""
    middle = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    matrix = np.array([[length, 0.0, middle[0]], [0.0, length, middle[1]], [0.0, 0.0, 1.0]])
    return Lens(size, matrix, np.array([first, 0.0, 0.0, 0.0]))


@dataclass(frozen=True, eq=False)
class _Problem:
    """
    The pixels (k, 2) [px] of points, and their places (k, 2) on the table [m].

    The parameters are those of `Scale.parameters`, the last two only where no lens is given.
    """

    pixels: Floats
    table: Floats
    size: tuple[int, int]
    lens: Lens | None
    focal_length: float | None

    @cached_property
    def ideal(self) -> Floats:
        """The pixels (k, 2) without the lens's distortion."""
        return self.pixels if self.lens is None else self.lens.undistorted(self.pixels)

    @cached_property
    def _prior(self) -> Floats:
        return np.array([math.log(self.focal_length or _ordinary(self.size)), 0.0])

    @cached_property
    def _deviations(self) -> Floats:
        return np.array([DEVIATION_FILE if self.focal_length else DEVIATION_ORDINARY, DEVIATION_DISTORTION])

    def without(self, row: int) -> _Problem:
        """Return the problem without a point."""
        return replace(self, pixels=np.delete(self.pixels, row, axis=0),
                       table=np.delete(self.table, row, axis=0))

    def exchanged(self, first: int, second: int) -> _Problem:
        """Return the problem with two points' places on the table exchanged."""
        table = self.table.copy()
        table[[first, second]] = table[[second, first]]
        return replace(self, table=table)

    def lens_of(self, parameters: Floats) -> Lens:
        """Return the lens that parameters (p,) describe."""
        if self.lens is not None:
            return self.lens
        return _plain_lens(self.size, math.exp(parameters[6]), parameters[7])

    def fit(self) -> tuple[Scale, float]:
        """Return the best solution, and its cost."""
        deviation = MARKING * max(self.size)
        best = min((self._searched(start, deviation) for start in self._starts()), key=lambda best: best.cost)
        squares = float(np.square(self._errors(best.x)).sum())
        freedom = max(2 * len(self.pixels) - 8, 0)
        measured = math.sqrt((MARKS * deviation**2 + squares) / (MARKS + freedom))
        solution = self._searched(best.x, measured)
        slopes = self._slopes(solution.x, measured)
        scale = Scale(self.lens_of(solution.x), cv2.Rodrigues(np.ascontiguousarray(solution.x[:3]))[0],
                      solution.x[3:6], np.zeros(1), self.lens is not None or self.focal_length is not None,
                      covariance=np.linalg.pinv(slopes.T @ slopes).astype(float))
        missed: Floats = np.linalg.norm(scale.points(self.pixels)[:, :2] - self.table, axis=1)
        missed[np.isnan(missed)] = np.inf
        return replace(scale, residuals=missed), float(solution.cost)

    def _starts(self) -> list[Floats]:
        """Return parameters (p,) from which a search for the best ones begins."""
        starts = []
        lengths = [math.exp(self._prior[0])]
        if self.lens is None and self.focal_length is None:
            lengths += [factor * lengths[0] for factor in (0.6, 1.7)]
        view, _ = cv2.findHomography(self.table, self.ideal, 0)
        for length in lengths:
            lens = self.lens_of(np.array([0.0] * 6 + [math.log(length), 0.0]))
            for rotation, shift in _poses(np.linalg.inv(lens.matrix) @ view, self.table.mean(axis=0)):
                turn = cv2.Rodrigues(rotation)[0].ravel()
                start = np.concatenate([turn, shift, [math.log(length), 0.0]])
                starts.append(start if self.lens is None else start[:6])
        return starts

    def _searched(self, start: Floats, deviation: float) -> Any:
        """Search from parameters (p,); the pixels have a standard deviation [px]."""
        return least_squares(
            lambda values: self._weighted(self._errors(values) / deviation, values), start,
            jac=lambda values: self._slopes(values, deviation), method='lm', x_scale='jac', max_nfev=200)

    def _weighted(self, errors: Floats, values: Floats) -> Floats:
        if self.lens is not None:
            return errors
        return np.concatenate([errors, (values[6:] - self._prior) / self._deviations])

    def _projected(self, values: Floats) -> tuple[Floats, Floats]:
        """Return the pixels (k, 2), and their derivatives (2 k, 15 or 10) in OpenCV's order."""
        lens = self.lens_of(values)
        points = np.column_stack([self.table, np.zeros(len(self.table))])
        turn, shift = np.ascontiguousarray(values[:3]), np.ascontiguousarray(values[3:6])
        coefficients = None if self.lens is not None else lens.coefficients
        pixels, slopes = cv2.projectPoints(points, turn, shift, lens.matrix, coefficients)
        return pixels.reshape(-1, 2), slopes

    def _errors(self, values: Floats) -> Floats:
        return (self._projected(values)[0] - self.ideal).ravel()

    def _slopes(self, values: Floats, deviation: float) -> Floats:
        """Return the derivatives (2 k or 2 k + 2, p) of the weighted errors."""
        slopes = self._projected(values)[1]
        if self.lens is not None:
            return slopes[:, :6] / deviation
        length = (slopes[:, 6] + slopes[:, 7]) * math.exp(values[6])
        wanted = np.column_stack([slopes[:, :6], length, slopes[:, 10]]) / deviation
        return np.concatenate([wanted, np.column_stack([np.zeros((2, 6)), np.diag(1.0 / self._deviations)])])


def _poses(view: Floats, middle: Floats) -> Iterator[tuple[Floats, Floats]]:
    """
    Give two rotations (3, 3) and translations (3,) [m] of a camera that sees a plane by a homography (3, 3).

    The homography's columns are two axes of the rotation and the translation (Zhang, A flexible new technique
    for camera calibration, IEEE TPAMI 22(11), 2000).  From afar, a plane that is inclined to the line of
    sight the other way looks nearly the same (Collins and Bartoli, Infinitesimal plane-based pose estimation,
    IJCV 109, 2014).

    :param middle: (2,) of the points on the plane [m].
    """
    first, second, shift = view.T * math.copysign(1.0, view[2] @ [*middle, 1.0])
    size = np.linalg.norm(first) + np.linalg.norm(second)
    left, _, right = np.linalg.svd(np.stack([first, second, 2.0 * np.cross(first, second) / size], axis=1))
    rotation, shift = left @ right, 2.0 * shift / size
    yield rotation, shift
    seen = rotation[:, :2] @ middle + shift
    inclined = np.cross(rotation[:, 2], -seen / np.linalg.norm(seen))
    sine = float(np.linalg.norm(inclined))
    if sine > 1e-3:
        other = cv2.Rodrigues(inclined * (2.0 * math.asin(min(sine, 1.0)) / sine))[0] @ rotation
        yield other, seen - other[:, :2] @ middle


def _exchanged(problem: _Problem) -> str:
    """Return the sentence that names two exchanged points; empty: there are none."""
    extent = float(np.linalg.norm(np.ptp(problem.table, axis=0)))
    count = min(len(problem.pixels), 10)
    fits = []
    for first, second in itertools.combinations(range(count), 2):
        other = problem.exchanged(first, second)
        try:
            _check_sides(other.ideal, other.table, lambda: '')
        except InputError:
            continue
        scale, cost = other.fit()
        if scale.residual <= MOST_RESIDUAL * extent:
            fits.append((cost, first + 1, second + 1))
    return 'points {1} and {2} seem to be exchanged'.format(*min(fits)) if fits else ''


def _remedy(problem: _Problem, residuals: Floats) -> str:
    """Return the sentence that names the point to which a bad solution is probably due."""
    if sentence := _exchanged(problem):
        return sentence
    count = len(problem.pixels)
    if 5 < count <= 12:  # the others can still contradict each other, and the search takes no time
        worst = min(range(count), key=lambda row: problem.without(row).fit()[0].residual)
    else:
        worst = int(np.argmax(residuals))
    return f'look at point {worst + 1} first, and check that all places are in metres'


def _warnings(scale: Scale, count: int) -> list[str]:
    """Return the warnings about a scale from `count` points."""
    warnings = []
    length = scale.lens.matrix[0, 0]
    if not scale.focal_length_known:
        deviation = math.sqrt(scale.covariance[6, 6])
        film = length * FILM_DIAGONAL / math.hypot(*scale.size)
        estimated = deviation < 0.7 * DEVIATION_ORDINARY
        origin = 'found from the points' if estimated else 'that of an ordinary telephone'
        warnings.append(f'The photograph does not contain its focal length, so it is {origin}: '
                        f'{film:.0f} mm of 35 mm film, give or take {100 * deviation:.0f} %.')
    quarters = np.array(list(itertools.product((0.25, 0.75), repeat=2))) * scale.size
    error = float(np.median(scale.uncertainty(quarters, HEIGHT, above=0.0)))
    if not error <= NOTICEABLE:
        warnings.append(f'A point {1e3 * HEIGHT:.0f} mm above the table is placed with an error of about '
                        f'{1e3 * error:.1f} mm: calibrate the camera if that is too much.')
    if scale.residual > POOR:
        worst = int(np.argmax(scale.residuals))
        warnings.append(f'The points miss their places by {1e3 * scale.residual:.1f} mm (rms), '
                        f'point {worst + 1} by {1e3 * scale.residuals[worst]:.1f} mm: mark them again.')
    if count == 4:
        warnings.append(
            'Four points fit nearly always, even if one is wrong: check the grid, or mark a fifth one.')
    return warnings


def _check_points(pixels: ArrayLike, table: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """
    Return the pixels (k, 2) and the places on the table (k, 2) [m] as arrays.

    :param size: width and height of the photograph [px].
    :raises InputError: where they are too few or too many, no numbers, outside, or nearly on one line.
    """
    marked, places = (np.asarray(given, float) for given in (pixels, table))
    if marked.ndim != 2 or marked.shape[1:] != (2,) or marked.shape != places.shape:
        raise InputError('scale', f'arrays of shape {marked.shape} and {places.shape}', PLACED,
                         'give as many of both')
    count = len(marked)
    if not FEWEST <= count <= MOST:
        raise InputError('scale', f'{count} points', PLACED,
                         'mark more points' if count < FEWEST else 'mark fewer')
    for row, (pixel, place) in enumerate(zip(marked, places, strict=True), 1):
        if not np.isfinite(pixel).all() or not np.isfinite(place).all():
            raise InputError(f'scale, point {row}', 'no finite number', PLACED, 'correct it')
        if (pixel < -0.5).any() or (pixel > np.array(size) - 0.5).any():
            raise InputError(f'scale, point {row}', f'the pixel {pixel[0]:g},{pixel[1]:g}',
                             f'a pixel of the photograph, {size[0]} x {size[1]}', 'mark it again')
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    if not SMALLEST <= extent <= LARGEST:
        raise InputError('scale', f'points on the table with an extent of {extent:.3g} m',
                         f'{SMALLEST:g} m to {LARGEST:g} m', 'give their places in metres')
    if not (_general(places) and _general(marked)):
        raise InputError('scale', 'points that are all, or all but one, nearly on one line',
                         'four points of which no three are on one line',
                         'mark points around the DLO, like the corners of a rectangle')
    return marked, places


def _check_sides(ideal: Floats, table: Floats, exchanged: Callable[[], str]) -> None:
    """
    Check that pixels without distortion (k, 2) show points of a table (k, 2) from above.

    :param exchanged: returns the sentence that names two exchanged points, or an empty text.
    :raises InputError: where the table is seen as in a mirror, or some points behind the camera.
    """
    matrix, _ = cv2.findHomography(table, ideal, 0)
    if matrix is None or not np.isfinite(matrix).all():
        raise InputError('scale', 'pixels that fit no view of the places', PLACED,
                         exchanged() or 'check them one by one')
    depth = np.column_stack([table, np.ones(len(table))]) @ matrix[2]
    if depth.min() * depth.max() <= 0.0:
        raise InputError('scale', 'points in an order in which no camera sees them',
                         'the places on the table in the order of the pixels',
                         exchanged() or 'check the points one by one')
    # v points down in the picture, so that a table seen from above turns round (determinant below zero).
    if np.linalg.det(matrix) * depth[0] > 0.0:
        raise InputError('scale', 'a table that is seen as in a mirror',
                         'x and y such that, seen from above, y is x turned anticlockwise',
                         'change the sign of y, or check the order of the points')


def _general(points: Floats) -> bool:
    """
    Tell whether four of the points (k, 2) are in general position.

    Only then do the equations of the homography from the points to themselves have one solution.
    """
    centred = points - points.mean(axis=0)
    x, y = (centred / max(float(np.sqrt(np.square(centred).sum(axis=1).mean())), 1e-12)).T
    zeros, ones = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate([np.stack([x, y, ones, zeros, zeros, zeros, -x * x, -x * y, -x], axis=1),
                           np.stack([zeros, zeros, zeros, x, y, ones, -y * x, -y * y, -y], axis=1)])
    values = np.linalg.svd(rows, compute_uv=False)
    return bool(values[7] > GENERAL * values[0])
