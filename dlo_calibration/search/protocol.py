# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a search method is: it asks for points of the unit cube and is told what they gave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats, frozen_array


@dataclass(frozen=True)
class Observation:
    """
    What one point gave.

    :param point: (d,) in the unit cube.
    :param score: to be minimised; infinite where the simulation failed.
    :param residuals: (m,) [m] simulated minus observed coordinates of all
        trials; None where the simulation failed.
    """

    point: Floats
    score: float
    residuals: Floats | None


@dataclass(frozen=True)
class Hints:
    """
    What is known before the first evaluation, in the unit cube of d parameters.

    :param start: (d,) prior estimate; nan where there is none.
    :param excited: (d,) False where surely no trial shows a parameter.
    :param refines: `start` is where the search of a simpler model ended: no other start is worth a try.
    """

    start: Floats
    excited: NDArray[np.bool_]
    refines: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, 'start', frozen_array(self.start))
        object.__setattr__(self, 'excited', frozen_array(self.excited, bool))

    @classmethod
    def none(cls, dimension: int) -> Hints:
        """Return hints that tell nothing."""
        return cls(np.full(dimension, np.nan), np.ones(dimension, np.bool_))

    @classmethod
    def at(cls, start: Floats) -> Hints:
        """Return hints that (d,) `start` is where a search of a simpler model ended."""
        return cls(start, np.ones(len(start), np.bool_), refines=True)


class Search(Protocol):
    """A minimiser over the unit cube.  It never sees a trial or a physical unit."""

    name: str

    def ask(self, limit: int) -> Floats:
        """
        Return the next (m, d) points to evaluate, m <= limit.

        How many is the method's choice and never depends on the number of
        workers.  No points at all means that it has finished.
        """

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`, in the order asked."""

    @property
    def stop_reason(self) -> str:
        """Why it finished, in words; empty while it has not."""

    @property
    def best(self) -> Floats | None:
        """The (d,) point that the method calls its result; None while no evaluation succeeded."""
