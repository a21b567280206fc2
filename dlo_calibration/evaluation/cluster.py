# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ClusterExecutor: simulates on the workers of a Dask scheduler, on any number of machines."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
from functools import partial
import io
import logging
import pickle
import socket
import threading
import time
import traceback
from typing import Any, Callable, Mapping
import uuid
import warnings

from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Simulator, Stop

PATIENCE = 8  # s after which a scheduler counts as unreachable
RETURN = 30.0  # s to wait for a new worker after the last one is lost
CACHE_SIZE = 1000  # trials and simulators in the cache of a worker


class ClusterExecutor(Executor):
    """
    An executor on the workers of a Dask scheduler.

    Each worker's machine needs this package; the scheduler's machine needs only Dask.

    :param address: of the scheduler, e.g. ``tcp://host:8786``.
    :param on_loss: called with a warning for each lost worker, from any thread.
    :param on_wait: called with a sentence if there is no worker yet.
    :raises InputError: if Dask is not installed or no scheduler answers.
    """

    def __init__(self, address: str, on_loss: Callable[[str], None] = lambda _: None,
                 on_wait: Callable[[str], None] = lambda _: None) -> None:
        try:
            from distributed import Client
            from distributed.comm import get_address_host_port
        except ImportError as error:
            raise InputError(
                'parameter scheduler', f'{address!r} without the library distributed ({error})',
                'that library', 'install it: pip install distributed') from error
        self._address = address
        self._on_loss = on_loss
        self._closed = threading.Event()
        self._pending: dict[Future[Any], Future[Any]] = {}  # future without a result -> Dask's future
        self._given_up: BaseException | None = None
        self._deadline = float('inf')  # [s] by which there must be a worker
        self._pickled: dict[int, tuple[Any, str, bytes]] = {}  # trials and simulators with key and pickle
        self._restore_logging = _mute_dask()
        try:
            # Try the address first: Dask's client retries for long, and logs an error when it is deleted.
            socket.create_connection(get_address_host_port(address, strict=True), PATIENCE).close()
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # e.g. about versions of the workers; failures are reported
                self._client = Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            self._restore_logging()
            raise InputError('parameter scheduler', f'{address!r} ({" ".join(str(error).split())})',
                             'the address of a Dask scheduler that answers, such as tcp://host:8786',
                             'start one with: dask scheduler') from error
        # Without pure=False, Dask would answer a call with the result of an equal one of another calibration.
        self._executor = self._client.get_executor(pure=False)
        self._client.subscribe_topic('all', self._hear)
        if not self._client.nthreads():
            on_wait(f'the scheduler {address} has no workers yet; waiting for one '
                    f'(start it with: dask worker {address} --nthreads 1)')
        threading.Thread(target=self._watch, name='watching a scheduler', daemon=True).start()

    def submit(self, call: Callable[..., Any], /, *args: Any, **keywords: Any) -> Future[Any]:
        """
        Return a future that may be cancelled at any time.

        Trials and simulators are pickled once, and each worker unpickles them once: with thousands of
        chains, pickling takes as long as simulating the trials.
        """
        future: Future[Any] = Future()
        # Send bytes and a function of Python's library: every worker and the scheduler can unpickle these.  A
        # worker that fails to unpickle a task, e.g. because a module is missing, leaves without an error.
        self._send(future, _pickled(_Call(call, *args, **keywords), self._pickled))
        if self._given_up is not None:
            self._fail(future, self._given_up)
        return future

    def _send(self, future: Future[Any], pickled: bytes) -> None:
        """Let a worker unpickle a call, which executes it; its result becomes that of a future."""
        remote = self._executor.submit(pickle.loads, pickled)  # noqa: S301  # a worker unpickles it
        self._pending[future] = remote
        future.add_done_callback(lambda done: remote.cancel() if done.cancelled() else None)
        remote.add_done_callback(lambda _: self._finish(future, pickled))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Disconnect when all submitted calls are done; at once without `wait` or with `cancel_futures`."""
        if not self._closed.is_set():
            self._executor.shutdown(wait=wait and not cancel_futures)
            self.close()

    def close(self) -> None:
        """Disconnect now: the scheduler drops the submitted calls."""
        if self._closed.is_set():
            return
        self._closed.set()
        thread = threading.Thread(target=self._disconnect, name='leaving a scheduler', daemon=True)
        thread.start()
        thread.join(2.0)  # s; a scheduler that does not answer must not delay the end

    def _disconnect(self) -> None:
        try:
            self._executor.shutdown(wait=False)
            self._client.close(timeout=PATIENCE)
        except Exception as error:  # the scheduler is gone, and the submitted calls with it
            logging.getLogger(__name__).debug('leaving a scheduler: %r', error)
        finally:
            self._restore_logging()

    def _finish(self, future: Future[Any], pickled: bytes) -> None:
        """Give a future its result, or an error that says what to do; send the call again if Dask lost it."""
        done = self._pending.get(future)
        if done is None:
            return
        error = CancelledError() if done.cancelled() else done.exception()
        if _is_misread_result(error):
            self._send(future, pickled)
        elif error is not None:
            reason = CancelledError() if self._closed.is_set() else self._explained(error)
            self._fail(future, reason)
            if reason is not error and not self._closed.is_set():
                self._give_up(reason)  # the other futures may never end, e.g. if all workers were killed
        elif self._pending.pop(future, None) and future.set_running_or_notify_cancel():
            future.set_result(done.result())

    def _fail(self, future: Future[Any], error: BaseException) -> None:
        """End a future with an error, unless it has ended."""
        if self._pending.pop(future, None) and future.set_running_or_notify_cancel():
            future.set_exception(error)

    def _explained(self, error: BaseException) -> BaseException:
        """Return an error that says what to do if the error is one of Dask's; else the error itself."""
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            return DloCalibrationError(
                f'{error.allowed_failures + 1} workers of the scheduler {self._address} ended '
                'unexpectedly, one after the other, at the same evaluation; see their logs, give them more '
                'memory, or start fewer on each machine')
        expected = 'dlo_calibration and its engine in the same version everywhere'
        missing = _missing_module(error)
        if missing:
            return InputError(f'scheduler {self._address}', f'a machine without the module {missing}',
                              expected, 'install dlo_calibration there, and start the worker again')
        if isinstance(error, AttributeError) and str(error).startswith("Can't get attribute"):  # by pickle
            return InputError(f'scheduler {self._address}', f'a machine with another version ({error})',
                              expected, 'install this dlo_calibration there, and start the worker again')
        if isinstance(error, CancelledError) or type(error).__name__ == 'FutureCancelledError':
            return self._lost()
        return error

    def _lost(self) -> DloCalibrationError:
        return DloCalibrationError(f'the scheduler {self._address} is lost, or dropped the evaluations; '
                                   'see its log, and start again')

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        """Receive an event of the scheduler."""
        _, content = event
        if content.get('action') == 'remove-worker' and not self._closed.is_set():
            self._on_loss(f'the scheduler lost the worker {content.get("worker")}; what it did is repeated')
            self._deadline = time.monotonic() + RETURN

    def _watch(self) -> None:
        """Give up when the scheduler or its last worker is lost; runs in a thread of its own."""
        while not self._closed.wait(0.5):
            if self._client.status != 'running':  # Dask has dropped all calls and tries to reconnect
                return self._give_up(self._lost())
            if time.monotonic() > self._deadline:
                self._deadline = float('inf')
                try:
                    workers = self._client.nthreads()
                except Exception as error:  # the connection is breaking; the next round sees its status
                    logging.getLogger(__name__).debug('asking a scheduler for its workers: %r', error)
                    continue
                if not workers:
                    return self._give_up(DloCalibrationError(
                        f'the scheduler {self._address} lost its last worker, and none came back within '
                        f'{RETURN:g} s; see their logs, give them more memory, and start them again'))

    def _give_up(self, reason: BaseException) -> None:
        """End all submitted calls, and all later ones, with this error."""
        self._given_up = reason
        for future in list(self._pending):
            self._fail(future, reason)


