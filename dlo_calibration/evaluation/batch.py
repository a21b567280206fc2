# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""BatchEvaluator: evaluates batches of points in parallel and yields the evaluations in order."""

from __future__ import annotations

from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Callable, Iterator, Mapping, Sequence

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.evaluation.log import EvaluatorMemory, Memory
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.protocol import Rollout


class BatchEvaluator:
    """
    Evaluates batches of points in order.

    Once the pool stops, a batch ends early, without an error.

    :param pool: simulates with the evaluator's simulator.
    :param memory: holds earlier evaluations, which are not simulated again, and stores each new evaluation
        when it is finished; None: nothing is stored.
    """

    def __init__(self, evaluator: Evaluator, pool: Pool, memory: EvaluatorMemory | None = None) -> None:
        self.evaluator = evaluator
        self._pool = pool
        self._memory = memory or Memory().of(evaluator)

    def __call__(self, points: Floats, first: int) -> Iterator[Evaluation]:
        """
        Begin at once; return an iterator that waits for the evaluations of (k, d) points.

        The first one has the index `first`.
        """
        stored = [self._memory.find(index, point) for index, point in enumerate(points, first)]
        new = [k for k, evaluation in enumerate(stored) if evaluation is None]
        trials = len(self.evaluator.trials)
        size = max(1, self._pool.portion(len(new) * trials) // trials)
        futures: dict[int, tuple[Future[list[Evaluation]], int]] = {}  # each with a place in its result
        for begin in range(0, len(new), size):
            portion = [(first + k, points[k]) for k in new[begin:begin + size]]
            jobs = [job for _, point in portion for job in self.evaluator.jobs(point)]
            future = self._pool.submit(jobs, partial(self._evaluated, portion))
            futures.update({k: (future, place) for place, k in enumerate(new[begin:begin + size])})
        return self._in_order(stored, futures)

    def _evaluated(self, points: Sequence[tuple[int, Floats]],
                   rollouts: Sequence[Rollout | SimulationError]) -> list[Evaluation]:
        """Return the evaluations of points with their indices, and store them."""
        trials, evaluations = len(self.evaluator.trials), []
        for k, (index, point) in enumerate(points):
            evaluations.append(
                self.evaluator.evaluated(index, point, rollouts[k * trials:(k + 1) * trials]))
            self._memory.add(evaluations[-1])
        return evaluations

    def _in_order(self, stored: Sequence[Evaluation | None],
                  futures: Mapping[int, tuple[Future[list[Evaluation]], int]]) -> Iterator[Evaluation]:
        """Yield the stored evaluations, and those of the futures in place of each None."""
        finished: Future[list[Evaluation]] = Future()  # so that the pool can also stop at a stored one
        finished.set_result([])
        for k, evaluation in enumerate(stored):
            future, place = futures.get(k, (finished, 0))
            try:
                evaluations = self._pool.result(future)
            except CancelledError:
                return
            yield evaluations[place] if evaluation is None else evaluation

    def residuals(self, points: Floats) -> Sequence[Floats | None]:
        """
        Return the residuals at (k, d) points; None where a simulation failed.

        :raises CancelledError: when stopped.
        """
        return self.begin(points)()

    def begin(self, points: Floats) -> Callable[[], Sequence[Floats | None]]:
        """Begin to evaluate (k, d) points; return a function that waits for their `residuals`."""
        under_way = self(points, 0)

        def result() -> Sequence[Floats | None]:
            residuals = [evaluation.residuals for evaluation in under_way]
            if len(residuals) < len(points):
                raise CancelledError
            return residuals

        return result
