# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a result: what `fit --output` and `capture` write into a folder."""

from __future__ import annotations

from pathlib import Path
import shutil
from typing import Callable

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.stages import sliced
from dlo_calibration.cli.source import Source
from dlo_calibration.files.evaluations import write_evaluations
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.result import write_result
from dlo_calibration.files.session import trial_records
from dlo_calibration.writing import Attempts, whole

RESULT, SESSION, REPORT, EVALUATIONS = 'result.xml', 'session.mcap', 'report.html', 'evaluations.csv'
REQUEST = 'request.xml'
INPUTS = (REQUEST, SESSION)  # that an unfinished calibration keeps


def file_names(source: Source) -> list[str]:
    """Return the names of the files that `write_files` writes."""
    return [RESULT, *([REQUEST] if source.is_request else []), SESSION, REPORT, EVALUATIONS]


def keep_input(folder: Path, source: Source) -> None:
    """Write the input of a calibration to a folder, so that it can be read again."""
    if source.is_request:
        _copy(source.path, folder / REQUEST)
    else:
        _write_session(folder / SESSION, source)


def write_files(folder: Path, source: Source, result: CalibrationResult, make_simulator: SimulatorFactory,
                should_stop: Callable[[], bool]) -> Attempts:
    """Write a result, and the session or request that it was found from, to a folder, as far as possible."""
    from dlo_calibration.report.page import digests, Origin, repeating_command, write_report

    attempts = Attempts(folder)
    with attempts.attempt(RESULT):
        write_result(folder / RESULT, result, source.options.flat())
    with attempts.attempt(SESSION):
        _write_session(folder / SESSION, source)
    if source.is_request:
        with attempts.attempt(REQUEST):
            _copy(source.path, folder / REQUEST)
    with attempts.attempt(EVALUATIONS):
        write_evaluations(folder / EVALUATIONS, result)
    with attempts.attempt(REPORT):
        repeated = REQUEST if source.is_request else SESSION
        repeatable = [folder / repeated] if repeated in attempts.written else []
        origin = Origin(source.path.name, repeating_command(repeated, source.options, source.selection),
                        source.options,
                        digests([*_recorded(source.path), *repeatable]),
                        [*source.session.problems, *source.refusals])
        write_report(folder / REPORT, result, origin,
                     lambda: sliced(result, source.options, make_simulator, should_stop))
    return attempts


def _recorded(path: Path) -> list[Path]:
    """List the files that hold the messages of a session."""
    return [path] if path.is_file() else sorted(one for one in path.iterdir()
                                                if one.suffix in ('.mcap', '.db3', '.zstd'))


def _write_session(path: Path, source: Source) -> None:
    """
    Write a session as one MCAP file; if it is one already, copy the file.

    Of a session with remapped topics, only the inputs are written, under the names of the calibrator.
    For a request, write the messages that a robot would have sent.
    """
    files = [source.path] if source.path.is_file() else sorted(source.path.glob('*.mcap'))
    remapped = source.session.messages.remapped
    if len(files) == 1 and files[0].suffix == '.mcap' and not remapped:
        _copy(files[0], path)
        return
    records, options = source.session.records, source.session.recorded
    if remapped:
        records = source.session.messages.renamed
    if source.is_request:
        records, options = trial_records(source.trials), source.options.flat()
    with whole(path) as new, SessionWriter(new, options) as writer:
        for record in records:
            writer.write(record.topic, record.type, record.data, record.log_time, flush=False)


def _copy(source: Path, target: Path) -> None:
    """Copy a file, unless it is there already."""
    if target.is_symlink() or not (target.exists() and target.samefile(source)):
        with whole(target) as new:
            shutil.copyfile(source, new)
