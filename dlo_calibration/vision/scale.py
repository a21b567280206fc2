# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Scale: the point on the table, or above it, that a pixel shows.

The table is the plane z = 0 of the trial's frame: x and y lie on it, z points up, and seen from above
y is x turned anticlockwise.  The frame of the camera is OpenCV's: x to the right, y down, z into the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math

import cv2
import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.lens import Lens

SPACINGS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # m
LINES = 12  # across the longer side of the picture: these can still be distinguished
FARTHEST = 3.0  # heights of the camera, from the point below it: beyond, a table is hardly seen
SAMPLES = 2000  # of each line: the resolution with which it ends at the border
POINTS = 25  # of each line that are returned, at most: a lens bends lines only a little
RASTER = 50  # pixels across and down the picture at which the table is sampled


@dataclass(frozen=True, eq=False)
class Scale:
    """
    A camera and its pose, found from points on the table.

    :param lens: of the camera, for the size of the photograph.
    :param rotation: (3, 3) from the table's frame to the camera's.
    :param translation: (3,) the table's origin in the camera's frame [m].
    :param residuals: (k,) distance on the table between each given point and where its pixel is [m].
    :param focal_length_known: False: neither a calibration nor the photograph's file has it.
    :param warnings: sentences for the user: the assumptions, and the errors that they may cause.
    :param covariance: (p, p) of the first p of `parameters`; the others are exact.
    """

    lens: Lens
    rotation: Floats
    translation: Floats
    residuals: Floats
    focal_length_known: bool
    warnings: tuple[str, ...] = ()
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        for name in ('rotation', 'translation', 'residuals', 'covariance'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the photograph [px]."""
        return self.lens.size

    @property
    def residual(self) -> float:
        """Root mean square of the residuals [m]."""
        return math.sqrt(float(np.square(self.residuals).mean()))

    @property
    def camera(self) -> Floats:
        """Place of the camera (3,) in the table's frame [m]."""
        return np.asarray(-self.rotation.T @ self.translation)

    def to_table(self, pixels: ArrayLike, height: ArrayLike = 0.0) -> Floats:
        """
        Return the points (n, 3) [m] that pixels (n, 2) show, if they are at some height above the table.

        The middle between the edges of a DLO on the table shows its axis, at the height of its radius.  That
        is nearly exact: planes that touch a tube and hold the camera make equal angles with the one through
        its axis, but equal angles are not equal distances in a picture.  The difference, at an angle a from
        the optical axis, is radius^2 / distance * tan(a) / cos(a): below 0.1 mm for a thickness of 20 mm,
        0.8 m away.

        :param height: of all points, or (n,) of each [m].
        :raises InputError: for a pixel above the horizon.
        """
        seen = np.asarray(pixels, float).reshape(-1, 2)
        points = self.points(seen, height)
        bad = np.flatnonzero(np.isnan(points).any(axis=1))
        if len(bad):
            u, v = seen[bad[0]]
            raise InputError(f'pixel {u:.0f},{v:.0f}', 'a place above the horizon of the table',
                             'a place on the table', 'check the points of the scale')
        return points

    def points(self, pixels: ArrayLike, height: ArrayLike = 0.0) -> Floats:
        """Return what `to_table` returns, with not a number for pixels above the horizon."""
        ideal = self.lens.undistorted(pixels)
        directions = np.linalg.inv(self.lens.matrix).T @ self.rotation
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ directions
        camera = self.camera
        height = np.broadcast_to(np.asarray(height, float), len(rays))
        with np.errstate(divide='ignore', invalid='ignore'):
            distance = (height - camera[2]) / rays[:, 2]
            points: Floats = camera + distance[:, None] * rays
        points[:, 2] = height
        points[~(distance > 0.0)] = np.nan
        return points

    def to_pixels(self, points: ArrayLike) -> Floats:
        """Return the pixels (n, 2) that show points (n, 3) [m]; not a number for those behind the camera."""
        seen = np.asarray(points, float).reshape(-1, 3) @ self.rotation.T + self.translation
        before = seen[:, 2] > 1e-6  # m
        ideal = (seen[before] / seen[before, 2:]) @ self.lens.matrix[:2].T
        pixels = np.full((len(seen), 2), np.nan)
        pixels[before] = self.lens.distorted(ideal)
        return pixels

    def metres_per_pixel(self, pixels: ArrayLike) -> Floats:
        """Return the side (n,) of a square on the table with the area of each pixel (n, 2) [m]."""
        seen = np.asarray(pixels, float).reshape(-1, 2)
        right, down = (self.points(seen + step) - self.points(seen - step) for step in np.eye(2) / 2.0)
        return np.sqrt(np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]))

    @property
    def parameters(self) -> Floats:
        """Rotation vector (3), translation (3) [m], logarithm of the focal length [px], first coefficient."""
        first = self.lens.coefficients[0] if len(self.lens.coefficients) else 0.0
        return np.concatenate([cv2.Rodrigues(self.rotation)[0].ravel(), self.translation,
                               [math.log(self.lens.matrix[0, 0]), first]])

    def uncertainty(self, pixels: ArrayLike, height: float = 0.0, above: float | None = None) -> Floats:
        """
        Return the standard deviation (n,) of the places that `to_table` finds [m].

        :param above: of the difference between the places at `height` and at this height instead.
        """
        changes = []
        deviations = np.sqrt(np.diag(self.covariance))
        for column, deviation in enumerate(deviations):
            sides = []
            for sign in (-1.0, 1.0):
                values = self.parameters
                values[column] += sign * deviation / 10.0
                moved = self.with_parameters(values)
                points = moved.points(pixels, height)
                sides.append(points - moved.points(pixels, above) if above is not None else points)
            changes.append((sides[1] - sides[0]) * 5.0)
        if not changes:
            return np.zeros(len(np.asarray(pixels, float).reshape(-1, 2)))
        scaled = np.stack(changes)[..., :2]  # (p, n, 2), for a change of one deviation
        correlation = self.covariance / np.outer(deviations, deviations)
        variance: Floats = np.einsum('pnk,pq,qnk->n', scaled, correlation, scaled)
        return np.sqrt(np.maximum(variance, 0.0))

    def with_parameters(self, values: Floats) -> Scale:
        """Return the scale with other `parameters` (8,)."""
        matrix = self.lens.matrix.copy()
        matrix[:2, :2] *= math.exp(values[6]) / matrix[0, 0]
        coefficients = self.lens.coefficients.copy()
        coefficients[:1] = values[7]
        return replace(self, lens=replace(self.lens, matrix=matrix, coefficients=coefficients),
                       rotation=cv2.Rodrigues(np.ascontiguousarray(values[:3]))[0], translation=values[3:6])


