# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a calibration: its input and its log while it is under way, then the files of its result."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, field
import json
from pathlib import Path
import shutil
from typing import Any, Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import engine_digest, SimulatorFactory
from dlo_calibration.calibration.options import MACHINE, names_of, Options, recordable
from dlo_calibration.calibration.passport import Passport
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError, unwritable
from dlo_calibration.evaluation.digest import digest, file_digests
from dlo_calibration.evaluation.log import CALIBRATION, Entry, EvaluationLog
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.result import write_evaluations, write_result
from dlo_calibration.files.session import trial_records
from dlo_calibration.model.trial import Trial
from dlo_calibration.workspace.source import Selection, Source
from dlo_calibration.writing import Attempts, make_folder, reason, whole

#: The files of a result, in the order in which they are listed.
RESULT, REQUEST, SESSION, REPORT, EVALUATIONS = FILES = (
    'result.xml', 'request.xml', 'session.mcap', 'report.html', 'evaluations.csv')
UNFINISHED, LOG = 'unfinished', 'evaluations.log'  # folder in the folder of a calibration, and file in that
LONGEST = 100000  # characters of a calibration's options; a stranger's must not take all memory


@dataclass(frozen=True)
class LogHead:
    """
    The first entry of a log: the calibration of its evaluations.

    :param digest: see `calibration_digest`.
    :param namespace: of the topics; None: the session has only one.
    :param options: without those of the machine.
    :param without: numbers of the trials that are left out.
    :param sessions: the SHA-256 of each recorded file, by its name.
    """

    digest: str
    namespace: str | None
    options: Mapping[str, Any]
    without: tuple[int, ...] = ()
    sessions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source) -> LogHead:
        """Return the head of a calibration that begins."""
        files = [file for part in source.parts or (source,) for file in recorded_files(part.path)]
        return cls(calibration_digest(source.trials, source.options), source.namespace,
                   recordable(source.options.flat()), source.selection.without, file_digests(files))

    @classmethod
    def read(cls, log: EvaluationLog) -> LogHead | None:
        """Return the head of a log; None if it has none, or a damaged one."""
        entry = log.find(CALIBRATION)
        if entry is None or len(entry.text) > LONGEST:
            return None
        try:
            head = cls(**json.loads(entry.text))
            return cls(str(head.digest), head.namespace and str(head.namespace),
                       Options.of(head.options).flat(), tuple(int(number) for number in head.without),
                       {str(name): str(sha256) for name, sha256 in head.sessions.items()})
        except (ValueError, TypeError, AttributeError, RecursionError, InputError):  # a stranger's
            return None


