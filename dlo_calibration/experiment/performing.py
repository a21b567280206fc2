# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""perform_all(): performs the tasks of an experiment that no journal has yet, in processes."""

from __future__ import annotations

from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, wait
from contextlib import closing
import time
from typing import Callable, Iterator, Protocol, Sequence, TextIO, TypeVar

from dlo_calibration.evaluation.processes import cores, ProcessExecutor
from dlo_calibration.experiment.journal import Done, Journal, Recorded

TOLD = 30.0  # s between two sentences on what is left, in a log file

Task_contra = TypeVar('Task_contra', bound=Recorded, contravariant=True)
Done_co = TypeVar('Done_co', covariant=True)


class Perform(Protocol[Task_contra, Done_co]):
    """A function that performs one task; it can be pickled."""

    def __call__(self, task: Task_contra, *, should_stop: Callable[[], bool] = ...) -> Done_co:
        """Return the outcome; raise CancelledError once `should_stop` is True."""


AnyTask = TypeVar('AnyTask', bound=Recorded)


def perform_all(what: str, tasks: Sequence[AnyTask], journal: Journal[Done], perform: Perform[AnyTask, Done],
                workers: int, stop: Callable[[], bool], note: Callable[[str], None], stream: TextIO) -> None:
    """
    Perform the tasks that the journal lacks, each in one process, and keep each outcome at once.

    It ends early if it is stopped, or if an outcome cannot be written.

    :param what: the tasks are called.
    :param workers: processes; 0: one per core; 1: this one.
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
        outcomes = _outcomes(waiting, perform, min(workers or cores(), len(waiting)), stop, note)
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
              stop: Callable[[], bool], note: Callable[[str], None]) -> Iterator[tuple[AnyTask, Done]]:
    """Yield each task with its outcome when it is done; end early if stopped."""
    if workers == 1:
        for task in waiting:
            try:
                yield task, perform(task, should_stop=stop)
            except CancelledError:
                return
        return
    with closing(ProcessExecutor(workers, note)) as executor:
        futures: dict[Future[Done], AnyTask] = {executor.submit(perform, task): task for task in waiting}
        while futures and not stop():
            for future in wait(futures, 0.1, FIRST_COMPLETED).done:  # s, then look at `stop` again
                yield futures.pop(future), future.result()
