# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""perform_all(): performs the tasks of an experiment that no journal has yet, on threads."""

from __future__ import annotations

from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
import threading
import time
from typing import Callable, Iterator, Protocol, Sequence, TextIO, TypeVar

from dlo_calibration.evaluation.pool import cores, PERIOD
from dlo_calibration.experiment.journal import Done, Journal, Recorded

TOLD = 30.0  # s between two sentences on what is left, in a log file

Task_contra = TypeVar('Task_contra', bound=Recorded, contravariant=True)
Done_co = TypeVar('Done_co', covariant=True)


class Perform(Protocol[Task_contra, Done_co]):
    """A function that performs one task."""

    def __call__(self, task: Task_contra, *, should_stop: Callable[[], bool] = ...) -> Done_co:
        """Return the outcome; raise CancelledError once `should_stop` is True."""


AnyTask = TypeVar('AnyTask', bound=Recorded)


def perform_all(what: str, tasks: Sequence[AnyTask], journal: Journal[Done], perform: Perform[AnyTask, Done],
                workers: int, stop: Callable[[], bool], note: Callable[[str], None], stream: TextIO) -> None:
    """
    Perform the tasks that the journal lacks, each in one thread, and keep each outcome at once.

    It ends early if it is stopped, or if an outcome cannot be written.

    :param what: the tasks are called.
    :param workers: threads; 0: one per core.
    :param note: called with each sentence for the user.
    :param stream: for a progress bar.
    """
    from dlo_calibration.report.terminal import TaskBar

    waiting = [task for task in tasks if journal.find(task) is None]
    total = len(tasks)
    if not waiting:
        return
    if len(waiting) < total:
        note(f'{total - len(waiting)} of {total} {what} are done already')
    begun = told = time.monotonic()
    with TaskBar(what, total, total - len(waiting), stream) as bar:
        outcomes = _outcomes(waiting, perform, min(workers or cores(), len(waiting)), stop)
        for count, (task, outcome) in enumerate(outcomes, start=1):
            journal.add(task, outcome)
            if journal.failure:
                return
            bar.advance()
            now = time.monotonic()
            if not bar.shown and now - told > TOLD:
                told = now
                left = (now - begun) / count * (len(waiting) - count)
                note(f'{total - len(waiting) + count} of {total} {what}; {left:.0f} s left')


def _outcomes(waiting: Sequence[AnyTask], perform: Perform[AnyTask, Done], workers: int,
              stop: Callable[[], bool]) -> Iterator[tuple[AnyTask, Done]]:
    """Yield each task with its outcome when it is done; end early if stopped."""
    ended = threading.Event()

    def should_stop() -> bool:
        return ended.is_set() or stop()

    with ThreadPoolExecutor(workers) as executor:
        try:
            futures: dict[Future[Done], AnyTask] = {
                executor.submit(perform, task, should_stop=should_stop): task for task in waiting}
            while futures and not stop():
                for future in wait(futures, PERIOD, FIRST_COMPLETED).done:
                    yield futures.pop(future), future.result()
        except CancelledError:  # a task was stopped
            return
        finally:
            ended.set()
            executor.shutdown(cancel_futures=True)
