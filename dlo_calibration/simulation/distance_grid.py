# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""DistanceGrid: the signed distances from a closed mesh that the core interpolates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation import core

MOST_POINTS = 400_000  # of a grid: an object of 20 cm gets cells of 3 mm, in a second
MOST_MESHES = 50  # of different shapes in a scene: 80 MB
MARGIN = 0.012  # m around the mesh; further away, the core extrapolates
NEAR = 4.0  # cells; up to here, distances are exact
SAMPLES = 2  # per cell and direction, on the surface
CANDIDATES = 4  # nearest samples whose triangles are tried
MOST_SAMPLES = 2_000_000
MOST_CROSSINGS = 20_000_000  # of columns of the grid with triangles; a closed surface has some 10,000
TILT = 1e-6, 1.618e-6  # of a cell: so that no column of the grid meets an edge of a regular mesh


@dataclass(frozen=True)
class DistanceGrid:
    """
    Signed distances at the points of a grid.

    :param distances: (x, y, z) [m], negative inside the mesh.
    :param corner: (3,) [m] of the first point.
    :param cell: [m] from a point to the next.
    """

    distances: NDArray[np.float32]
    corner: Floats
    cell: float

    @classmethod
    def of(cls, triangles: Floats) -> DistanceGrid:
        """
        Return the grid of a mesh of (t, 3, 3) [m] triangles, of any orientation.

        :raises ValueError: if the mesh is not closed, or folded too often.
        """
        return _grid(np.ascontiguousarray(triangles, dtype=float).tobytes())

    @cached_property
    def shared(self) -> core.Grid:
        """The same in the core, which all bodies of this mesh share."""
        return core.Grid(self.distances, self.corner, self.cell)


@lru_cache(maxsize=MOST_MESHES)
def _grid(octets: bytes) -> DistanceGrid:
    triangles = np.frombuffer(octets).reshape(-1, 3, 3)
    triangles = _closed(triangles)
    low, high = triangles.min(axis=(0, 1)) - MARGIN, triangles.max(axis=(0, 1)) + MARGIN
    cell = float(np.cbrt(np.prod(high - low) / MOST_POINTS))
    while np.prod(np.ceil((high - low) / cell) + 1) > 1.2 * MOST_POINTS:  # a long and thin mesh
        cell *= 1.2
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [start + cell * np.arange(count) for start, count in zip(low, counts, strict=True)]
    distances = _distances(axes, triangles, cell)
    distances[_inside(axes, triangles, cell)] *= -1
    return DistanceGrid(distances.astype(np.float32), low, cell)


def _closed(triangles: Floats) -> Floats:
    """
    Return the triangles that have an area.

    :raises ValueError: if an edge does not belong to as many triangles in one direction as in the other.
    """
    corners, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    edges = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    numbers, counts = np.unique(edges.min(axis=1) * len(corners) + edges.max(axis=1), return_counts=True)
    odd = int((counts % 2).sum())
    if odd or not len(faces):
        raise ValueError(f'a mesh that is not closed: {odd} of {len(numbers)} edges are open')
    return np.asarray(corners[faces])


def _distances(axes: list[Floats], triangles: Floats, cell: float) -> Floats:
    """
    Return the distances of the points of a grid from triangles, (x, y, z) [m].

    Up to `NEAR` cells away they are exact but for the choice of the triangle; further away, they are those
    from the surface in the nearest cell that has any.
    """
    from scipy.ndimage import distance_transform_edt  # slow to load
    from scipy.spatial import cKDTree

    samples, owners = _samples(triangles, cell / SAMPLES)
    first = np.array([axis[0] for axis in axes])
    at = tuple(np.round((samples - first) / cell).astype(int).T)
    sample_at = np.full([len(axis) for axis in axes], -1)
    sample_at[at] = np.arange(len(samples))
    beyond, nearest = distance_transform_edt(sample_at < 0, return_indices=True)
    points = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1)
    distances = np.asarray(np.linalg.norm(points - samples[sample_at[tuple(nearest)]], axis=3))
    near = beyond <= NEAR
    points = points[near]
    _, candidates = cKDTree(samples).query(points, k=min(CANDIDATES, len(samples)), workers=-1)
    best = np.full(len(points), np.inf)
    for column in candidates.reshape(len(points), -1).T:
        best = np.minimum(best, _squares(points, triangles[owners[column]]))
    distances[near] = np.sqrt(best)
    return distances


