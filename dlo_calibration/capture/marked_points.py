# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Marked points: pixels and where they are on the table, refused where they cannot make a scale."""

from __future__ import annotations

from typing import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats

FEWEST = 4  # points that determine how a plane is seen (Hartley and Zisserman, Multiple View Geometry, 4.1)
MOST = 1000
SMALLEST, LARGEST = 0.01, 20.0  # m, extent of the points on the table
PLACED = 'the pixel and the place on the table of four points or more'
#: Smallest singular value but one of the homography's equations, of the largest: 0.36 for the corners of a
#: square, 0 where no four of the points are in general position.
GENERAL = 0.01


def check_points(pixels: ArrayLike, table: ArrayLike, size: tuple[int, int],
                 thing: str) -> tuple[Floats, Floats]:
    """
    Return the pixels (k, 2) and the places on the table (k, 2) [m] as arrays.

    :param size: width and height of the photograph [px].
    :raises InputError: where they are too few, no numbers, outside, or nearly on one line.
    """
    marked, places = (np.asarray(one, float) for one in (pixels, table))
    if marked.ndim != 2 or marked.shape[1:] != (2,) or marked.shape != places.shape:
        raise InputError(thing, f'arrays of shape {marked.shape} and {places.shape}', PLACED,
                         'give as many of both')
    count = len(marked)
    if not FEWEST <= count <= MOST:
        raise InputError(thing, f'{count} points', PLACED,
                         'mark more points' if count < FEWEST else 'mark fewer')
    for row, (pixel, place) in enumerate(zip(marked, places, strict=True), 1):
        if not np.isfinite(pixel).all() or not np.isfinite(place).all():
            raise InputError(f'{thing}, point {row}', 'no finite number', PLACED, 'correct it')
        if (pixel < -0.5).any() or (pixel > np.array(size) - 0.5).any():
            raise InputError(f'{thing}, point {row}', f'the pixel {pixel[0]:g},{pixel[1]:g}',
                             f'a pixel of the photograph, {size[0]} x {size[1]}', 'mark it again')
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    if not SMALLEST <= extent <= LARGEST:
        raise InputError(thing, f'points on the table with an extent of {extent:.3g} m',
                         f'{SMALLEST:g} m to {LARGEST:g} m', 'give their places in metres')
    if not (_general(places) and _general(marked)):
        raise InputError(thing, 'points of which all, or all but one, are nearly on one line',
                         'four points of which no three are on one line',
                         'mark points around the DLO, like the corners of a rectangle')
    return marked, places


def check_sides(ideal: Floats, table: Floats, thing: str, exchanged: Callable[[], str]) -> None:
    """
    Check that pixels without distortion (k, 2) show points of a table (k, 2) from above.

    :param exchanged: gives the sentence that tells which two points were exchanged, or nothing.
    :raises InputError: where the table is seen as in a mirror, or some points behind the camera.
    """
    matrix, _ = cv2.findHomography(table, ideal, 0)
    if matrix is None or not np.isfinite(matrix).all():
        raise InputError(thing, 'points that no camera sees so', PLACED,
                         exchanged() or 'check them one by one')
    depth = np.column_stack([table, np.ones(len(table))]) @ matrix[2]
    if depth.min() * depth.max() <= 0.0:
        raise InputError(thing, 'points in an order in which no camera sees them',
                         'the places on the table in the order of the pixels',
                         exchanged() or 'check the points one by one')
    # v points down in the picture, so that a table seen from above turns round (determinant below zero).
    if np.linalg.det(matrix) * depth[0] > 0.0:
        raise InputError(thing, 'a table that is seen as in a mirror',
                         'x and y such that, seen from above, y is x turned anticlockwise',
                         'change the sign of y, or check the order of the points')


def _general(points: Floats) -> bool:
    """
    Tell whether four of the points (k, 2) are in general position.

    Only then do the equations of the homography from the points to themselves have one solution.
    """
    centred = points - points.mean(axis=0)
    x, y = (centred / max(float(np.sqrt(np.square(centred).sum(axis=1).mean())), 1e-12)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate([np.stack([x, y, one, zero, zero, zero, -x * x, -x * y, -x], axis=1),
                           np.stack([zero, zero, zero, x, y, one, -y * x, -y * y, -y], axis=1)])
    values = np.linalg.svd(rows, compute_uv=False)
    return bool(values[7] > GENERAL * values[0])