class CalibrationFolder:
    """
    The folder of a calibration.

    Until the result is complete, its folder ``unfinished`` has a copy of the input and the log of the
    evaluations, so that the calibration can go on after an interruption, even by `kill -9`.  Call `begin`,
    give `log` to the calibration, then call `complete`.

    :ivar log: of the evaluations; None: it could not be written, so the calibration could not be resumed.
    :raises InputError: if the folder cannot be written, or another calibration is using it.
    """

    def __init__(self, path: Path) -> None:
        make_folder(path)  # fails before hours are spent on a search
        self.path, self._unfinished = path, path / UNFINISHED
        self._source: Source | None = None
        self._sessions: Mapping[str, str] = {}
        try:
            if self._unfinished.is_symlink():
                raise OSError('it is a link')
            self._unfinished.mkdir(exist_ok=True)
        except OSError as error:
            raise unwritable(self._unfinished, error, 'folder') from error
        self._new, self._resumed = not (self._unfinished / LOG).exists(), False
        self.log: EvaluationLog | None = None
        self._opened_log = EvaluationLog(self._unfinished / LOG)

    @staticmethod
    def is_unfinished(path: Path) -> bool:
        """Tell whether a folder has a calibration that can be resumed."""
        return (path / UNFINISHED / LOG).exists()

    @staticmethod
    def input_of(path: Path) -> Path:
        """Return the path of the request or session in a folder; if it is unfinished, of the copy."""
        folder = path / UNFINISHED if CalibrationFolder.is_unfinished(path) else path
        return folder / (REQUEST if (folder / REQUEST).exists() else SESSION)

    def resume(self, given: Selection) -> Selection:
        """
        Return the selection of the calibration that began here, with the machine options of a command line.

        :param given: the selection of the command line.
        :raises InputError: if nothing here can go on, or if the command line contradicts it.
        """
        head = LogHead.read(self._opened_log)
        if head is None:
            raise InputError(f'log {self._opened_log.path}', 'no calibration', 'a log that fit has written',
                             f'use fit SESSION --output {self.path}, with the options of the beginning')
        remedy = 'leave it out, or begin anew with fit SESSION and another --output'
        # A stranger's log must not choose a file of this machine: its user names the scene again, whose
        # content `begin` compares.
        begun = {name: value for name, value in head.options.items()
                 if name not in (*names_of(MACHINE), 'scene')}
        for name, value in given.options.items():
            if name in begun and Options.of({name: value}).flat()[name] != begun[name]:
                raise InputError(f'option {name} beside --resume', f'{value}',
                                 f'{begun[name]}, as at the beginning', remedy)
        if given.without not in ((), head.without):
            raise InputError('--without beside --resume', ','.join(map(str, given.without)),
                             f'{",".join(map(str, head.without)) or "none"}, as at the beginning', remedy)
        self._resumed = True
        return Selection(given.path, {**begun, **given.options}, given.namespace or head.namespace,
                         given.remap, head.without)

    def begin(self, source: Source, warn: Callable[[str], None], *, instead: bool = False) -> None:
        """
        Copy the input of a calibration, and open its `log`; begin anew or go on.

        :param warn: called with each sentence that the user should read.
        :param instead: whether to discard another calibration that was interrupted here.
        :raises InputError: if another calibration was interrupted here, and `instead` is false.
        """
        self._source = source
        before, head = LogHead.read(self._opened_log), LogHead.of(source)
        evaluations = self._opened_log.evaluations
        if before is not None and before.digest != head.digest:
            if evaluations and not instead:
                raise self._occupied(before, source, evaluations)
            self._opened_log.remove()
            self._opened_log, self._new, before = EvaluationLog(self._unfinished / LOG), True, None
        if self._opened_log.evaluations:
            warn(self._opened_log.resumed)
        self._sessions = (before or head).sessions
        if before is None:
            try:
                if source.request is not None:
                    _copy(source.path, self._unfinished / REQUEST)
                else:
                    _write_session(source, self._unfinished / SESSION)
                self._opened_log.add(CALIBRATION, Entry(np.zeros(0), json.dumps(asdict(head))))
            except (OSError, InputError) as error:
                warn(f'warning: folder {self._unfinished}: cannot be written: {reason(error)}; the '
                     'calibration could not go on after an interruption')
                return
        self.log = self._opened_log

    def _occupied(self, before: LogHead, source: Source, evaluations: int) -> InputError:
        scene = before.options['scene']
        remedy = 'use fit --resume for it, choose another folder, or remove its folder unfinished'
        if self._resumed:
            remedy = 'go on with the version and the session with which it began, or begin anew with fit'
        if scene and not source.options.scene:
            remedy = f'add --scene {scene}, which it had'
        return InputError(f'folder {self.path}', f'{evaluations} evaluations of another calibration',
                          'the same trials, options and version', remedy)

    def complete(self, result: CalibrationResult, make_simulator: SimulatorFactory,
                 should_stop: Callable[[], bool], *, stopped: bool, responsive: bool) -> Attempts:
        """
        Write the files of a result, as far as possible; once all are written, discard the log.

        :param make_simulator: for the slices of the report, until `should_stop` returns true.
        :param stopped: whether the user stopped the calibration; the log is then kept to resume it.
        :param responsive: see `write_report`.
        """
        from dlo_calibration.report.page import Origin, repeating_command
        from dlo_calibration.workspace.report_writer import write_report

        assert self._source is not None
        source, attempts = self._source, Attempts(self.path)
        parts = source.parts or (source,)
        stamps = [record.log_time * 1e-9 for part in parts for record in part.session.inputs]
        write_values(attempts, result, source.options, Passport.new(
            source.options.measured_by, min(stamps, default=0.0), self._sessions))
        with attempts.attempt(SESSION):
            _write_session(source, self.path / SESSION)
        if source.request is not None:
            with attempts.attempt(REQUEST):
                _copy(source.path, self.path / REQUEST)
        with attempts.attempt(REPORT):
            copy = REQUEST if source.request is not None else SESSION
            origin = Origin(source.path.name, repeating_command(copy, source.options, source.flags),
                            source.options,
                            file_digests([*recorded_files(source.path),
                                          *([self.path / copy] if copy in attempts.written else [])]),
                            [*source.session.warnings, *source.refusals])
            write_report(self.path / REPORT, result, origin, make_simulator, should_stop,
                         responsive=responsive)
        if not (stopped or attempts.failure):
            self.discard()
        return attempts

    def discard(self) -> None:
        """Remove the log and the copy of the input."""
        for name in (REQUEST, SESSION):
            (self._unfinished / name).unlink(missing_ok=True)
        self._opened_log.remove()
        with suppress(OSError):  # it may have other files
            self._unfinished.rmdir()

    def close(self) -> None:
        """Close the log; discard it if this calibration began it and finished no evaluation."""
        if not self._opened_log.evaluations and (self._new or not self._opened_log.path.exists()):
            self.discard()
        self._opened_log.close()


