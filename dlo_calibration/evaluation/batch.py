# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""BatchEvaluator: evaluates batches of points in order, several at the same time."""

from __future__ import annotations

from concurrent.futures import CancelledError, Future
import copy
from functools import partial
from typing import Callable, Iterator, Mapping, Sequence

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.memory import EvaluatorMemory, Memory
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.protocol import Rollout


class BatchEvaluator:
    """
    Evaluates batches of points in order.

    Once the pool stops, a batch ends early, without an error.

    :param pool: simulates, with the evaluator's simulator.
    :param memory: has the evaluations that need not be simulated again, and gets each new one as soon as it
        is finished; None: nothing is remembered.
    """

    def __init__(self, evaluator: Evaluator, pool: Pool, memory: EvaluatorMemory | None = None) -> None:
        self.evaluator = evaluator
        self._pool = pool
        self._memory = memory or Memory().of(evaluator)

    def of(self, space: ParameterSpace, memory: Memory) -> BatchEvaluator:
        """Return one of the same trials with other parameters."""
        other = copy.copy(self)
        other.evaluator = self.evaluator.of(space)
        other._memory = memory.of(other.evaluator)
        return other

    def __call__(self, points: Floats, first: int) -> Iterator[Evaluation]:
        """
        Begin at once; return an iterator that waits for the evaluations of (k, d) points.

        The first one has the index `first`.
        """
        known = [self._memory.find(index, point) for index, point in enumerate(points, first)]
        new, trials = [k for k, one in enumerate(known) if one is None], len(self.evaluator.trials)
        size = max(1, self._pool.portion(len(new) * trials) // trials)
        futures: dict[int, tuple[Future[list[Evaluation]], int]] = {}  # and the place in its answer
        for begin in range(0, len(new), size):
            portion = [(first + k, points[k]) for k in new[begin:begin + size]]
            jobs = [job for _, point in portion for job in self.evaluator.jobs(point)]
            future = self._pool.submit(jobs, partial(self._evaluated, portion))
            futures.update({k: (future, place) for place, k in enumerate(new[begin:begin + size])})
        return self._in_order(known, futures)

    def _evaluated(self, points: Sequence[tuple[int, Floats]],
                   rollouts: Sequence[Rollout | SimulationError]) -> list[Evaluation]:
        """Return the evaluations of points, each with its index, and remember them."""
        trials, found = len(self.evaluator.trials), []
        for k, (index, point) in enumerate(points):
            found.append(self.evaluator.evaluated(index, point, rollouts[k * trials:(k + 1) * trials]))
            self._memory.add(found[-1])
        return found

    def _in_order(self, known: Sequence[Evaluation | None],
                  futures: Mapping[int, tuple[Future[list[Evaluation]], int]]) -> Iterator[Evaluation]:
        """Yield what is known and what the futures give, at its place in their answers."""
        answered: Future[list[Evaluation]] = Future()
        answered.set_result([])
        for k, evaluation in enumerate(known):
            future, place = futures.get(k, (answered, 0))
            try:
                found = self._pool.result(future)
            except CancelledError:
                return
            yield found[place] if evaluation is None else evaluation

    def residuals(self, points: Floats) -> Sequence[Floats | None]:
        """
        Return the residuals at (k, d) points; None where a simulation failed.

        :raises CancelledError: when stopped.
        """
        return self.begin(points)()

    def begin(self, points: Floats) -> Callable[[], Sequence[Floats | None]]:
        """Begin to evaluate (k, d) points; return what gives their `residuals`."""
        under_way = self(points, 0)

        def ended() -> Sequence[Floats | None]:
            found = [evaluation.residuals for evaluation in under_way]
            if len(found) < len(points):
                raise CancelledError
            return found

        return ended
