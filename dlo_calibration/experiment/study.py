# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Study: the calibrations that answer the paper's two questions.

Consistency: does every random seed lead to the same parameters?
Validity: do the parameters explain an action that was left out of the calibration?  (Alvarez, Yamazaki and
Matsubara, tables 1 and 2.)
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass, replace
import functools
import time
from typing import Any, Callable, Iterator, Mapping

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options, recordable
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.digest import code_digest, digest
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.search import SEARCHES

#: Rooms whose code determines the outcome of a calibration or a plan.
DECISIVE = ('model', 'observation', 'simulation', 'evaluation', 'search', 'inference', 'calibration',
            'planning', 'experiment')


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
        """Plain values that identify the calibration for a reader of the journal."""
        return {'object': self.subject.name, 'search': self.search, 'seed': self.seed, 'engine': self.engine,
                'left_out': None if self.left_out is None else self.left_out + 1}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on: tasks with the same key have the same outcome."""
        judges = self.judges
        return task_digest(self.engine, self.trials, recordable(self.options.flat()), judges.trials,
                           recordable(judges.options.flat()))


@dataclass(frozen=True)
class Study:
    """
    The plan of an experiment.

    :param runs: calibrations of each subject with each search, each with its own seed.
    :param seed: of the first run; each further run adds 1.
    :param command: the command that repeats the experiment.
    :param samples: whether the subjects are the samples of the package.
    """

    subjects: tuple[Subject, ...]
    searches: tuple[str, ...]
    runs: int
    seed: int
    command: str
    samples: bool

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise InputError('--runs', str(self.runs), '1 or more', 'correct it')
        if not self.searches:
            raise InputError('--search', 'no name', f'one or more of {", ".join(SEARCHES)}', 'name one')

    @property
    def evaluations(self) -> dict[str, int]:
        """Largest number of evaluations of a calibration, by search."""
        return {search: max(subject.observed.options_of(search, self.seed).evaluations
                            for subject in self.subjects) for search in self.searches}

    def tasks(self, engines: Mapping[str, str]) -> Iterator[Task]:
        """
        Yield all calibrations: the first run of every subject and search, then the second.

        :param engines: name of the simulator, by the subject's name.
        """
        for run in range(self.runs):
            for subject in self.subjects:
                for search in self.searches:
                    for left_out in (None, *subject.held_back):
                        yield Task(subject, search, self.seed + run, engines[subject.name], left_out)


def task_digest(*about: Any) -> str:
    """Return a digest of dataclasses, arrays and plain values, and of the source code of the package."""
    return digest(code_digest(DECISIVE), *about)



@dataclass(frozen=True)
class Judgement:
    """
    How well the calibrated parameters explain a trial that was left out of the calibration.

    :param score: difference score [cm]; None if the trial could not be simulated.
    :param error: mean point error [m]; None likewise.
    :param share: mean point error [% of the DLO's length]; None likewise.
    """

    trial: str
    score: float | None
    error: float | None
    share: float | None


@dataclass(frozen=True)
class Outcome:
    """
    The result of one calibration.

    :param values: of the parameters, 0..100; empty if it failed.
    :param excited: names of the parameters that the trials show; the others keep their default.
    :param score: average difference score of the trials calibrated on [cm].
    :param error: mean point error of the same trials [m].
    :param evaluations: number of evaluations of the search.
    :param simulations: number of rollouts in all.
    :param seconds: its duration on one thread [s].
    :param judgements: one for each trial that judges it.
    :param failure: why it failed; empty if it did not.
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
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        return cls(**{**entry, 'excited': tuple(entry['excited']), 'values': dict(entry['values']),
                      'judgements': tuple(Judgement(**judgement) for judgement in entry['judgements'])})


def perform(task: Task, make_simulator: SimulatorFactory,
            should_stop: Callable[[], bool] = lambda: False) -> Outcome:
    """
    Calibrate once, on one thread, and judge the parameters.

    :raises CancelledError: if stopped.
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
    """Return the trials that judge a task, each with its simulated chains at the goals, (g, n, 3) [m]."""
    judges, chains = task.judges, []
    space = replace(task.options.space, free=tuple(outcome.values))  # with the chosen parts
    with closing(make_simulator(judges.options)) as simulator:
        for trial in with_shared_places(judges.trials):
            physical = space.physical(outcome.values, trial.initial.length)
            try:
                chains.append((trial, simulator.simulate(trial, physical).chains))
            except SimulationError:
                continue
    return chains


def _judgements(judges: Observed, result: CalibrationResult,
                make_simulator: SimulatorFactory) -> tuple[Judgement, ...]:
    if not judges.trials:
        return ()
    judgements = []
    point = result.space.point(result.values)
    with closing(make_simulator(judges.options)) as simulator:
        for trial in with_shared_places(judges.trials):
            evaluation = Evaluator([trial], result.space, simulator).evaluate(0, point)
            score, errors = evaluation.score, evaluation.errors
            judgements.append(Judgement(trial.name, None, None, None) if errors is None else Judgement(
                trial.name, score, errors.mean, 100 * errors.mean / trial.initial.length))
    return tuple(judgements)
