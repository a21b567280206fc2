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
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.board import (
    COLUMNS,
    FEWEST_CORNERS,
    find_board,
    printed_sheet,
    ROWS,
    RULER,
    SQUARE,
)
from dlo_calibration.vision.film import Film
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.sheet import Sheet

Bools = NDArray[np.bool_]

VIEWS = 8  # images that give the focal length, evenly over the film
CORNER = 0.5  # px, standard deviation of a corner
FOCAL, DISTORTION = 0.25, 0.05  # standard deviations, as in `pose`, before any image is seen
ORDINARY = 26.0 / math.hypot(36.0, 24.0)  # focal length of the picture's diagonal, as in `pose`
AGAIN = 30  # images from one search for the board to the next
WINDOW = (25, 25)  # px, in which a corner is followed
MARGIN = 40  # px around the board, where it is followed
BORDER = 10.0  # px; a corner nearer to the picture's border is not sought
REFINED = (5, 5)  # px around a corner, where it is sought
REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
BESIDE = 0.12  # sides of a square from a corner, where the white of a square is free of its marker
CONTRAST = 20  # of 255, by which white squares are brighter than black ones
STRAY = 1.0  # px by which a corner may lie beside the view of the others
BENT = 3.0  # px, the same where the lens's distortion is unknown
POOR = 0.5  # px, deviation of the corners from the view, from which on they are not all the board's
UNSURE = 0.002  # m, deviation of places in the picture from which on the view is not known
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
        self._since = AGAIN  # images since the last search
        self._moves = False

    @property
    def sheet(self) -> Sheet:
        """The sheet that the board is printed on."""
        return printed_sheet(self._printed)

    def next(self, pixels: Pixels) -> Scale | None:
        """
        Return the scale of the next image; None: too little of the board is seen to tell it.

        While the camera does not move, it is the same one, also where something hides the board.

        :param pixels: (h, w, 3) RGB.
        """
        grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
        self._since += 1
        corners, kept = self._corners, np.zeros(len(self._corners), bool)
        if self._grey is not None and len(corners):
            corners, kept = self._followed(self._grey, grey)
            near = kept & (np.linalg.norm(corners - self._shown, axis=1) < STILL)
            if not self._moves and self._scale is not None and near.sum() >= max(
                    FEWEST_CORNERS, len(near) / 4):
                return self._scale
        if len(corners):
            corners, kept = self._on_board(grey, corners, kept)
        if 2 * kept.sum() < (COLUMNS - 1) * (ROWS - 1) and (not kept.any() or self._since >= AGAIN):
            corners, kept = self._found(pixels, corners, kept)
        scale = self._posed(corners, kept)
        if self._scale is not None and not self._moves and (scale is None or self._still(corners, kept)):
            # The camera stands; something hides the board, or hid it.
            self._corners = self._shown
            return self._scale
        self._moves = self._moves or self._scale is not None and scale is not None
        # Later corners are compared with these: between neighbouring images, a slow motion looks like none.
        self._scale, self._shown, self._grey = scale, corners, grey
        self._corners = corners if kept.any() else corners[:0]
        return self._scale

    def _still(self, corners: Floats, kept: Bools) -> bool:
        """Return whether the corners that are seen are where the last scale has them."""
        assert self._scale is not None
        places = np.column_stack([self._places, np.zeros(len(self._places))])[kept]
        away = np.linalg.norm(self._scale.to_pixels(places) - corners[kept], axis=1)
        return bool(np.median(away) < 2.0 * STILL)

    def _found(self, pixels: Pixels, corners: Floats, kept: Bools) -> tuple[Floats, Bools]:
        """Return the corners found anew, if they are more than those that are followed."""
        self._since = 0
        try:
            found, places = find_board(pixels, self._printed)
        except InputError:
            return corners, kept
        if len(found) <= kept.sum():
            return corners, kept
        self._places = _all_places(self._printed)
        view, _ = cv2.findHomography(places, self._lens.undistorted(found), cv2.RANSAC, STRAY)
        if view is None:
            return corners, kept
        shown = self._lens.distorted(cv2.perspectiveTransform(self._places[:, None], view)[:, 0])
        grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
        return _sought(grey, shown, self._places, STRAY)

    def _followed(self, before: Pixels, now: Pixels) -> tuple[Floats, Bools]:
        """Return where the corners (k, 2) have moved to, and which are seen."""
        height, width = now.shape
        low = np.clip(np.floor(self._corners.min(axis=0)).astype(int) - MARGIN, 0, (width - 1, height - 1))
        high = np.clip(np.ceil(self._corners.max(axis=0)).astype(int) + MARGIN, low + 1, (width, height))
        part = slice(low[1], high[1]), slice(low[0], high[0])
        start = (self._corners - low).astype(np.float32)[:, None]
        places: Any
        places, found, _ = cv2.calcOpticalFlowPyrLK(
            before[part], now[part], start, None, winSize=WINDOW, maxLevel=2)
        return places[:, 0].astype(float) + low, found[:, 0] > 0

    def _on_board(self, grey: Pixels, corners: Floats, kept: Bools) -> tuple[Floats, Bools]:
        """Return corners (k, 2) where the image shows them, or where the others say, and which are seen."""
        ideal = self._lens.undistorted(corners)
        kept = kept & np.isfinite(ideal[:, 0])
        for _ in range(2):
            if kept.sum() < FEWEST_CORNERS:
                return corners, np.zeros(len(corners), bool)
            view, _ = cv2.findHomography(self._places[kept], ideal[kept], cv2.RANSAC, STRAY)
            if view is None:
                return corners, np.zeros(len(corners), bool)
            shown = cv2.perspectiveTransform(self._places[:, None], view)[:, 0]
            # From where the others say, each is sought anew, so that no errors add up from image to image.
            corners, kept = _sought(grey, self._lens.distorted(shown), self._places, STRAY)
            ideal = self._lens.undistorted(corners)
        return corners, kept

    def _posed(self, corners: Floats, kept: Bools) -> Scale | None:
        """Return the scale that the corners show; None: they do not tell it well enough."""
        if kept.sum() < FEWEST_CORNERS:
            return None
        seen, places = corners[kept], self._places[kept]
        if self._scale is None:
            try:
                scale = scale_from_points(seen, places, self._lens.size, self._lens)
            except InputError:
                return None
            turn, shift = cv2.Rodrigues(scale.rotation)[0], scale.translation.reshape(3, 1).copy()
        else:
            turn, shift = cv2.Rodrigues(self._scale.rotation)[0], self._scale.translation.reshape(3, 1).copy()
        points, ideal = np.column_stack([places, np.zeros(len(places))]), self._lens.undistorted(seen)
        _, turn, shift = cv2.solvePnP(points, ideal, self._lens.matrix, None, turn, shift, True)
        shown, slopes = cv2.projectPoints(points, turn, shift, self._lens.matrix, None)
        errors = (shown[:, 0] - ideal).ravel()
        deviation = math.sqrt((np.square(errors).sum() + CORNER**2) / (len(errors) - 5))
        covariance = deviation**2 * np.linalg.pinv(slopes[:, :6].T @ slopes[:, :6])
        scale = Scale(self._lens, cv2.Rodrigues(turn)[0], shift.ravel(), np.zeros(1), True,
                      covariance=covariance)
        quarters = np.array([(x, y) for x in (0.25, 0.75) for y in (0.25, 0.75)]) * self._lens.size
        if not (deviation < POOR and scale.uncertainty(quarters).max() < UNSURE):
            return None
        residuals = np.linalg.norm(scale.points(seen)[:, :2] - places, axis=1)
        return Scale(self._lens, scale.rotation, scale.translation, residuals, True)


