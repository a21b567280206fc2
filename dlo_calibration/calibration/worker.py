# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Worker: a thread that calibrates; options and trials go in, frozen events come out."""

from __future__ import annotations

from bisect import insort
from collections import Counter
from concurrent.futures import Executor
from contextlib import closing, ExitStack
from dataclasses import dataclass, replace
import math
import queue
import threading
import time
import traceback
from typing import Callable, Iterator, Sequence, Union

from dlo_calibration.calibration.calibrate import advised, calibrate, confirmed, explained
from dlo_calibration.calibration.options import AUTO, CONFIRMING, Options
from dlo_calibration.calibration.parts import calibrate_parts
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation import processes
from dlo_calibration.evaluation.cluster import ClusterExecutor
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.slices import cut, Slices
from dlo_calibration.inference.uncertainty import good_count
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, SEARCHES
from dlo_calibration.simulation.protocol import Simulator

GUESSED = 'no trial tells anything about it; guessed from the height at which the DLO lies'

SimulatorFactory = Callable[[Options], Simulator]

STOPPED_PATIENCE = 5.0  # s that a confirmation may still take once it was asked to stop


@dataclass(frozen=True)
class Failure:
    """
    A calibration that ended without a result.

    :param text: one line that says why.
    :param details: the traceback, where the reason is a defect of the program;
        else empty.
    """

    text: str
    details: str = ''


@dataclass(frozen=True)
class Notice:
    """
    Something that the user should know at once, and that does not end the calibration.

    :param text: one line, e.g. about a process that died.
    """

    text: str


Event = Union[Evaluation, Notice, CalibrationResult, Failure]


def calibrate_with(trials: Sequence[Trial], options: Options, make_simulator: SimulatorFactory,
                   on_evaluation: Callable[[Evaluation], None] | None = None,
                   should_stop: Callable[[], bool] = lambda: False,
                   on_notice: Callable[[str], None] = lambda _: None) -> CalibrationResult:
    """
    Calibrate as `options` say, in as many processes as they say, or on the machines of a scheduler.

    The node and the command line both come here, so that the same trials and
    options give the same result in both.

    :param on_notice: called at once with a sentence where e.g. a process died, from any
        thread; `CalibrationResult.warnings` tells it, too.
    :raises DloCalibrationError: where there is no result.
    """
    notices: list[str] = []

    def notice(text: str) -> None:
        notices.append(text)
        on_notice(text)

    with ExitStack() as stack:
        executor = _executor(options, notice, on_notice)  # its processes start while the engine is made
        if executor is not None:
            stack.callback(executor.close)
        simulator = stack.enter_context(closing(make_simulator(options)))
        if executor is not None:
            simulator.prepare()
        result = fitted_with(trials, options, simulator, on_evaluation, should_stop, executor)
        result = explained(advised(result, simulator, should_stop), simulator, should_stop)
    told = (text if count == 1 else f'{text} ({count} times)' for text, count in Counter(notices).items())
    result = replace(result, warnings=(*result.warnings, *told))
    return confirmed_with(result, options, make_simulator, should_stop)


def fitted_with(trials: Sequence[Trial], options: Options, simulator: Simulator,
                on_evaluation: Callable[[Evaluation], None] | None = None,
                should_stop: Callable[[], bool] = lambda: False,
                executor: Executor | None = None) -> CalibrationResult:
    """
    Search as `options` say, on a simulator that is there, and examine what was found; no more than that.

    :raises DloCalibrationError: where there is no result.
    """
    known = hints(trials, options)
    space, guessed = _guessed(options.space, known)
    search = SEARCHES[options.search](space.dimension, options.seed, known)
    method = calibrate if options.parts else calibrate_parts
    return _noted(method(
        trials, space, simulator, search, budget=options.evaluations, seed=options.seed,
        on_evaluation=on_evaluation, should_stop=should_stop, executor=executor), guessed)


def hints(trials: Sequence[Trial], options: Options) -> Hints:
    """Return what the observed chains alone say, for the search."""
    from dlo_calibration.observation.excitation import priors  # which loads half of SciPy

    known = priors(trials, options.space, options.table_height if options.table else None)
    rows = tuple(int(count) for count in known.rows)
    return Hints(known.start, known.lower, known.upper, rows, known.excites)


def _guessed(space: ParameterSpace, known: Hints) -> tuple[ParameterSpace, tuple[str, ...]]:
    """
    Return a space whose defaults are what the chains alone say, and of which parameters.

    That is the self-collision radius only, from the height at which the DLO lies: no
    other has a guess where no trial shows it.
    """
    name = 'self_collision'
    if name not in space.free or space.fixed.get(name, BY_NAME[name].default) != BY_NAME[name].default:
        return space, ()
    start = float(known.start[space.free.index(name)])
    if not 0 <= start <= 1:
        return space, ()
    return replace(space, fixed={**space.fixed, name: start * SCALE}), (name,)


def _noted(result: CalibrationResult, guessed: Sequence[str]) -> CalibrationResult:
    """Return a result that says where a value is a guess from the chains alone."""
    excited = None if result.examination is None else result.examination.uncertainty.excited
    parameters = dict(result.parameters)
    for k, name in enumerate(result.space.free):
        if name in guessed and excited is not None and not excited[k]:
            parameters[name] = replace(parameters[name], note=GUESSED)
    return replace(result, parameters=parameters)


