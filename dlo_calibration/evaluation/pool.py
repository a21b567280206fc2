# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pool: simulates jobs with one simulator, on threads of this process or on other machines."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
import copy
from functools import partial
import math
import os
import sys
import threading
from typing import Callable, Sequence, TypeVar

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.log import Memory
from dlo_calibration.simulation.protocol import Job, Rollout, simulate_all, Simulator, Stop

PERIOD = 0.05  # s between two polls of `should_stop`
NICE = 5  # reduction of the priority of threads that simulate: threads that answer users come first

Outcome = TypeVar('Outcome')


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


class Threads(ThreadPoolExecutor):
    """
    Threads that simulate.

    :param workers: their number; 0: one per core.
    """

    def __init__(self, workers: int = 0) -> None:
        #: number of threads
        self.workers = workers or cores()
        super().__init__(self.workers, 'simulation', _lower_priority)

    def close(self) -> None:
        """Cancel calls that have not begun, and wait for the others."""
        self.shutdown(cancel_futures=True)


def _lower_priority() -> None:
    if sys.platform == 'linux':  # there, each thread has its own priority
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, min(os.getpriority(os.PRIO_PROCESS, thread) + NICE, 19))


class Pool:
    """
    Simulates jobs with one simulator; a calibration gets all its rollouts from it.

    Rollouts come in the order of the jobs and do not depend on the number of workers.

    :param executor: its workers simulate: `Threads` or a `ClusterExecutor`; None: one thread.
    :param should_stop: polled while a caller waits; once it returns True, the pool stops.
    :param memory: holds earlier rollouts, which are not simulated again, and stores the new ones.
    """

    def __init__(self, simulator: Simulator, executor: Executor | None = None,
                 should_stop: Callable[[], bool] = lambda: False, memory: Memory | None = None) -> None:
        self.simulator = simulator
        self._executor = executor or Threads(1)
        self._should_stop = should_stop
        self._memory = memory or Memory()
        self._stop = Stop()
        self._under_way: set[Future[list[Rollout | SimulationError]]] = set()

    def refined(self) -> Pool | None:
        """Return a pool with twice the segments and half the time step, which stops with this one."""
        finer = self.simulator.refined()
        if finer is None:
            return None
        other = copy.copy(self)
        other.simulator = finer
        return other

    def stop(self) -> None:
        """End all rollouts; waiting for one raises a CancelledError."""
        self._stop.set()
        for future in list(self._under_way):
            future.cancel()

    def portion(self, jobs: int) -> int:
        """Return the number of jobs, out of `jobs`, that a worker should simulate in one call."""
        most: int = getattr(self.simulator, 'at_a_time', 1)
        return max(1, min(most, math.ceil(jobs / getattr(self._executor, 'workers', 1))))

    def submit(self, jobs: Sequence[Job],
               then: Callable[[list[Rollout | SimulationError]], Outcome]) -> Future[Outcome]:
        """
        Begin to simulate jobs in one call of a worker; `result` waits for it.

        :param then: converts the rollouts to the result of the future, when they are finished.
        """
        outcome: Future[Outcome] = Future()
        under_way = self._executor.submit(simulate_all, self.simulator, jobs, self._stop)
        self._under_way.add(under_way)
        under_way.add_done_callback(partial(self._finish, outcome, then))
        return outcome

    def _finish(self, outcome: Future[Outcome], then: Callable[[list[Rollout | SimulationError]], Outcome],
                ended: Future[list[Rollout | SimulationError]]) -> None:
        self._under_way.discard(ended)
        try:
            outcome.set_result(then(ended.result()))
        except BaseException as error:
            outcome.set_exception(error)

    def result(self, future: Future[Outcome]) -> Outcome:
        """
        Wait for the result of a future of `submit`.

        :raises CancelledError: when stopped.
        """
        while not self._should_stop():
            try:
                return future.result(PERIOD)
            except TimeoutError:
                if future.done():
                    return future.result()
            except KeyboardInterrupt:
                self.stop()
                raise
        self.stop()
        raise CancelledError

    def begin(self, jobs: Sequence[Job]) -> Callable[[], list[Rollout | SimulationError]]:
        """Begin to simulate jobs on all workers; return a function that waits for the rollouts."""
        name = self.simulator.name
        stored = [self._memory.rollout(name, job) for job in jobs]
        new = [k for k, rollout in enumerate(stored) if rollout is None]
        size, futures = self.portion(len(new)), []
        for first in range(0, len(new), size):
            portion = [jobs[k] for k in new[first:first + size]]
            futures.append(self.submit(portion, partial(self._memory.add_rollouts, name, portion)))

        def result() -> list[Rollout | SimulationError]:
            simulated = iter([rollout for future in futures for rollout in self.result(future)])
            return [next(simulated) if rollout is None else rollout for rollout in stored]

        return result

    def simulate(self, jobs: Sequence[Job]) -> list[Rollout | SimulationError]:
        """
        Return the rollout of each job, or why it failed.

        :raises CancelledError: when stopped.
        """
        return self.begin(jobs)()
