# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Journal: keeps the outcomes of an experiment on disk, so that it can continue after an interruption."""

from __future__ import annotations

from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict
from errno import EEXIST
import json
import os
from pathlib import Path
import threading
import time
from typing import Any, Callable, Generic, Iterator, Mapping, Protocol, Sequence, TextIO, TypeVar

from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.pool import cores, PERIOD
from dlo_calibration.writing import Attempts

Done = TypeVar('Done')


class Recorded(Protocol):
    """A task whose outcome is kept."""

    @property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""

    @property
    def about(self) -> Mapping[str, Any]:
        """Plain values that tell a reader of the journal which task it is."""


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
        self._path = path
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
            with self._path.open('a', encoding='utf-8') as stream:
                stream.write(('\n' if self._cut else '') + f'{line}\n')
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            self.failure, self._cut = error.strerror or str(error), True
        else:
            self._cut = False
        self._outcomes[task.key] = outcome

NOTE_PERIOD = 30.0  # s between two sentences on what is left, in a log file

AnyTask = TypeVar('AnyTask', bound=Recorded)


def performed(what: str, tasks: Sequence[AnyTask], path: Path, of: Callable[[Mapping[str, Any]], Done],
              perform: Callable[..., Done], workers: int, attempts: Attempts, stop: Callable[[], bool],
              note: Callable[[str], None], stream: TextIO) -> list[tuple[AnyTask, Done]]:
    """
    Perform the tasks that a journal lacks, each in one thread, and return all tasks that are done.

    Each outcome is written at once.  It ends early if it is stopped, or if an outcome cannot be written.

    :param what: the tasks are called.
    :param path: of the journal; `of` builds its outcomes, see `Journal`.
    :param perform: called with a task and the keyword `should_stop`; returns its outcome, or raises
        CancelledError once `should_stop` is True.
    :param workers: threads; 0: one per core.
    :param attempts: gets the journal as a failure if it cannot be written.
    :param note: called with each sentence for the user.
    :param stream: for a progress bar.
    :raises InputError: if the journal cannot be read.
    """
    from dlo_calibration.report.terminal import TaskBar

    journal, total = Journal(path, of), len(tasks)
    waiting = [task for task in tasks if journal.find(task) is None]
    if 0 < len(waiting) < total:
        note(f'{total - len(waiting)} of {total} {what} are done already')
    begun = noted = time.monotonic()
    if waiting:
        with TaskBar(what, total, total - len(waiting), stream) as bar:
            outcomes = _outcomes(waiting, perform, min(workers or cores(), len(waiting)), stop)
            for count, (task, outcome) in enumerate(outcomes, start=1):
                journal.add(task, outcome)
                if journal.failure:
                    attempts.fail(f'the end of {path.name}', journal.failure)
                    break
                bar.advance()
                now = time.monotonic()
                if not bar.shown and now - noted > NOTE_PERIOD:
                    noted = now
                    left = (now - begun) / count * (len(waiting) - count)
                    note(f'{total - len(waiting) + count} of {total} {what}; {left:.0f} s left')
    return [(task, known) for task in tasks if (known := journal.find(task)) is not None]


def _outcomes(waiting: Sequence[AnyTask], perform: Callable[..., Done], workers: int,
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
