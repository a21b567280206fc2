# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Grid: lines of the table, to be drawn over a photograph so that a wrong scale is seen."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from dlo_calibration.capture.scale import Scale
from dlo_calibration.model.chain import Floats, frozen_array

SPACINGS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # m
LINES = 12  # across the longer side of the picture; as many can be told apart
FARTHEST = 3.0  # heights of the camera, from the point below it: beyond, a table is hardly seen
SAMPLES = 2000  # of each line, which ends at the border with this resolution
KEPT = 40  # of them, about, as a lens bends lines only a little
RASTER = 50  # pixels across and down the picture, where the table is looked for


@dataclass(frozen=True, eq=False)
class GridLine:
    """
    A line of the table, within the picture.

    :param axis: `x` or `y`, the coordinate that is the same everywhere on it.
    :param value: of that coordinate [m].
    :param pixels: (n, 2) along it [px].
    """

    axis: str
    value: float
    pixels: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, 'pixels', frozen_array(self.pixels))

    @property
    def label(self) -> str:
        """What is written beside it, e.g. ``x 0.10``."""
        return f'{self.axis} {self.value:.2f}'


def grid(scale: Scale) -> list[GridLine]:
    """Return the lines of the table that a photograph shows; none if it shows no table."""
    table = _seen(scale)
    if len(table) < 3:
        return []
    low, high = table.min(axis=0), table.max(axis=0)
    middle = np.median(scale.to_pixels(np.column_stack([table, np.zeros(len(table))])), axis=0)
    wanted = max(scale.size) * float(scale.metres_per_pixel([middle])[0]) / LINES
    spacing = next((one for one in SPACINGS if one >= wanted), SPACINGS[-1])
    lines = []
    for axis, name in enumerate('xy'):
        along = np.linspace(low[1 - axis], high[1 - axis], SAMPLES)
        for number in range(math.ceil(low[axis] / spacing), math.floor(high[axis] / spacing) + 1):
            points = np.zeros((SAMPLES, 3))
            points[:, axis], points[:, 1 - axis] = number * spacing, along
            lines += [GridLine(name, number * spacing, piece) for piece in _within(scale, points)]
    return lines


def _seen(scale: Scale) -> Floats:
    """Return points (n, 2) of the table all over the picture, if they are not too far away [m]."""
    width, height = scale.size
    across, down = np.linspace(0.0, width - 1.0, RASTER), np.linspace(0.0, height - 1.0, RASTER)
    u, v = np.meshgrid(across, down)
    points = scale.points(np.stack([u.ravel(), v.ravel()], axis=1))[:, :2]
    far = FARTHEST * abs(float(scale.camera[2]))
    near: Floats = points[np.linalg.norm(points - scale.camera[:2], axis=1) <= far]
    return near


def _within(scale: Scale, points: Floats) -> list[Floats]:
    """Return the pieces (n, 2) [px] of a line of points (m, 3) that are in the picture."""
    pixels = scale.to_pixels(points)
    inside = np.all((pixels >= -0.5) & (pixels <= np.array(scale.size) - 0.5), axis=1).reshape(-1)
    # Far outside, a lens's formula leads back into the picture.
    inside[inside] &= np.linalg.norm(scale.points(pixels[inside]) - points[inside], axis=1) < 1e-4
    changes = np.flatnonzero(np.diff(inside.astype(int)))
    pieces = np.split(pixels, changes + 1)
    starts = inside[np.concatenate([[0], changes + 1])]
    return [piece[np.unique(np.linspace(0, len(piece) - 1, KEPT).astype(int))]
            for piece, kept in zip(pieces, starts, strict=True) if kept and len(piece) > 1]
