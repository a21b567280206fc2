# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Elastic: the line of a DLO that fits what an image shows, and keeps its length and its shape elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from dlo_calibration.model.chain import Floats

ITERATIONS = 4  # as a segment's length is no linear function of its ends
ALONG = 0.01  # weight of second differences along the line, to that of those across
BAND = 6  # diagonals of the normal equations: three points in a row are connected


@dataclass(frozen=True, eq=False)
class Evidence:
    """
    What is known of a line of n points; weights are 1 / variance [1/px^2], 0: nothing.

    :param measured: (n, 2) where the line seems to be [px].
    :param across: (n,) weight of that, across the line.
    :param expected: (n, 2) where the points are expected [px].
    :param along: (n,) weight of that, along the line.
    :param anywhere: weight of that, in all directions.
    :param lengths: (n - 1,) of the segments [px].
    :param stretch: (n - 1,) weight of each of these lengths.
    :param bend: weight of the second differences of `expected` across the line; those along it, by which
        neighbouring lengths differ, hardly count.
    :param kept: (n - 2,) share of those second differences that remains; below 1, the line becomes straight.
    :param ends: (2, 2) where both ends are seen [px].
    :param end_weights: (2,).
    """

    measured: Floats
    across: Floats
    expected: Floats
    along: Floats
    anywhere: float
    lengths: Floats
    stretch: Floats
    bend: float
    kept: Floats
    ends: Floats
    end_weights: Floats


def fitted(start: Floats, known: Evidence) -> Floats:
    """Return the line (n, 2) [px] that fits the evidence best, by Gauss and Newton from a line nearby."""
    line = start
    bends = known.kept[:, None] * (known.expected[:-2] - 2 * known.expected[1:-1] + known.expected[2:])
    for _ in range(ITERATIONS):
        normal = _Normal(len(line))
        tangents = directions(line)
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        normal.add(normals[:, None], _along(normals, known.measured), known.across)
        normal.add(tangents[:, None], _along(tangents, known.expected), known.along)
        segments = np.diff(line, axis=0)
        units = segments / np.maximum(np.linalg.norm(segments, axis=1, keepdims=True), 1e-9)
        normal.add(np.stack([-units, units], axis=1), known.lengths, known.stretch)
        for axes, bend in ((normals, known.bend), (tangents, ALONG * known.bend)):
            stencil = np.array([1.0, -2.0, 1.0])[None, :, None] * axes[1:-1, None]
            normal.add(stencil, _along(axes[1:-1], bends), np.full(len(bends), bend))
        everywhere = np.full(len(line), known.anywhere)
        for axis in np.eye(2):
            normal.add(np.broadcast_to(axis, (len(line), 1, 2)), known.expected @ axis, everywhere)
        for axis in np.eye(2):
            for k, first in enumerate((0, len(line) - 1)):
                normal.add(axis[None, None], known.ends[k:k + 1] @ axis, known.end_weights[k:k + 1], first)
        line = normal.solution()
    return line


def directions(line: Floats) -> Floats:
    """Return the unit vectors (n, 2) along a line (n, 2)."""
    tangents = np.gradient(line, axis=0)
    return np.asarray(tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9))


def _along(vectors: Floats, points: Floats) -> Floats:
    return np.asarray((vectors * points).sum(axis=1))


class _Normal:
    """The normal equations of a line's points, as a band."""

    def __init__(self, count: int) -> None:
        self._matrix = np.zeros((BAND, 2 * count))
        self._right = np.zeros(2 * count)

    def add(self, factors: Floats, wanted: Floats, weights: Floats, first: int = 0) -> None:
        """
        Add equations, each of k points in a row.

        :param factors: (m, k, 2) of the points' coordinates; row i begins with point `first` + i.
        :param wanted: (m,) values of the sums.
        :param weights: (m,).
        """
        count = len(factors)
        flat = factors.reshape(count, -1)
        for q in range(flat.shape[1]):
            columns = slice(2 * first + q, 2 * (first + count) + q - 1, 2)
            weighted = weights * flat[:, q]
            self._right[columns] += weighted * wanted
            for p in range(q + 1):
                self._matrix[BAND - 1 + p - q, columns] += weighted * flat[:, p]

    def solution(self) -> Floats:
        """Return the points (n, 2)."""
        self._matrix[-1] += 1e-9
        return np.asarray(solveh_banded(self._matrix, self._right, check_finite=False)).reshape(-1, 2)
