# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `check`: tells whether a session still shows the DLO of a result."""

from __future__ import annotations

import argparse
from pathlib import Path

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.arguments import add_source, read_result_file, selected
from dlo_calibration.cli.output import print_json, print_message, print_sentences
from dlo_calibration.evaluation.digest import file_digests
from dlo_calibration.workspace.check import checked, plain_check
from dlo_calibration.workspace.folder import recorded_files
from dlo_calibration.workspace.source import read_source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('result', metavar='RESULT.xml', type=Path, help='the DLO as it was')
    add_source(parser)


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    file = read_result_file(chosen)
    source = read_source(selected(chosen), print_message, file.file_options).require_trials()
    if set(file_digests(recorded_files(source.path)).values()) & set(file.passport.sessions.values()):
        print_message('warning: the session: one from which the result was found, so that it agrees; '
                      'expected a new one')
    check = checked(file, source.trials, source.options, make_simulator)
    for warning in check.validation.warnings:
        if warning not in source.trial_warnings:  # read_source has printed these
            print_message(f'warning: {warning}')
    if chosen.json:
        print_json(plain_check(check))
    else:
        print_sentences([f'{check.verdict[0].upper()}{check.verdict[1:]}.', *check.words,
                         *filter(None, [file.passport.words])])
    return 0
