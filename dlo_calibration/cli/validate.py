# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `validate`: simulates trials with the parameters of a result, without fitting."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
import time
from typing import Sequence

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains
from dlo_calibration.calibration.stages import confirmed
from dlo_calibration.cli.arguments import add_source, read_result_file, selected
from dlo_calibration.cli.output import print_message, print_result
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.files.result import Description
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.observation.plausibility import implausible_trials
from dlo_calibration.workspace.source import read_source


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
    print_result(confirmed(result, source.options, make_simulator), chosen.json)
    return 0


def validated(file: Description, trials: Sequence[Trial], options: Options,
              make_simulator: SimulatorFactory = make_chosen_simulator) -> CalibrationResult:
    """
    Simulate trials with the parameters of a result, without fitting.

    :returns: a result whose only evaluation has these parameters; values and intervals are those of `file`.
    :raises SimulationError: if a trial cannot be simulated.
    """
    trials = with_shared_places(trials)
    with closing(make_simulator(options)) as simulator:
        begun = time.monotonic()
        evaluation = Evaluator(trials, file.space, simulator).evaluate(0, file.space.point(file.values))
        seconds = time.monotonic() - begun
    if evaluation.failure:
        raise SimulationError(evaluation.failure)
    implausible = implausible_trials(trials, options.table_top, bool(options.scene))
    warnings = (*implausible, *(f'never came to rest: {name}; the last state was compared'
                           for name in evaluation.unsettled))
    return CalibrationResult(
        space=file.space, estimates=file.parameters, best=evaluation, trials=trials,
        chains=simulated_chains(trials, evaluation), evaluations=(evaluation,),
        seconds=seconds, search=file.search, engine=simulator.name,
        stop_reason='validation: nothing was fitted', seed=file.seed, warnings=warnings,
        implausible=implausible, unusable_fit=file.unusable)