def _all_places(printed: float) -> Floats:
    """Return the places (48, 2) of all corners between the squares in the board's frame [m]."""
    columns, rows = np.meshgrid(np.arange(1, COLUMNS), np.arange(1, ROWS))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float) * (SQUARE * printed / RULER)


def _sought(grey: Pixels, expected: Floats, places: Floats, stray: float) -> tuple[Floats, Bools]:
    """
    Return all corners (48, 2) [px], those that are not seen as expected, and which are seen.

    A corner is seen where two black squares meet, at most `stray` pixels from where it is expected.
    """
    height, width = grey.shape
    inside: Bools = np.all((expected > BORDER) & (expected < (width - BORDER, height - BORDER)), axis=1)
    corners = expected.copy()
    if not inside.any():
        return corners, inside
    start = np.ascontiguousarray(expected[inside], np.float32)[:, None].copy()
    sought = cv2.cornerSubPix(grey, start, REFINED, (-1, -1), REFINEMENT)[:, 0].astype(float)
    corners[inside] = np.where(np.linalg.norm(sought - expected[inside], axis=1)[:, None] < stray, sought,
                               np.nan)
    # The four squares around it: those of even column and row, counted from the upper left, are black.
    view, _ = cv2.findHomography(places, expected, 0)
    side = float(places[1, 0] - places[0, 0])
    steps = BESIDE * side * np.array([[-1, 1], [1, -1], [1, 1], [-1, -1]])
    around = cv2.perspectiveTransform((places[:, None] + steps).reshape(-1, 1, 2), view).reshape(-1, 4, 2)
    at = (around + (corners - expected)[:, None]).astype(np.float32)
    shades = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0).astype(float)
    column, row = np.rint(places / side).astype(int).T
    even = ((column + ROWS - row) % 2 == 0)[:, None]
    first, second = np.where(even, shades[:, :2], shades[:, 2:]), np.where(even, shades[:, 2:], shades[:, :2])
    kept = inside & np.isfinite(corners[:, 0]) & (second.min(axis=1) - first.max(axis=1) > CONTRAST)
    return np.where(kept[:, None], corners, expected), kept


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
            views.append(_whole_board(frame.pixels, printed))
        except InputError as refused:
            error = refused
    if not views:
        raise error or InputError('film', 'no image that shows the board', 'the board beside the DLO',
                                  'lay the board on the table')
    return _lens_of(views, film.size)


