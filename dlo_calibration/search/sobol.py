# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Sobol: points that fill the unit cube evenly.

They are those of `scipy.stats.qmc.Sobol`, bit for bit.  That module takes 0.6 s to load, and start points
are the first thing that a search needs: a fit that takes 1.2 s would take half as long again.
"""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.chain import Floats

BITS = 30  # of each coordinate
#: For each dimension but the first: a primitive polynomial, its coefficients as bits, and the first
#: direction numbers (Joe and Kuo, Constructing Sobol sequences with better two-dimensional projections, 2008)
DIRECTIONS = (
    (3, 1), (7, 1, 3), (11, 1, 3, 1), (13, 1, 1, 1), (19, 1, 1, 3, 3), (25, 1, 3, 5, 13), (37, 1, 1, 5, 5,
    17), (41, 1, 1, 5, 5, 5), (47, 1, 1, 7, 11, 19), (55, 1, 1, 5, 1, 1), (59, 1, 1, 1, 3, 11), (61, 1, 3, 5,
    5, 31), (67, 1, 3, 3, 9, 7, 49), (91, 1, 1, 1, 15, 21, 21), (97, 1, 3, 1, 13, 27, 49), (103, 1, 1, 1, 15,
    7, 5), (109, 1, 3, 1, 15, 13, 25), (115, 1, 1, 5, 5, 19, 61), (131, 1, 3, 7, 11, 23, 15, 103), (137, 1, 3,
    7, 13, 13, 15, 69), (143, 1, 1, 3, 13, 7, 35, 63), (145, 1, 3, 5, 9, 1, 25, 53), (157, 1, 3, 1, 13, 9, 35,
    107), (167, 1, 3, 1, 5, 27, 61, 31), (171, 1, 1, 5, 11, 19, 41, 61), (185, 1, 3, 5, 3, 3, 13, 69), (191,
    1, 1, 7, 13, 1, 19, 1), (193, 1, 3, 7, 5, 13, 19, 59), (203, 1, 1, 3, 9, 25, 29, 41), (211, 1, 3, 5, 13,
    23, 1, 55), (213, 1, 3, 7, 3, 13, 59, 17), (229, 1, 3, 1, 3, 5, 53, 69), (239, 1, 1, 5, 5, 23, 33, 13),
    (241, 1, 1, 7, 7, 1, 61, 123), (247, 1, 1, 7, 9, 13, 61, 49), (253, 1, 3, 3, 5, 3, 55, 33), (285, 1, 3, 1,
    15, 31, 13, 49, 245), (299, 1, 3, 5, 15, 31, 59, 63, 97), (301, 1, 3, 1, 11, 11, 11, 77, 249), (333, 1, 3,
    1, 11, 27, 43, 71, 9), (351, 1, 1, 7, 15, 21, 11, 81, 45), (355, 1, 3, 7, 3, 25, 31, 65, 79), (357, 1, 3,
    1, 1, 19, 11, 3, 205), (361, 1, 1, 5, 9, 19, 21, 29, 157), (369, 1, 3, 7, 11, 1, 33, 89, 185), (391, 1, 3,
    3, 3, 15, 9, 79, 71), (397, 1, 3, 7, 11, 15, 39, 119, 27), (425, 1, 1, 3, 1, 11, 31, 97, 225), (451, 1, 1,
    1, 3, 23, 43, 57, 177), (463, 1, 3, 7, 7, 17, 17, 37, 71), (487, 1, 3, 1, 5, 27, 63, 123, 213), (501, 1,
    1, 3, 5, 11, 43, 53, 133), (529, 1, 3, 5, 5, 29, 17, 47, 173, 479), (539, 1, 3, 3, 11, 3, 1, 109, 9, 69),
    (545, 1, 1, 1, 5, 17, 39, 23, 5, 343), (557, 1, 3, 1, 5, 25, 15, 31, 103, 499), (563, 1, 1, 1, 11, 11, 17,
    63, 105, 183), (601, 1, 1, 5, 11, 9, 29, 97, 231, 363), (607, 1, 1, 5, 15, 19, 45, 41, 7, 383))


class Sobol:
    """
    A scrambled Sobol sequence (Matousek, On the L2-discrepancy for anchored boxes, 1998).

    :param dimension: d, at most one more than `DIRECTIONS` has.
    :param seed: of the `numpy.random.Generator` that scrambles it.
    """

    def __init__(self, dimension: int, seed: int) -> None:
        generator = np.random.default_rng(seed)
        powers = 2**np.arange(BITS, dtype=np.uint32)
        shift = generator.integers(2, size=(dimension, BITS), dtype=np.uint32) @ powers
        lower = np.tril(generator.integers(2, size=(dimension, BITS, BITS), dtype=np.uint32), -1)
        lower += np.eye(BITS, dtype=np.uint32)
        bits = np.array([_directions(k) for k in range(dimension)], np.uint32)[:, :, None] // powers[::-1] & 1
        self._directions = (lower[:, None] @ bits[..., None])[..., 0] % 2 @ powers[::-1]
        self._next, self._drawn = shift, 0

    def random(self, count: int) -> Floats:
        """Return the next (count, d) points of the unit cube."""
        points = np.empty((count, len(self._next)))
        for point in points:
            point[:] = self._next / 2.0**BITS
            zero = (~self._drawn & self._drawn + 1).bit_length() - 1  # the lowest bit that is 0
            self._next = self._next ^ self._directions[:, zero]
            self._drawn += 1
        return points


def _directions(dimension: int) -> list[int]:
    """Return the direction numbers of a dimension (Bratley and Fox, ACM TOMS 14(1), 1988)."""
    if dimension == 0:
        return [1 << BITS - 1 - j for j in range(BITS)]
    polynomial, *numbers = DIRECTIONS[dimension - 1]
    degree = len(numbers)
    for j in range(degree, BITS):
        new = numbers[j - degree]
        for k in range(degree):
            if polynomial >> degree - 1 - k & 1:
                new ^= numbers[j - k - 1] << k + 1
        numbers.append(new)
    return [number << BITS - 1 - j for j, number in enumerate(numbers)]
