# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
BatchEvaluator: many parameter sets evaluated in order, in this process or by an executor.

Each process and each thread creates and uses a simulator of its own.
"""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
import copy
import math
import pickle
import queue
import threading
from typing import Callable, Iterator, Mapping, Sequence
import uuid
import weakref

from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.memory import EvaluatorMemory, Memory
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.protocol import TogetherSimulator

AT_A_TIME = 48  # rollouts: twelve for each lane, of which some are empty only towards the end


class BatchEvaluator:
    """
    Evaluates batches of points in order.

    Once stopped, a batch ends early, without an error.

    :param should_stop: asked again and again; True ends the batch.
    :param executor: runs the evaluations; None: this thread does.
    :param memory: has the evaluations that need not be simulated again, and gets each new one as soon as it
        is finished; None: nothing is remembered.
    """

    def __init__(self, evaluator: Evaluator, should_stop: Callable[[], bool],
                 executor: Executor | None, memory: EvaluatorMemory | None = None) -> None:
        self.evaluator = evaluator
        self._memory = memory or Memory().of(evaluator)
        self._should_stop = should_stop
        self._executor = executor
        self._parcel = _Parcel(evaluator)
        self._key = uuid.uuid4().hex  # identifies these trials on all machines

    def of(self, space: ParameterSpace, memory: Memory) -> BatchEvaluator:
        """Return one of the same trials with other parameters: workers keep what belongs to the trials."""
        other = copy.copy(self)
        other.evaluator = self.evaluator.of(space)
        other._memory = memory.of(other.evaluator)
        return other

    def __call__(self, points: Floats, first: int) -> Iterator[Evaluation]:
        """Yield the evaluations of (k, d) points; the first one has the index `first`."""
        if self._executor is not None:
            return self._in_parallel(points, first, self._executor)
        return self._here(points, first)

    def _here(self, points: Floats, first: int) -> Iterator[Evaluation]:
        known = [self._memory.find(index, point) for index, point in enumerate(points, first)]
        for k, evaluation in enumerate(known):
            if evaluation is None:
                new = [j for j in range(k, len(points)) if known[j] is None][:self._portion(len(points))]
                try:
                    found = self.evaluator.evaluate_all([(first + j, points[j]) for j in new],
                                                        self._should_stop)
                except CancelledError:
                    return
                for j, evaluation in zip(new, found, strict=True):
                    self._memory.add(evaluation)
                    known[j] = evaluation
            elif self._should_stop():
                return
            one = known[k]
            assert one is not None
            yield one

    def _portion(self, points: int) -> int:
        """Return how many of so many points to evaluate at a time."""
        if not isinstance(self.evaluator.simulator, TogetherSimulator):
            return 1
        wanted = math.ceil(AT_A_TIME / len(self.evaluator.trials))
        return max(1, min(wanted, points // getattr(self._executor, 'workers', 1)))

    def _in_parallel(self, points: Floats, first: int, executor: Executor) -> Iterator[Evaluation]:
        """Begin at once; return an iterator that waits."""
        known = [self._memory.find(index, point) for index, point in enumerate(points, first)]
        new, size = [k for k, one in enumerate(known) if one is None], self._portion(len(points))
        futures: dict[int, tuple[Future[list[Evaluation]], int]] = {}  # and the place in its answer
        for begin in range(0, len(new), size):
            portion = new[begin:begin + size]
            future = executor.submit(_evaluate_in_worker, self._key, self._parcel, self.evaluator.space,
                                     [(first + k, points[k]) for k in portion])
            futures.update({k: (future, place) for place, k in enumerate(portion)})
        return self._finished(known, futures)

    def _finished(self, known: Sequence[Evaluation | None],
                  futures: Mapping[int, tuple[Future[list[Evaluation]], int]]) -> Iterator[Evaluation]:
        """Yield what is known and what the futures give, at its place in their answers."""
        finished: queue.SimpleQueue[Future[list[Evaluation]]] = queue.SimpleQueue()
        waiting = {future for future, _ in futures.values()}
        for future in waiting:
            future.add_done_callback(finished.put)
        try:
            for k, evaluation in enumerate(known):
                while k in futures and futures[k][0] in waiting:
                    if self._should_stop():
                        return
                    self._take(finished, waiting)
                if self._should_stop():
                    return
                yield futures[k][0].result()[futures[k][1]] if evaluation is None else evaluation
        finally:
            for future, _ in futures.values():
                future.cancel()

    def _take(self, finished: queue.SimpleQueue[Future[list[Evaluation]]],
              waiting: set[Future[list[Evaluation]]]) -> None:
        """Wait shortly for the next evaluations in the order in which they finish, and remember them."""
        try:
            future = finished.get(timeout=0.05)
        except queue.Empty:
            return
        waiting.remove(future)
        if not future.cancelled() and future.exception() is None:  # an error is raised when its turn comes
            for evaluation in future.result():
                self._memory.add(evaluation)

    def residuals(self, points: Floats) -> Sequence[Floats | None]:
        """
        Return the residuals at (k, d) points; None where a simulation failed.

        :raises CancelledError: when stopped.
        """
        return self.begin(points)()

    def begin(self, points: Floats) -> Callable[[], Sequence[Floats | None]]:
        """Begin to evaluate (k, d) points, if an executor does that; return what gives their `residuals`."""
        under_way = self(points, 0)

        def ended() -> Sequence[Floats | None]:
            found = [evaluation.residuals for evaluation in under_way]
            if len(found) < len(points):
                raise CancelledError
            return found

        return ended


class _Parcel:
    """
    An evaluator that is sent to workers.

    It is pickled only once, and each worker unpickles it only once: with thousands of
    chains, that takes as long as simulating the trials.
    """

    def __init__(self, evaluator: Evaluator | None, packed: bytes = b'') -> None:
        self._evaluator, self._packed = evaluator, packed

    def open(self) -> Evaluator:
        """Return the evaluator: the original in this process, a copy in a worker process."""
        if self._evaluator is None:
            self._evaluator = pickle.loads(self._packed)  # noqa: S301  # sent by the parent process
        assert self._evaluator is not None
        return self._evaluator

    def __reduce__(self) -> tuple[type[_Parcel], tuple[None, bytes]]:
        self._packed = self._packed or pickle.dumps(self._evaluator, pickle.HIGHEST_PROTOCOL)
        return _Parcel, (None, self._packed)


class _WorkerThread(threading.local):
    """
    The evaluator that a worker's thread keeps for the current calibration.

    Its simulator is closed when another calibration begins or the thread ends.
    """

    key = ''
    evaluator: Evaluator
    close: Callable[[], object] = staticmethod(lambda: None)

    def of(self, key: str, parcel: _Parcel) -> Evaluator:
        if key != self.key:
            self.close()
            self.key, self.evaluator = key, copy.copy(parcel.open())
            self.close = weakref.finalize(self.evaluator, self.evaluator.simulator.close)
        return self.evaluator


_worker_thread = _WorkerThread()


def _evaluate_in_worker(key: str, parcel: _Parcel, space: ParameterSpace,
                        points: Sequence[tuple[int, Floats]]) -> list[Evaluation]:
    """Evaluate points of a space, each with its index, in a worker that keeps the evaluator of the trials."""
    return _worker_thread.of(key, parcel).of(space).evaluate_all(points)
