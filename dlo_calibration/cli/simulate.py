# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `simulate`: predicts what a calibrated DLO does in given actions."""

from __future__ import annotations

import argparse
from contextlib import closing
import json
from pathlib import Path
import time
from typing import Any, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.engines import obstacles_of, SimulatorFactory
from dlo_calibration.calibration.options import Options, SIMULATION
from dlo_calibration.cli.arguments import (
    add_common_arguments,
    add_options,
    add_without,
    read_result_file,
    selected,
)
from dlo_calibration.cli.output import print_json, print_message, print_sentences
from dlo_calibration.errors import InputError
from dlo_calibration.files.chain_file import write_chain
from dlo_calibration.files.result import Description
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import Manipulation
from dlo_calibration.model.parameters import HANDS
from dlo_calibration.observation.table import resting_level
from dlo_calibration.planning.prediction import DRAWS, plain_prediction, Prediction, simulate
from dlo_calibration.planning.rehearsal import motion_of_actions
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.simulation.scene import Obstacle
from dlo_calibration.workspace.source import read_manipulations
from dlo_calibration.writing import Attempts, make_folder, whole

ALL = 'simulation.json'  # file with all predictions
MOST_DRAWS = 10_000
Named = Sequence[tuple[str, Prediction]]  # names of trials, which can be anything, and what happens there
USED = (*SIMULATION, 'workers', 'frame_pose', 'grip_tolerance', 'length_tolerance', 'release')  # options


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
    add_options(parser, USED)


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report.sentences import prediction_sentences

    for name, least, most in (('draws', 0, MOST_DRAWS), ('seed', 0, 2**32 - 1)):
        if not least <= getattr(chosen, name) <= most:
            raise InputError(f'--{name}', str(getattr(chosen, name)), f'{least} to {most}', 'correct it')
    description = read_result_file(chosen)
    manipulations, options = read_manipulations(selected(chosen), print_message, description.file_options)
    shift = np.array([description.physical().get(name, 0.0) for name in HANDS[1:]])
    if shift.any():  # the hands of the session have the error that the calibration has found
        manipulations = tuple(manipulation.with_shifted_hands(shift) for manipulation in manipulations)
    if chosen.output is not None:
        make_folder(chosen.output)  # before the simulations
    begun = time.monotonic()
    predictions = [(manipulation.name, _predicted(description, manipulation, options, chosen, make_simulator))
                   for manipulation in manipulations]
    with closing(make_simulator(options)) as simulator:
        about = {**_plain(predictions), 'draws': chosen.draws, 'seed': chosen.seed, 'engine': simulator.name,
                 'seconds': time.monotonic() - begun}
        try:
            if chosen.output is not None:
                write_prediction_files(chosen.output, predictions, about, simulator, obstacles_of(options))
                print_message(f'the predictions are in {chosen.output}')
        finally:  # whatever the disk does
            if chosen.json:
                print_json(about)
            else:
                print_sentences(sentence for name, prediction in predictions
                                for sentence in (f'{name}:', *prediction_sentences(prediction)))
        if chosen.gui:
            _show(predictions, options, simulator)
    return 0


def _predicted(description: Description, asked: Manipulation, options: Options, chosen: argparse.Namespace,
               make_simulator: SimulatorFactory) -> Prediction:
    """Return the prediction of a trial, with a warning if its DLO is hardly the calibrated one."""
    change = abs(asked.start.length - description.length) / description.length * 100
    if change > options.length_tolerance:
        print_message(
            f'trial {asked.name!r}: its chain is {asked.start.length:.4g} m long, {change:.0f} % from the '
            f'{description.length:.4g} m of the calibrated DLO; check that both are the same DLO, in metres')
    try:
        return simulate(description, asked.start, asked.steps, options=options, draws=chosen.draws,
                        seed=chosen.seed, make_simulator=make_simulator)
    except InputError as error:
        raise InputError(f'trial {asked.name!r}, {error.thing}', error.came, error.expected,
                         error.remedy) from error


def _plain(predictions: Named) -> dict[str, Any]:
    """Return the actions of all trials as plain values, each with the name of its trial."""
    plain = [(name, plain_prediction(prediction)) for name, prediction in predictions]
    return {'actions': [{'trial': name, **action}
                        for name, prediction in plain for action in prediction['actions']],
            'remarks': [f'trial {name!r}: {remark}'
                        for name, prediction in plain for remark in prediction['remarks']]}


def _show(predictions: Named, options: Options, simulator: Simulator) -> None:
    """
    Show the motions in a window until the user closes it.

    :raises DloCalibrationError: if no window can be opened.
    """
    from dlo_calibration.report.drawing import hand_colours
    from dlo_calibration.simulation.window import FRAME_RATE, MOST_FRAMES, show, ShownMotion

    radius, films, levels = predictions[0][1].physical['self_collision'], [], []
    for name, prediction in predictions:
        trial, motion = motion_of_actions(
            prediction.start, [step.step for step in prediction.steps], simulator, prediction.physical,
            frame_rate=FRAME_RATE, most=MOST_FRAMES)
        films.append(ShownMotion.of(name, trial, motion, hand_colours([trial]), radius))
        levels.append(resting_level(trial, options.table_height))
    heights = [level - radius for level in levels if level is not None]
    show(films, radius, min(heights, default=options.table_height) if options.table else None, options.scene,
         lambda: print_message('close the window, or press Ctrl-C, to end'))


def write_prediction_files(folder: Path, predictions: Sequence[tuple[str, Prediction]],
                           about: Mapping[str, Any], simulator: Simulator,
                           obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Write predictions to a folder, as far as possible.

    :param predictions: names of trials, which can be anything, and what happens in them.
    :param about: the same, as plain values.
    :param obstacles: of the scene, for the drawings.
    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    from dlo_calibration.report.plan_drawing import write_prediction_animation, write_prediction_picture

    attempts = Attempts(folder)
    with attempts.attempt(ALL), whole(folder / ALL) as new:
        new.write_text(f'{json.dumps(about, indent=2, allow_nan=False)}\n', encoding='utf-8')
    for k, (name, prediction) in enumerate(predictions, start=1):
        for number, step in enumerate(prediction.steps, start=1):
            for suffix in ('csv', 'xml'):
                file = f'trial_{k}_after_{number}.{suffix}'
                with attempts.attempt(file):
                    write_chain(folder / file, Chain(step.chain))
        with attempts.attempt(f'trial_{k}.png'):
            write_prediction_picture(prediction, name, folder / f'trial_{k}.png', obstacles=obstacles)
        with attempts.attempt(f'trial_{k}.gif'):
            write_prediction_animation(prediction, name, simulator, folder / f'trial_{k}.gif',
                                       obstacles=obstacles)
    attempts.require()
