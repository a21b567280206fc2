# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure what calibration is worth: plans with fitted, default and true parameters, executed in reality.

    python benchmark/worth.py [--pairs N] [--objects NAME ...] [--output DIR] [--workers N]

Each of the five samples is calibrated on its trials, and gets random pairs of a start and a goal.
Reality is a finer simulation with the true properties.
Plans that are already in DIR are not made again.  The tables are printed, and written to DIR.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import dataclass, replace
import functools
from pathlib import Path
import shlex
import sys
from typing import Mapping

from plan_executions import (
    Belief,
    CalibrationTask,
    DEFAULT,
    execute,
    learn,
    Planner,
    PlanOutcome,
    PlanTask,
    TRUE,
)
from reality import KNOWN_DLOS, KnownDlo
import worth_tables

from dlo_calibration.calibration.engines import make_simulator, SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli.output import print_message
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.experiment.journal import Journal, Laboratory
from dlo_calibration.experiment.study import Observed
from dlo_calibration.files.session import read_session, samples
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import plan
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import whole

NAMES = tuple(dlo.name for dlo in KNOWN_DLOS)
BELIEFS, PLANS = 'knowledge.jsonl', 'plans.jsonl'  # journals in the folder of the experiment


@dataclass(frozen=True)
class WorthStudy:
    """
    The plan of the experiment.

    :param observed: trials of each object, on which it is calibrated.
    :param pairs: number of starts and goals of each object, from the random `seed`.
    :param command: that repeats the experiment.
    """

    observed: Mapping[KnownDlo, Observed]
    pairs: int
    seed: int
    options: PlanOptions
    command: str

    def __post_init__(self) -> None:
        if self.pairs < 1:
            raise InputError('--pairs', str(self.pairs), '1 or more', 'correct it')


def conduct_worth(study: WorthStudy, laboratory: Laboratory, make_simulator: SimulatorFactory,
                  planner: Planner = plan) -> str:
    """
    Make the plans that the laboratory lacks, then write tables and a picture of all.

    :returns: the tables; empty if no plan is done.
    :raises InputError: if a journal cannot be read.
    """
    folder, attempts = laboratory.folder, laboratory.attempts
    with closing(make_simulator(Options())) as simulator:
        engine = simulator.name
    done = laboratory.outcomes(
        'plans', _tasks(study, laboratory, make_simulator, engine), Journal(folder / PLANS, PlanOutcome.of),
        functools.partial(execute, make_simulator=make_simulator, planner=planner))
    if not done:
        return ''
    wanted = 3 * len(study.observed) * study.pairs
    text = worth_tables.markdown(done, study.command, engine, len(done) == wanted)
    for name, content in (('worth.md', text), ('worth.csv', worth_tables.executions_csv(done))):
        with attempts.attempt(name), whole(folder / name) as new:
            new.write_text(content, encoding='utf-8')
    with attempts.attempt('worth.png'):
        worth_tables.picture(done, folder / 'worth.png')
    if len(done) < wanted:
        laboratory.report(
            f'interrupted: {len(done)} of {wanted} are done; the same command continues with the others')
    return text


def _tasks(study: WorthStudy, laboratory: Laboratory, make_simulator: SimulatorFactory, engine: str
           ) -> list[PlanTask]:
    """Calibrate the objects; return the first pair of all objects, then the second."""
    fitted = laboratory.outcomes(
        'calibrations', [CalibrationTask(dlo, observed, engine) for dlo, observed in study.observed.items()],
        Journal(laboratory.folder / BELIEFS, Belief.of),
        functools.partial(learn, make_simulator=make_simulator))
    certain = replace(study.options, draws=0)  # without uncertainty, all draws would be the same
    tasks = []
    for index in range(study.pairs):
        for calibration, belief in fitted:
            dlo = calibration.dlo
            tasks.append(PlanTask(dlo, belief, index, study.seed, study.options, engine))
            tasks += [PlanTask(dlo, Belief.certain(kind, dlo), index, study.seed, certain, engine)
                      for kind in (DEFAULT, TRUE)]
    return tasks


def main() -> int:
    """Make the tables; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--pairs', type=int, default=20, help='of each object (default: %(default)s)')
    parser.add_argument('--objects', nargs='+', choices=NAMES, default=NAMES)
    parser.add_argument('--seed', type=int, default=1, help='of the pairs (default: %(default)s)')
    parser.add_argument('--output', type=Path, default=Path('experiment_output'),
                        help='folder for all files (default: %(default)s)')
    parser.add_argument('--workers', type=int, default=0, help='processes; 0: one per core')
    chosen = parser.parse_args()
    observed = {}
    for dlo in KNOWN_DLOS:
        if dlo.name in chosen.objects:
            session = read_session(samples() / dlo.name)
            observed[dlo] = Observed(session.trials, session.options)
    command = ['python', 'benchmark/worth.py', '--pairs', str(chosen.pairs), '--seed', str(chosen.seed)]
    command += [] if len(observed) == len(NAMES) else ['--objects', *chosen.objects]
    study = WorthStudy(observed, chosen.pairs, chosen.seed, PlanOptions(workers=1), shlex.join(command))
    with StopFlag() as stop:
        laboratory = Laboratory(chosen.output, chosen.workers, stop, print_message, sys.stderr)
        text = conduct_worth(study, laboratory, make_simulator)
    print(text)
    laboratory.attempts.require()
    return stop.exit_code if stop() else 0


if __name__ == '__main__':
    try:
        sys.exit(main())
    except DloCalibrationError as error:
        sys.exit(f'{sys.argv[0]}: {error}')
