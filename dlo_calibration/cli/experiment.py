# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `experiment`: does what is not done yet, and writes the tables and pictures."""

from __future__ import annotations

import argparse
from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
import json
from pathlib import Path
import shlex
import time
from typing import Any, Callable, Iterator, Mapping, Protocol, Sequence, TextIO

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.processes import cores, ProcessExecutor
from dlo_calibration.experiment import tables as report
from dlo_calibration.experiment.study import (
    Journal,
    judged_chains,
    Observed,
    Outcome,
    perform,
    Subject,
    Task,
    tasks,
)
from dlo_calibration.experiment.summary import complete_runs, run_score, summary
from dlo_calibration.files.samples import samples
from dlo_calibration.report.drawing import session_picture
from dlo_calibration.report.terminal import TaskBar
from dlo_calibration.search import SEARCHES

JOURNAL, SCATTER = 'calibrations.jsonl', 'parameters.png'
RUNS = 20  # the paper's
PAPER_SEARCH = 'random'
#: Options that the verb has in another form, or no use for.
NOT_AN_OPTION = ('search', 'scheduler', 'start_after_trials', 'output_directory', 'record')
#: Options that are not taken from what was recorded.
OF_A_SEARCH = ('search', 'evaluations', 'seed', 'workers', 'scheduler')
POLL = 0.1  # s
TOLD = 30.0  # s between two lines of progress where there is no terminal


class Observe(Protocol):
    """Reads a session with the options of the command line, or with those of another session."""

    def __call__(self, path: Path, of_result: Mapping[str, Any] | None = None) -> Observed:
        """Return what is in the session at `path`."""


@dataclass(frozen=True)
class Plan:
    """
    What is to be done.

    :param runs: of each subject with each search.
    :param seed: of the first run.
    :param evaluations: of a search at most, for the account.
    :param workers: processes; 0: one per core.
    :param command: that repeats it.
    :param samples: whether the subjects are the package's samples.
    """

    subjects: tuple[Subject, ...]
    searches: tuple[str, ...]
    runs: int
    seed: int
    evaluations: int
    workers: int
    command: str
    samples: bool

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise InputError('--runs', str(self.runs), '1 or more', 'correct it')
        if not self.searches:
            raise InputError('--search', 'no name', f'one or more of {", ".join(SEARCHES)}', 'name one')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb understands, beside the options."""
    parser.add_argument('sessions', metavar='SESSION', type=Path, nargs='*',
                        help='one of each object; default: the five samples of the package')
    parser.add_argument('--runs', metavar='N', type=int, default=RUNS,
                        help='calibrations of each object with each search, with one seed after the other '
                             f'(default: {RUNS})')
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


def planned(chosen: argparse.Namespace, given: Mapping[str, Any], program: Sequence[str],
            flags: Sequence[str], observe: Observe) -> Plan:
    """
    Return what a command line asks for.

    :param given: options that it sets.
    :param program: the command's first words.
    :param flags: its words that set `given`.
    :raises InputError: where that cannot be done.
    """
    default = Options().flat()
    fixed = {name: given.get(name, default[name]) for name in OF_A_SEARCH}
    searches = tuple(dict.fromkeys(name for word in chosen.search for name in word.split(',') if name))
    for name in searches:
        Options.of({'search': name})
    paths = chosen.sessions or sorted(path for path in samples().glob('object*') if path.is_dir())
    others = chosen.validate_on or []
    if others and len(others) != len(paths):
        raise InputError('--validate-on', f'{len(others)} session(s)', f'one for each of the {len(paths)} '
                         'session(s) that are calibrated on', 'name as many, in the same order')

    def observed(path: Path, of_result: Mapping[str, Any] | None = None) -> Observed:
        found = observe(path, of_result)
        return Observed(found.trials, Options.of({**found.options.flat(), **fixed}))

    subjects = []
    for k, (name, path) in enumerate(zip(_names(paths), paths, strict=True)):
        own = observed(path)
        held = () if others else tuple(one - 1 for one in dict.fromkeys(
            chosen.held_back or range(1, len(own.trials) + 1)))
        subjects.append(Subject(name, own, held, observed(others[k], own.options.flat()) if others else None))
    words = [*program, *map(str, chosen.sessions), '--runs', str(chosen.runs), '--search', ','.join(searches)]
    words += ['--held-back', *map(str, chosen.held_back)] if chosen.held_back else []
    words += ['--validate-on', *map(str, others)] if others else []
    options = subjects[0].observed.options
    return Plan(tuple(subjects), searches, chosen.runs, options.seed, options.evaluations, options.workers,
                shlex.join([*words, *flags]), samples=not chosen.sessions)


def _names(paths: Sequence[Path]) -> list[str]:
    """Name the objects after their sessions; one whose name is taken gets a number."""
    names = [path.stem if path.suffix in ('.mcap', '.db3', '.xml') else path.resolve().name
             for path in paths]
    return [name if name not in names[:k] else f'{name}_{names[:k].count(name) + 1}'
            for k, name in enumerate(names)]


def act(plan: Plan, folder: Path, make_simulator: SimulatorFactory, stop: Callable[[], bool],
        note: Callable[[str], None], stream: TextIO) -> report.Account | None:
    """
    Do the calibrations that `folder` has no outcome of, then write tables and pictures of all.

    Where it is stopped, they are of what is done.

    :param stream: for a progress bar.
    :returns: None where nothing is done.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'folder {folder}', str(error), 'a folder that can be written to',
                         'choose another one with --output') from error
    journal = Journal(folder / JOURNAL)
    engines = {subject.name: _engine(subject, make_simulator) for subject in plan.subjects}
    wanted = list(tasks(plan.subjects, plan.searches, plan.runs, plan.seed, engines))
    _do([task for task in wanted if journal.find(task) is None], len(wanted), plan.workers, journal,
        make_simulator, stop, note, stream)
    done = [(task, outcome) for task in wanted if (outcome := journal.find(task)) is not None]
    groups = [group for subject in plan.subjects for search in plan.searches
              if complete_runs(group := [one for one in done if one[0].subject is subject
                                         and one[0].search == search])]
    if not groups:
        return None
    account = report.Account(
        tuple(summary(group) for group in groups), plan.command, ', '.join(dict.fromkeys(engines.values())),
        plan.runs, plan.evaluations, plan.samples,
        complete=len(done) == len(wanted))
    for name, text in (
            ('experiment.md', report.markdown(account)),
            ('experiment.json', json.dumps(report.document(account), indent=2, allow_nan=False) + '\n'),
            ('consistency.csv', report.consistency_csv(account)),
            ('validity.csv', report.validity_csv(account)), ('calibrations.csv', report.runs_csv(done))):
        _write(folder / name, text)
    report.scatter_picture(groups, folder / SCATTER)
    for group in groups:
        _draw(group, folder, make_simulator)
    note(f'tables and pictures are in {folder}')
    if not account.complete:
        note(f'interrupted: {len(done)} of {len(wanted)} calibrations are done; '
             'the same command goes on from there')
    return account