def grid(scale: Scale) -> list[tuple[str, Floats]]:
    """
    Return the lines of the table that a photograph shows; none if it shows no table.

    :returns: the label of each, e.g. ``x 0.10`` for the line x = 0.10 m, and its pixels (n, 2).
    """
    table = _seen(scale)
    if len(table) < 3:
        return []
    low, high = table.min(axis=0), table.max(axis=0)
    middle = np.median(scale.to_pixels(np.column_stack([table, np.zeros(len(table))])), axis=0)
    wanted = max(scale.size) * float(scale.metres_per_pixel([middle])[0]) / LINES
    spacing = next((candidate for candidate in SPACINGS if candidate >= wanted), SPACINGS[-1])
    lines = []
    for axis, name in enumerate('xy'):
        along = np.linspace(low[1 - axis], high[1 - axis], SAMPLES)
        for number in range(math.ceil(low[axis] / spacing), math.floor(high[axis] / spacing) + 1):
            points = np.zeros((SAMPLES, 3))
            points[:, axis], points[:, 1 - axis] = number * spacing, along
            lines += [(f'{name} {number * spacing:.2f}', piece) for piece in _within(scale, points)]
    return lines


def _seen(scale: Scale) -> Floats:
    """Return points (n, 2) of the table all over the picture, without those too far away [m]."""
    width, height = scale.size
    across, down = np.linspace(0.0, width - 1.0, RASTER), np.linspace(0.0, height - 1.0, RASTER)
    u, v = np.meshgrid(across, down)
    points = scale.points(np.stack([u.ravel(), v.ravel()], axis=1))[:, :2]
    far = FARTHEST * abs(float(scale.camera[2]))
    return np.asarray(points[np.linalg.norm(points - scale.camera[:2], axis=1) <= far])


def _within(scale: Scale, points: Floats) -> list[Floats]:
    """Return the pieces (n, 2) [px] of a line of points (m, 3) that are in the picture."""
    pixels = scale.to_pixels(points)
    inside = np.all((pixels >= -0.5) & (pixels <= np.array(scale.size) - 0.5), axis=1).reshape(-1)
    # Far outside, a lens's formula leads back into the picture.
    inside[inside] &= np.linalg.norm(scale.points(pixels[inside]) - points[inside], axis=1) < 1e-4
    changes = np.flatnonzero(np.diff(inside.astype(int)))
    pieces = np.split(pixels, changes + 1)
    starts = inside[np.concatenate([[0], changes + 1])]
    return [piece[np.unique(np.linspace(0, len(piece) - 1, POINTS).astype(int))]
            for piece, visible in zip(pieces, starts, strict=True) if visible and len(piece) > 1]
