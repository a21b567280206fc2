# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `fit`: finds the parameters that explain a session best, and writes the result."""

from __future__ import annotations

import argparse
from contextlib import closing, ExitStack
from dataclasses import replace
from pathlib import Path
import sys

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import plain
from dlo_calibration.cli.arguments import add_source, selected
from dlo_calibration.cli.output import print_json, print_message, print_result
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.files.result import HOW, read_result
from dlo_calibration.signals import StopFlag
from dlo_calibration.workspace.folder import CalibrationFolder, EVALUATIONS, FILES, REPORT, RESULT, SESSION
from dlo_calibration.workspace.source import read_source, read_sources, Source
from dlo_calibration.workspace.validation import validated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_source(parser, several=True)
    written = parser.add_mutually_exclusive_group()
    written.add_argument('--output', metavar='DIR', type=Path,
                         help=f'write {RESULT}, {SESSION}, {REPORT} and {EVALUATIONS} to this folder; until '
                         'then, each finished evaluation is kept there')
    written.add_argument('--resume', metavar='DIR', type=Path,
                         help='go on with a calibration that was interrupted, from what --output DIR kept; '
                         'SESSION and options are those of its beginning')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    with ExitStack() as stack:
        folder = None
        if chosen.resume is not None:
            if not CalibrationFolder.is_unfinished(chosen.resume):
                return _finished(chosen, make_simulator)
            folder = stack.enter_context(closing(CalibrationFolder(chosen.resume)))
            _require_one(chosen.session)
            path = chosen.session[0] if chosen.session else CalibrationFolder.input_of(chosen.resume)
            selection = selected(chosen, path)
            if not chosen.session:  # the copy of the input has the calibrator's names
                selection = replace(selection, remap={})
            selections = [folder.resume(selection)]
        elif not chosen.session:
            raise InputError('fit', 'no SESSION', 'a session or a request', 'name it, or --resume DIR')
        else:
            selections = [selected(chosen, path) for path in chosen.session]
        source = read_sources(selections, print_message).require_trials()
        if source.options.own and len(source.options.trials_of_sessions) < 2:
            raise InputError('--own', 'one session', 'several sessions of the DLO',
                             'name them all: fit FIRST SECOND --own NAME')
        output = chosen.output
        if output is None and 'output_directory' in selections[0].options:
            output = Path(source.options.output_directory)
        if folder is None and output is not None:
            folder = stack.enter_context(closing(CalibrationFolder(output)))
        if folder is not None:
            folder.begin(source, print_message)
        _fit(chosen, source, folder, make_simulator)
    return 0


def _require_one(sessions: list[Path]) -> None:
    """
    Check that no more than one session is resumed: the folder has all trials in one.

    :raises InputError: if there are several.
    """
    if len(sessions) > 1:
        raise InputError('--resume', f'{len(sessions)} sessions', 'none, or one', 'leave them out')


def _fit(chosen: argparse.Namespace, source: Source, folder: CalibrationFolder | None,
         make_simulator: SimulatorFactory) -> None:
    """Calibrate, print the result, and write its files."""
    from dlo_calibration.report.terminal import SearchBar

    warnings = list(source.trial_warnings)  # read_source has printed these
    log = None if folder is None else folder.log

    def warn_once(text: str) -> None:
        if text not in warnings:
            print_message(f'warning: {text}')
            warnings.append(text)

    most = choose(source.trials, source.options).options.evaluations
    with StopFlag() as stop:
        with SearchBar(most, sys.stderr, shown=not chosen.json, logged=log.evaluations if log else 0) as bar:
            try:
                result = calibrate(
                    source.trials, source.options, on_evaluation=bar.take, on_notice=warn_once,
                    should_stop=stop, make_simulator=make_simulator, log=log)
            except SimulationError:
                if stop():
                    raise KeyboardInterrupt(stop.exit_code) from None
                if folder is not None:  # it would fail again
                    folder.discard()
                raise
        stopped = stop()
        try:
            print_result(result, chosen.json, warnings)  # first, as the page takes seconds
        finally:  # even if stdout fails
            if folder is not None:
                attempts = folder.complete(result, make_simulator, stop, stopped=stopped,
                                           responsive=False)
        if folder is not None:
            attempts.require()
            written = ', '.join(name for name in FILES if name in attempts.written)
            print_message(f'{written} are in {folder.path}')
            if stopped and log is not None:
                print_message('the calibration was stopped; it goes on with: '
                              f'dlo-calibration fit --resume {folder.path}')


def _finished(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """
    Say that a folder has nothing to resume; with `--json`, print its result.

    The trials are simulated once more, because `result.xml` does not hold everything that JSON shows.
    """
    folder: Path = chosen.resume
    if not (folder / RESULT).is_file():
        raise InputError(f'folder {folder}', 'no interrupted calibration', 'one that fit --output began',
                         'check the folder, or begin with fit SESSION --output')
    print_message(f'nothing to resume: the calibration is finished, and its result is {folder / RESULT}')
    if chosen.json:
        file = read_result(folder / RESULT)
        _require_one(chosen.session)
        path = chosen.session[0] if chosen.session else CalibrationFolder.input_of(folder)
        source = read_source(selected(chosen, path), print_message, file.file_options).require_trials()
        trials = [trial for trial in source.trials if trial.name in file.trials]
        result = replace(validated(file, trials, source.options, make_simulator),
                         warnings=file.warnings, confirmation=file.confirmation)
        print_json({**plain(result), **{name: getattr(file, name) for name in HOW}})
    return 0
