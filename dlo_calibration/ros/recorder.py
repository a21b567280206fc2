# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Recorder: records the node's session; the node goes on working when the disk fails."""

from __future__ import annotations

from contextlib import suppress
import itertools
from pathlib import Path
import time
from typing import Callable, Mapping, Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.passport import Passport
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.files.recording import RecordingError, SessionWriter
from dlo_calibration.model.trial import Trial
from dlo_calibration.report.page import Origin, repeating_command
from dlo_calibration.workspace.folder import EVALUATIONS, REPORT, RESULT, session_log, write_values
from dlo_calibration.workspace.report_writer import ReportWriter
from dlo_calibration.writing import Attempts


class Recorder:
    """
    Records one session after the other; no method raises if the disk fails, and what works is still written.

    :param on_failure: called with a warning for each thing that cannot be written, and at the end of a
        session with a list of them.
    :param make_simulator: for the report of a result.
    """

    def __init__(self, on_failure: Callable[[str], None], make_simulator: SimulatorFactory) -> None:
        self._on_failure = on_failure
        self._reporter = ReportWriter(make_simulator)
        self._session: SessionWriter | None = None
        self._missing: dict[Path, list[str]] = {}  # unwritten things, by the folder of an open session
        self._calibrated: SessionWriter | None = None  # the session of the calibration under way
        self._log: EvaluationLog | None = None
        self._written = False  # whether the result of the calibration is on the disk

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
        """Write the messages that wait in a group."""
        self._write(SessionWriter.flush)

    def dropped(self, counts: Mapping[str, int]) -> None:
        """Record how many messages of each kind were dropped since the session began."""
        self._write(lambda session: session.write_dropped(counts))

    def taken_back(self, first: int, last: int) -> None:
        """Record that the messages of a trial, stamped from `first` to `last` [ns], are left out."""
        self._write(lambda session: session.write_discard(first, last))

    def start(self, trials: Sequence[Trial], options: Options) -> EvaluationLog | None:
        """
        Record that a calibration starts on the messages so far; return its log, see `session_log`.

        The log is removed when the result is on the disk.

        :returns: None if the option `record` is not set, or the log cannot be opened.
        """
        self._log, self._written = None, False
        if options.record:
            try:
                self._log = session_log(Path(options.output_directory).expanduser(), trials, options)
            except InputError as error:
                self._on_failure(f'{error}; this calibration could not go on after an interruption')
        self._write(lambda session: session.write_options(options.flat()))
        self._write(lambda session: session.write_mark('start'))
        self._calibrated = self._session
        return self._log

    def finish(self, *, interrupted: bool) -> None:
        """
        End the calibration; its session ends too, if another one has begun.

        The log stays if a later calibration needs its evaluations.
        """
        calibrated, self._calibrated = self._calibrated, None
        if calibrated is not self._session:
            self._write(SessionWriter.close, calibrated)
        log, self._log = self._log, None
        if log is not None:
            with suppress(OSError):  # an old log does no harm
                if not log.evaluations or self._written and not interrupted:
                    log.remove()
            log.close()

    def result(self, result: CalibrationResult, options: Options) -> str:
        """
        Write result.xml and evaluations.csv into the folder of the calibration's session.

        report.html follows some seconds later. The files of an earlier result become result_1.xml, ...

        :returns: a sentence about the earlier result; empty if there is none.
        """
        if self._calibrated is None:
            return ''
        folder = self._calibrated.path
        older = _free_suffix(folder)
        for name in (RESULT, EVALUATIONS):
            with suppress(OSError):  # it was not written then, or is replaced now
                if older:
                    (folder / name).replace(folder / _numbered(name, older))
        attempts = Attempts(folder)
        write_values(attempts, result, options, Passport.new(options.measured_by))
        self._written = not attempts.failure
        if attempts.failure:
            self._miss(folder, attempts.failure)
        origin = Origin(folder.name, repeating_command(folder.name, options), options)
        self._reporter.begin(folder / REPORT, result, origin,
                             folder / _numbered(REPORT, older) if older else None)
        return f'{folder / RESULT} is the newest result; the one before is {_numbered(RESULT, older)} there' \
            if older else ''

    def report_failures(self) -> None:
        """Call `on_failure` for each page that could not be written since the last call."""
        for path, why in self._reporter.failures():
            self._miss(path.parent, f'{path.name}: {why}')

    def end(self) -> None:
        """
        End the session, with a warning if its folder is incomplete; without a session, do nothing.

        While a calibration is under way, its session stays open until that ends.
        """
        if self._session is not self._calibrated:
            self._write(SessionWriter.close)
        self._session = None
        self.report_failures()
        missing, self._missing = self._missing, {}
        for folder, texts in missing.items():
            self._on_failure(f'session {folder} is incomplete; could not be written: {"; ".join(texts)}')

    def close(self) -> None:
        """End the session, and wait for its report; warn if the folder is incomplete."""
        self.finish(interrupted=True)
        self._write(SessionWriter.close)
        self._reporter.close()
        self.end()

    def _miss(self, folder: Path, what: str, text: str = '') -> None:
        """Warn now, and at the end of the session, that something could not be written; `text` is for now."""
        self._missing.setdefault(folder, []).append(what)
        self._on_failure((text or f'session {folder}: could not be written: {what}')
                         + '; once there is room, ~/reset begins a new session')

    def _write(self, write: Callable[[SessionWriter], None], to: SessionWriter | None = None) -> None:
        """Write to a session, by default the one that is being recorded."""
        session = self._session if to is None else to
        if session is None or session.failure:
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


def _numbered(name: str, suffix: str) -> str:
    """Return the name of a file of an older result."""
    stem, dot, kind = name.partition('.')
    return f'{stem}{suffix}{dot}{kind}'


def _free_suffix(folder: Path) -> str:
    """Return the suffix that the files of an older result get, e.g. ``_1``; empty if there are none."""
    names = (RESULT, EVALUATIONS, REPORT)
    suffixes = itertools.chain([''], (f'_{number}' for number in itertools.count(1)))
    return next(suffix for suffix in suffixes if not any(
        (folder / _numbered(name, suffix)).exists() for name in names))
