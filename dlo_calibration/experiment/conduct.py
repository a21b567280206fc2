# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""conduct(): perform the missing calibrations of an experiment, and write its tables and pictures."""

from __future__ import annotations

from contextlib import closing
import functools
import json
from operator import itemgetter
from pathlib import Path
from typing import Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.experiment import tables
from dlo_calibration.experiment.journal import Journal, Laboratory
from dlo_calibration.experiment.study import judged_chains, Outcome, perform, Study, Subject, Task
from dlo_calibration.experiment.summary import complete_runs, run_score, summary
from dlo_calibration.report.drawing import session_picture
from dlo_calibration.writing import Attempts, whole

JOURNAL = 'calibrations.jsonl'  # in the folder of an experiment


def conduct(study: Study, laboratory: Laboratory, make_simulator: SimulatorFactory) -> tables.Account | None:
    """
    Perform the calibrations whose outcome the laboratory lacks, then write tables and pictures of all.

    If it is stopped, or outcomes cannot be written, tables and pictures show the runs that are complete.

    :returns: the content of the tables; None if no run is complete.
    :raises InputError: if the journal cannot be read.
    """
    engines = {subject.name: _engine(subject, make_simulator) for subject in study.subjects}
    wanted = list(study.tasks(engines))
    done = laboratory.outcomes('calibrations', wanted, Journal(laboratory.folder / JOURNAL, Outcome.of),
                               functools.partial(perform, make_simulator=make_simulator))
    groups = [group for subject in study.subjects for search in study.searches
              if complete_runs(group := [(task, outcome) for task, outcome in done
                                         if task.subject is subject and task.search == search])]
    if not groups:
        return None
    account = tables.Account(
        tuple(summary(group) for group in groups), study.command, ', '.join(dict.fromkeys(engines.values())),
        study.runs, study.evaluations, study.samples, complete=len(done) == len(wanted))
    _write_all(account, groups, done, make_simulator, laboratory.attempts)
    if not laboratory.attempts.failure:
        laboratory.report(f'tables and pictures are in {laboratory.folder}')
    if not account.complete:
        laboratory.report(f'interrupted: {len(done)} of {len(wanted)} calibrations are done; '
                          'the same command continues with the others')
    return account


def _engine(subject: Subject, make_simulator: SimulatorFactory) -> str:
    """Return the name of the engine that simulates an object."""
    with closing(make_simulator(subject.observed.options)) as simulator:
        return simulator.name


def _write_all(account: tables.Account, groups: Sequence[Sequence[tuple[Task, Outcome]]],
               done: Sequence[tuple[Task, Outcome]], make_simulator: SimulatorFactory, attempts: Attempts
               ) -> None:
    """Write tables and pictures."""
    folder = attempts.folder
    for name, text in (
            ('experiment.md', tables.markdown(account)),
            ('experiment.json', json.dumps(tables.document(account), indent=2, allow_nan=False) + '\n'),
            ('consistency.csv', tables.consistency_csv(account)),
            ('validity.csv', tables.validity_csv(account)), ('calibrations.csv', tables.runs_csv(done))):
        with attempts.attempt(name), whole(folder / name) as new:
            new.write_text(text, encoding='utf-8')
    with attempts.attempt('parameters.png'):
        tables.scatter_picture(groups, folder / 'parameters.png')
    for group in groups:
        name = f'{group[0][0].subject.name}_{group[0][0].search}.png'
        with attempts.attempt(name):
            _draw(group, folder / name, make_simulator)


def _draw(group: Sequence[tuple[Task, Outcome]], path: Path, make_simulator: SimulatorFactory) -> None:
    """Draw the trials that judge a run, for the run with the median score."""
    scored = sorted(((score, run) for run in complete_runs(group)
                     if (score := run_score(run)) is not None), key=itemgetter(0))
    if not scored:
        return
    _, run = scored[(len(scored) - 1) // 2]
    shown = [pair for task, outcome in run if not outcome.failure
             for pair in judged_chains(task, outcome, make_simulator)]
    if shown:
        trials, chains = zip(*shown, strict=True)
        session_picture(trials, chains, path)
