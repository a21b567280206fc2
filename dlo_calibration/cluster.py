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

"""Cluster: evaluations on the workers of a Dask scheduler, on any number of machines."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor, Future
import logging
import socket
import threading
from typing import Any, Callable, Mapping
import warnings

from dlo_calibration.errors import DloCalibrationError, InputError

PATIENCE = 8  # s until a scheduler counts as unreachable
LOGGERS = ('distributed', 'distributed.client', 'tornado.application', 'asyncio')  # of Dask, on stderr
PACKAGE = __name__.partition('.')[0]


class ClusterExecutor(Executor):
    """
    An executor of the workers that a Dask scheduler has.

    The machine of the scheduler needs this package as those of its workers do.

    :param address: of the scheduler, e.g. ``tcp://host:8786``.
    :param on_loss: called with a sentence for each worker that is lost, from any thread.
    :param on_wait: called with a sentence where there is no worker yet.
    :raises InputError: where Dask is not installed, or no scheduler answers.
    """

    def __init__(self, address: str, on_loss: Callable[[str], None] = lambda _: None,
                 on_wait: Callable[[str], None] = lambda _: None) -> None:
        try:
            from distributed import Client
            from distributed.comm import get_address_host_port
        except ImportError as error:
            raise InputError(
                'parameter scheduler', f'{address!r} without the library distributed ({error})',
                'that library', f"install it with pip install '{PACKAGE}[distributed]'") from error
        self._address = address
        self._on_loss = on_loss
        self._closed = threading.Event()
        self._silence = _Silence()
        try:
            # A client that cannot connect tries for long, and complains once more when it is collected.
            socket.create_connection(get_address_host_port(address, strict=True), PATIENCE).close()
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # e.g. of other versions at the workers; what fails says so
                self._client = Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            self._silence.end()
            raise InputError('parameter scheduler', f'{address!r} ({" ".join(str(error).split())})',
                             'the address of a Dask scheduler that answers, such as tcp://host:8786',
                             'start one with: dask scheduler') from error
        # Without pure=False, Dask would take equal calls of two calibrations for the same one.
        self._executor = self._client.get_executor(pure=False)
        self._client.subscribe_topic('all', self._hear)
        if not self._client.scheduler_info()['workers']:
            on_wait(f'the scheduler {address} has no workers yet; waiting for one '
                    f'(start it with: dask worker {address} --nthreads 1)')

    def submit(self, call: Callable[..., Any], /, *args: Any, **keywords: Any) -> Future[Any]:
        """Return a future that may be cancelled at any time."""
        future: Future[Any] = Future()
        there = self._executor.submit(call, *args, **keywords)
        future.add_done_callback(lambda done: there.cancel() if done.cancelled() else None)
        there.add_done_callback(lambda done: self._pass_on(done, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End when everything submitted is done; at once where it need not wait."""
        if not self._closed.is_set():
            self._executor.shutdown(wait=wait and not cancel_futures)
            self.close()

    def close(self) -> None:
        """Leave now: the scheduler forgets what was submitted."""
        if self._closed.is_set():
            return
        self._closed.set()
        try:
            self._executor.shutdown(wait=False)
            self._client.close(timeout=PATIENCE)
        except Exception as error:  # the scheduler is gone, and with it what was submitted
            logging.getLogger(__name__).debug('leaving a scheduler: %r', error)
        finally:
            self._silence.end()

    def _pass_on(self, done: Future[Any], future: Future[Any]) -> None:
        """Give `future` what `done` ended with, in words that say what to do."""
        if not future.set_running_or_notify_cancel():
            return
        error = CancelledError() if done.cancelled() else done.exception()
        if error is None:
            future.set_result(done.result())
        elif self._closed.is_set():
            future.set_exception(CancelledError())
        else:
            future.set_exception(self._explained(error))

    def _explained(self, error: BaseException) -> BaseException:
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            return DloCalibrationError(
                f'{error.allowed_failures + 1} workers of the scheduler {self._address} one after the other '
                'ended unexpectedly at the same evaluation; see their logs, give them more memory, or start '
                'fewer on a machine')
        missing = _missing_module(error)
        if missing:
            return InputError(f'scheduler {self._address}', f'a machine without the module {missing}',
                              f'{PACKAGE} and its engine, the same version everywhere',
                              f'install {PACKAGE} there, and start it again')
        if isinstance(error, CancelledError) or type(error).__name__ == 'FutureCancelledError':
            return DloCalibrationError(f'the scheduler {self._address} is lost, or dropped the evaluations; '
                                       'see its log, and start again')
        return error

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        """Take an event of the scheduler."""
        _, content = event
        if content.get('action') == 'remove-worker' and not self._closed.is_set():
            self._on_loss(f'the scheduler lost the worker {content.get("worker")}; what it did is done again')


def _missing_module(error: BaseException | None) -> str:
    """Return the name of a module that was not found, here or in what caused it; else nothing."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError):
            return error.name or str(error)
        error = error.__cause__ or error.__context__
    return ''


class _Silence:
    """Keeps Dask from writing to stderr, until `end`: a progress bar is there."""

    def __init__(self) -> None:
        self._before = {name: logging.getLogger(name).level for name in LOGGERS}
        for name in LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)

    def end(self) -> None:
        for name, level in self._before.items():
            logging.getLogger(name).setLevel(level)