class _Call(partial[Any]):
    """A call that unpickling executes."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return partial(self.func, **self.keywords), self.args


def _pickled(call: _Call, pickled: dict[int, tuple[Any, str, bytes]]) -> bytes:
    """Pickle a call: trials and simulators by key, for the cache of workers, and each `Stop` as a new one."""
    class Pickler(pickle.Pickler):
        def reducer_override(self, content: Any) -> Any:
            if isinstance(content, Stop):
                return Stop, ()
            if not isinstance(content, (Trial, Simulator)):
                return NotImplemented
            if id(content) not in pickled:
                pickled[id(content)] = (
                    content, uuid.uuid4().hex, pickle.dumps(content, pickle.HIGHEST_PROTOCOL))
            return _unpickled, pickled[id(content)][1:]

    stream = io.BytesIO()
    Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(call)
    return stream.getvalue()


_cache: dict[str, Any] = {}  # of this worker, by key


def _unpickled(key: str, pickled: bytes) -> Any:
    if key not in _cache:
        while len(_cache) >= CACHE_SIZE:
            del _cache[next(iter(_cache))]
        _cache[key] = pickle.loads(pickled)  # noqa: S301  # sent by the calibrating process
    return _cache[key]


def _is_misread_result(error: BaseException | None) -> bool:
    """
    Return whether Dask misread a result as an error.

    Dask reads the status of a call after its result has arrived. If the worker is lost in between, Dask
    unpacks the result as if it were type, exception and traceback (`_cascade_future` of its cfexecutor).
    """
    wrong = isinstance(error, (TypeError, ValueError))  # no three things, or another number of them
    frames = traceback.extract_tb(error.__traceback__) if error is not None and wrong else []
    return bool(frames) and frames[-1].name == '_cascade_future'


def _missing_module(error: BaseException | None) -> str:
    """Return the name of the missing module that caused an error, or ''."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError):
            return error.name or str(error)
        error = error.__cause__ or error.__context__
    return ''


def _mute_dask() -> Callable[[], None]:
    """Keep Dask from logging to stderr, where the progress bar is; return a function that undoes this."""
    names = ('distributed', 'distributed.client', 'tornado.application', 'asyncio')
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)

    def restore() -> None:
        for logger, level in levels.items():
            logger.setLevel(level)

    return restore
