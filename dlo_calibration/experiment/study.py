# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Experiment: the paper's two questions to a calibration, asked many times.

Consistency: does it find the same parameters whatever the random seed is?
Validity: do they explain an action that was not calibrated on?  (Alvarez, Yamazaki
and Matsubara, tables 1 and 2.)
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
import functools
import hashlib
import json
import os
from pathlib import Path
import time
from typing import Any, Callable, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial

#: Options that change nothing in what a calibration finds.
WITHOUT_EFFECT = ('workers', 'scheduler', 'start_after_trials', 'output_directory', 'record')
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


@dataclass(frozen=True)
class Judgement:
    """
    How well found parameters explain a trial that they were not found with.

    :param score: difference score [cm]; None where it could not be simulated.
    :param error: mean point error [m]; None likewise.
    :param share: the same in percent of the DLO's length; None likewise.
    """

    trial: str
    score: float | None
    error: float | None
    share: float | None


@dataclass(frozen=True)
class Outcome:
    """
    What one calibration found.

    :param values: of the parameters, 0..100; empty where it failed.
    :param excited: names of those that the trials tell anything about; the others have their default.
    :param score: average difference score of the trials calibrated on [cm].
    :param error: mean point error of those [m].
    :param evaluations: of the search.
    :param simulations: rollouts in all.
    :param seconds: it took, in one process.
    :param failure: why it failed; empty where it did not.
    """

    values: Mapping[str, float]
    excited: tuple[str, ...] = ()
    score: float | None = None
    error: float | None = None
    evaluations: int = 0
    simulations: int = 0
    seconds: float = 0.0
    judgements: tuple[Judgement, ...] = ()
    failure: str = ''

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Outcome:
        """Build from what `asdict` gave; raise TypeError, KeyError or ValueError where that is not one."""
        return cls(**{**entry, 'excited': tuple(entry['excited']), 'values': dict(entry['values']),
                      'judgements': tuple(Judgement(**one) for one in entry['judgements'])})


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


def perform(task: Task, make_simulator: SimulatorFactory,
            should_stop: Callable[[], bool] = lambda: False) -> Outcome:
    """
    Do one calibration in this process, and judge it.

    :raises CancelledError: when stopped.
    """
    options, trials, begun = task.options, task.trials, time.monotonic()
    with closing(make_simulator(options)) as simulator:
        try:
            result = fitted(Setting(trials, options, simulator, should_stop=should_stop))
        except SimulationError as error:
            if should_stop():
                raise CancelledError from error
            return Outcome({}, failure=str(error))
    if should_stop():
        raise CancelledError
    examined = result.examination
    excited = result.space.free if examined is None else tuple(
        name for name, there in zip(result.space.free, examined.uncertainty.excited, strict=True) if there)
    return Outcome(
        values=result.values, excited=excited, score=result.best.score, error=result.errors.mean,
        evaluations=len(result.evaluations), simulations=result.simulations, seconds=time.monotonic() - begun,
        judgements=_judgements(task.judges, result, make_simulator))


def judged_chains(task: Task, outcome: Outcome, make_simulator: SimulatorFactory
                  ) -> list[tuple[Trial, Floats]]:
    """Return the trials that a task is judged by, each with its simulated (g, n, 3) [m] goals."""
    judges, found = task.judges, []
    space = replace(task.options.space, free=tuple(outcome.values))  # of as many parts as were found
    with closing(make_simulator(judges.options)) as simulator:
        for trial in judges.trials:
            physical = space.physical(outcome.values, trial.initial.length)
            try:
                found.append((trial, simulator.simulate(trial, physical).chains))
            except SimulationError:
                continue
    return found


def _judgements(judges: Observed, result: CalibrationResult,
                make_simulator: SimulatorFactory) -> tuple[Judgement, ...]:
    if not judges.trials:
        return ()
    found = []
    point = result.space.point(result.values)
    with closing(make_simulator(judges.options)) as simulator:
        for trial in judges.trials:
            one = Evaluator([trial], result.space, simulator).evaluate(0, point)
            found.append(Judgement(trial.name, None, None, None) if one.errors is None else
                         Judgement(trial.name, one.score, one.errors.mean,
                                   100 * one.errors.mean / trial.initial.length))
    return tuple(found)


class Journal:
    """
    The outcomes of an experiment, in a file with one JSON document a line.

    A line that was cut, as where a process was killed, does not count.

    :raises InputError: where the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._outcomes: dict[str, Outcome] = {}
        try:
            text = path.read_text(encoding='utf-8', errors='replace') if path.exists() else ''
        except OSError as error:
            raise self._unusable(error) from error
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._outcomes.setdefault(entry['key'], Outcome.of(entry['outcome']))
            except (ValueError, TypeError, KeyError):
                continue
        self._cut = bool(text) and not text.endswith('\n')

    def find(self, task: Task) -> Outcome | None:
        """Return the outcome of a task; None where it is not done."""
        return self._outcomes.get(task.key)

    def add(self, task: Task, outcome: Outcome) -> None:
        """
        Write down an outcome, on the disk when this returns.

        :raises InputError: where it cannot be written.
        """
        line = json.dumps({
            'object': task.subject.name, 'search': task.search, 'seed': task.seed, 'engine': task.engine,
            'left_out': None if task.left_out is None else task.left_out + 1,
            'outcome': asdict(outcome), 'key': task.key})
        try:
            with self._path.open('a', encoding='utf-8') as stream:
                stream.write(('\n' if self._cut else '') + f'{line}\n')
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise self._unusable(error) from error
        self._cut = False
        self._outcomes[task.key] = outcome

    def _unusable(self, error: OSError) -> InputError:
        return InputError(f'file {self._path}', str(error), 'a file that can be read and written',
                          'choose another folder with --output')


def _effective(options: Options) -> dict[str, Any]:
    return {name: value for name, value in options.flat().items() if name not in WITHOUT_EFFECT}


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
