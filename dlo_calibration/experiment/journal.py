# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Laboratory and journal: perform tasks and record their outcomes, so that an experiment can continue."""

from __future__ import annotations

from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from errno import EEXIST
import json
import os
from pathlib import Path
import threading
import time
from typing import Any, Callable, Generic, Iterator, Mapping, Protocol, Sequence, TextIO, TypeVar

from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.pool import cores, PERIOD
from dlo_calibration.writing import Attempts, make_folder

Done = TypeVar('Done')


class Recorded(Protocol):
    """A task whose outcome is kept."""

    @property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""

    @property
    def about(self) -> Mapping[str, Any]:
        """Plain values that identify the task for a reader of the journal."""


class Journal(Generic[Done]):
    """
    The outcomes of an experiment, in a file with one JSON document per line.

    An incomplete line, which a killed process leaves, is ignored.

    :param of: builds an outcome, a dataclass, from its `asdict`; raises TypeError, KeyError or ValueError
        for any other values.
    :ivar failure: why an outcome could not be written; empty if all could be.
    :raises InputError: if the file cannot be read.
    """

    def __init__(self, path: Path, of: Callable[[Mapping[str, Any]], Done]) -> None:
        self.path = path
        self.failure = ''
        self._outcomes: dict[str, Done] = {}
        try:
            if path.is_symlink() or (path.exists() and not path.is_file()):  # a FIFO would block for ever
                raise OSError(EEXIST, 'something that is no file has this name')
            text = path.read_text(encoding='utf-8', errors='replace') if path.exists() else ''
        except OSError as error:
            raise InputError(f'file {path}', error.strerror or str(error),
                             'a file that can be read and written', 'choose another folder with --output'
                             ) from error
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._outcomes.setdefault(entry['key'], of(entry['outcome']))
            except (ValueError, TypeError, KeyError):
                continue
        self._cut = bool(text) and not text.endswith('\n')

    def find(self, task: Recorded) -> Done | None:
        """Return the outcome of a task; None if it is not done."""
        return self._outcomes.get(task.key)

    def add(self, task: Recorded, outcome: Done) -> None:
        """Append an outcome; when this returns, it is on disk, or `failure` says why not."""
        plain: Any = outcome
        line = json.dumps({**task.about, 'outcome': asdict(plain), 'key': task.key})
        try:
            with self.path.open('a', encoding='utf-8') as stream:
                stream.write(('\n' if self._cut else '') + f'{line}\n')
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            self.failure, self._cut = error.strerror or str(error), True
        else:
            self._cut = False
        self._outcomes[task.key] = outcome


REPORT_PERIOD = 30.0  # s between two sentences on the remaining time, in a log file

AnyTask = TypeVar('AnyTask', bound=Recorded)


@dataclass(frozen=True)
class Laboratory:
    """
    Performs the tasks of an experiment, and keeps its files in one folder.

    :param folder: for journals, tables and pictures.
    :param workers: threads; 0: one per core.
    :param stop: polled; once it returns True, no further task is performed.
    :param report: called with each sentence for the user.
    :param stream: for progress bars.
    :ivar attempts: the files that were written, and those that could not be.
    :raises InputError: if the folder cannot be made.
    """

    folder: Path
    workers: int
    stop: Callable[[], bool]
    report: Callable[[str], None]
    stream: TextIO
    attempts: Attempts = field(init=False)

    def __post_init__(self) -> None:
        make_folder(self.folder)
        object.__setattr__(self, 'attempts', Attempts(self.folder))

    def outcomes(self, what: str, tasks: Sequence[AnyTask], journal: Journal[Done],
                 perform: Callable[..., Done]) -> list[tuple[AnyTask, Done]]:
        """
        Perform the tasks that a journal lacks, each in one thread, and return all tasks that are done.

        Each outcome is written at once.  It ends early if it is stopped, or if an outcome cannot be written.

        :param what: the tasks are called.
        :param perform: called with a task and the keyword `should_stop`; returns its outcome, or raises
            CancelledError once `should_stop` is True.
        """
        from dlo_calibration.report.terminal import TaskBar

        total, waiting = len(tasks), [task for task in tasks if journal.find(task) is None]
        if 0 < len(waiting) < total:
            self.report(f'{total - len(waiting)} of {total} {what} are done already')
        begun = reported = time.monotonic()
        if waiting:
            with TaskBar(what, total, total - len(waiting), self.stream) as bar:
                for count, (task, new) in enumerate(self._performed(waiting, perform), start=1):
                    journal.add(task, new)
                    if journal.failure:
                        self.attempts.fail(f'the end of {journal.path.name}', journal.failure)
                        break
                    bar.advance()
                    now = time.monotonic()
                    if not bar.shown and now - reported > REPORT_PERIOD:
                        reported = now
                        seconds = (now - begun) / count * (len(waiting) - count)
                        self.report(f'{total - len(waiting) + count} of {total} {what}; {seconds:.0f} s left')
        return [(task, stored) for task in tasks if (stored := journal.find(task)) is not None]

    def _performed(self, waiting: Sequence[AnyTask], perform: Callable[..., Done]
                   ) -> Iterator[tuple[AnyTask, Done]]:
        """Yield each task with its outcome when it is done; end early if stopped."""
        ended = threading.Event()

        def should_stop() -> bool:
            return ended.is_set() or self.stop()

        with ThreadPoolExecutor(min(self.workers or cores(), len(waiting))) as executor:
            try:
                futures: dict[Future[Done], AnyTask] = {
                    executor.submit(perform, task, should_stop=should_stop): task for task in waiting}
                while futures and not self.stop():
                    for future in wait(futures, PERIOD, FIRST_COMPLETED).done:
                        yield futures.pop(future), future.result()
            except CancelledError:  # a task was stopped
                return
            finally:
                ended.set()
                executor.shutdown(cancel_futures=True)
