# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Loop: which way round a line follows it.

A DLO goes straight on where its loop closes.  A line that turns back there has followed the loop the wrong
way round, as may happen while two strands beside each other open into a loop.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from dlo_calibration.model.chain import Floats

TOUCHES = 1.3  # widths between the middles of two strands that cross, at most: no ground is seen between them
BESIDE = 2.0  # widths from there to where their directions are compared
SHORTEST = 6.0  # widths along a loop
LESS = 0.5  # rad by which the line turns less if it follows the loop the other way round


def straight_on(line: Floats, width: float) -> Floats:
    """
    Return a line (n, 2) that follows its loop the other way round if it goes on straighter so.

    :param line: (n, 2), evenly along the DLO; it is returned itself if it has no such loop.
    :param width: of the DLO, in the same unit.
    """
    spacing = max(float(np.linalg.norm(np.diff(line, axis=0), axis=1).mean()), width / len(line))
    beside = max(round(BESIDE * width / spacing), 1)
    inner = np.arange(beside, len(line) - beside)
    apart = cdist(line[inner], line[inner])
    apart[np.tri(len(inner), k=round(SHORTEST * width / spacing), dtype=bool)] = np.inf
    if not apart.size or apart.min() > TOUCHES * width:
        return line
    i, j = inner[list(np.unravel_index(apart.argmin(), apart.shape))]
    arrives, leaves = line[i] - line[i - beside], line[j + beside] - line[j]
    begins, ends = line[i + beside] - line[i], line[j] - line[j - beside]
    now = _angle(arrives, begins) + _angle(ends, leaves)
    turned = _angle(arrives, -ends) + _angle(-begins, leaves)
    if turned > now - LESS:
        return line
    return np.concatenate([line[:i + 1], line[i + 1:j][::-1], line[j:]])


def _angle(first: Floats, second: Floats) -> float:
    """Return the angle between two vectors (2,) [rad]."""
    return float(abs(np.arctan2(first[0] * second[1] - first[1] * second[0], first @ second)))
