# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Conduct: makes the missing plans of the experiment on what calibration is worth, and writes its tables."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
import functools
from pathlib import Path
from typing import Callable, Mapping, TextIO

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.experiment import worth_tables
from dlo_calibration.experiment.journal import Journal
from dlo_calibration.experiment.knowledge import Calibration, DEFAULT, Knowledge, learn, TRUE
from dlo_calibration.experiment.known_dlos import KnownDlo
from dlo_calibration.experiment.performing import perform_all
from dlo_calibration.experiment.study import Observed
from dlo_calibration.experiment.worth import execute, Planner, PlanOutcome, PlanTask
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import plan
from dlo_calibration.writing import Attempts, make_folder, whole

KNOWLEDGE, PLANS = 'knowledge.jsonl', 'plans.jsonl'  # journals in the folder of the experiment


@dataclass(frozen=True)
class WorthStudy:
    """
    What the experiment does.

    :param observed: trials of each object, on which it is calibrated.
    :param pairs: number of starts and goals of each object, from the random `seed`.
    :param workers: threads; 0: one per core.
    :param command: that repeats the experiment.
    """

    observed: Mapping[KnownDlo, Observed]
    pairs: int
    seed: int
    options: PlanOptions
    workers: int
    command: str

    def __post_init__(self) -> None:
        if self.pairs < 1:
            raise InputError('--pairs', str(self.pairs), '1 or more', 'correct it')


def conduct_worth(study: WorthStudy, folder: Path, make_simulator: SimulatorFactory,
                  stop: Callable[[], bool], note: Callable[[str], None], stream: TextIO,
                  planner: Planner = plan) -> tuple[str, Attempts]:
    """
    Make the plans that are not in `folder` yet, then write tables and a picture of all.

    :param note: called with each sentence for the user.
    :param stream: for a progress bar.
    :returns: the tables, empty if no plan is done; and the files that could not be written.
    :raises InputError: if `folder` cannot be made, or a journal cannot be read.
    """
    make_folder(folder)
    attempts = Attempts(folder)
    with closing(make_simulator(Options())) as simulator:
        engine = simulator.name
    tasks = _tasks(study, folder, make_simulator, engine, attempts, stop, note, stream)
    journal = Journal(folder / PLANS, PlanOutcome.of)
    perform_all('plans', tasks, journal,
                functools.partial(execute, make_simulator=make_simulator, planner=planner),
                study.workers, stop, note, stream)
    if journal.failure:
        attempts.fail(f'the end of {PLANS}', journal.failure)
    done = [(task, outcome) for task in tasks if (outcome := journal.find(task)) is not None]
    if not done:
        return '', attempts
    wanted = 3 * len(study.observed) * study.pairs
    text = worth_tables.markdown(done, study.command, engine, len(done) == wanted)
    for name, content in (('worth.md', text), ('worth.csv', worth_tables.courses_csv(done))):
        with attempts.attempt(name), whole(folder / name) as new:
            new.write_text(content, encoding='utf-8')
    with attempts.attempt('worth.png'):
        worth_tables.picture(done, folder / 'worth.png')
    if len(done) < wanted:
        note(f'interrupted: {len(done)} of {wanted} are done; the same command continues with the others')
    return text, attempts


def _tasks(study: WorthStudy, folder: Path, make_simulator: SimulatorFactory, engine: str,
           attempts: Attempts, stop: Callable[[], bool], note: Callable[[str], None], stream: TextIO
           ) -> list[PlanTask]:
    """Return the first pair of all objects, then the second; calibrate the objects before."""
    journal = Journal(folder / KNOWLEDGE, Knowledge.of)
    calibrations = [Calibration(dlo, observed, engine) for dlo, observed in study.observed.items()]
    perform_all('calibrations', calibrations, journal,
                functools.partial(learn, make_simulator=make_simulator), study.workers, stop, note, stream)
    if journal.failure:
        attempts.fail(f'the end of {KNOWLEDGE}', journal.failure)
    certain = replace(study.options, draws=0)  # without doubt, all draws would be the same
    found = []
    for index in range(study.pairs):
        for one in calibrations:
            fitted = journal.find(one)
            if fitted is not None:
                found.append(PlanTask(one.dlo, fitted, index, study.seed, study.options, engine))
                found += [PlanTask(one.dlo, Knowledge.without_doubt(kind, one.dlo), index, study.seed,
                                   certain, engine) for kind in (DEFAULT, TRUE)]
    return found
