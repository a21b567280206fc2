# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
ProcessExecutor: processes that simulate.

They end as soon as the process that started them ends, for whatever reason.  A process that
dies, or hangs, is replaced, and its call is repeated.

They are forked from Python's fork server, which has loaded the kernels (`loaded`): so they begin at once,
and share what it has loaded.
"""

from __future__ import annotations

import atexit
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, forkserver, parent_process, resource_tracker, util
from multiprocessing.context import ForkServerProcess, SpawnProcess
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
import os
import queue
import shutil
import signal
import sys
import threading
import time
import traceback
import types
from typing import Any, Callable, Iterator, Mapping

from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.signals import before_end

LOADED = 'dlo_calibration.evaluation.loaded'  # what the fork server imports
SIGNALS = (signal.SIGINT, signal.SIGTERM)
DEATHS = 3  # processes that may die at the same call before it fails
ANSWER_LIMIT = 60.0  # s without a sign of life after which a process counts as hanging; the default
SIGN_PERIOD = 0.25  # s between two signs of life; a small part of the shortest limit, 1 s
START_LIMIT = 60.0  # s more for the first sign: on a busy machine Python may take some seconds to start
_starting = threading.Lock()
_loaded: list[str] = []


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def begin_to_load() -> None:
    """Start the fork server now, so that it loads the kernels while this process does something else."""
    with _sheltered():
        if not _loaded:
            _loaded.append(LOADED)
            forkserver.set_forkserver_preload(_loaded)
            before_end(lambda: shutil.rmtree(util.get_temp_dir(), ignore_errors=True))  # its socket is there
        forkserver.ensure_running()


class ProcessExecutor(Executor):
    """
    An executor of `workers` processes; 0: one per core.

    They start with the first call, and end by `close` or with the parent process.  They
    ignore SIGINT and SIGTERM: the parent handles these.  They do not import the
    main module, so nothing that is defined there can be sent to them.  A process
    that dies is replaced and its call is repeated; a call at which `DEATHS`
    processes died ends with a `ProcessEnded`.  A process that hangs is killed: it gives
    a sign of life as long as it loads modules, and then whenever its simulation advances.

    :param on_death: called with a sentence for each death, from any thread.
    :param answer_limit: time [s] without a sign of life after which a process that works is killed.
    :param fresh: whether they begin with nothing loaded, e.g. to compile kernels.
    """

    def __init__(self, workers: int, on_death: Callable[[str], None] = lambda _: None,
                 answer_limit: float = ANSWER_LIMIT, fresh: bool = False) -> None:
        self._fresh = fresh
        self._tasks: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._on_death = on_death
        self._answer_limit = answer_limit
        self._closed = threading.Event()
        self._processes: dict[_Process, connection.Connection] = {}
        self._threads: list[threading.Thread] = []
        self._beginning = threading.Lock()  # guards `_threads`
        self._changing = threading.Lock()  # guards `_processes`
        # At exit, Python would send SIGTERM, which the processes ignore, and wait for them for ever.
        atexit.register(self.close)
        #: number of processes
        self.workers = workers or cores()
        if not fresh:
            begin_to_load()

    def submit(self, call: Callable[..., Any], /, *args: Any, **keywords: Any) -> Future[Any]:
        """
        Return a future that may be cancelled until a process takes it.

        :raises DloCalibrationError: if no process can be started.
        """
        if self._closed.is_set():
            raise RuntimeError('the executor is closed')
        self._begin()
        task = _Task(Future(), call, args, keywords)
        self._tasks.put(task)
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End when all submitted calls are done."""
        if cancel_futures:
            self._cancel_waiting()
        with self._beginning:  # else some of them may not have been started yet
            threads = list(self._threads)
        for _ in threads:
            self._tasks.put(None)
        if wait:
            for thread in threads:
                thread.join()
            atexit.unregister(self.close)

    def close(self) -> None:
        """Kill the processes now; calls under way are cancelled."""
        self._closed.set()
        atexit.unregister(self.close)
        self._cancel_waiting()
        self._kill()
        self.shutdown()

    def _begin(self) -> None:
        """Start the processes, unless they have been."""
        with self._beginning:
            if self._threads:
                return
            first = []
            try:
                for _ in range(self.workers):
                    first.append(self._new_process())
            except BaseException:
                self._kill()
                raise
            self._threads = [threading.Thread(target=self._serve, args=(process,), name='simulation',
                                              daemon=True) for process in first]
            for thread in self._threads:
                thread.start()
            threading.Thread(target=self._watch, name='watching simulations', daemon=True).start()

    def _cancel_waiting(self) -> None:
        while True:
            try:
                task = self._tasks.get_nowait()
            except queue.Empty:
                return
            if task is not None:
                task.future.cancel()
                task.future.set_running_or_notify_cancel()

    def _kill(self) -> None:
        with self._changing:
            for process in self._processes:
                process.kill()
        for process in list(self._processes):
            process.join()

    def _new_process(self) -> _Process:
        with self._changing:
            if self._closed.is_set():
                raise CancelledError
            here, there = connection.Pipe()
            process = (_Fresh if self._fresh else _Forked)(target=_work, args=(there,), daemon=True)
            try:
                process.start()
            except (OSError, EOFError) as error:  # EOFError: the fork server has ended
                raise DloCalibrationError(f'a process that simulates could not be started ({error}); '
                                          'use fewer workers') from error
            finally:
                there.close()
            self._processes[process] = here
            return process

    def _end(self, process: _Process) -> None:
        """Close the connection to a process, and wait for its end."""
        with self._changing:
            self._processes.pop(process).close()
        process.join()

    def _watch(self) -> None:
        """Kill processes that hang; runs in a thread of its own while the others do."""
        while not self._closed.wait(SIGN_PERIOD) and any(thread.is_alive() for thread in self._threads):
            with self._changing:
                for process in self._processes:
                    if process.works:
                        # Counted, not measured: while this process is stopped too, nobody is silent.
                        process.silence += SIGN_PERIOD
                        if process.silence > self._answer_limit:
                            process.kill()

    def _answer(self, process: _Process, task: _Task) -> tuple[Any, BaseException | None]:
        """Return the result or the error of a call in a process."""
        channel = self._processes[process]
        process.silence, process.works = min(process.silence, 0.0), True
        try:
            channel.send((task.call, task.args, task.keywords))
            while (answer := channel.recv()) is None:  # a sign of life
                process.silence = 0.0
        finally:
            process.works = False
        result: tuple[Any, BaseException | None] = answer
        return result

    def _serve(self, process: _Process | None) -> None:
        """Pass waiting tasks to a process, replacing it when it dies; runs in a thread per process."""
        while (task := self._tasks.get()) is not None:
            if task.future.set_running_or_notify_cancel():
                process = self._do(task, process)
        if process is not None:
            self._end(process)

    def _do(self, task: _Task, process: _Process | None) -> _Process | None:
        """Give the future of a task its result or error; return the process if it still lives."""
        deaths = 0
        while True:
            try:
                process = process or self._new_process()
                result, failure = self._answer(process, task)
            except (EOFError, OSError):
                assert process is not None
                self._end(process)
                deaths, ended, process = deaths + 1, process, None
                ending, remedy = self._ending(ended)
                if self._closed.is_set():
                    task.future.set_exception(CancelledError())
                    return None
                self._on_death(f'a process that simulates {ending}; its evaluation is repeated')
                if deaths == DEATHS:
                    task.future.set_exception(ProcessEnded(
                        f'{DEATHS} processes one after the other ended unexpectedly at the same evaluation, '
                        f'the last one {ending}; {remedy}'))
                    return None
            except BaseException as error:  # no new process could start, or the call cannot be pickled
                task.future.set_exception(error)
                return process
            else:
                if failure is None:
                    task.future.set_result(result)
                else:
                    task.future.set_exception(failure)
                return process

    def _ending(self, process: _Process) -> tuple[str, str]:
        """Return in words how a process ended, and what to do about it."""
        code, remedy = process.exitcode, 'free memory, or use fewer workers'
        if process.silence > self._answer_limit:
            return (f'gave no answer for {self._answer_limit:g} s and is replaced',
                    'raise answer_limit, or use fewer workers')
        if code is None or code >= 0:
            return f'ended unexpectedly with exit code {code}', remedy
        killed = f'was killed by {signal.Signals(-code).name}'
        if code == -signal.SIGKILL:
            return f'{killed}, as happens when memory runs out', remedy
        return killed, f'{remedy}, or simulate without a scene'


