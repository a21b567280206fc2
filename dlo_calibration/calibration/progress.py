# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The progress of a calibration."""

from __future__ import annotations

from bisect import insort
import math
import time
from typing import Callable

from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.uncertainty import good_count


class Progress:
    """
    The progress of a calibration.

    :param evaluations: largest number of evaluations.
    :param trials: number of trials that each evaluation simulates.
    :param known: number of evaluations that a log answers: they tell nothing about the speed.
    :param clock: the time [s].
    """

    def __init__(self, evaluations: int, trials: int, known: int = 0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.evaluations = evaluations
        self._known = known
        self.count = 0
        self.newest: Evaluation | None = None
        self.best: Evaluation | None = None
        self._good: list[Evaluation] = []  # the best ones, best first
        self._simulations = 0
        self._trials = trials
        self._clock, self._begun = clock, clock()

    def take(self, evaluation: Evaluation) -> None:
        """Count the next evaluation."""
        self.count += 1
        if self.count > self._known:
            self._simulations += self._trials - evaluation.skipped
        else:
            self._begun = self._clock()
        self.newest = evaluation
        if self.best is None or evaluation.score < self.best.score:
            self.best = evaluation
        if math.isfinite(evaluation.score):
            insort(self._good, evaluation, key=lambda one: one.score)
            del self._good[good_count(self.evaluations):]

    @property
    def spread(self) -> dict[str, float]:
        """
        Spread of the best 5 % of the evaluations so far (8 at least) around the best, 0..100, by parameter.

        It is the root mean square distance, as in `uncertainty.spread_of_best`.
        """
        good = self._good[:good_count(self.count)]
        if self.best is None or not good:
            return {}
        return {name: math.sqrt(sum((one.values[name] - value)**2 for one in good) / len(good))
                for name, value in self.best.values.items() if all(name in one.values for one in good)}

    @property
    def simulations_per_second(self) -> float:
        """Rollouts per second, of those that were made."""
        return self._simulations / self._elapsed

    @property
    def seconds_left(self) -> float:
        """Time until the last evaluation [s], at the speed so far; infinite before one was made."""
        left, made = self.evaluations - self.count, self.count - self._known
        return self._elapsed / made * left if made > 0 else float('inf')

    @property
    def _elapsed(self) -> float:
        return max(self._clock() - self._begun, 1e-6)