def calibration_digest(trials: Sequence[Trial], options: Options) -> str:
    """
    Return a digest, the same for calibrations with the same evaluations in the same order.

    :raises InputError: if the scene cannot be read.
    """
    chosen = recordable(choose(trials, options).options.flat())
    del chosen['scene']  # its content counts, not its path
    return digest(engine_digest(options), chosen, tuple(trials))


def session_log(folder: Path, trials: Sequence[Trial], options: Options) -> EvaluationLog:
    """
    Open the log of a calibration of the node.

    It lies beside the folders of sessions and is named after trials and options, so that after an
    interruption another session with the same ones finds it.

    :raises InputError: if it cannot be opened, or the scene cannot be read.
    """
    name = f'dlo_unfinished_{calibration_digest(trials, options)}.log'
    make_folder(folder)
    return EvaluationLog(folder / name)


def write_values(attempts: Attempts, result: CalibrationResult, options: Options, passport: Passport
                 ) -> None:
    """Write the result and the table of its evaluations into the folder of `attempts`."""
    with attempts.attempt(RESULT):
        write_result(attempts.folder / RESULT, result, options.flat(), passport)
    with attempts.attempt(EVALUATIONS):
        write_evaluations(attempts.folder / EVALUATIONS, result)


def recorded_files(path: Path) -> list[Path]:
    """List the files that hold the messages of a session."""
    if not path.exists():  # several sessions were calibrated together
        return []
    return [path] if path.is_file() else sorted(file for file in path.iterdir()
                                                if file.suffix in ('.mcap', '.db3', '.zstd'))


def _write_session(source: Source, path: Path) -> None:
    """
    Write a session as one MCAP file; copy it if it is one already.

    A session with remapped topics is written with the inputs alone, under the names of the calibrator; a
    request becomes the messages that a robot would have sent.
    """
    files = [source.path] if source.path.is_file() else sorted(source.path.glob('*.mcap'))  # none: of several
    remapped = source.session.remapped
    if len(files) == 1 and files[0].suffix == '.mcap' and not remapped:
        _copy(files[0], path)
        return
    records, given = source.session.records, source.session.file_options
    options = None if given is None else given.values
    if remapped:
        records = source.session.renamed
    if source.request is not None:
        records, options = trial_records(source.trials), source.options.flat()
    write_records(path, records, options)


def _copy(source: Path, target: Path) -> None:
    """Copy a file, unless it is there already."""
    if target.is_symlink() or not (target.exists() and target.samefile(source)):
        with whole(target) as new:
            shutil.copyfile(source, new)