def _samples(triangles: Floats, spacing: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return points on triangles, (s, 3) [m], at most `spacing` apart, and the triangle of each."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    sides = np.stack([first, second, second - first])
    parts = np.maximum(np.ceil(np.linalg.norm(sides, axis=2).max(axis=0) / spacing), 1).astype(int)
    while ((parts + 1) * (parts + 2) // 2).sum() > MOST_SAMPLES:
        parts = np.maximum(parts // 2, 1)
        if (parts == 1).all():
            break
    samples, owners = [], []
    for count in np.unique(parts):
        which = np.flatnonzero(parts == count)
        a, b = (grid.ravel() / count for grid in np.mgrid[:count + 1, :count + 1])
        a, b = a[a + b < 1 + 1e-9], b[a + b < 1 + 1e-9]
        samples.append((triangles[which, None, 0] + a[:, None] * first[which, None]
                        + b[:, None] * second[which, None]).reshape(-1, 3))
        owners.append(np.repeat(which, len(a)))
    return np.concatenate(samples), np.concatenate(owners)


def _squares(points: Floats, triangles: Floats) -> Floats:
    """Return the squared distance of each of (n, 3) points from its triangle of (n, 3, 3), (n,) [m^2]."""
    best = np.full(len(points), np.inf)
    inside = np.ones(len(points), bool)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    for k in range(3):
        start, side = triangles[:, k], triangles[:, (k + 1) % 3] - triangles[:, k]
        away = points - start
        share = np.clip(_dot(away, side) / np.maximum(_dot(side, side), 1e-300), 0.0, 1.0)
        beside = away - share[:, None] * side
        best = np.minimum(best, _dot(beside, beside))
        inside &= _dot(np.cross(side, away), normals) >= 0
    areas = np.maximum(_dot(normals, normals), 1e-300)
    above = _dot(points - triangles[:, 0], normals)**2 / areas
    return np.where(inside & (areas > 1e-300), np.minimum(best, above), best)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum('ij,ij->i', a, b))


def _inside(axes: list[Floats], triangles: Floats, cell: float) -> NDArray[np.bool_]:
    """
    Return which points of a grid lie inside: above an odd number of crossings of their column.

    :raises ValueError: if there are too many crossings.
    """
    xs, ys = axes[0] + TILT[0] * cell, axes[1] + TILT[1] * cell
    counts = [len(axis) for axis in axes]
    crossings = np.zeros((counts[0], counts[1], counts[2] + 1), np.int32)
    low = np.stack([np.searchsorted(xs, triangles[:, :, 0].min(axis=1)),
                    np.searchsorted(ys, triangles[:, :, 1].min(axis=1))], axis=1)
    high = np.stack([np.searchsorted(xs, triangles[:, :, 0].max(axis=1)),
                     np.searchsorted(ys, triangles[:, :, 1].max(axis=1))], axis=1)
    wide, deep = (high - low).T
    if (columns := int((wide * deep).sum())) > MOST_CROSSINGS:
        layers = columns // np.prod(counts[:2])
        raise ValueError(f'a mesh with {layers} triangles above each other')
    for chunk in np.array_split(np.arange(len(triangles)), 1 + columns // 2_000_000):
        number = wide[chunk] * deep[chunk]
        which = np.repeat(chunk, number)
        at = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
        i = low[which, 0] + at // np.maximum(deep[which], 1)
        j = low[which, 1] + at % np.maximum(deep[which], 1)
        a, b, c = (triangles[which, k] for k in range(3))
        x, y = xs[i], ys[j]
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        with np.errstate(divide='ignore', invalid='ignore'):
            s = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
            t = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
            hit = (s >= 0) & (t >= 0) & (s + t <= 1)
            z = a[:, 2] + s * (b[:, 2] - a[:, 2]) + t * (c[:, 2] - a[:, 2])
        k = np.searchsorted(axes[2], z[hit])
        np.add.at(crossings, (i[hit], j[hit], k), 1)
    return np.asarray(np.cumsum(crossings, axis=2)[:, :, :-1] % 2 == 1)
