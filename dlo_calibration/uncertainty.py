# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Uncertainty: how far the parameters of the good evaluations lie apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.chain import Floats

BEST_SHARE = 0.05  # of the evaluations count as good,
BEST_MINIMUM = 8  # but never fewer than that many
UNKNOWN_STD = 1 / np.sqrt(12)  # of a value anywhere in 0..1
IDENTIFIABLE_STD = UNKNOWN_STD / 2


class Scored(Protocol):
    """A point of the unit cube with its score."""

    @property
    def point(self) -> Floats:
        """The (d,) point."""

    @property
    def score(self) -> float:
        """Lower is better."""


@dataclass(frozen=True)
class Spread:
    """
    Spread of the good evaluations, all (d,) in the unit cube.

    `identifiable` is True where they lie closer together than half of what
    values drawn at random from the whole range would.
    """

    std: Floats
    lower: Floats
    upper: Floats
    identifiable: NDArray[np.bool_]


def spread_of_best(evaluations: Sequence[Scored], best: Floats) -> Spread:
    """
    Return how far the parameters of the best evaluations lie apart.

    A parameter that the trials determine has similar values in all good
    evaluations; one that they do not can be anything.  `std` is the root mean
    square distance of the best 5 % (8 at least) from the (d,) point `best`;
    `lower` and `upper` are their extremes.  With too few evaluations to
    choose from, nothing is identifiable.  This measures the search as much as
    the trials: it says what this calibration knows, not what the data could tell.
    """
    good = sorted((e for e in evaluations if np.isfinite(e.score)), key=lambda e: e.score)
    count = max(BEST_MINIMUM, round(BEST_SHARE * len(good)))
    if len(good) < 2 * count:
        unknown = np.ones_like(best)
        return Spread(unknown * UNKNOWN_STD, unknown * 0, unknown, unknown < 0)
    points = np.stack([e.point for e in good[:count]])
    std = np.minimum(np.sqrt(np.mean((points - best) ** 2, axis=0)), UNKNOWN_STD)
    return Spread(std, points.min(axis=0), points.max(axis=0), std < IDENTIFIABLE_STD)
