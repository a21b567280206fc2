# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The page of a result; on the node, it is written in the background."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from importlib import import_module
from multiprocessing import get_context, parent_process
import os
from pathlib import Path
import signal
import threading
from typing import Callable, Iterator

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.stages import sliced
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.report.before_after import films
from dlo_calibration.report.figure import Panel
from dlo_calibration.report.page import drawn_trials, Origin, page_of
from dlo_calibration.writing import reason, write_file

PATIENCE = 10.0  # s; whoever ends the node does not wait longer


def write_report(path: Path, result: CalibrationResult, origin: Origin, make_simulator: SimulatorFactory,
                 should_stop: Callable[[], bool], *, responsive: bool) -> None:
    """
    Write the page of a result, with slices that are simulated here.

    :param should_stop: once it returns true, the page gets no more slices.
    :param responsive: whether to draw the pictures in another process.  While Matplotlib draws in a thread, a
        service of the node or the capture page may wait for more than 0.1 s; a process costs memory.
    :raises DloCalibrationError: if the page cannot be drawn or written.
    """
    executor = (ProcessPoolExecutor(1, get_context('spawn'), _give_way_and_end_with_parent) if responsive
                else ThreadPoolExecutor(1))
    try:
        with executor:
            executor.submit(import_module, 'matplotlib.figure')  # loading it takes as long as the slices
            slices = sliced(result, origin.options, make_simulator, should_stop)
            page = executor.submit(page_of, result, origin, slices, _films(
                result, origin, make_simulator, should_stop)).result()
    except BrokenExecutor as error:
        raise DloCalibrationError('the process that draws it was ended from outside') from error
    write_file(path, page)


def _films(result: CalibrationResult, origin: Origin, make_simulator: SimulatorFactory,
           should_stop: Callable[[], bool]) -> dict[int, Panel]:
    """Return the films of the trials that the page draws; none if the engine fails."""
    try:
        return films(result, drawn_trials(result), origin.options, make_simulator, should_stop)
    except Exception:  # the page is written even if the engine fails
        return {}


class ReportWriter:
    """
    Writes pages in a thread, one after the other; it collects errors instead of raising them.

    :param make_simulator: called in that thread, for the slices.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator = make_simulator
        self._stop = threading.Event()
        self._thread = ThreadPoolExecutor(1, 'report')
        self._pages: list[tuple[Path, Future[None]]] = []

    def begin(self, path: Path, result: CalibrationResult, origin: Origin, older: Path | None = None) -> None:
        """
        Begin to write a page; returns at once.

        :param older: where to move an older page with this path, even one that is still being written.
        """
        self._pages.append((path, self._thread.submit(self._write, path, result, origin, older)))

    def failures(self) -> Iterator[tuple[Path, str]]:
        """Yield each page that could not be written since the last call, and the reason."""
        pages, self._pages = self._pages, []
        for path, future in pages:
            if future.done() and not future.cancelled():
                error = future.exception()
                if isinstance(error, Exception):
                    yield path, reason(error)
            elif self._stop.is_set():
                yield path, f'it was not ready {PATIENCE:.0f} s after the end'
            else:
                self._pages.append((path, future))

    def close(self) -> None:
        """End the simulations, and wait until the pages are written, at most `PATIENCE`."""
        self._stop.set()
        wait([future for _, future in self._pages], PATIENCE)
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _write(self, path: Path, result: CalibrationResult, origin: Origin, older: Path | None) -> None:
        if older is not None and path.exists():
            path.replace(older)
        write_report(path, result, origin, self._make_simulator, self._stop.is_set, responsive=True)


def _give_way_and_end_with_parent() -> None:
    """Give way to other processes; leave signals to the parent, and end with it, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(5)
    threading.Thread(target=_wait_for_its_end, daemon=True).start()


def _wait_for_its_end() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
