# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
View: how a film shows the table, image by image, from the printed board.

The board is found in one image, and followed from there; the camera may move.  Where no calibration is given,
several images give the focal length.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.board import FEWEST_CORNERS, find_board, RULER
from dlo_calibration.vision.film import Film
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import Scale

VIEWS = 8  # images that give the focal length, evenly over the film
CORNER = 0.3  # px, standard deviation of a corner
FOCAL, DISTORTION = 0.25, 0.05  # standard deviations, as in `pose`, before any image is seen
ORDINARY = 26.0 / math.hypot(36.0, 24.0)  # focal length of the picture's diagonal, as in `pose`
AGAIN = 30  # images from one search for the board to the next
WINDOW = (25, 25)  # px, in which a corner is followed
MARGIN = 40  # px around the board, where it is followed
STRAY = 1.5  # px by which a corner may lie beside the view of the others
STILL = 0.25  # px: a camera on a stand shows the board moved by less


class BoardFinder:
    """
    Finds the board from image to image.

    :param lens: of the camera, for images of the film's size.
    :param printed: length of the board's ruler line, as measured on the print [m].
    """

    def __init__(self, lens: Lens, printed: float = RULER) -> None:
        self._lens, self._printed = lens, printed
        self._scale: Scale | None = None
        self._corners, self._places = np.zeros((0, 2)), np.zeros((0, 2))
        self._grey: Pixels | None = None
        self._shown: Floats = np.zeros((0, 2))  # corners when the scale was made
        self._count = 0

    def next(self, pixels: Pixels) -> Scale | None:
        """
        Return the scale of the next image; None: too little of the board is seen.

        While the camera does not move, it is the same one.

        :param pixels: (h, w, 3) RGB.
        """
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        self._count += 1
        still = False
        if len(self._corners) and self._grey is not None:
            still = self._follow(self._grey, grey)
        if not len(self._corners) or (self._count % AGAIN == 0 and not still):
            self._find(pixels)
        self._grey = np.asarray(grey, np.uint8)
        if not len(self._corners):
            return None
        if self._scale is None or not still:
            self._scale = self._posed()
            self._shown = self._corners
        return self._scale

    def _find(self, pixels: Pixels) -> None:
        try:
            self._corners, self._places = find_board(pixels, self._printed)
        except InputError:
            self._corners, self._places = np.zeros((0, 2)), np.zeros((0, 2))
        self._scale = None

    def _follow(self, before: Pixels, now: Pixels) -> bool:
        """Follow the corners; tell whether they are where they were."""
        height, width = now.shape
        low = np.maximum(np.floor(self._corners.min(axis=0)).astype(int) - MARGIN, 0)
        high = np.minimum(np.ceil(self._corners.max(axis=0)).astype(int) + MARGIN, (width, height))
        part = slice(low[1], high[1]), slice(low[0], high[0])
        start = (self._corners - low).astype(np.float32)[:, None]
        places: Any
        places, found, _ = cv2.calcOpticalFlowPyrLK(
            before[part], now[part], start, None, winSize=WINDOW, maxLevel=2)
        corners = places[:, 0].astype(float) + low
        kept = found[:, 0] > 0
        if kept.sum() < FEWEST_CORNERS:
            self._corners = self._corners[:0]
            return False
        view, _ = cv2.findHomography(self._places[kept], corners[kept], cv2.RANSAC, STRAY)
        if view is None:
            self._corners = self._corners[:0]
            return False
        shown = cv2.perspectiveTransform(self._places[:, None], view)[:, 0]
        kept &= np.linalg.norm(shown - corners, axis=1) < STRAY
        if len(self._shown) == len(corners):
            moved = np.linalg.norm(corners[kept] - self._shown[kept], axis=1)
            if kept.sum() >= FEWEST_CORNERS and np.median(moved) < STILL:
                # Something may hide some of the corners; they are still where they were.
                self._corners = self._shown
                return True
        if kept.sum() < FEWEST_CORNERS:
            self._corners = self._corners[:0]
            return False
        # A corner that something hides reappears where the others say.
        self._corners = np.where(kept[:, None], corners, shown)
        return False

    def _posed(self) -> Scale:
        """Return the scale that the corners show."""
        if self._scale is None:
            return scale_from_points(self._corners, self._places, self._lens.size, self._lens)
        ideal = self._lens.undistorted(self._corners)
        points = np.column_stack([self._places, np.zeros(len(self._places))])
        turn, shift = cv2.Rodrigues(self._scale.rotation)[0], self._scale.translation.reshape(3, 1).copy()
        _, turn, shift = cv2.solvePnP(points, ideal, self._lens.matrix, np.zeros(4), turn, shift, True)
        scale = Scale(self._lens, cv2.Rodrigues(turn)[0], shift.ravel(), np.zeros(1), True)
        residuals = np.linalg.norm(scale.points(self._corners)[:, :2] - self._places, axis=1)
        return Scale(self._lens, scale.rotation, scale.translation, residuals, True)


def film_lens(film: Film, printed: float = RULER) -> Lens:
    """
    Return the lens of a film's camera from how it shows the board: focal length and first coefficient.

    :raises InputError: where no image shows the board.
    """
    views = []
    error: InputError | None = None
    for time in np.linspace(0.0, film.duration, VIEWS, endpoint=False):
        frame = next(film.frames(float(time)), None)
        if frame is None:
            break
        try:
            views.append(find_board(frame.pixels, printed))
        except InputError as refused:
            error = refused
    if not views:
        raise error or InputError('film', 'no image that shows the board', 'the board beside the DLO',
                                  'lay the board on the table')
    return _lens_of(views, film.size)


def _lens_of(views: list[tuple[Floats, Floats]], size: tuple[int, int]) -> Lens:
    """Return the lens that fits several views of the board best: pixels (k, 2) and places (k, 2) [m]."""
    ordinary = math.log(ORDINARY * math.hypot(*size))
    middle = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0

    def lens(values: Floats) -> Lens:
        length = math.exp(values[0])
        return Lens(size, np.array([[length, 0.0, middle[0]], [0.0, length, middle[1]], [0.0, 0.0, 1.0]]),
                    np.array([values[1], 0.0, 0.0, 0.0]))

    start = [np.array([ordinary, 0.0])]
    for pixels, places in views:
        scale = scale_from_points(pixels, places, size)
        start.append(scale.parameters[:6])
        start[0] = start[0] + np.array([scale.parameters[6] - ordinary, 0.0]) / len(views)

    def errors(values: Floats) -> Floats:
        assumed = lens(values[:2])
        rows = [np.array([(values[0] - ordinary) / FOCAL, values[1] / DISTORTION])]
        for k, (pixels, places) in enumerate(views):
            pose = values[2 + 6 * k:8 + 6 * k]
            points = np.column_stack([places, np.zeros(len(places))])
            seen, _ = cv2.projectPoints(points, pose[:3], pose[3:], assumed.matrix, assumed.coefficients)
            rows.append((seen.reshape(-1, 2) - pixels).ravel() / CORNER)
        return np.concatenate(rows)

    solution = least_squares(errors, np.concatenate(start), method='lm', x_scale='jac')
    return lens(solution.x[:2])


def first_lens(pixels: Pixels, printed: float = RULER) -> Lens:
    """
    Return the lens of a camera from one view of the board.

    :raises InputError: where the board is not seen.
    """
    return _lens_of([find_board(pixels, printed)], (pixels.shape[1], pixels.shape[0]))
