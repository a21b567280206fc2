# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `experiment`: repeats the paper's experiment, and prints its tables."""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
import sys
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import MACHINE, names_of, Options
from dlo_calibration.cli.options import add_options, given_options
from dlo_calibration.cli.output import INTERRUPTED, print_json, tell
from dlo_calibration.cli.source import read_source
from dlo_calibration.errors import InputError
from dlo_calibration.experiment import tables
from dlo_calibration.experiment.conduct import conduct, Plan
from dlo_calibration.experiment.study import Observed, Subject
from dlo_calibration.files.samples import samples
from dlo_calibration.search import SEARCHES
from dlo_calibration.signals import StopFlag

TEXT = "repeat the paper's experiment: how consistent found parameters are, and how valid"
PAPER_RUNS, PAPER_SEARCH = 20, 'random'
#: Options that are not taken from what was recorded, so that all objects are searched alike.
SAME_FOR_ALL = ('search', 'evaluations', 'seed', *names_of(MACHINE))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb understands."""
    parser.add_argument('sessions', metavar='SESSION', type=Path, nargs='*',
                        help='one of each object; default: the five samples of the package')
    parser.add_argument('--runs', metavar='N', type=int, default=PAPER_RUNS,
                        help='calibrations of each object with each search, with one seed after the other '
                             f'(default: {PAPER_RUNS})')
    default = Options().search
    parser.add_argument('--search', metavar='NAME', nargs='+', default=[PAPER_SEARCH, default],
                        help=f'one or more of {", ".join(SEARCHES)} '
                             f"(default: {PAPER_SEARCH}, which is the paper's, and {default})")
    judged = parser.add_mutually_exclusive_group()
    judged.add_argument('--held-back', metavar='K', type=int, nargs='+',
                        help='numbers of the trials that are left out in turn and simulated with what the '
                             'others gave (default: all)')
    judged.add_argument('--validate-on', metavar='SESSION', type=Path, nargs='+',
                        help='simulate the trials of these with what the sessions gave, one for each '
                             'SESSION; nothing is left out then')
    parser.add_argument('--output', metavar='DIR', type=Path, default=Path('experiment_output'),
                        help='folder of all files; what is found done there is not done again '
                             '(default: experiment_output)')
    parser.add_argument('--namespace', help='of the topics, where a session holds several')
    parser.add_argument('--json', action='store_true', help='print one JSON document')
    # A flag of its own is in place of `search`; of the machine's options, only the processes count here.
    add_options(parser, without=['search', *(name for name in names_of(MACHINE) if name != 'workers')])


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Do what the verb says; return the exit code."""
    plan = _plan(chosen)
    with StopFlag() as stop:
        account = conduct(plan, chosen.output, make_simulator, stop, tell, sys.stderr)
    if account is None:
        raise KeyboardInterrupt
    if chosen.json:
        print_json(tables.document(account), sys.stdout)
    else:
        sys.stdout.write(tables.markdown(account))
    return 0 if account.complete else INTERRUPTED


def _plan(chosen: argparse.Namespace) -> Plan:
    """
    Return what a command line asks for.

    :raises InputError: where that cannot be done.
    """
    searches = tuple(dict.fromkeys(name for word in chosen.search for name in word.split(',') if name))
    for name in searches:
        Options.of({'search': name})
    paths = chosen.sessions or sorted(path for path in samples().glob('object*') if path.is_dir())
    others = chosen.validate_on or []
    if others and len(others) != len(paths):
        raise InputError('--validate-on', f'{len(others)} session(s)', f'one for each of the {len(paths)} '
                         'session(s) that are calibrated on', 'name as many, in the same order')
    subjects = []
    for k, (name, path) in enumerate(zip(_names(paths), paths, strict=True)):
        own = _observed(chosen, path)
        held = () if others else tuple(one - 1 for one in dict.fromkeys(
            chosen.held_back or range(1, len(own.trials) + 1)))
        judges = _observed(chosen, others[k], own.options.flat()) if others else None
        subjects.append(Subject(name, own, held, judges))
    options = subjects[0].observed.options
    return Plan(tuple(subjects), searches, chosen.runs, options.seed, options.evaluations, options.workers,
                _command(chosen, searches), samples=not chosen.sessions)


def _observed(chosen: argparse.Namespace, path: Path, of_result: Mapping[str, Any] | None = None) -> Observed:
    """Return what is in a session, with the options to use on it."""
    source = read_source(chosen, lambda text: tell(f'{path}: {text}'), of_result, path).require_trials()
    same = {**Options().flat(), **given_options(chosen)}
    return Observed(source.trials, Options.of({**source.options.flat(),
                                               **{name: same[name] for name in SAME_FOR_ALL}}))


def _command(chosen: argparse.Namespace, searches: Sequence[str]) -> str:
    """Return the command that repeats an experiment."""
    from dlo_calibration.report.page import as_flags

    words = ['dlo-calibration', 'experiment', *map(str, chosen.sessions), '--runs', str(chosen.runs),
             '--search', ','.join(searches)]
    words += ['--held-back', *map(str, chosen.held_back)] if chosen.held_back else []
    words += ['--validate-on', *map(str, chosen.validate_on)] if chosen.validate_on else []
    words += [flag for name, value in given_options(chosen).items() for flag in as_flags(name, value)]
    return shlex.join(words)


def _names(paths: Sequence[Path]) -> list[str]:
    """Name the objects after their sessions; one whose name is taken gets a number."""
    names = [path.stem if path.suffix in ('.mcap', '.db3', '.xml') else path.resolve().name
             for path in paths]
    return [name if name not in names[:k] else f'{name}_{names[:k].count(name) + 1}'
            for k, name in enumerate(names)]
