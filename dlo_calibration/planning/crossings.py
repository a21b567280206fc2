# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Crossings of a DLO with itself."""

from __future__ import annotations

from dlo_calibration.model.chain import Floats
from dlo_calibration.observation.table import crossing_segments


def crossings(points: Floats) -> int:
    """Return how often a DLO crosses itself seen from above, of its points, (n, 3) [m]."""
    return len(crossing_segments(points)[0])
