# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Compiling: kernels are compiled in a process of its own, so that this one answers meanwhile."""

from __future__ import annotations

from contextlib import suppress
import queue
import threading
import time
from typing import Callable, Iterator

from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.processes import begin_to_load, cores, ProcessExecutor
from dlo_calibration.simulation.kernel_cache import (
    compile_kernels,
    is_compiled,
    KERNELS,
    remark,
    SIMULATION,
    TOGETHER,
)

PERIOD = 0.05  # s between two looks whether to wait no longer


class Compiling:
    """
    Has kernels compiled where this machine has not yet compiled them.

    The kernels for several trials at once come after those of the simulation, and nobody waits for them.

    :param module: of the kernels.
    :param then: called when they are compiled, in the thread that waited for that, e.g. to load them.
    """

    def __init__(self, module: str = SIMULATION, then: Callable[[], None] = lambda: None) -> None:
        self._module, self._then = module, then
        self._news: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._executor: ProcessExecutor | None = None
        self._closed = False
        self._ended = threading.Event()
        self.under_way = ''  # what to tell while it compiles

    @property
    def done(self) -> bool:
        """Tell whether nothing waits for it any more."""
        return self._ended.is_set()

    def begin(self) -> None:
        """Begin; return at once."""
        threading.Thread(target=self._work, name='compiling', daemon=True).start()

    def wait(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """
        Wait until the kernels are compiled.

        :raises DloCalibrationError: as soon as it shall stop.
        """
        while not self._ended.wait(PERIOD):
            if should_stop():
                raise DloCalibrationError('it was stopped while the engine was being loaded or compiled')

    def news(self) -> Iterator[str]:
        """Yield, once, what the log should tell."""
        while not self._news.empty():
            yield self._news.get_nowait()

    def close(self) -> None:
        """End it now."""
        with self._lock:
            self._closed = True
            if self._executor is not None:
                self._executor.close()

    def _work(self) -> None:
        try:
            if not is_compiled(self._module):
                self.under_way = _words(self._module)
                self._compile(self._module)
            if not self._closed:
                self._then()
        except Exception:  # whoever uses the engine meets the same error, and tells it
            return
        finally:
            self.under_way = ''
            self._ended.set()
        with suppress(Exception):  # the simulation does without, but takes longer
            if self._module == SIMULATION and not is_compiled(TOGETHER):
                self._compile(TOGETHER)

    def _compile(self, module: str) -> None:
        begun = time.monotonic()
        with self._lock:
            if self._closed:
                return
            self._executor = ProcessExecutor(1, fresh=True)
        for text in filter(None, [_words(module), remark()]):
            self._news.put(text)
        try:
            self._executor.submit(compile_kernels, module).result()
            self._news.put(f'the {KERNELS[module]} is compiled, after {time.monotonic() - begun:.0f} s')
        except Exception as error:
            if not self._closed:
                self._news.put(f'the {KERNELS[module]} could not be compiled: {error}')
            raise
        finally:
            with suppress(RuntimeError):
                self._executor.close()


def load(workers: int) -> None:
    """
    Load the kernels where the first calibration needs them: for its processes, or in this one if it has none.

    :param workers: number of processes; 0: one per core.
    """
    if (workers or cores()) > 1:
        begin_to_load()
    else:
        compile_kernels(SIMULATION)


def _words(module: str) -> str:
    return f'compiling the {KERNELS[module]} for this machine, once, about half a minute'