def confirmed_with(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
                   should_stop: Callable[[], bool] = lambda: False) -> CalibrationResult:
    """
    Return a result with its confirmation, where `options` leave the choice of the engine open.

    Whatever the confirming engine does, the result is not lost.
    """
    if options.engine != AUTO or result.engine == CONFIRMING:
        return result
    begun = time.monotonic()
    try:
        simulator = make_simulator(replace(options, engine=CONFIRMING))
        if simulator.name == result.engine:
            return result
        try:
            return confirmed(result, simulator,
                             lambda: should_stop() and time.monotonic() - begun > STOPPED_PATIENCE)
        finally:
            simulator.close()
    except Exception as error:
        text = ' '.join(f'{type(error).__name__}: {error}'.split())
        return replace(result, warnings=(*result.warnings, f'not confirmed by engine {CONFIRMING}: {text}'))


def sliced_with(result: CalibrationResult, options: Options, make_simulator: SimulatorFactory,
                should_stop: Callable[[], bool] = lambda: False) -> Slices | None:
    """
    Simulate slices around a result, in this thread; None where the engine fails.

    They may be coarse, as the time for them is short: see `slices.cut`.
    """
    try:
        with closing(make_simulator(options)) as simulator:
            return cut(result, simulator, should_stop)
    except Exception:  # whatever the engine does, there is a page
        return None


def _executor(options: Options, on_death: Callable[[str], None],
              on_wait: Callable[[str], None]) -> processes.ProcessExecutor | ClusterExecutor | None:
    """Return where evaluations are simulated; None: here."""
    if options.scheduler:
        return ClusterExecutor(options.scheduler, on_death, on_wait)
    workers = min(options.workers or processes.cores(), options.evaluations)
    return processes.ProcessExecutor(workers, on_death) if workers > 1 else None


class Progress:
    """
    How far a calibration has come.

    :param evaluations: how many there will be at most.
    :param trials: simulated in each of them.
    """

    def __init__(self, evaluations: int, trials: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.evaluations = evaluations
        self.count = 0
        self.newest: Evaluation | None = None
        self.best: Evaluation | None = None
        self._good: list[Evaluation] = []  # the best ones, best first
        self._simulations = 0
        self._trials = trials
        self._clock, self._begun = clock, clock()

    def take(self, evaluation: Evaluation) -> None:
        """Take the next evaluation."""
        self.count += 1
        self._simulations += self._trials - evaluation.skipped
        self.newest = evaluation
        if self.best is None or evaluation.score < self.best.score:
            self.best = evaluation
        if math.isfinite(evaluation.score):
            insort(self._good, evaluation, key=lambda one: one.score)
            del self._good[good_count(self.evaluations):]

    @property
    def spread(self) -> dict[str, float]:
        """
        How far the best 5 % of the evaluations so far (8 at least) lie from the best, 0..100, by parameter.

        The root mean square distance, as in `uncertainty.spread_of_best`.
        """
        good = self._good[:good_count(self.count)]
        if self.best is None or not good:
            return {}
        return {name: math.sqrt(sum((one.values[name] - value)**2 for one in good) / len(good))
                for name, value in self.best.values.items() if all(name in one.values for one in good)}

    @property
    def simulations_per_second(self) -> float:
        """Rollouts per second so far."""
        return self._simulations / self._elapsed

    @property
    def seconds_left(self) -> float:
        """Time until the last evaluation [s], at the speed so far; infinite before the first."""
        left = self.evaluations - self.count
        return self._elapsed / self.count * left if self.count else float('inf')

    @property
    def _elapsed(self) -> float:
        return max(self._clock() - self._begun, 1e-6)


class Worker:
    """
    Calibrates in a thread of its own.

    `events` receives an `Evaluation` for each finished one, in order, a `Notice` where
    something else is worth to be known, and at the end exactly one `CalibrationResult` or `Failure`.

    :param make_simulator: called in the thread, so that an engine lives where it is used.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self.events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._make_simulator = make_simulator
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def alive(self) -> bool:
        """Tell whether the thread still works; events may be waiting when it does not."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, trials: Sequence[Trial], options: Options) -> None:
        """
        Begin to calibrate.

        :raises DloCalibrationError: while it is calibrating already.
        """
        if self.alive:
            raise DloCalibrationError('a calibration is under way already')
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._work, args=(tuple(trials), options, self._stop), name='calibration', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the calibration to end with the best so far; returns at once."""
        self._stop.set()

    def waiting_events(self) -> Iterator[Event]:
        """Take what waits in `events`, without waiting for more."""
        while True:
            try:
                yield self.events.get_nowait()
            except queue.Empty:
                return

    def join(self, timeout: float | None = None) -> bool:
        """Wait until the thread has ended, `timeout` [s] at most; return whether it has."""
        if self._thread is not None:
            self._thread.join(timeout)
        return not self.alive

    def _work(self, trials: Sequence[Trial], options: Options, stop: threading.Event) -> None:
        event: Event
        try:
            event = calibrate_with(trials, options, self._make_simulator, self.events.put, stop.is_set,
                                   lambda text: self.events.put(Notice(text)))
        except DloCalibrationError as error:
            event = Failure(str(error))
        except BaseException as error:  # a thread that dies silently leaves the user waiting for ever
            text = ' '.join(str(error).split())
            event = Failure(f'{type(error).__name__}: {text}' if text else type(error).__name__,
                            traceback.format_exc())
        self.events.put(event)
