# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""Processes that simulate: they end with whoever started them, at once, however that one ends."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection, parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
import os
import signal
import sys
import threading
import types
from typing import Any, Callable, Iterator

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_starting = threading.Lock()


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


class ProcessExecutor(Executor):
    """
    An executor of `workers` fresh processes; 0: one per core.

    The processes ignore SIGINT and SIGTERM, so that Ctrl-C reaches the one who
    knows what to do about it; they end by `close`, or when the parent is gone.
    They do not import the main module: nothing defined there can be sent.
    """

    def __init__(self, workers: int) -> None:
        self._context = _Context()
        self._pool = ProcessPoolExecutor(workers or cores(), mp_context=self._context, initializer=_begin)

    def submit(self, call: Callable[..., Any], /, *args: Any, **keywords: Any) -> Future[Any]:
        """Return a future that may be cancelled at any time."""
        # A future of the pool itself may not: where a process died, the pool's own thread fails
        # on what was cancelled meanwhile, and prints that (CPython 3.11).
        future: Future[Any] = Future()
        self._pool.submit(call, *args, **keywords).add_done_callback(lambda done: _pass_on(done, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End when everything submitted is done."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def close(self) -> None:
        """End the processes now, whatever they are doing."""
        # First of all: where one has died, the pool holds its lock until the others, deaf to SIGTERM, end.
        for process in self._context.started:
            process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._context.started:
            process.join()


def _pass_on(done: Future[Any], future: Future[Any]) -> None:
    """Give `future` what `done` ended with, unless it was cancelled."""
    if not future.set_running_or_notify_cancel():
        return
    error = CancelledError() if done.cancelled() else done.exception()
    if error is not None:
        future.set_exception(error)
    else:
        future.set_result(done.result())


class _Process(SpawnProcess):
    """A spawned process that starts deaf to signals and without the parent's main module."""

    def start(self) -> None:
        # The main module may be one that loads rclpy; a child needs nothing from it.
        with _starting, _blocked_signals():
            main = sys.modules['__main__']
            sys.modules['__main__'] = types.ModuleType('__main__')
            try:
                super().start()
            finally:
                sys.modules['__main__'] = main


class _Context(SpawnContext):
    """Spawns such processes, and remembers them."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[_Process] = []

    def Process(self, *args: Any, **keywords: Any) -> _Process:  # type: ignore[override]  # noqa: N802
        process = _Process(*args, **keywords)
        self.started.append(process)
        return process


@contextmanager
def _blocked_signals() -> Iterator[None]:
    """Block SIGINT and SIGTERM in this thread; a process started here begins with them blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Prepare a process that simulates."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
