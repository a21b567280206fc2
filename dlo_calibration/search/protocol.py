# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a search method is: it asks for points of the unit cube and is told what they gave."""

from __future__ import annotations

from dataclasses import dataclass, replace
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

    :param start: (d,) estimate; nan where there is none.
    :param lower: (d,) lower end of the range of that estimate; 0 where there is none.
    :param upper: (d,) upper end; 1 where there is none.
    :param rows: how many residuals each of T trials has, in order; empty where
        that is not known.
    :param excites: (T, d) True where a trial excites a parameter.
    :param refines: `start` is where a search of a simpler model ended: no other start is worth a try.
    """

    start: Floats
    lower: Floats
    upper: Floats
    rows: tuple[int, ...]
    excites: NDArray[np.bool_]
    refines: bool = False

    def __post_init__(self) -> None:
        for name in ('start', 'lower', 'upper'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        excites = np.array(self.excites, dtype=np.bool_)
        excites.flags.writeable = False
        object.__setattr__(self, 'excites', excites)

    @classmethod
    def none(cls, dimension: int) -> Hints:
        """Return hints that tell nothing."""
        blank = np.zeros(dimension)
        return cls(blank * np.nan, blank, blank + 1, (), np.zeros((0, dimension), dtype=np.bool_))

    @classmethod
    def at(cls, start: Floats) -> Hints:
        """Return hints that (d,) `start` is where a search of a simpler model ended."""
        return replace(cls.none(len(start)), start=start, refines=True)

    @property
    def excited(self) -> NDArray[np.bool_]:
        """(d,) True for the parameters that some trial excites; all where nothing is known."""
        return np.logical_or.reduce(self.excites) if len(self.excites) else np.ones(len(self.start), np.bool_)


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
