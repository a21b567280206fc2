# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
What obstacles of a scene look like: outlines for drawings, triangles of meshes for drawings and markers.

A drawing looks along a direction; its projection, (2, 3), gives the coordinates of a point in it.
"""

from __future__ import annotations

from typing import Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.model.action import rotation_matrix
from dlo_calibration.model.chain import Floats
from dlo_calibration.report.figure import EDGE, OBSTACLE
from dlo_calibration.simulation.scene import AROUND, extremes, Obstacle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_TRIANGLES = 5000  # shown of a mesh; more cannot be distinguished
CELLS = 40  # along the longest edge of a mesh, of which each keeps one corner
ABOVE = np.eye(3)[:2]  # the projection seen from above


def outline(obstacle: Obstacle, projection: Floats) -> Floats:
    """Return the outline in a projection, (k, 2) [m], anticlockwise; of a mesh, its convex hull."""
    from scipy.spatial import ConvexHull, QhullError

    points, radius = extremes(obstacle)
    points = points @ projection.T
    if radius:
        turns = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
        points = (points[:, None] + radius * np.column_stack([np.cos(turns), np.sin(turns)])).reshape(-1, 2)
    try:
        corners: Floats = points[ConvexHull(points).vertices]
    except QhullError:  # a flat mesh, seen along its plane
        return points[[int(np.lexsort(points.T)[end]) for end in (0, -1)]]
    return corners


def triangles_of(obstacle: Obstacle) -> Floats:
    """
    Return the triangles of a mesh where it stands, (t, 3, 3) [m]; at most about `MOST_TRIANGLES`.

    A larger mesh is made coarser: all corners in a cell of a grid become one, in their middle.
    """
    scaled = obstacle.triangles * obstacle.sizes
    if len(scaled) > MOST_TRIANGLES:
        scaled = _coarser(scaled)
    placed: Floats = scaled @ rotation_matrix(obstacle.turn).T + obstacle.position
    return placed


def draw_obstacles(axes: Axes, obstacles: Sequence[Obstacle], projection: Floats) -> None:
    """Draw obstacles behind chains, but before bands, without changing the section that the axes show."""
    from matplotlib.collections import PolyCollection

    for number, obstacle in enumerate(obstacles):
        shapes = list(triangles_of(obstacle) @ projection.T) if obstacle.shape == 'mesh' else [
            outline(obstacle, projection)]
        # The edges of triangles, in their colour, close the gaps between them.
        axes.add_collection(PolyCollection(
            shapes, facecolor=OBSTACLE, edgecolor=EDGE if len(shapes) == 1 else OBSTACLE, linewidth=0.8,
            zorder=0.6, label=None if number else 'obstacle'), autolim=False)


def _coarser(triangles: Floats) -> Floats:
    """Return a mesh, (t, 3, 3), with one corner at most in each cell of a grid."""
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    cells = np.floor((corners - low) / ((high - low).max() / CELLS)).astype(int)
    _, of_cell = np.unique(cells, axis=0, return_inverse=True)
    of_cell = of_cell.ravel()
    count = np.bincount(of_cell)
    middles = np.stack([np.bincount(of_cell, weights=axis) / count for axis in corners.T], axis=1)
    faces = of_cell.reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    coarse: Floats = middles[faces[np.sort(first)]]
    return coarse
