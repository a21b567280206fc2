# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `plan`: finds actions that bring a calibrated DLO from one configuration to another."""

from __future__ import annotations

import argparse
from contextlib import closing
from itertools import count, takewhile
import json
from pathlib import Path
import sys

from dlo_calibration.calibration.engines import obstacles_of, SimulatorFactory
from dlo_calibration.calibration.options import FileOptions, Options, SIMULATION
from dlo_calibration.cli.arguments import add_options, given_options
from dlo_calibration.cli.output import print_json, print_message, print_sentences
from dlo_calibration.errors import unwritable
from dlo_calibration.files.chain_file import read_chain_file, write_chain
from dlo_calibration.files.request import Request, TrialRequest, write_request
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.model.chain import Chain
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import plain_plan, Plan
from dlo_calibration.planning.planner import plan
from dlo_calibration.planning.rehearsal import ActionStep, in_turn
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import Attempts, make_folder, whole

PLAN = 'plan'  # begins the names of files
OF_PLACE = ('table', 'table_height', 'scene')  # options that say where the DLO lies


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('result', metavar='RESULT.xml', type=Path, help='the calibrated DLO')
    for flag, name, which in (('--from', 'start', 'where the DLO lies'),
                              ('--to', 'goal', 'where it shall lie')):
        parser.add_argument(flag, dest=name, metavar='CHAIN', type=Path, required=True, help=(
            f'{which}: a CSV file with rows x,y,z [m], first point to last, or an XML document'))
    parser.add_argument('--output', metavar='DIR', type=Path, help=(
        f'write {PLAN}.json, {PLAN}.xml (for simulate), {PLAN}.png, {PLAN}.gif, and the predicted chains '
        'after_1.csv, after_2.csv, ... to this folder'))
    parser.add_argument('--json', action='store_true', help='print one JSON document')
    add_options(parser, kind=PlanOptions, title='options of the plan')
    add_options(parser, SIMULATION, title='options of the simulation (default: those of the result)')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report.sentences import plan_sentences
    from dlo_calibration.report.terminal import PlanBar

    options = PlanOptions.of(given_options(chosen, PlanOptions))
    description = read_result(chosen.result)
    of_result = description.file_options
    for warning in of_result.warnings:
        if warning != str(of_result.refusal):
            print_message(warning)
    simulation = of_result.options(given_options(chosen))
    start, goal = read_chain_file(chosen.start), read_chain_file(chosen.goal)
    if chosen.output is not None:
        make_folder(chosen.output)  # before the search
    with StopFlag() as stop:
        with PlanBar(sys.stderr, shown=not chosen.json) as bar:
            made = plan(description, start, goal, options, simulation=simulation, on_progress=bar.take,
                        should_stop=stop, make_simulator=make_simulator)
        if stop() and not made.actions and not made.reached:
            raise KeyboardInterrupt(stop.exit_code)
        try:
            if chosen.json:  # first, as drawings take seconds
                print_json(plain_plan(made))
            else:
                print_sentences(plan_sentences(made))
        finally:  # even if stdout fails
            if chosen.output is not None:
                write_plan_files(chosen.output, made, description, simulation, make_simulator)
                print_message(f'the plan is in {chosen.output}')
    return 0


def write_plan_files(folder: Path, plan: Plan, description: Description, simulation: Options,
                     make_simulator: SimulatorFactory) -> None:
    """
    Write a plan to a folder, as far as possible; it replaces an older one.

    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    from dlo_calibration.report.plan_drawing import write_plan_animation, write_plan_picture

    _remove_older(folder)
    attempts, obstacles = Attempts(folder), obstacles_of(simulation)
    path = folder / PLAN
    with attempts.attempt(f'{PLAN}.json'), whole(path.with_suffix('.json')) as new:
        new.write_text(f'{json.dumps(plain_plan(plan), indent=2, allow_nan=False)}\n', encoding='utf-8')
    for k, action in enumerate(plan.actions, start=1):
        with attempts.attempt(f'after_{k}.csv'):
            write_chain(folder / f'after_{k}.csv', Chain(action.predicted))
    if plan.actions:
        with attempts.attempt(f'{PLAN}.xml'):
            write_request(path.with_suffix('.xml'), plan_request(plan, description, simulation))
    with attempts.attempt(f'{PLAN}.png'):
        write_plan_picture(plan, path.with_suffix('.png'), obstacles=obstacles)
    if plan.actions:
        with attempts.attempt(f'{PLAN}.gif'), closing(make_simulator(simulation)) as simulator:
            write_plan_animation(plan, simulator, Posterior.of(description).best, path.with_suffix('.gif'),
                                 obstacles=obstacles)
    attempts.require()


def plan_request(plan: Plan, description: Description, simulation: Options) -> Request:
    """Return the request to simulate the actions of a plan, at least one."""
    steps = in_turn([ActionStep(planned.action) for planned in plan.actions])
    options = {name: value for name, value in simulation.flat().items() if name in OF_PLACE}
    return Request((TrialRequest(PLAN, plan.start, tuple(step.action for step in steps), ()),),
                   FileOptions({**options, 'mass': description.mass}))


def _remove_older(folder: Path) -> None:
    """Remove the files of an older plan, which may have more actions."""
    if not (folder / f'{PLAN}.json').is_file():
        return
    chains = takewhile(Path.is_file, (folder / f'after_{k}.csv' for k in count(1)))
    for path in (*(folder / f'{PLAN}{suffix}' for suffix in ('.xml', '.gif')), *chains):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(path, error) from error
