# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure what calibration is worth: plans with fitted, default and true parameters, executed in reality.

    python benchmark/worth.py [--pairs N] [--objects NAME ...] [--output DIR] [--workers N]

Each of the five samples is calibrated on its trials, and gets random pairs of a start and a goal.
Reality is a finer simulation with the true properties.
Plans that DIR has already are not made again.  The tables are printed, and written to DIR.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
import sys

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.cli.output import tell
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.experiment.known_dlos import KNOWN_DLOS
from dlo_calibration.experiment.study import Observed
from dlo_calibration.experiment.worth_conduct import conduct_worth, WorthStudy
from dlo_calibration.files.samples import samples
from dlo_calibration.files.session import read_session
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.signals import StopFlag

NAMES = tuple(dlo.name for dlo in KNOWN_DLOS)


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
    study = WorthStudy(observed, chosen.pairs, chosen.seed, PlanOptions(workers=1), chosen.workers,
                       shlex.join(command))
    with StopFlag() as stop:
        text, attempts = conduct_worth(study, chosen.output, make_simulator, stop, tell, sys.stderr)
    print(text)
    attempts.require()
    return stop.exit_code if stop() else 0


if __name__ == '__main__':
    try:
        sys.exit(main())
    except DloCalibrationError as error:
        sys.exit(f'{sys.argv[0]}: {error}')
