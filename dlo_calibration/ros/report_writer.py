# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
ReportWriter: writes the page of a result in the background, because that takes seconds.

Its pictures are drawn in another process: while Matplotlib draws in a thread, a service of the node may wait
for more than 0.1 s.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context, parent_process
import os
from pathlib import Path
import queue
import signal
import threading
from typing import Iterator

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.stages import sliced
from dlo_calibration.inference.slices import Slices
from dlo_calibration.report.page import Origin, page_of, write_page
from dlo_calibration.writing import reason

PATIENCE = 10.0  # s; whoever ends the node does not wait longer


class ReportWriter:
    """
    Writes pages; it collects errors instead of raising them.

    :param make_simulator: called in a thread of its own, for the slices.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator = make_simulator
        self._failures: queue.SimpleQueue[tuple[Path, str]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._threads: dict[threading.Thread, Path] = {}

    def begin(self, path: Path, result: CalibrationResult, origin: Origin, older: Path | None = None) -> None:
        """
        Begin to write a page; returns at once.

        :param older: where a page that has this path goes before, also one that is still being written.
        """
        self._threads = {thread: page for thread, page in self._threads.items() if thread.is_alive()}
        before = [thread for thread, page in self._threads.items() if page == path]
        thread = threading.Thread(target=self._write, args=(path, result, origin, older, before),
                                  name='report', daemon=True)
        self._threads[thread] = path
        thread.start()

    def failures(self) -> Iterator[tuple[Path, str]]:
        """Yield each page that could not be written since the last call, and the reason."""
        while not self._failures.empty():
            yield self._failures.get_nowait()

    def close(self) -> None:
        """End the simulations, and wait until the pages are written, at most `PATIENCE` for each."""
        self._stop.set()
        for thread, path in self._threads.items():
            thread.join(PATIENCE)
            if thread.is_alive():
                self._failures.put((path, f'it was not ready {PATIENCE:.0f} s after the end'))
        self._threads = {}

    def _write(self, path: Path, result: CalibrationResult, origin: Origin, older: Path | None,
               before: list[threading.Thread]) -> None:
        try:
            for thread in before:
                thread.join()
            if older is not None and path.exists():
                path.replace(older)
            slices = sliced(result, origin.options, self._make_simulator, self._stop.is_set)
            with ProcessPoolExecutor(1, get_context('spawn'), _end_with_parent) as process:
                page = process.submit(page_of, result, origin, partial(_known, slices)).result()
            write_page(path, page)
        except Exception as error:  # the user must learn why there is no page
            self._failures.put((path, reason(error)))


def _known(slices: Slices | None) -> Slices | None:
    """Return slices that were simulated before."""
    return slices


def _end_with_parent() -> None:
    """Leave signals to the node, come after it, and end with it, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(5)
    threading.Thread(target=_wait_for_its_end, daemon=True).start()


def _wait_for_its_end() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
