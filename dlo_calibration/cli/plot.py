# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `plot`: draws each trial as measured, and as simulated with a result."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from dlo_calibration.calibration.engines import obstacles_of, SimulatorFactory
from dlo_calibration.cli.arguments import add_source, read_result_file, selected
from dlo_calibration.cli.output import print_json, print_message
from dlo_calibration.errors import InputError
from dlo_calibration.workspace.source import read_source
from dlo_calibration.workspace.validation import validated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_source(parser)
    parser.add_argument('result', metavar='RESULT.xml', type=Path, nargs='?',
                        help='simulate with the parameters of this result (default: draw only measurements)')
    parser.add_argument('--output', metavar='DIR', type=Path, default=Path(),
                        help='write trial_1.png, ... to this folder (default: the current one)')
    parser.add_argument('--animation', action='store_true',
                        help='also write trial_1.gif, ..., which show how the simulated DLO moves')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report.animation import write_animations
    from dlo_calibration.report.drawing import write_pictures

    if chosen.animation and chosen.result is None:
        raise InputError('--animation', 'no RESULT.xml', 'parameters to simulate with',
                         'name a result: dlo-calibration plot SESSION RESULT.xml --animation')
    file = None if chosen.result is None else read_result_file(chosen)
    of_result = None if file is None else file.file_options
    source = read_source(selected(chosen), print_message, of_result).require_trials()
    result = None if file is None else validated(file, source.trials, source.options, make_simulator)
    trials = source.trials if result is None else result.trials
    names = {trial.name for trial in trials}
    numbers = [number for number, trial in zip(source.numbers, source.trials, strict=True)
               if trial.name in names]
    obstacles = obstacles_of(source.options)
    pictures = write_pictures(trials, None if result is None else result.chains, chosen.output,
                              print_message, numbers, obstacles)
    animations: list[Path] = []
    if chosen.animation and result is not None:
        physical = result.space.physical(result.values, result.length)  # of the first session
        with closing(make_simulator(source.options)) as simulator:
            animations = write_animations(result.trials, simulator, physical, chosen.output,
                                          print_message, numbers, obstacles)
    if chosen.json:
        print_json({'pictures': [str(path) for path in pictures],
                    'animations': [str(path) for path in animations]})
    return 0
