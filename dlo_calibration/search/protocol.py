# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Search: a method that asks for points of the unit cube and is told their observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.model.chain import Floats, frozen_array


@dataclass(frozen=True)
class Observation:
    """
    The result of evaluating one point.

    :param point: (d,) in the unit cube.
    :param score: difference score, to be minimised; infinite where the simulation failed.
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
    :param excited: (d,) False where no trial can show the effect of a parameter.
    :param refines: `start` is the result for a simpler model, so that the search starts only there.
    :param jacobian: (m, d) of the residuals at `start` [m per unit cube], if it is known already.
    :param coarse: the search ends where a step gains little, before it has quite converged.
    """

    start: Floats
    excited: NDArray[np.bool_]
    refines: bool = False
    jacobian: Floats | None = None
    coarse: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, 'start', frozen_array(self.start))
        object.__setattr__(self, 'excited', frozen_array(self.excited, bool))

    @classmethod
    def none(cls, dimension: int) -> Hints:
        """Return hints without an estimate; all parameters count as excited."""
        return cls(np.full(dimension, np.nan), np.ones(dimension, np.bool_))

    @classmethod
    def at(cls, start: Floats, jacobian: Floats | None = None, coarse: bool = False) -> Hints:
        """Return hints with the result (d,) of a search with a simpler model as the only start."""
        return cls(start, np.ones(len(start), np.bool_), True, jacobian, coarse)


class Search(Protocol):
    """A minimiser over the unit cube.  It never sees a trial or a physical unit."""

    name: str

    def ask(self, limit: int) -> Floats:
        """
        Return the next (m, d) points to evaluate, m <= limit.

        The method chooses m, whatever the number of workers.  No points at all
        mean that it has finished.
        """

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`, in the order asked."""

    @property
    def stop_reason(self) -> str:
        """Why it finished, in words; empty until then."""

    @property
    def best(self) -> Floats | None:
        """The (d,) point that is the result of the method; None until an evaluation has succeeded."""

    @property
    def model(self) -> Linearisation | None:
        """Linear model of the residuals at `best`; None where the method has not made one."""