def _whole_board(pixels: Pixels, printed: float) -> tuple[Floats, Floats]:
    """
    Return pixels (k, 2) and places (k, 2) [m] of the board's corners, also of those beside unread markers.

    :raises InputError: where the board is not seen.
    """
    found, at = find_board(pixels, printed)
    view, _ = cv2.findHomography(at, found, cv2.RANSAC, BENT)
    places = _all_places(printed)
    if view is None:
        return found, at
    grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
    corners, kept = _sought(grey, cv2.perspectiveTransform(places[:, None], view)[:, 0], places, BENT)
    return (corners[kept], places[kept]) if kept.sum() > len(found) else (found, at)


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

    def errors(values: Floats, deviation: float) -> Floats:
        assumed = lens(values[:2])
        rows = [np.array([(values[0] - ordinary) / FOCAL, values[1] / DISTORTION])]
        for k, (pixels, places) in enumerate(views):
            pose = values[2 + 6 * k:8 + 6 * k]
            points = np.column_stack([places, np.zeros(len(places))])
            seen, _ = cv2.projectPoints(points, pose[:3], pose[3:], assumed.matrix, assumed.coefficients)
            rows.append((seen.reshape(-1, 2) - pixels).ravel() / deviation)
        return np.concatenate(rows)

    found, deviation = np.concatenate(start), CORNER
    for _ in range(2):  # the second time, the corners themselves tell how exact they are
        found = least_squares(errors, found, loss='soft_l1', x_scale='jac', args=(deviation,)).x
        deviation *= 1.4826 * float(np.median(np.abs(errors(found, deviation)[2:])))
    return lens(found[:2])


def first_lens(pixels: Pixels, printed: float = RULER) -> Lens:
    """
    Return the lens of a camera from one view of the board.

    :raises InputError: where the board is not seen.
    """
    return _lens_of([_whole_board(pixels, printed)], (pixels.shape[1], pixels.shape[0]))
