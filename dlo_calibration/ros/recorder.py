# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Recorder: records the node's session; the node goes on working when the disk fails."""

from __future__ import annotations

from pathlib import Path
import time
from typing import Callable

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError
from dlo_calibration.files.evaluations import write_evaluations
from dlo_calibration.files.recording import RecordingError, SessionWriter
from dlo_calibration.files.result import write_result
from dlo_calibration.report.page import Origin, repeating_command
from dlo_calibration.ros.report_writer import ReportWriter


class Recorder:
    """
    Records one session after the other; a failing disk makes no method raise.

    :param on_failure: called once, with the reason, when a session can no longer be written.
    :param make_simulator: for the report of a result.
    """

    def __init__(self, on_failure: Callable[[str], None], make_simulator: SimulatorFactory) -> None:
        self._on_failure = on_failure
        self._reporter = ReportWriter(make_simulator)
        self._session: SessionWriter | None = None

    @property
    def folder(self) -> Path | None:
        """Folder of the session that is being recorded; None if there is none."""
        return None if self._session is None else self._session.path

    def begin(self, options: Options) -> None:
        """Begin a session in a new folder, if the option `record` is set."""
        if options.record:
            name = time.strftime('dlo_session_%Y%m%d_%H%M%S')
            try:
                self._session = SessionWriter(Path(options.output_directory).expanduser() / name)
            except RecordingError as error:
                self._on_failure(str(error))

    def message(self, topic: str, kind: str, octets: bytes) -> None:
        """Record a message that was received or sent just now: CDR `octets` of the type `kind`."""
        self._write(lambda session: session.write(topic, kind, octets, time.time_ns()))

    def start(self, options: Options) -> None:
        """Record that a calibration with `options` starts, on the messages recorded so far."""
        self._write(lambda session: session.write_options(options.flat()))
        self._write(lambda session: session.write_mark('start'))

    def result(self, result: CalibrationResult, options: Options) -> None:
        """
        Write result.xml and evaluations.csv (result_2.xml, ...) into the session's folder.

        report.html (report_2.html, ...) follows some seconds later.
        """
        if self._session is not None:
            folder = self._session.path
            try:
                path = _free(folder, 'result', '.xml')
                write_result(path, result, options.flat())
                write_evaluations(_free(folder, 'evaluations', '.csv'), result)
            except InputError as error:
                self._on_failure(str(error))
                return
            origin = Origin(folder.name, repeating_command(folder.name, options), options)
            self._reporter.begin(folder / path.name.replace('result', 'report').replace('.xml', '.html'),
                                 result, origin)

    def tell(self) -> None:
        """Call `on_failure` for each report that could not be written since the last call."""
        for text in self._reporter.failures():
            self._on_failure(text)

    def end(self) -> None:
        """End the session; without one, do nothing."""
        self._write(SessionWriter.close)
        self._session = None

    def close(self) -> None:
        """End the session, and wait for its report."""
        self.end()
        self._reporter.close()

    def _write(self, write: Callable[[SessionWriter], None]) -> None:
        if self._session is None:
            return
        try:
            write(self._session)
        except RecordingError as error:
            self._session = None  # first, as on_failure sends a message, which would be recorded
            self._on_failure(str(error))


def _free(folder: Path, stem: str, suffix: str) -> Path:
    """Return a file name that is not taken."""
    path, number = folder / f'{stem}{suffix}', 2
    while path.exists():
        path, number = folder / f'{stem}_{number}{suffix}', number + 1
    return path