def _engine(subject: Subject, make_simulator: SimulatorFactory) -> str:
    with closing(make_simulator(subject.observed.options)) as simulator:
        simulator.prepare()  # the processes find it compiled
        return simulator.name


def _do(waiting: Sequence[Task], total: int, workers: int, journal: Journal,
        make_simulator: SimulatorFactory, stop: Callable[[], bool], note: Callable[[str], None],
        stream: TextIO) -> None:
    """Do tasks, each in one process, and write down each as it is done."""
    if not waiting:
        return
    if len(waiting) < total:
        note(f'{total - len(waiting)} of {total} calibrations are done already')
    begun = told = time.monotonic()
    with TaskBar('calibrations', total, total - len(waiting), stream) as bar:
        outcomes = _outcomes(waiting, min(workers or cores(), len(waiting)), make_simulator, stop, note)
        for count, (task, outcome) in enumerate(outcomes, start=1):
            journal.add(task, outcome)
            bar.advance()
            now = time.monotonic()
            if not bar.shown and now - told > TOLD:
                told = now
                left = (now - begun) / count * (len(waiting) - count)
                note(f'{total - len(waiting) + count} of {total} calibrations; {left:.0f} s left')


def _outcomes(waiting: Sequence[Task], workers: int, make_simulator: SimulatorFactory,
              stop: Callable[[], bool], note: Callable[[str], None]) -> Iterator[tuple[Task, Outcome]]:
    """Yield tasks as they are done; end early when stopped."""
    if workers == 1:
        for task in waiting:
            try:
                yield task, perform(task, make_simulator, stop)
            except CancelledError:
                return
        return
    with _executor(workers, note) as executor:
        futures: dict[Future[Outcome], Task] = {
            executor.submit(perform, task, make_simulator): task for task in waiting}
        while futures and not stop():
            for future in wait(futures, POLL, FIRST_COMPLETED).done:
                yield futures.pop(future), future.result()


@contextmanager
def _executor(workers: int, note: Callable[[str], None]) -> Iterator[ProcessExecutor]:
    executor = ProcessExecutor(workers, note)
    try:
        yield executor
    finally:
        executor.close()


def _draw(group: Sequence[tuple[Task, Outcome]], folder: Path, make_simulator: SimulatorFactory) -> None:
    """Draw the actions that a run is judged by, of the run whose score is the median."""
    scored = sorted(((score, found) for found in complete_runs(group)
                     if (score := run_score(found)) is not None), key=lambda one: one[0])
    if not scored:
        return
    _, found = scored[(len(scored) - 1) // 2]
    shown = [one for task, outcome in found if not outcome.failure
             for one in judged_chains(task, outcome, make_simulator)]
    if shown:
        trials, chains = zip(*shown, strict=True)
        session_picture(trials, chains, folder / f'{group[0][0].subject.name}_{group[0][0].search}.png')


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise InputError(f'file {path}', str(error), 'a place that can be written to',
                         'choose another one with --output') from error
