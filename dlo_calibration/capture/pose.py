# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Pose: where the camera stood, and its focal length, from points on the table.

What is known before the points are seen goes in as an observation with its standard deviation: the focal
length from a file or of an ordinary camera, and nearly no distortion (maximum a posteriori estimate).
So a few points that tell little about the lens leave it as it was, and a board's many corners correct it.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools
import math
from typing import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from dlo_calibration.capture.camera import Lens
from dlo_calibration.capture.marked_points import check_points, check_sides
from dlo_calibration.capture.photograph import FILM_DIAGONAL
from dlo_calibration.capture.scale import Scale
from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats

#: Main cameras of telephones have 35 mm equivalents of 23 to 28 mm (e.g. 26 mm in the specifications of
#: Apple's iPhone 12 and 15), webcams with a diagonal angle of view of 78 degrees (Logitech C920) 27 mm.
ORDINARY_LENGTH = 26.0  # mm
#: Standard deviations of the focal length's logarithm.  Exif's has whole millimetres, and the picture may
#: have been stabilised or corrected, which cuts some per cent of it.
DEVIATION_ORDINARY, DEVIATION_FILE = 0.25, 0.03
DEVIATION_DISTORTION = 0.05  # of the first radial coefficient; cameras correct most of it
MARKING = 0.0005  # of the picture's longer side: deviation of a person's marks, 2 px of 4000
MARKS = 2.0  # that the above counts for, beside what the residuals of many points tell
MOST_RESIDUAL = 0.01  # of the points' extent; beyond it, something is wrong
HEIGHT = 0.01  # m above the table, for which a note tells what the unknown focal length costs
WORTH_TELLING = 2e-4  # m
POOR = 2e-3  # m, a residual that careful marks stay below


def scale_from_points(pixels: ArrayLike, table: ArrayLike, size: tuple[int, int], lens: Lens | None = None,
                      focal_length: float | None = None, thing: str = 'scale') -> Scale:
    """
    Return the scale of a photograph from points on its table.

    :param pixels: (k, 2) where the points are seen, k >= 4 [px].
    :param table: (k, 2) where they are on the table [m].
    :param size: width and height of the photograph [px].
    :param lens: of the camera, calibrated; or else
    :param focal_length: as the photograph's file tells it [px].
    :param thing: what the points are called in errors.
    :raises InputError: where they cannot be right.
    """
    marked, places = check_points(pixels, table, size, thing)
    lens = None if lens is None else lens.fitted(size, 'camera calibration')
    problem = _Problem(marked, places, size, lens, focal_length)
    for row in np.flatnonzero(np.isnan(problem.ideal).any(axis=1)):
        raise InputError(f'{thing}, point {row + 1}', 'a pixel so far outside that its direction is unknown',
                         'one that the camera calibration covers', 'mark a point nearer to the middle')
    check_sides(problem.ideal, places, thing, lambda: _exchanged(problem))
    fit = problem.fit()
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    if not fit.residual <= MOST_RESIDUAL * extent:
        raise InputError(
            thing, f'points that miss their places on the table by {1e3 * fit.residual:.1f} mm (rms)',
            f'at most {1e3 * MOST_RESIDUAL * extent:.1f} mm', _suspicion(problem, fit))
    return problem.scale(fit)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A solution: parameters (p,), their covariance (p, p), cost, and distances (k,) on the table [m]."""

    parameters: Floats
    covariance: Floats
    cost: float
    residuals: Floats

    @property
    def residual(self) -> float:
        return math.sqrt(float(np.square(self.residuals).mean()))


class _Problem:
    """
    Points (k, 2) [px] that are to be seen where points (k, 2) of the table are [m].

    The parameters are those of `Scale.parameters`, the last two only where no lens is given.
    """

    def __init__(self, pixels: Floats, table: Floats, size: tuple[int, int], lens: Lens | None,
                 focal_length: float | None) -> None:
        self.pixels, self.table, self.size = pixels, table, size
        self.lens, self.focal_length = lens, focal_length
        self.ideal = pixels if lens is None else lens.undistorted(pixels)
        ordinary = ORDINARY_LENGTH / FILM_DIAGONAL * math.hypot(*size)
        self._prior = np.array([math.log(focal_length or ordinary), 0.0])
        self._deviations = np.array([DEVIATION_FILE if focal_length else DEVIATION_ORDINARY,
                                     DEVIATION_DISTORTION])

    def without(self, rows: Sequence[int]) -> _Problem:
        """Return the problem without some points."""
        return _Problem(np.delete(self.pixels, rows, axis=0), np.delete(self.table, rows, axis=0),
                        self.size, self.lens, self.focal_length)

    def exchanged(self, one: int, other: int) -> _Problem:
        """Return the problem with two points' places on the table exchanged."""
        table = self.table.copy()
        table[[one, other]] = table[[other, one]]
        return _Problem(self.pixels, table, self.size, self.lens, self.focal_length)

    def lens_of(self, parameters: Floats) -> Lens:
        """Return the lens that parameters (p,) describe."""
        if self.lens is not None:
            return self.lens
        (width, height), length = self.size, math.exp(parameters[6])
        middle = (width - 1) / 2.0, (height - 1) / 2.0
        matrix = np.array([[length, 0.0, middle[0]], [0.0, length, middle[1]], [0.0, 0.0, 1.0]])
        return Lens(self.size, matrix, np.array([parameters[7], 0.0, 0.0, 0.0]))

    def fit(self) -> _Fit:
        """Return the best solution."""
        deviation = MARKING * max(self.size)
        best = min((self._refined(start, deviation) for start in self._starts()), key=lambda one: one.cost)
        squares = float(np.square(self._errors(best.parameters)).sum())
        freedom = max(2 * len(self.pixels) - 8, 0)
        told = math.sqrt((MARKS * deviation**2 + squares) / (MARKS + freedom))
        return self._refined(best.parameters, told)

    def scale(self, fit: _Fit) -> Scale:
        """Return the scale that a solution describes."""
        lens = self.lens_of(fit.parameters)
        known = self.lens is not None or self.focal_length is not None
        scale = Scale(lens, cv2.Rodrigues(np.ascontiguousarray(fit.parameters[:3]))[0], fit.parameters[3:6],
                      fit.residuals, known, (), fit.covariance)
        return Scale(lens, scale.rotation, scale.translation, fit.residuals, known,
                     tuple(_notes(scale, len(self.pixels))), fit.covariance)

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

    def _refined(self, start: Floats, deviation: float) -> _Fit:
        """Search from parameters (p,), where the pixels have some standard deviation [px]."""
        solution = least_squares(
            lambda values: self._weighted(self._errors(values) / deviation, values), start,
            jac=lambda values: self._slopes(values, deviation), method='lm', x_scale='jac', max_nfev=200)
        values: Floats = solution.x
        slopes = self._slopes(values, deviation)
        scale = Scale(self.lens_of(values), cv2.Rodrigues(np.ascontiguousarray(values[:3]))[0], values[3:6],
                      np.zeros(1), True)
        missed: Floats = np.linalg.norm(scale.points(self.pixels)[:, :2] - self.table, axis=1)
        missed[np.isnan(missed)] = np.inf
        covariance = np.linalg.pinv(slopes.T @ slopes)
        return _Fit(values, covariance.astype(float), float(solution.cost), missed)

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
    """Return the sentence that names two points which were exchanged; empty if no two were."""
    extent = float(np.linalg.norm(np.ptp(problem.table, axis=0)))
    count = min(len(problem.pixels), 10)
    fits = []
    for one, other in itertools.combinations(range(count), 2):
        other_problem = problem.exchanged(one, other)
        try:
            check_sides(other_problem.ideal, other_problem.table, '', lambda: '')
        except InputError:
            continue
        fits.append((other_problem.fit(), one, other))
    good = [entry for entry in fits if entry[0].residual <= MOST_RESIDUAL * extent]
    if not good:
        return ''
    _, one, other = min(good, key=lambda entry: entry[0].cost)
    return f'points {one + 1} and {other + 1} seem to be exchanged'


