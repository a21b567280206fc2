# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `validate`: simulates trials with the parameters of a result, without fitting."""

from __future__ import annotations

import argparse
from pathlib import Path

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.stages import confirmed
from dlo_calibration.cli.arguments import add_source, read_result_file, selected
from dlo_calibration.cli.output import print_message, print_result
from dlo_calibration.workspace.source import read_source
from dlo_calibration.workspace.validation import validated, with_large_errors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('result', metavar='RESULT.xml', type=Path,
                        help='simulate with the parameters of this result')
    add_source(parser)


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    file = read_result_file(chosen)
    source = read_source(selected(chosen), print_message, file.file_options).require_trials()
    result = validated(file, source.trials, source.options, make_simulator)
    result = with_large_errors(result, file, source.options, make_simulator)
    print_result(confirmed(result, source.options, make_simulator), chosen.json, source.trial_warnings)
    return 0
