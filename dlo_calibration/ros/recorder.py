# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Recorder: records the node's session; the node goes on working when the disk fails."""

from __future__ import annotations

from pathlib import Path
import time
from typing import Callable, Mapping

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.files.evaluations import write_evaluations
from dlo_calibration.files.recording import RecordingError, SessionWriter
from dlo_calibration.files.result import write_result
from dlo_calibration.report.page import Origin, repeating_command
from dlo_calibration.ros.report_writer import ReportWriter
from dlo_calibration.writing import Attempts


class Recorder:
    """
    Records one session after the other; a failing disk makes no method raise.

    What cannot be written any more does not prevent the rest.

    :param on_failure: called with each thing that cannot be written and the reason, and when a session
        ends, with all that its folder lacks.
    :param make_simulator: for the report of a result.
    """

    def __init__(self, on_failure: Callable[[str], None], make_simulator: SimulatorFactory) -> None:
        self._on_failure = on_failure
        self._reporter = ReportWriter(make_simulator)
        self._session: SessionWriter | None = None
        self._missing: dict[Path, list[str]] = {}  # by the folder of a session that has not ended
        self._calibrated: SessionWriter | None = None  # the session of the calibration under way

    @property
    def folder(self) -> Path | None:
        """Folder of the session that is being recorded; None if there is none."""
        return None if self._session is None else self._session.path

    def begin(self, options: Options) -> None:
        """Begin a session in a new folder, if the option `record` is set."""
        if options.record:
            path = Path(options.output_directory).expanduser() / time.strftime('dlo_session_%Y%m%d_%H%M%S')
            try:
                self._session = SessionWriter(path)
            except RecordingError as error:
                self._miss(path, f'everything: {_cause(error)}', str(error))

    def message(self, topic: str, kind: str, octets: bytes, flush: bool = True) -> None:
        """
        Record a message that was received or sent just now: CDR `octets` of the type `kind`.

        :param flush: False where `flush` follows soon.
        """
        self._write(lambda session: session.write(topic, kind, octets, flush=flush))

    def of_calibration(self, topic: str, kind: str, octets: bytes) -> None:
        """Record a message of the calibration under way in the session in which it started."""
        self._write(lambda session: session.write(topic, kind, octets), self._calibrated)

    def flush(self) -> None:
        """Give the messages that wait in a group to the operating system."""
        self._write(SessionWriter.flush)

    def dropped(self, counts: Mapping[str, int]) -> None:
        """Record how many messages of each kind were dropped since the session began."""
        self._write(lambda session: session.write_dropped(counts))

    def start(self, options: Options) -> None:
        """Record that a calibration with `options` starts, on the messages recorded so far."""
        self._write(lambda session: session.write_options(options.flat()))
        self._write(lambda session: session.write_mark('start'))
        self._calibrated = self._session

    def finish(self) -> None:
        """End the calibration; its session ends too, if another one has begun."""
        calibrated, self._calibrated = self._calibrated, None
        if calibrated is not self._session:
            self._write(SessionWriter.close, calibrated)

    def result(self, result: CalibrationResult, options: Options) -> None:
        """
        Write result.xml and evaluations.csv (result_2.xml, ...) into the folder of the calibration's session.

        report.html (report_2.html, ...) follows some seconds later.
        """
        if self._calibrated is not None:
            folder = self._calibrated.path
            suffix, attempts = _free(folder), Attempts(folder)
            name = f'result{suffix}.xml'
            with attempts.attempt(name):
                write_result(folder / name, result, options.flat())
            name = f'evaluations{suffix}.csv'
            with attempts.attempt(name):
                write_evaluations(folder / name, result)
            if attempts.failure:
                self._miss(folder, attempts.failure)
            origin = Origin(folder.name, repeating_command(folder.name, options), options)
            self._reporter.begin(folder / f'report{suffix}.html', result, origin)

    def tell(self) -> None:
        """Call `on_failure` for each report that could not be written since the last call."""
        for path, why in self._reporter.failures():
            self._miss(path.parent, f'{path.name}: {why}')

    def end(self) -> None:
        """
        End the session, and tell what its folder lacks; without one, do nothing.

        While a calibration is under way, its session stays open until that ends.
        """
        if self._session is not self._calibrated:
            self._write(SessionWriter.close)
        self._session = None
        self._conclude()

    def close(self) -> None:
        """End the session, wait for its report, and tell what its folder lacks."""
        self.finish()
        self._write(SessionWriter.close)
        self._reporter.close()
        self.end()

    def _conclude(self) -> None:
        self.tell()
        missing, self._missing = self._missing, {}
        for folder, texts in missing.items():
            self._on_failure(f'session {folder} is incomplete; could not be written: {"; ".join(texts)}')

    def _miss(self, folder: Path, what: str, text: str = '') -> None:
        """Tell now, and when the session ends, that something could not be written; `text` is for now."""
        self._missing.setdefault(folder, []).append(what)
        self._on_failure((text or f'session {folder}: could not be written: {what}')
                         + '; once there is room, ~/reset begins a new session')

    def _write(self, write: Callable[[SessionWriter], None], to: SessionWriter | None = None) -> None:
        """Write to a session, by default the one that is being recorded."""
        session = self._session if to is None else to
        if session is None or session.failed:
            return
        try:
            write(session)
        except RecordingError as error:
            since = time.strftime('%H:%M:%S')
            self._miss(session.path, f'messages from {since} on: {_cause(error)}', str(error))


def _cause(error: RecordingError) -> str:
    """Return why a session could not be written, in few words."""
    cause = error.__cause__
    return getattr(cause, 'strerror', None) or str(cause or error)


def _free(folder: Path) -> str:
    """Return what distinguishes the names of a result's files from those that are there: ``_2``, ..."""
    suffix, number = '', 2
    while any((folder / f'{stem}{suffix}{kind}').exists() for stem, kind in (
            ('result', '.xml'), ('evaluations', '.csv'), ('report', '.html'))):
        suffix, number = f'_{number}', number + 1
    return suffix