class ProcessEnded(DloCalibrationError):
    """A call at which `DEATHS` processes ended."""


@dataclass(frozen=True)
class _Task:
    future: Future[Any]
    call: Callable[..., Any]
    args: tuple[Any, ...]
    keywords: Mapping[str, Any]


class _Process(BaseProcess):
    """A process that starts with signals blocked and without the parent's main module."""

    works = False  # whether it executes a call
    silence = -START_LIMIT  # s without a sign of life while it worked

    def start(self) -> None:
        with _sheltered():
            super().start()


class _Forked(_Process, ForkServerProcess):
    """A process that begins with what the fork server has loaded."""


class _Fresh(_Process, SpawnProcess):
    """A process that begins with nothing loaded."""


@contextmanager
def _sheltered() -> Iterator[None]:
    """
    Block SIGINT and SIGTERM in this thread, and hide the main module.

    A process started here begins with the signals blocked; the main module may load rclpy, which it does not
    need.
    """
    # Start Python's resource tracker first: starting it later would unblock the signals again.
    resource_tracker.ensure_running()
    with _starting:
        before, main = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS), sys.modules['__main__']
        sys.modules['__main__'] = types.ModuleType('__main__')
        try:
            yield
        finally:
            sys.modules['__main__'] = main
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(channel: connection.Connection) -> None:
    """Execute calls until the parent closes the connection; the main function of a process."""
    _begin()
    sending, works = threading.Lock(), threading.Event()
    threading.Thread(target=_give_signs, args=(channel, sending, works), daemon=True).start()
    while True:
        try:
            octets = channel.recv_bytes()
            works.set()
            call, args, keywords = ForkingPickler.loads(octets)
            answer = call(*args, **keywords), None
            works.clear()
            with sending:
                channel.send(answer)
        except (EOFError, BrokenPipeError):
            return
        except BaseException as error:
            works.clear()
            with sending:
                channel.send((None, _sendable(error)))


def _give_signs(channel: connection.Connection, sending: threading.Lock, works: threading.Event) -> None:
    """
    Give signs of life while a call advances; runs in a thread.

    A process that is stopped gives none, nor does one in whose simulation nothing is counted.  Before
    the first count it may be loading modules or compiling, which nothing counts.
    """
    from dlo_calibration.simulation.protocol import advances  # loads NumPy, which the parent need not

    seen = 0
    while works.wait():
        count = advances()
        if count == 0 or count != seen:
            seen = count
            with sending:
                if works.is_set():
                    try:
                        channel.send(None)
                    except OSError:  # the parent has closed the connection
                        return
        time.sleep(SIGN_PERIOD)


def _sendable(error: BaseException) -> BaseException:
    """Return an error that can be unpickled elsewhere, with its traceback as a note."""
    text = ''.join(traceback.format_exception(error))
    try:
        error.add_note(f'In a process that simulates:\n{text}')
        ForkingPickler.loads(ForkingPickler.dumps(error))
    except Exception:
        return RuntimeError(text)
    return error


def _begin() -> None:
    """Ignore SIGINT and SIGTERM, lower the priority, and end with the parent."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.nice(5)  # the node or the terminal that the user waits for comes first
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
