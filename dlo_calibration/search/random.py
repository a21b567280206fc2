# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's search: uniform random parameter sets."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import Hints, Observation

AT_MOST = 300  # points of one batch: threads wait at its end, and its residuals are in memory until then


class RandomSearch:
    """
    Draw points uniformly from the unit cube, independently of earlier results.

    :param dimension: number of parameters.
    :param seed: of the `numpy.random.Generator`.
    :param hints: not used.
    """

    name = 'random'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        self._lowest: Observation | None = None
        self._dimension = dimension
        self._generator = np.random.default_rng(seed)

    def ask(self, limit: int) -> Floats:
        """Return the next (m, d) points, m <= AT_MOST, of one random sequence that does not depend on m."""
        return self._generator.random((min(limit, AT_MOST), self._dimension))

    def tell(self, observations: Sequence[Observation]) -> None:
        """Remember the best point; later points do not depend on it."""
        for one in observations:
            if np.isfinite(one.score) and (self._lowest is None or one.score < self._lowest.score):
                self._lowest = one

    @property
    def model(self) -> Linearisation | None:
        """None: random points make no linear model."""
        return None

    @property
    def stop_reason(self) -> str:
        """Always empty: it never finishes by itself."""
        return ''

    @property
    def best(self) -> Floats | None:
        """The (d,) point of lowest score."""
        return None if self._lowest is None else self._lowest.point
