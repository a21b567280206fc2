# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Search: a method that asks for points of the box and receives their observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generator, Sequence, TypeVar

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Ends, Linearisation
from dlo_calibration.model.chain import Floats, frozen_array


@dataclass(frozen=True)
class Observation:
    """
    The result of evaluating one point.

    :param point: (d,) in the box.
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
    The prior knowledge of a search, in the box of d parameters.

    :param start: (d,) prior estimate; nan where there is none.
    :param excited: (d,) False where no trial can show the effect of a parameter.
    :param refines: `start` is the result for a simpler model, so that the search starts only there.
    :param jacobian: (m, d) of the residuals at `start` [m per unit]; None: unknown.
    :param coarse: the search ends where a step gains little, before it has converged.
    :param upper: (d,) upper ends of the box, or one for all; the lower ones are 0.
    :param middle: (d,) of the start points: see `spread`.
    :param follows_valley: the search looks along the valley in which parameters make up for each other, too.
    """

    start: Floats
    excited: NDArray[np.bool_]
    refines: bool = False
    jacobian: Floats | None = None
    coarse: bool = False
    upper: Ends = 1.0
    middle: Ends = 0.5
    follows_valley: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, 'start', frozen_array(self.start))
        object.__setattr__(self, 'excited', frozen_array(self.excited, bool))

    @classmethod
    def none(cls, dimension: int, upper: Ends = 1.0) -> Hints:
        """Return hints without an estimate; all parameters count as excited."""
        return cls(np.full(dimension, np.nan), np.ones(dimension, np.bool_), upper=upper)

    @classmethod
    def at(cls, start: Floats, jacobian: Floats | None = None, coarse: bool = False, upper: Ends = 1.0
           ) -> Hints:
        """Return hints with the result (d,) of a search with a simpler model as the only start."""
        return cls(start, np.ones(len(start), np.bool_), True, jacobian, coarse, upper)

    def spread(self, shares: Floats | float) -> Floats:
        """Return start points, (n, d), for shares of 0 to 1."""
        return spread(self.middle, self.upper, shares)


def spread(middle: Ends, upper: Ends, shares: Floats | float) -> Floats:
    """
    Return points, (n, d), that fill one unit of each parameter, as far as its scale allows around the middle.

    All over a wider scale, most of few points would be far from any DLO like those before.

    :param middle: (d,), or one for all; `upper` the upper ends of the box, likewise.
    :param shares: (n, d) of the unit, 0 to 1.
    """
    width = np.minimum(upper, 1.0)
    return np.asarray(np.clip(middle - width / 2, 0.0, upper - width) + width * shares)


Result = TypeVar('Result')
#: It yields (m, d) points, receives their m observations, and returns a result.
Batches = Generator[Floats, Sequence[Observation], Result]


class Search:
    """
    A minimiser over the box; it never sees a trial or a physical unit.

    A method derives from it, and yields batches of points in `_batches`.  A batch may be asked in portions of
    any size: the points depend neither on the portions nor on the number of workers.

    :param dimension: number of parameters.
    :param seed: of the method's random numbers.
    :param hints: prior knowledge; None: none.
    """

    name: str

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        self._dimension, self._seed = dimension, seed
        self._hints = Hints.none(dimension) if hints is None else hints
        self._upper: Floats = np.broadcast_to(self._hints.upper, dimension)  # ends of the box
        self._lowest: Observation | None = None
        self._under_way: Batches[str] | None = None
        self._batch: Floats = np.zeros((0, dimension))
        self._observations: list[Observation] = []  # of the first points of the batch
        self.stop_reason = ''  # why the method ended, in words; empty until then

    def _batches(self) -> Batches[str]:
        """Yield batches of points; return why the method ended, in words."""
        raise NotImplementedError

    def _improves(self, observation: Observation) -> bool:
        """Tell whether an observation is better than the best so far: by default, its score is lower."""
        return bool(np.isfinite(observation.score)) and (
            self._lowest is None or observation.score < self._lowest.score)

    def ask(self, limit: int) -> Floats:
        """Return the next (m, d) points, m <= limit; none once the method has ended."""
        if self._under_way is None:
            self._under_way = self._batches()
            self._batch = np.asarray(next(self._under_way), dtype=float)
        return self._batch[len(self._observations):][:limit].copy()

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`, in the order asked; go on once the batch is complete."""
        for observation in observations:
            if self._improves(observation):
                self._lowest = observation
        self._observations.extend(observations)
        if self._under_way is None or self.stop_reason or len(self._observations) < len(self._batch):
            return
        complete, self._observations = self._observations, []
        try:
            self._batch = np.asarray(self._under_way.send(complete), dtype=float)
        except StopIteration as end:
            self._batch, self.stop_reason = np.zeros((0, self._dimension)), str(end.value)

    @property
    def best(self) -> Floats | None:
        """The (d,) point that is the result of the method; None until an evaluation has succeeded."""
        return None if self._lowest is None else self._lowest.point

    @property
    def model(self) -> Linearisation | None:
        """Linear model of the residuals at `best`; None if the method has not made one."""
        return None

    @property
    def rivals(self) -> tuple[Observation, ...]:
        """Observations that may fit as well as `best`; empty if the method does not keep them."""
        return ()
