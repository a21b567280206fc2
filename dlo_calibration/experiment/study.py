# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Study: the calibrations that answer the paper's two questions.

Consistency: does a calibration find the same parameters with every random seed?
Validity: do the parameters explain an action that was not calibrated on?  (Alvarez, Yamazaki
and Matsubara, tables 1 and 2.)
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
import functools
import hashlib
import json
from pathlib import Path
from typing import Any, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.declaration import MACHINE
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.trial import Trial

#: Folders whose code cannot change what a calibration finds.
SHOWING = ('cli', 'report', 'ros')


@dataclass(frozen=True)
class Observed:
    """
    The trials of a DLO, and the options to simulate them with.

    :param options: if `calibrate` is auto, all trials decide it, so that each calibration finds the same
        parameters, whichever trial is left out.
    """

    trials: tuple[Trial, ...]
    options: Options

    def __post_init__(self) -> None:
        object.__setattr__(self, 'options', replace(
            choose(self.trials, self.options).options, evaluations=self.options.evaluations))

    def options_of(self, search: str, seed: int) -> Options:
        """Return the options of a calibration; each search has a number of evaluations of its own."""
        return choose(self.trials, replace(self.options, search=search, seed=seed)).options


@dataclass(frozen=True)
class Subject:
    """
    One object of the experiment.

    :param name: for tables and files; unique.
    :param observed: the trials that it is calibrated on.
    :param held_back: indices of the trials that are left out in turn, each to judge one calibration.
    :param others: trials that judge every calibration, and are in none; None: there are none.
    """

    name: str
    observed: Observed
    held_back: tuple[int, ...]
    others: Observed | None = None

    def __post_init__(self) -> None:
        count = len(self.observed.trials)
        for index in self.held_back:
            if not 0 <= index < count:
                raise InputError('--held-back', str(index + 1), f'1 to {count}, the trials of {self.name}',
                                 'correct the number')  # counted from 1, as the trials' names are
        if self.held_back and count < 2:
            raise InputError(f'session {self.name}', 'one trial', 'at least two, one of which is held back',
                             'record more actions, or judge by another session with --validate-on')


@dataclass(frozen=True)
class Task:
    """
    One calibration of an object.

    :param engine: name of the simulator that will be used.
    :param left_out: index of the trial that is left out and judges it; None: the subject's `others`
        judge it, if there are any.
    """

    subject: Subject
    search: str
    seed: int
    engine: str
    left_out: int | None = None

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The trials that are calibrated on."""
        return tuple(trial for k, trial in enumerate(self.subject.observed.trials) if k != self.left_out)

    @property
    def options(self) -> Options:
        """The options of the calibration."""
        return self.subject.observed.options_of(self.search, self.seed)

    @property
    def judges(self) -> Observed:
        """The trials that judge it; there may be none."""
        if self.left_out is not None:
            return Observed((self.subject.observed.trials[self.left_out],), self.options)
        return self.subject.others or Observed((), self.options)

    @property
    def about(self) -> dict[str, Any]:
        """Plain values that tell a reader of the journal which calibration it is."""
        return {'object': self.subject.name, 'search': self.search, 'seed': self.seed, 'engine': self.engine,
                'left_out': None if self.left_out is None else self.left_out + 1}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on: tasks with the same key have the same outcome."""
        judges = self.judges
        return digest(self.engine, self.trials, effective(self.options), judges.trials,
                      effective(judges.options))


def tasks(subjects: Sequence[Subject], searches: Sequence[str], runs: int, seed: int,
          engines: Mapping[str, str]) -> Iterator[Task]:
    """
    Yield all calibrations of an experiment: the first run of every subject and search, then the second.

    :param seed: of the first run; each further run adds one.
    :param engines: name of the simulator, by the subject's name.
    """
    for run in range(runs):
        for subject in subjects:
            for search in searches:
                for left_out in (None, *subject.held_back):
                    yield Task(subject, search, seed + run, engines[subject.name], left_out)


def digest(*about: Any) -> str:
    """Return a digest of dataclasses, arrays and plain values, and of the source code of the package."""
    return hashlib.sha256(json.dumps(_plain([_sources(), *about]), sort_keys=True).encode()).hexdigest()


def effective(options: Options) -> dict[str, Any]:
    """Return the options that can change what a calibration finds."""
    of_the_machine = names_of(MACHINE)
    return {name: value for name, value in options.flat().items() if name not in of_the_machine}


def _plain(value: Any) -> Any:
    """Convert a value to types that JSON has; numbers keep every digit."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value


@functools.cache
def _sources() -> str:
    """Return a digest of the source code: other code may find other parameters."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for file in sorted(folder.rglob('*.py')):
        if file.relative_to(folder).parts[0] not in SHOWING:
            digest.update(f'{file.relative_to(folder)}\n'.encode() + file.read_bytes())
    return digest.hexdigest()
