# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The calibration of a project's trials, as the page shows it: its progress and its result."""

from __future__ import annotations

from contextlib import closing, ExitStack, suppress
from dataclasses import dataclass
import json
from pathlib import Path
import threading
from typing import Any, Mapping

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import MACHINE, names_of, Options
from dlo_calibration.calibration.result import CalibrationResult, plain, with_nulls
from dlo_calibration.capture.project import CALIBRATION
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.report.sentences import sentences
from dlo_calibration.workspace.folder import CalibrationFolder, FILES, RESULT
from dlo_calibration.workspace.source import read_source, Selection
from dlo_calibration.workspace.worker import CalibrationWarning, Failure, Progress, Worker
from dlo_calibration.writing import reason, write_file

PAGE_RESULT = 'result.json'  # file with the result that the page shows
LONGEST = 2**22  # bytes of that file; a stranger's must not take all memory
PATIENCE = 5.0  # s, for which the end of the page waits at most
IDLE, CALIBRATING, DONE, FAILED, STOPPED = 'idle', 'calibrating', 'done', 'failed', 'stopped'


@dataclass(frozen=True)
class PageResult:
    """
    A result as the page shows it.

    :param digest: of the trials that were calibrated.
    :param values: as `fit --json` prints them, with `sentences`.
    """

    digest: str
    values: dict[str, Any]


