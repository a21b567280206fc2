# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ReportWriter: writes the page of a result in a thread of its own, because that takes seconds."""

from __future__ import annotations

from pathlib import Path
import queue
import threading
from typing import Iterator

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.stages import sliced
from dlo_calibration.report.page import Origin, write_report


class ReportWriter:
    """
    Writes pages; it collects errors instead of raising them.

    :param make_simulator: called in the thread, for the slices.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator = make_simulator
        self._failures: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def begin(self, path: Path, result: CalibrationResult, origin: Origin) -> None:
        """Begin to write a page; returns at once."""
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=self._write, args=(path, result, origin), name='report', daemon=True)
        self._threads.append(thread)
        thread.start()

    def failures(self) -> Iterator[str]:
        """Yield a sentence for each page that could not be written since the last call."""
        while not self._failures.empty():
            yield self._failures.get_nowait()

    def close(self) -> None:
        """End the simulations, and wait until the pages are written, at most 10 s for each."""
        self._stop.set()
        for thread in self._threads:
            thread.join(10.0)

    def _write(self, path: Path, result: CalibrationResult, origin: Origin) -> None:
        try:
            slices = sliced(result, origin.options, self._make_simulator, self._stop.is_set)
            write_report(path, result, origin, slices)
        except Exception as error:  # the user must learn why there is no page
            self._failures.put(f'the report could not be written: {" ".join(str(error).split()) or error!r}')
