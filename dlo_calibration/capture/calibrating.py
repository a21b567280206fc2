# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrating: the calibration of a project's trials, its progress, and its result in the folder."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
import json
from pathlib import Path
import threading
from typing import Any

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.plain import known, plain
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.worker import Failure, Notice, Worker
from dlo_calibration.capture.connections import Begun, Connections
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.writing import make_folder, reason, whole

FOLDER, SHOWN = 'result', 'result.json'  # in the project; in that, what the page shows
FILES = ('result.xml', 'session.mcap', 'report.html', 'evaluations.csv')
LONGEST = 2**22  # bytes of what the page shows; a stranger's must not take all memory
PATIENCE = 5.0  # s; whoever ends the page does not wait longer
IDLE, CALIBRATING, DONE, FAILED, STOPPED = 'idle', 'calibrating', 'done', 'failed', 'stopped'


@dataclass(frozen=True)
class Shown:
    """
    A result as the page shows it.

    :param digest: of the trials that it was found from.
    :param values: as `fit --json` prints it, with `sentences`.
    """

    digest: str
    values: dict[str, Any]


class Calibrating:
    """
    Calibrates in threads; all methods return at once, and belong to one thread, or to a lock.

    :param project: its folder.
    """

    def __init__(self, project: Path, connections: Connections) -> None:
        self.folder = project / FOLDER
        self.state, self.text = IDLE, ''
        self.shown: Shown | None = None
        self.found: Description | None = None  # the same result, to be simulated
        self.files: tuple[str, ...] = ()  # of that result, in the folder
        self.revision = 0  # changes when files have been written
        self._connections = connections
        self._worker = Worker(connections.make_simulator)
        self._begun: Begun | None = None
        self._progress: Progress | None = None
        self._notices: list[str] = []
        self._digest = ''
        self._writing: threading.Thread | None = None
        self._ending = threading.Event()
        self._reopen()

    @property
    def busy(self) -> bool:
        """Whether a calibration is under way."""
        return self.state == CALIBRATING

    def start(self, session: Path, digest: str) -> None:
        """
        Begin to calibrate.

        :param session: the MCAP file with the trials and the options.
        :param digest: of the trials, to tell whether they change afterwards.
        :raises InputError: if it is under way already, or the session cannot be used.
        """
        if self.busy or (self._writing is not None and self._writing.is_alive()):
            raise InputError('calibration', 'another one', 'one at a time',
                             'stop the one that is under way, or wait until its files are written')
        notices: list[str] = []
        make_folder(self.folder)
        begun = self._connections.begin(self.folder, session, notices.append)
        self._begun, self._notices, self._digest = begun, notices, digest
        chosen = choose(begun.trials, begun.options).options
        self._progress = Progress(chosen.evaluations, len(begun.trials))
        self.state, self.text = CALIBRATING, ''
        self._worker.start(begun.trials, begun.options, begun.log)

    def stop(self) -> None:
        """Ask the calibration to end with the best so far."""
        self._worker.stop()

    def take(self) -> bool:
        """Take what the calibration has found since the last call; return whether there was anything."""
        news = False
        for event in self._worker.waiting_events():
            news = True
            if isinstance(event, Evaluation):
                assert self._progress is not None
                self._progress.take(event)
            elif isinstance(event, Notice):
                self._notices.append(event.text)
            elif isinstance(event, Failure):
                self._fail(event)
            else:
                self._finish(event)
        return news

    def plain(self, digest: str) -> dict[str, Any]:
        """
        Return what the page shows of the calibration, without the result.

        :param digest: of the trials as they are now.
        """
        progress, best = self._progress, None
        if progress is not None and progress.best is not None:
            best = {'score': progress.best.score, 'parameters': dict(progress.best.values)}
        left = progress.seconds_left if progress is not None and self.busy and progress.count else None
        return {'state': self.state, 'evaluations': 0 if progress is None else progress.count,
                'of': 0 if progress is None else progress.evaluations, 'seconds_left': left, 'best': best,
                'text': self.text or None, 'warnings': list(dict.fromkeys(self._notices)),
                'outdated': self.shown is not None and self.shown.digest != digest,
                'files': list(self.files)}

    def plain_result(self, digest: str) -> dict[str, Any] | None:
        """Return the result as the page shows it; None: there is none."""
        if self.shown is None:
            return None
        return {**self.shown.values, 'outdated': self.shown.digest != digest}

    def close(self) -> None:
        """End the calibration; what was evaluated is kept, so that it can go on."""
        self._ending.set()
        self._worker.stop()
        self._worker.join(PATIENCE)
        if self._writing is not None:
            self._writing.join(PATIENCE)
        if self._begun is not None and self.busy:
            self._begun.close(finished=False)

    def _fail(self, failure: Failure) -> None:
        assert self._begun is not None
        self._begun.close(finished=not self._worker.stopped)  # else the same would happen again
        self.state, self.text = (STOPPED, 'it was stopped before the first evaluation had finished') \
            if self._worker.stopped else (FAILED, failure.text)

    def _finish(self, result: CalibrationResult) -> None:
        """Show a result, and write its files in a thread."""
        if self._ending.is_set():  # not stopped by the user, so that it goes on later
            return
        stopped = self._worker.stopped
        values = known({**plain(result), 'sentences': self._connections.sentences(result)})
        assert self._begun is not None
        self.shown, self.files = Shown(self._digest, values), ()
        self.found = Description.of(result, self._begun.options.flat())
        self.state = STOPPED if stopped else DONE
        self._writing = threading.Thread(
            target=self._write, args=(self._begun, result, self.shown, self.state), name='result',
            daemon=True)
        self._writing.start()

    def _write(self, begun: Begun, result: CalibrationResult, shown: Shown, state: str) -> None:
        try:
            try:
                self._keep(shown, state)
                attempts = begun.write(result, self._ending.is_set)
                self.files = tuple(name for name in FILES if name in attempts.written)
                if attempts.failure:
                    self._notices.append(f'could not be written: {attempts.failure}')
            finally:
                begun.close(finished=state == DONE)
        except Exception as error:  # a thread that dies silently would leave the person waiting
            self._notices.append(f'the result could not be written: {reason(error)}')
        self.revision += 1

    def _keep(self, shown: Shown, state: str) -> None:
        text = json.dumps({'digest': shown.digest, 'state': state, 'result': shown.values}, allow_nan=False)
        with whole(self.folder / SHOWN) as new:
            new.write_text(text, encoding='utf-8')

    def _reopen(self) -> None:
        """Show the result of an earlier opening."""
        # There is none, or it is a stranger's.
        with suppress(OSError, ValueError, RecursionError, KeyError, TypeError, DloCalibrationError):
            path = self.folder / SHOWN
            if not _is_ours(path) or path.stat().st_size > LONGEST:
                return
            kept = json.loads(path.read_text(encoding='utf-8'))
            values = kept['result']
            if not isinstance(values, dict) or not isinstance(values['parameters'], dict):
                return
            self.shown = Shown(str(kept['digest']), values)
            self.state = STOPPED if kept['state'] == STOPPED else DONE
            found = read_result(self.folder / FILES[0])
            if found.score == values['score']:  # else the process was killed before it had written this file
                self.found = found
                self.files = tuple(name for name in FILES if _is_ours(self.folder / name))


def _is_ours(path: Path) -> bool:
    """Tell whether a path is a file; a link in a stranger's folder could lead anywhere."""
    return path.is_file() and not path.is_symlink()