class ProjectCalibration:
    """
    Calibrates in threads; all methods return at once. It is not thread-safe.

    :param project: its folder.
    :param options: of the command line, by name.
    """

    def __init__(self, project: Path, make_simulator: SimulatorFactory, options: Mapping[str, Any]) -> None:
        self.folder = project / CALIBRATION
        self.state, self.text = IDLE, ''
        self.result: PageResult | None = None
        self.description: Description | None = None  # the same result, to simulate it
        self.files: tuple[str, ...] = ()  # of that result, in the folder
        self._make_simulator = make_simulator
        self._machine = {name: value for name, value in options.items() if name in names_of(MACHINE)}
        self._worker = Worker(make_simulator)
        self._calibration: CalibrationFolder | None = None
        self._options = Options()
        self._progress = Progress(0, 0)
        self._warnings: list[str] = []
        self._digest = ''
        self._writing: threading.Thread | None = None
        self.written = threading.Event()  # set once the files of a result are written
        self._ending = threading.Event()
        self._reopen()

    @property
    def busy(self) -> bool:
        """Whether a calibration is under way."""
        return self.state == CALIBRATING

    def require_idle(self) -> None:
        """
        Check that a calibration can begin.

        :raises InputError: if another one is under way, or its files are being written.
        """
        if self.busy or (self._writing is not None and self._writing.is_alive()):
            raise InputError('calibration', 'another one', 'one at a time',
                             'stop the other one, or wait until its files are written')

    def start(self, session: Path, digest: str) -> None:
        """
        Begin to calibrate.

        :param session: the MCAP file with the trials and the options.
        :param digest: of the trials, which shows whether they change afterwards.
        :raises InputError: if another one is under way, or the session cannot be used.
        """
        self.require_idle()
        warnings: list[str] = []
        source = read_source(Selection(session, self._machine), warnings.append).require_trials()
        with ExitStack() as stack:
            folder = stack.enter_context(closing(CalibrationFolder(self.folder)))
            folder.begin(source, warnings.append, instead=True)
            stack.pop_all()  # the folder stays open until the calibration has ended
        self._calibration, self._options = folder, source.options
        self._warnings, self._digest = warnings, digest
        chosen = choose(source.trials, source.options).options
        self._progress = Progress(chosen.evaluations, len(source.trials))
        self.state, self.text = CALIBRATING, ''
        self._worker.start(source.trials, source.options, folder.log)

    def stop(self) -> None:
        """Ask the calibration to end with the best so far."""
        self._worker.stop()

    def take(self) -> bool:
        """Take the events of the calibration since the last call; return whether there were any."""
        news = False
        for event in self._worker.waiting_events():
            news = True
            if isinstance(event, Evaluation):
                self._progress.take(event)
            elif isinstance(event, CalibrationWarning):
                self._warnings.append(event.text)
            elif isinstance(event, Failure):
                self._fail(event)
            else:
                self._finish(event)
        return news

    def plain(self, digest: str) -> dict[str, Any]:
        """
        Return the state of the calibration as the page shows it, without the result.

        :param digest: of the trials as they are now.
        """
        progress, best = self._progress, None
        if progress.best is not None:
            best = {'score': progress.best.score, 'parameters': dict(progress.best.values)}
        seconds_left = progress.seconds_left if self.busy and progress.count else None
        return {'state': self.state, 'evaluations': progress.count, 'of': progress.evaluations,
                'seconds_left': seconds_left, 'best': best,
                'text': self.text or None, 'warnings': list(dict.fromkeys(self._warnings)),
                'outdated': self.result is not None and self.result.digest != digest,
                'files': list(self.files)}

    def plain_result(self, digest: str) -> dict[str, Any] | None:
        """Return the result as the page shows it; None: there is none."""
        if self.result is None:
            return None
        return {**self.result.values, 'outdated': self.result.digest != digest}

    def close(self) -> None:
        """End the calibration; its log stays, so that it can be resumed."""
        self._ending.set()
        self._worker.stop()
        self._worker.join(PATIENCE)
        if self._writing is not None:
            self._writing.join(PATIENCE)
        if self._calibration is not None and self.busy:
            self._calibration.close()

    def _fail(self, failure: Failure) -> None:
        assert self._calibration is not None
        if not self._worker.stopped:  # it would fail again
            self._calibration.discard()
        self._calibration.close()
        self.state, self.text = (STOPPED, 'it was stopped before the first evaluation had finished') \
            if self._worker.stopped else (FAILED, failure.text)

    def _finish(self, result: CalibrationResult) -> None:
        """Show a result, and write its files in a thread."""
        if self._ending.is_set():  # the page ends, and the calibration can be resumed
            return
        stopped = self._worker.stopped
        words = [result.choice.words] if result.choice and result.choice.words else []
        values = with_nulls({**plain(result), 'sentences': [*words, *sentences(result)]})
        assert self._calibration is not None
        self.result, self.files = PageResult(self._digest, values), ()
        self.description = Description.of(result, self._options.flat())
        self.state = STOPPED if stopped else DONE
        self._writing = threading.Thread(
            target=self._write, args=(self._calibration, result, self.result, self.state), name='result',
            daemon=True)
        self._writing.start()

    def _write(self, calibration: CalibrationFolder, result: CalibrationResult, page: PageResult, state: str
               ) -> None:
        try:
            with closing(calibration):
                text = json.dumps({'digest': page.digest, 'state': state, 'result': page.values},
                                  allow_nan=False)
                write_file(self.folder / PAGE_RESULT, text)
                attempts = calibration.complete(result, self._make_simulator, self._ending.is_set,
                                                stopped=state == STOPPED, responsive=True)
                self.files = tuple(name for name in FILES if name in attempts.written)
                if attempts.failure:
                    self._warnings.append(f'could not be written: {attempts.failure}')
        except Exception as error:  # the person would wait for a thread that died silently
            self._warnings.append(f'the result could not be written: {reason(error)}')
        self.written.set()

    def _reopen(self) -> None:
        """Show the result of an earlier session of the page."""
        # The file does not exist, or is a stranger's.
        with suppress(OSError, ValueError, RecursionError, KeyError, TypeError, DloCalibrationError):
            path = self.folder / PAGE_RESULT
            if not _is_ours(path) or path.stat().st_size > LONGEST:
                return
            content = json.loads(path.read_text(encoding='utf-8'))
            values = content['result']
            if not isinstance(values, dict) or not isinstance(values['parameters'], dict):
                return
            self.result = PageResult(str(content['digest']), values)
            self.state = STOPPED if content['state'] == STOPPED else DONE
            description = read_result(self.folder / RESULT)
            if description.score == values['score']:  # else the process was killed before it wrote this file
                self.description = description
                self.files = tuple(name for name in FILES if _is_ours(self.folder / name))


def _is_ours(path: Path) -> bool:
    """Tell whether a path is a file; a link in a stranger's folder could lead anywhere."""
    return path.is_file() and not path.is_symlink()
