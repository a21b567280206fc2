# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `plan`: finds actions that bring a calibrated DLO from one configuration to another."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli.options import add_options, given_options
from dlo_calibration.cli.output import print_json, standard_output, tell
from dlo_calibration.cli.plan_files import PLAN, write_plan_files
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plain import plain_plan
from dlo_calibration.planning.plan import Plan
from dlo_calibration.planning.planner import plan
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import make_folder

#: The options that a simulation needs.
SIMULATION = ('engine', 'table', 'table_height', 'scene', 'nodes', 'time_step', 'stable_distance',
              'stable_time', 'settle_limit', 'answer_limit')


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
    add_options(parser, without=[one.name for one in Options.declarations() if one.name not in SIMULATION],
                title='options of the simulation (default: those of the result)')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report.plan_sentences import plan_sentences
    from dlo_calibration.report.terminal import PlanBar

    options = PlanOptions.of(given_options(chosen, PlanOptions))
    found = read_result(chosen.result)
    simulation = _simulation(chosen, found)
    start, goal = read_chain_file(chosen.start), read_chain_file(chosen.goal)
    if chosen.output is not None:
        make_folder(chosen.output)  # before the search
    with StopFlag() as stop:
        with PlanBar(sys.stderr, shown=not chosen.json) as bar:
            made = plan(found, start, goal, options, simulation=simulation, on_progress=bar.take,
                        should_stop=stop, make_simulator=make_simulator)
        if stop() and not made.actions and not made.reached:
            raise KeyboardInterrupt(stop.exit_code)
        try:
            _print(made, plan_sentences(made), chosen.json)  # first, as drawings take seconds
        finally:  # whatever becomes of the output
            if chosen.output is not None:
                write_plan_files(chosen.output, made, found, simulation, make_simulator)
                tell(f'the plan is in {chosen.output}')
    return 0


def _simulation(chosen: argparse.Namespace, found: Description) -> Options:
    """Return the options of the simulation: those of the result, where no flag says otherwise."""
    given, of_result = given_options(chosen), found.file_options
    for text in of_result.problems:
        if text != str(of_result.refusal):
            tell(text)
    if of_result.refusal is not None and 'scene' not in given:
        raise of_result.refusal
    return Options.of({**of_result.values, **given})


def _print(made: Plan, sentences: list[str], as_json: bool) -> None:
    """Print a plan on stdout."""
    if as_json:
        print_json(plain_plan(made))
        return
    from dlo_calibration.report.terminal import console, escape

    with standard_output() as stream:
        out = console(stream)
        for sentence in sentences:
            out.print(escape(sentence))
