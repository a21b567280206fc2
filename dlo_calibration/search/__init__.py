# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Search methods with the same ask / tell interface; SEARCHES lists them by name."""

from __future__ import annotations

from typing import Callable, Mapping

from dlo_calibration.search.least_squares import LeastSquares
from dlo_calibration.search.protocol import Hints, Observation, Search
from dlo_calibration.search.sampling import CmaEs, RandomSearch

__all__ = ['CmaEs', 'Hints', 'LeastSquares', 'Observation', 'RandomSearch', 'Search', 'SEARCHES']

#: name -> constructor(dimension, seed, hints=None)
SEARCHES: Mapping[str, Callable[..., Search]] = {
    LeastSquares.name: LeastSquares,
    RandomSearch.name: RandomSearch,
    CmaEs.name: CmaEs,
}
