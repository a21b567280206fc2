# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
PlannerProcesses: processes that simulate, kept from one plan to the next.

This process never loads an engine: loading one, or compiling its kernels, would delay answers to requests.
"""

from __future__ import annotations

from concurrent.futures import CancelledError, wait
from contextlib import closing
import threading
from typing import Callable

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.processes import cores, ProcessExecutor

PERIOD = 0.05  # s between two looks whether to wait no longer


class PlannerProcesses:
    """
    Keeps processes ready, so that the first simulation of a plan does not wait for the compiler.

    :param make_simulator: makes the engine; it is sent to the processes.
    :param on_death: called with a sentence for each process that dies, from any thread.
    :param wait: waits until the kernels are compiled, or its argument tells to stop; see `Compiling`.
    """

    def __init__(self, make_simulator: SimulatorFactory, on_death: Callable[[str], None],
                 wait: Callable[[Callable[[], bool]], None] = lambda should_stop: None) -> None:
        self._make_simulator = make_simulator
        self._wait = wait
        self._on_death = on_death
        self._changing = threading.Lock()  # held while the engine is being loaded, too
        self._starting = threading.Lock()
        self._executor: ProcessExecutor | None = None
        self._kept: tuple[int, float] | None = None  # number and limit that the processes have
        self._engine: str | None = None  # what they have loaded
        self._closed = False

    def prepare(self, simulation: Options, workers: int) -> None:
        """Begin to start processes and to load the engine in them; return at once."""
        threading.Thread(target=self._try, args=(simulation, workers), name='preparing', daemon=True).start()

    def ready(self, simulation: Options, workers: int,
              should_stop: Callable[[], bool] = lambda: False) -> ProcessExecutor:
        """
        Return the executor when its processes can simulate.

        :param workers: number of processes; 0: one per core.
        :param should_stop: whether to wait no longer, e.g. for the compiler.
        :raises DloCalibrationError: if no process can be started, or the engine cannot be used; if it
            waits no longer.
        :raises CancelledError: after `close`.
        """
        self._wait(should_stop)
        while not self._changing.acquire(timeout=PERIOD):
            _check(should_stop)
        try:
            executor = self._started(workers or cores(), simulation.answer_limit)
            engine = f'{simulation.engine} {simulation.scene}'
            if self._engine != engine:
                # One alone compiles what an engine may have besides the kernels; the others load it.
                first = executor.submit(_load, self._make_simulator, simulation)
                while not wait([first], PERIOD).done:
                    _check(should_stop)
                first.result()
                for _ in range((workers or cores()) - 1):
                    executor.submit(_load, self._make_simulator, simulation)
                self._engine = engine
            return executor
        finally:
            self._changing.release()

    def close(self) -> None:
        """End the processes now; what they simulate is cancelled."""
        with self._starting:
            self._closed = True
            if self._executor is not None:
                self._executor.close()

    def _try(self, simulation: Options, workers: int) -> None:
        try:
            self.ready(simulation, workers)
        except Exception:  # the next plan meets the same error, and tells it
            pass

    def _started(self, workers: int, answer_limit: float) -> ProcessExecutor:
        """Return an executor of so many processes: the present one, or a new one instead of it."""
        with self._starting:
            if self._closed:
                raise CancelledError
            if self._executor is None or self._kept != (workers, answer_limit):
                if self._executor is not None:
                    self._executor.close()
                self._engine = None
                self._executor = ProcessExecutor(workers, self._on_death, answer_limit)
                self._kept = workers, answer_limit
            return self._executor


def _check(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise DloCalibrationError('it was stopped while the engine was being loaded or compiled')


def _load(make_simulator: SimulatorFactory, simulation: Options) -> None:
    """Make an engine, which reads its scene and compiles the kernels if they are not."""
    with closing(make_simulator(simulation)) as simulator:
        simulator.prepare()
