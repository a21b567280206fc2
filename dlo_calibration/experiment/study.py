# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Study: which calibrations the paper's two questions take.

Consistency: does a calibration find the same parameters whatever the random seed is?
Validity: do they explain an action that was not calibrated on?  (Alvarez, Yamazaki
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

from dlo_calibration.calibration.options import MACHINE, names_of, Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.trial import Trial

#: Rooms that only show what others found: a change there makes no calibration obsolete.
SHOWING = ('cli', 'report', 'ros')


@dataclass(frozen=True)
class Observed:
    """Trials of a DLO, and the options to simulate them with."""

    trials: tuple[Trial, ...]
    options: Options


@dataclass(frozen=True)
class Subject:
    """
    One object of the experiment.

    :param name: for tables and files; unique.
    :param observed: what it is calibrated on.
    :param held_back: indices of trials that are left out of a calibration in turn, to judge it by.
    :param others: trials that no calibration sees, to judge it by; None: there are none.
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
                                 'correct the number')
        if self.held_back and count < 2:
            raise InputError(f'session {self.name}', 'one trial', 'at least two, one of which is held back',
                             'record more actions, or judge by another session with --validate-on')


@dataclass(frozen=True)
class Task:
    """
    One calibration of an object.

    :param engine: name of the simulator that will do it.
    :param left_out: index of the trial that it is judged by; None: none is left out,
        and it is judged by the subject's `others`, if there are any.
    """

    subject: Subject
    search: str
    seed: int
    engine: str
    left_out: int | None = None

    @property
    def trials(self) -> tuple[Trial, ...]:
        """What it is calibrated on."""
        return tuple(trial for k, trial in enumerate(self.subject.observed.trials) if k != self.left_out)

    @property
    def options(self) -> Options:
        """What it is calibrated with."""
        return replace(self.subject.observed.options, search=self.search, seed=self.seed)

    @property
    def judges(self) -> Observed:
        """What it is judged by."""
        if self.left_out is not None:
            return Observed((self.subject.observed.trials[self.left_out],), self.options)
        return self.subject.others or Observed((), self.options)

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on: two tasks with the same key have the same outcome."""
        judges = self.judges
        about = [_sources(), self.engine, self.trials, _effective(self.options), judges.trials,
                 _effective(judges.options)]
        return hashlib.sha256(json.dumps(_plain(about), sort_keys=True).encode()).hexdigest()


def tasks(subjects: Sequence[Subject], searches: Sequence[str], runs: int, seed: int,
          engines: Mapping[str, str]) -> Iterator[Task]:
    """
    Yield all calibrations of an experiment, the first run of everything before the second.

    :param seed: of the first run; the next has the next one.
    :param engines: name of the simulator of each subject, by its name.
    """
    for run in range(runs):
        for subject in subjects:
            for search in searches:
                for left_out in (None, *subject.held_back):
                    yield Task(subject, search, seed + run, engines[subject.name], left_out)


def _effective(options: Options) -> dict[str, Any]:
    """Return the options that can change what a calibration finds."""
    of_the_machine = names_of(MACHINE)
    return {name: value for name, value in options.flat().items() if name not in of_the_machine}


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; numbers keep every digit."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value


@functools.cache
def _sources() -> str:
    """Return a digest of the program: another one may find something else."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for file in sorted(folder.rglob('*.py')):
        if file.relative_to(folder).parts[0] not in SHOWING:
            digest.update(f'{file.relative_to(folder)}\n'.encode() + file.read_bytes())
    return digest.hexdigest()
