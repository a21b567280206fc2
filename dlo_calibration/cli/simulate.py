# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `simulate`: predicts what a calibrated DLO does in given actions."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
import time
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli.options import add_options
from dlo_calibration.cli.output import print_json, standard_output, tell
from dlo_calibration.cli.plan import SIMULATION
from dlo_calibration.cli.prediction_files import write_prediction_files
from dlo_calibration.cli.source import (
    add_common_arguments,
    add_without,
    read_manipulations,
    read_result_file,
)
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import Description
from dlo_calibration.model.manipulation import Manipulation
from dlo_calibration.observation.table import resting_level
from dlo_calibration.planning.course import simulated_course
from dlo_calibration.planning.plain import plain_prediction
from dlo_calibration.planning.prediction import DRAWS, Prediction, simulate
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.writing import make_folder

MOST_DRAWS = 10_000
Named = Sequence[tuple[str, Prediction]]  # names of trials, which can be anything, and what happens there
USED = (*SIMULATION, 'grip_tolerance', 'length_tolerance', 'release')  # options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('result', metavar='RESULT.xml', type=Path, help='the calibrated DLO')
    parser.add_argument('session', metavar='SESSION', type=Path, help=(
        'an MCAP file, the folder of a rosbag2 recording, or an XML request: initial chains and actions; '
        'goal chains are not needed'))
    add_without(parser)
    add_common_arguments(parser)
    parser.add_argument('--output', metavar='DIR', type=Path, help=(
        'write to this folder, for each trial: a picture, an animation, and the chain after each action as '
        'CSV and XML; and simulation.json'))
    parser.add_argument('--gui', action='store_true', help=(
        "show the motions in PyBullet's window, in real time"))
    parser.add_argument('--draws', type=int, default=DRAWS, help=(
        f'number of draws from the posterior, for the 90 %% intervals; default {DRAWS}'))
    parser.add_argument('--seed', type=int, default=1, help='of these draws; default 1')
    add_options(parser, without=[one.name for one in Options.declarations() if one.name not in USED])


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    for name, least, most in (('draws', 0, MOST_DRAWS), ('seed', 0, 2**32 - 1)):
        if not least <= getattr(chosen, name) <= most:
            raise InputError(f'--{name}', str(getattr(chosen, name)), f'{least} to {most}', 'correct it')
    found = read_result_file(chosen)
    manipulations, options = read_manipulations(chosen, tell, found.file_options)
    if chosen.output is not None:
        make_folder(chosen.output)  # before the simulations
    begun = time.monotonic()
    predictions = [(one.name, _predicted(found, one, options, chosen, make_simulator))
                   for one in manipulations]
    with closing(make_simulator(options)) as simulator:
        about = {**_plain(predictions), 'draws': chosen.draws, 'seed': chosen.seed, 'engine': simulator.name,
                 'seconds': time.monotonic() - begun}
        try:
            if chosen.output is not None:
                write_prediction_files(chosen.output, predictions, about, simulator)
                tell(f'the predictions are in {chosen.output}')
        finally:  # whatever the disk does
            _print(predictions, about, chosen.json)
        if chosen.gui:
            _show(predictions, options, simulator)
    return 0


def _predicted(found: Description, asked: Manipulation, options: Options, chosen: argparse.Namespace,
               make_simulator: SimulatorFactory) -> Prediction:
    """Return the prediction of a trial, and tell if its DLO is hardly the calibrated one."""
    change = abs(asked.start.length - found.length) / found.length * 100
    if change > options.length_tolerance:
        tell(f'trial {asked.name!r}: its chain is {asked.start.length:.4g} m long, {change:.0f} % from the '
             f'{found.length:.4g} m of the calibrated DLO; check that both are the same DLO, in metres')
    try:
        return simulate(found, asked.start, asked.steps, options=options, draws=chosen.draws,
                        seed=chosen.seed, make_simulator=make_simulator)
    except InputError as error:
        raise InputError(f'trial {asked.name!r}, {error.thing}', error.came, error.expected,
                         error.remedy) from error


def _plain(predictions: Named) -> dict[str, Any]:
    """Return the actions of all trials as plain values, each with the name of its trial."""
    told = [(name, plain_prediction(one)) for name, one in predictions]
    return {'actions': [{'trial': name, **action} for name, one in told for action in one['actions']],
            'remarks': [f'trial {name!r}: {remark}' for name, one in told for remark in one['remarks']]}


def _print(predictions: Named, about: Mapping[str, Any], as_json: bool) -> None:
    """Print predictions on stdout."""
    if as_json:
        print_json(about)
        return
    from dlo_calibration.report.prediction_sentences import prediction_sentences
    from dlo_calibration.report.terminal import console, escape

    with standard_output() as stream:
        out = console(stream)
        for name, one in predictions:
            out.print(escape(f'{name}:'))
            for sentence in prediction_sentences(one):
                out.print(escape(sentence))


def _show(predictions: Named, options: Options, simulator: Simulator) -> None:
    """
    Show the motions in a window until the user closes it.

    :raises DloCalibrationError: if no window can be opened.
    """
    from dlo_calibration.report.drawing import hand_colours
    from dlo_calibration.simulation.window import Film, FRAME_RATE, MOST_FRAMES, show

    radius, films, levels = predictions[0][1].physical['self_collision'], [], []
    for name, one in predictions:
        trial, motion = simulated_course(one.start, [step.step for step in one.steps], simulator,
                                         one.physical, frame_rate=FRAME_RATE, most=MOST_FRAMES)
        films.append(Film.of(name, trial, motion, hand_colours([trial]), radius))
        levels.append(resting_level(trial, options.table_height))
    known = [level - radius for level in levels if level is not None]
    show(films, radius, min(known, default=options.table_height) if options.table else None, options.scene,
         lambda: tell('close the window, or press Ctrl-C, to end'))
