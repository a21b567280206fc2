# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `fit`: finds the parameters that explain a session best, and writes the result."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.plain import plain
from dlo_calibration.cli.options import given_options
from dlo_calibration.cli.output import print_json, print_result, tell
from dlo_calibration.cli.result_files import (
    EVALUATIONS,
    file_names,
    INPUTS,
    keep_input,
    REPORT,
    REQUEST,
    RESULT,
    SESSION,
    write_files,
)
from dlo_calibration.cli.source import add_source, left_out, read_source, Source
from dlo_calibration.cli.unfinished import Unfinished
from dlo_calibration.cli.validate import validated
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.files.result import HOW, read_result
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import make_folder

if TYPE_CHECKING:
    from dlo_calibration.report.terminal import SearchBar


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_source(parser, optional=True)
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
        unfinished, log = None, None
        if chosen.resume is not None:
            if not Unfinished.is_in(chosen.resume):
                return _finished(chosen, make_simulator)
            unfinished = stack.enter_context(Unfinished(chosen.resume, INPUTS))
            unfinished.complete(chosen)
        elif chosen.session is None:
            raise InputError('fit', 'no SESSION', 'a session or a request', 'name it, or --resume DIR')
        source = read_source(chosen, tell).require_trials()
        folder = chosen.resume or chosen.output
        if folder is None and 'output_directory' in given_options(chosen):
            folder = Path(source.options.output_directory)
        if folder is not None:
            make_folder(folder)  # before hours are spent on a search
            unfinished = unfinished or stack.enter_context(Unfinished(folder, INPUTS))
            namespace = None if source.session.messages.remapped else chosen.namespace
            log = unfinished.begin(source, namespace, lambda path: keep_input(path, source), tell,
                                   left_out(chosen))
        stopped = _fit(chosen, source, folder, make_simulator, log)
        if unfinished is not None and not stopped:
            unfinished.remove()
        elif log is not None:
            tell(f'the calibration was stopped; it goes on with: dlo-calibration fit --resume {folder}')
    return 0


def _fit(chosen: argparse.Namespace, source: Source, folder: Path | None, make_simulator: SimulatorFactory,
         log: EvaluationLog | None) -> bool:
    """Calibrate, print the result, and write it; return whether the user stopped it."""
    told: list[str] = []
    bar: SearchBar | None = None

    def warn_once(text: str) -> None:
        if text not in told:
            tell(f'warning: {text}')
            told.append(text)

    def show(evaluation: Evaluation) -> None:
        nonlocal bar
        if bar is None:  # what draws it takes as long to load as the first simulations, which go on meanwhile
            from dlo_calibration.report.terminal import SearchBar

            most = choose(source.trials, source.options).options.evaluations
            bar = stack.enter_context(SearchBar(
                most, sys.stderr, shown=not chosen.json, known=log.evaluations if log else 0))
        bar.take(evaluation)

    with StopFlag() as stop:
        with ExitStack() as stack:
            try:
                result = calibrate(
                    source.trials, source.options, on_evaluation=show, on_notice=warn_once,
                    should_stop=stop, make_simulator=make_simulator, log=log)
            except SimulationError:
                if not stop():
                    if log is not None:  # the same would happen again
                        log.remove()
                    raise
                raise KeyboardInterrupt(stop.exit_code) from None
        stopped = stop()
        try:
            print_result(result, chosen.json, told)  # first, as the page takes seconds
        finally:  # whatever becomes of the output
            attempts = None if folder is None else write_files(folder, source, result, make_simulator, stop)
        if attempts is not None:
            attempts.require()
            tell(f'{", ".join(file_names(source))} are in {folder}')
    return stopped


def _finished(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """
    Say that there is nothing to resume in a folder, and print its result, if JSON is wanted.

    Its trials are simulated once more, as the file does not hold all that the document tells.
    """
    folder: Path = chosen.resume
    if not (folder / RESULT).is_file():
        raise InputError(f'folder {folder}', 'no interrupted calibration', 'one that fit --output began',
                         'check the folder, or begin with fit SESSION --output')
    tell(f'nothing to resume: the calibration is finished, and its result is {folder / RESULT}')
    if chosen.json:
        file = read_result(folder / RESULT)
        if chosen.session is None:
            chosen.session = folder / (REQUEST if (folder / REQUEST).is_file() else SESSION)
        source = read_source(chosen, tell, file.file_options).require_trials()
        trials = [trial for trial in source.trials if trial.name in file.trials]
        result = replace(validated(file, trials, source.options, make_simulator),
                         warnings=file.warnings, confirmation=file.confirmation)
        print_json({**plain(result), **{name: getattr(file, name) for name in HOW}})
    return 0
