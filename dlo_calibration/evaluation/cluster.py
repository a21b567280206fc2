# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ClusterExecutor: evaluations on the workers of a Dask scheduler, on any number of machines."""

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
RETURN = 30.0  # s that we wait for a worker after the last one was lost
MOST_KEPT = 1000  # trials and simulators that a worker keeps


class ClusterExecutor(Executor):
    """
    An executor on the workers of a Dask scheduler.

    This package must be installed where the workers are; the scheduler's machine needs only Dask.

    :param address: of the scheduler, e.g. ``tcp://host:8786``.
    :param on_loss: called with a sentence for each lost worker, from any thread.
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
        self._kept: dict[int, tuple[Any, str, bytes]] = {}  # trials and simulators, as workers keep them
        self._silence = _Silence()
        try:
            # Try the address first: Dask's client retries for long, and logs an error when it is deleted.
            socket.create_connection(get_address_host_port(address, strict=True), PATIENCE).close()
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # e.g. about versions of the workers; failures are reported
                self._client = Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            self._silence.end()
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
        chains, that takes as long as simulating the trials.
        """
        future: Future[Any] = Future()
        # Send bytes and a function of Python's library: any worker and the scheduler can unpickle these.  A
        # worker that fails to unpickle a task, e.g. because a module is missing, leaves without an error.
        self._send(future, _packed(_Call(call, *args, **keywords), self._kept))
        if self._given_up is not None:
            self._fail(future, self._given_up)
        return future

    def _send(self, future: Future[Any], packed: bytes) -> None:
        """Let a worker unpickle a call, which makes it, and give its result to a future."""
        there = self._executor.submit(pickle.loads, packed)  # noqa: S301  # a worker unpickles it
        self._pending[future] = there
        future.add_done_callback(lambda done: there.cancel() if done.cancelled() else None)
        there.add_done_callback(lambda _: self._pass_on(future, packed))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End when all submitted calls are done; at once if they are cancelled or need not be waited for."""
        if not self._closed.is_set():
            self._executor.shutdown(wait=wait and not cancel_futures)
            self.close()

    def close(self) -> None:
        """Disconnect now: the scheduler drops the submitted calls."""
        if self._closed.is_set():
            return
        self._closed.set()
        leaving = threading.Thread(target=self._leave, name='leaving a scheduler', daemon=True)
        leaving.start()
        leaving.join(2.0)  # s; a scheduler that does not answer must not delay the end

    def _leave(self) -> None:
        try:
            self._executor.shutdown(wait=False)
            self._client.close(timeout=PATIENCE)
        except Exception as error:  # the scheduler is gone, and the submitted calls with it
            logging.getLogger(__name__).debug('leaving a scheduler: %r', error)
        finally:
            self._silence.end()

    def _pass_on(self, future: Future[Any], packed: bytes) -> None:
        """Give a future its result, or an error that says what to do; send the call again if Dask lost it."""
        done = self._pending.get(future)
        if done is None:
            return
        error = CancelledError() if done.cancelled() else done.exception()
        if _mistaken(error):
            self._send(future, packed)
        elif error is not None:
            reason = CancelledError() if self._closed.is_set() else self._explained(error)
            self._fail(future, reason)
            if reason is not error and not self._closed.is_set():
                self._give_up(reason)  # other futures might never end, e.g. if all workers were killed
        elif self._pending.pop(future, None) and future.set_running_or_notify_cancel():
            future.set_result(done.result())

    def _fail(self, future: Future[Any], error: BaseException) -> None:
        """End a future with an error, unless it has ended."""
        if self._pending.pop(future, None) and future.set_running_or_notify_cancel():
            future.set_exception(error)

    def _explained(self, error: BaseException) -> BaseException:
        """Return an error that says what to do in place of one of Dask; any other as it is."""
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
        """React to an event of the scheduler."""
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
    """A call that is executed by unpickling it."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return partial(self.func, **self.keywords), self.args


def _packed(call: _Call, kept: dict[int, tuple[Any, str, bytes]]) -> bytes:
    """Pickle a call, with trials and simulators as workers keep them, and without what stops it here."""
    class Pickler(pickle.Pickler):
        def reducer_override(self, one: Any) -> Any:
            if isinstance(one, Stop):
                return Stop, ()
            if not isinstance(one, (Trial, Simulator)):
                return NotImplemented
            if id(one) not in kept:
                kept[id(one)] = one, uuid.uuid4().hex, pickle.dumps(one, pickle.HIGHEST_PROTOCOL)
            return _unpacked, kept[id(one)][1:]

    stream = io.BytesIO()
    Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(call)
    return stream.getvalue()


_here: dict[str, Any] = {}  # what this worker has unpacked


def _unpacked(key: str, packed: bytes) -> Any:
    if key not in _here:
        while len(_here) >= MOST_KEPT:
            del _here[next(iter(_here))]
        _here[key] = pickle.loads(packed)  # noqa: S301  # sent by whoever calibrates
    return _here[key]


def _mistaken(error: BaseException | None) -> bool:
    """
    Tell whether Dask took a result for an error.

    It reads the status of a call after its result has arrived. If the worker is lost in between, Dask
    unpacks the result as if it were type, exception and traceback (`_cascade_future` of its cfexecutor).
    """
    frames = traceback.extract_tb(error.__traceback__) if isinstance(error, TypeError) else []
    return bool(frames) and frames[-1].name == '_cascade_future'


def _missing_module(error: BaseException | None) -> str:
    """Return the name of the missing module that caused an error; empty if there is none."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError):
            return error.name or str(error)
        error = error.__cause__ or error.__context__
    return ''


class _Silence:
    """Keeps Dask from writing to stderr until `end`: the progress bar is there."""

    def __init__(self) -> None:
        names = ('distributed', 'distributed.client', 'tornado.application', 'asyncio')
        self._before = {name: logging.getLogger(name).level for name in names}
        for name in names:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)

    def end(self) -> None:
        for name, level in self._before.items():
            logging.getLogger(name).setLevel(level)
