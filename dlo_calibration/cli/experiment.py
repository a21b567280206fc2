# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `experiment`: repeats the experiment of the paper, and prints its tables."""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
import sys
from typing import Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import FileOptions, MACHINE, names_of, Options, recordable
from dlo_calibration.cli.arguments import add_common_arguments, add_options, given_options, selected
from dlo_calibration.cli.output import print_json, print_message, standard_output
from dlo_calibration.errors import InputError, printable
from dlo_calibration.experiment import tables
from dlo_calibration.experiment.conduct import conduct
from dlo_calibration.experiment.journal import Laboratory
from dlo_calibration.experiment.study import Observed, Study, Subject
from dlo_calibration.files.session import samples
from dlo_calibration.search import SEARCHES
from dlo_calibration.signals import StopFlag
from dlo_calibration.workspace.source import read_source

#: Options that come from the command line alone, so that they are the same for all objects.
SAME_FOR_ALL = ('search', 'evaluations', 'seed', *names_of(MACHINE))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('sessions', metavar='SESSION', type=Path, nargs='*',
                        help='one session per object (default: the five samples of the package)')
    parser.add_argument('--runs', metavar='N', type=int, default=20,
                        help='calibrations of each object with each search, each with its own seed '
                             '(default: %(default)s, as in the paper)')
    default = Options().search
    parser.add_argument('--search', metavar='NAME', nargs='+', default=['random', default],
                        help=f'one or more of {", ".join(SEARCHES)} '
                             f'(default: random, as in the paper, and {default})')
    judged = parser.add_mutually_exclusive_group()
    judged.add_argument('--held-back', metavar='K', type=int, nargs='+',
                        help='numbers of the trials to cross-validate with: each is left out in turn, and '
                             'simulated with the parameters that the others give (default: all)')
    judged.add_argument('--validate-on', metavar='SESSION', type=Path, nargs='+',
                        help='leave no trial out, but simulate the trials of these sessions with the '
                             'parameters found; one for each SESSION that is calibrated on')
    parser.add_argument('--output', metavar='DIR', type=Path, default=Path('experiment_output'),
                        help='folder for all files; calibrations that it has already are not repeated '
                             '(default: %(default)s)')
    add_common_arguments(parser)
    # `--search` is declared above; of the machine's options, only `workers` has an effect here.
    add_options(parser, {*recordable(Options().flat()), 'workers'} - {'search'})


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    study = _study(chosen)
    with StopFlag() as stop:
        workers = Options.of(given_options(chosen)).workers
        laboratory = Laboratory(chosen.output, workers, stop, print_message, sys.stderr)
        account = conduct(study, laboratory, make_simulator)
    if account is None:
        laboratory.attempts.require()
        raise KeyboardInterrupt(stop.exit_code)
    if chosen.json:
        print_json(tables.document(account))
    else:
        with standard_output() as stream:
            stream.write(tables.markdown(account))
    laboratory.attempts.require()
    return 0 if account.complete else stop.exit_code


def _study(chosen: argparse.Namespace) -> Study:
    """
    Return the experiment that a command line asks for.

    :raises InputError: if sessions, trial numbers or searches cannot be used.
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
        held = () if others else tuple(number - 1 for number in dict.fromkeys(
            chosen.held_back or range(1, len(own.trials) + 1)))
        judges = _observed(chosen, others[k], FileOptions(own.options.flat())) if others else None
        subjects.append(Subject(name, own, held, judges))
    options = subjects[0].observed.options
    return Study(tuple(subjects), searches, chosen.runs, options.seed, _command(chosen, searches),
                 samples=not chosen.sessions)


def _observed(chosen: argparse.Namespace, path: Path, of_result: FileOptions | None = None) -> Observed:
    """Return the trials of a session, with the options to use on them."""
    source = read_source(selected(chosen, path), lambda text: print_message(f'{path}: {text}'), of_result)
    same = {**Options().flat(), **given_options(chosen)}
    return Observed(source.require_trials().trials, Options.of({**source.options.flat(),
                                               **{name: same[name] for name in SAME_FOR_ALL}}))


def _command(chosen: argparse.Namespace, searches: Sequence[str]) -> str:
    """Return the command that repeats an experiment."""
    from dlo_calibration.report.page import as_flags

    words = ['dlo-calibration', 'experiment', *map(str, chosen.sessions), '--runs', str(chosen.runs),
             '--search', ','.join(searches)]
    words += [word for text in chosen.remap for word in ('--remap', text)]
    words += ['--held-back', *map(str, chosen.held_back)] if chosen.held_back else []
    words += ['--validate-on', *map(str, chosen.validate_on)] if chosen.validate_on else []
    words += [flag for name, value in given_options(chosen).items() for flag in as_flags(name, value)]
    return shlex.join(words)


def _names(paths: Sequence[Path]) -> list[str]:
    """Name the objects after their sessions; a repeated name gets a number."""
    names = [printable(path.stem if path.suffix in ('.mcap', '.db3', '.xml') else path.resolve().name)
             for path in paths]
    return [name if name not in names[:k] else f'{name}_{names[:k].count(name) + 1}'
            for k, name in enumerate(names)]
