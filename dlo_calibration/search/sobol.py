# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A scrambled Sobol sequence: points that fill the unit cube evenly.

The points are those of `scipy.stats.qmc.Sobol`, bit for bit, without the second that SciPy's statistics take
to load.  Sources: I. M. Sobol, "On the distribution of points in a cube and the approximate evaluation of
integrals", USSR Computational Mathematics and Mathematical Physics 7 (1967); S. Joe and F. Y. Kuo,
"Constructing Sobol sequences with better two-dimensional projections", SIAM J. Sci. Comput. 30 (2008), with
their table new-joe-kuo-6.21201; J. Matousek, "On the L2-discrepancy for anchored boxes", J. Complexity 14
(1998), for the scrambling.
"""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.chain import Floats

BITS = 30  # of a coordinate
#: for each coordinate after the first, the bits of a primitive polynomial, and its initial direction numbers
DIRECTIONS: tuple[tuple[int, ...], ...] = (
    (3, 1), (7, 1, 3), (11, 1, 3, 1), (13, 1, 1, 1), (19, 1, 1, 3, 3), (25, 1, 3, 5, 13),
    (37, 1, 1, 5, 5, 17), (41, 1, 1, 5, 5, 5), (47, 1, 1, 7, 11, 19), (55, 1, 1, 5, 1, 1),
    (59, 1, 1, 1, 3, 11), (61, 1, 3, 5, 5, 31), (67, 1, 3, 3, 9, 7, 49), (91, 1, 1, 1, 15, 21, 21),
    (97, 1, 3, 1, 13, 27, 49), (103, 1, 1, 1, 15, 7, 5), (109, 1, 3, 1, 15, 13, 25),
    (115, 1, 1, 5, 5, 19, 61), (131, 1, 3, 7, 11, 23, 15, 103), (137, 1, 3, 7, 13, 13, 15, 69),
    (143, 1, 1, 3, 13, 7, 35, 63), (145, 1, 3, 5, 9, 1, 25, 53), (157, 1, 3, 1, 13, 9, 35, 107),
    (167, 1, 3, 1, 5, 27, 61, 31), (171, 1, 1, 5, 11, 19, 41, 61), (185, 1, 3, 5, 3, 3, 13, 69),
    (191, 1, 1, 7, 13, 1, 19, 1), (193, 1, 3, 7, 5, 13, 19, 59), (203, 1, 1, 3, 9, 25, 29, 41),
    (211, 1, 3, 5, 13, 23, 1, 55), (213, 1, 3, 7, 3, 13, 59, 17), (229, 1, 3, 1, 3, 5, 53, 69),
    (239, 1, 1, 5, 5, 23, 33, 13), (241, 1, 1, 7, 7, 1, 61, 123), (247, 1, 1, 7, 9, 13, 61, 49),
    (253, 1, 3, 3, 5, 3, 55, 33), (285, 1, 3, 1, 15, 31, 13, 49, 245), (299, 1, 3, 5, 15, 31, 59, 63, 97),
    (301, 1, 3, 1, 11, 11, 11, 77, 249), (333, 1, 3, 1, 11, 27, 43, 71, 9),
    (351, 1, 1, 7, 15, 21, 11, 81, 45), (355, 1, 3, 7, 3, 25, 31, 65, 79),
    (357, 1, 3, 1, 1, 19, 11, 3, 205), (361, 1, 1, 5, 9, 19, 21, 29, 157),
    (369, 1, 3, 7, 11, 1, 33, 89, 185), (391, 1, 3, 3, 3, 15, 9, 79, 71),
    (397, 1, 3, 7, 11, 15, 39, 119, 27), (425, 1, 1, 3, 1, 11, 31, 97, 225),
    (451, 1, 1, 1, 3, 23, 43, 57, 177), (463, 1, 3, 7, 7, 17, 17, 37, 71),
    (487, 1, 3, 1, 5, 27, 63, 123, 213), (501, 1, 1, 3, 5, 11, 43, 53, 133),
    (529, 1, 3, 5, 5, 29, 17, 47, 173, 479), (539, 1, 3, 3, 11, 3, 1, 109, 9, 69),
    (545, 1, 1, 1, 5, 17, 39, 23, 5, 343), (557, 1, 3, 1, 5, 25, 15, 31, 103, 499),
    (563, 1, 1, 1, 11, 11, 17, 63, 105, 183), (601, 1, 1, 5, 11, 9, 29, 97, 231, 363),
    (607, 1, 1, 5, 15, 19, 45, 41, 7, 383), (617, 1, 3, 7, 7, 31, 19, 83, 137, 221),
    (623, 1, 1, 1, 3, 23, 15, 111, 223, 83), (631, 1, 1, 5, 13, 31, 15, 55, 25, 161),
    (637, 1, 1, 3, 13, 25, 47, 39, 87, 257),
)


class Sobol:
    """
    A Sobol sequence in the unit cube of `dimension` coordinates, scrambled at random.

    :param dimension: at most 64.
    """

    def __init__(self, dimension: int, seed: int) -> None:
        generator = np.random.default_rng(seed)
        directions = np.array([_directions(k) for k in range(dimension)], dtype=np.uint32)
        shift = generator.integers(2, size=(dimension, BITS), dtype=np.uint32)
        lower = np.tril(generator.integers(2, size=(dimension, BITS, BITS), dtype=np.uint32))
        lower[:, range(BITS), range(BITS)] = 1
        # A product of matrices of bits, where addition is exclusive or; the highest bit is the first.
        places = np.arange(BITS - 1, -1, -1, dtype=np.uint32)
        bits = directions[:, :, None] >> places & 1
        self._directions = ((bits @ lower.transpose(0, 2, 1) & 1) << places).sum(axis=2, dtype=np.uint32)
        self._next = (shift << np.arange(BITS, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
        self._count = 0

    def points(self, count: int) -> Floats:
        """Return the next points, (count, dimension)."""
        points = np.empty((count, len(self._next)))
        for point in points:
            point[:] = self._next / 2**BITS
            # In the order of the Gray code, only one bit of the index changes: the lowest zero of its number.
            self._next = self._next ^ self._directions[:, (~self._count & self._count + 1).bit_length() - 1]
            self._count += 1
        return points


def _directions(k: int) -> list[int]:
    """Return the direction numbers of coordinate k, one for each bit of an index."""
    if k == 0:
        return [1 << BITS - 1 - j for j in range(BITS)]
    polynomial, *numbers = DIRECTIONS[k - 1]
    degree = len(numbers)
    for j in range(degree, BITS):
        number = numbers[j - degree]
        for i in range(1, degree + 1):
            if polynomial >> degree - i & 1:
                number ^= numbers[j - i] << i
        numbers.append(number)
    return [number << BITS - 1 - j for j, number in enumerate(numbers)]