def _suspicion(problem: _Problem, fit: _Fit) -> str:
    """Say which point of a bad solution is the likely reason."""
    count = len(problem.pixels)
    sentence = _exchanged(problem)
    if sentence:
        return sentence
    if 5 < count <= 12:  # as many remain as can contradict each other, and it takes no time
        worst = min(range(count), key=lambda row: problem.without([row]).fit().residual)
    else:
        worst = int(np.argmax(fit.residuals))
    return f'look at point {worst + 1} first, and check that all places are in metres'


def _notes(scale: Scale, count: int) -> list[str]:
    """Return what the user should know about a scale from `count` points."""
    notes = []
    length = scale.lens.matrix[0, 0]
    if not scale.focal_length_known:
        deviation = math.sqrt(scale.covariance[6, 6])
        film = length * FILM_DIAGONAL / math.hypot(*scale.size)
        found = deviation < 0.7 * DEVIATION_ORDINARY
        where = 'found from the points' if found else 'that of an ordinary telephone'
        notes.append(f'The focal length is not in the photograph: {film:.0f} mm of 35 mm film, give or take '
                     f'{100 * deviation:.0f} %, is {where}.')
    quarters = np.array(list(itertools.product((0.25, 0.75), repeat=2))) * scale.size
    error = float(np.median(scale.uncertainty(quarters, HEIGHT, above=0.0)))
    if not error <= WORTH_TELLING:
        notes.append(f'A point {1e3 * HEIGHT:.0f} mm above the table is placed with an error of about '
                     f'{1e3 * error:.1f} mm: calibrate the camera if that is too much.')
    if scale.residual > POOR:
        worst = int(np.argmax(scale.residuals))
        notes.append(f'The points miss their places by {1e3 * scale.residual:.1f} mm (rms), '
                     f'point {worst + 1} by {1e3 * scale.residuals[worst]:.1f} mm: mark them again.')
    if count == 4:
        notes.append('Four points fit nearly always, even if one is wrong: look at the grid, or mark five.')
    return notes
