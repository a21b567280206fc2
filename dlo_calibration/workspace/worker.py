# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Worker: calibrates in a thread of its own, which puts frozen events on a queue; and its progress."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass
import math
import queue
import threading
import time
import traceback
from typing import Callable, Generic, Iterator, Sequence, TypeVar

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import DloCalibrationError, one_line
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.inference.uncertainty import good_count
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class Failure:
    """
    Work that ended without a result.

    :param text: one line that says why.
    :param details: the traceback if the reason is a defect of the program; else empty.
    """

    text: str
    details: str = ''


@dataclass(frozen=True)
class CalibrationWarning:
    """
    A warning of a calibration under way, to be shown immediately.

    :param text: one line, e.g. about a process that died.
    """

    text: str


Event = TypeVar('Event')


class Background(Generic[Event]):
    """
    Does one piece of work at a time in a thread of its own.

    `events` receives the events of the work, in order, and at the end exactly one: the value that the work
    returns, or a `Failure`.

    :param name: of the work, e.g. ``calibration``.
    """

    def __init__(self, name: str) -> None:
        self.events: queue.SimpleQueue[Event | Failure] = queue.SimpleQueue()
        self._name = name
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def alive(self) -> bool:
        """Tell whether the thread is running; afterwards, events may still be waiting."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stopped(self) -> bool:
        """Tell whether the last work was asked to end with the best so far."""
        return self._stop.is_set()

    def begin(self, work: Callable[[Callable[[], bool]], Event]) -> None:
        """
        Begin to work.

        :param work: called with a function that tells whether to end with the best so far.
        :raises DloCalibrationError: while it is working already.
        """
        if self.alive:
            raise DloCalibrationError(f'another {self._name} is under way')
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, args=(work, self._stop.is_set, self.events),
                                        name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the work to end with the best so far, and return immediately."""
        self._stop.set()

    def waiting_events(self) -> Iterator[Event | Failure]:
        """Yield the waiting `events`, without waiting for more."""
        while not self.events.empty():  # there is no other reader
            yield self.events.get_nowait()

    def join(self, timeout: float | None = None) -> bool:
        """Wait until the thread has ended, `timeout` [s] at most; return whether it has."""
        if self._thread is not None:
            self._thread.join(timeout)
        return not self.alive

    @staticmethod
    def _work(work: Callable[[Callable[[], bool]], Event], should_stop: Callable[[], bool],
              events: queue.SimpleQueue[Event | Failure]) -> None:
        event: Event | Failure
        try:
            event = work(should_stop)
        except DloCalibrationError as error:
            event = Failure(str(error))
        except BaseException as error:  # else the user waits for ever for a dead thread
            event = Failure(one_line(error), traceback.format_exc())
        events.put(event)


CalibrationEvent = Evaluation | CalibrationWarning | CalibrationResult | Failure


class Worker(Background[CalibrationEvent]):
    """
    Calibrates in a thread of its own.

    `events` receives each finished `Evaluation`, in order, each `CalibrationWarning`, and at the end exactly
    one `CalibrationResult` or `Failure`.

    :param make_simulator: makes the engine; called in the thread that uses the engine.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        super().__init__('calibration')
        self._make_simulator = make_simulator

    def start(self, trials: Sequence[Trial], options: Options, log: EvaluationLog | None = None) -> None:
        """
        Begin to calibrate.

        :param log: of finished evaluations, see `calibrate`; it belongs to the calibration until its end.
        :raises DloCalibrationError: while it is calibrating already.
        """
        trials = tuple(trials)

        def work(should_stop: Callable[[], bool]) -> CalibrationEvent:
            def warn(text: str) -> None:
                self.events.put(CalibrationWarning(text))

            if log is not None and log.resumed:
                warn(log.resumed)
            return calibrate(trials, options, on_evaluation=self.events.put, on_notice=warn,
                             should_stop=should_stop, make_simulator=self._make_simulator, log=log)

        self.begin(work)


class Progress:
    """
    The progress of a calibration.

    :param evaluations: largest number of evaluations.
    :param trials: number of trials that each evaluation simulates.
    :param logged: number of evaluations that a log answers; they do not count for the speed.
    :param clock: the time [s].
    """

    def __init__(self, evaluations: int, trials: int, logged: int = 0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.evaluations = evaluations
        self._logged = logged
        self.count = 0
        self.newest: Evaluation | None = None
        self.best: Evaluation | None = None
        self._good: list[Evaluation] = []  # the best ones, best first
        self._simulations = 0
        self._trials = trials
        self._clock, self._begun = clock, clock()

    def take(self, evaluation: Evaluation) -> None:
        """Count the next evaluation."""
        self.count += 1
        if self.count > self._logged:
            self._simulations += self._trials - evaluation.skipped
        else:
            self._begun = self._clock()
        self.newest = evaluation
        if self.best is None or evaluation.score < self.best.score:
            self.best = evaluation
        if math.isfinite(evaluation.score):
            insort(self._good, evaluation, key=lambda evaluation: evaluation.score)
            del self._good[good_count(self.evaluations):]

    @property
    def spread(self) -> dict[str, float]:
        """
        Spread of the best 5 % of the evaluations (at least 8) around the best, 0..100, by parameter.

        It is the root mean square distance, as in `uncertainty.spread_of_best`.
        """
        good = self._good[:good_count(self.count)]
        if self.best is None or not good:
            return {}
        return {name: math.sqrt(sum((evaluation.values[name] - value)**2 for evaluation in good) / len(good))
                for name, value in self.best.values.items()
                if all(name in evaluation.values for evaluation in good)}

    @property
    def simulations_per_second(self) -> float:
        """Rollouts per second, without those that a log answered."""
        return self._simulations / self._elapsed

    @property
    def seconds_left(self) -> float:
        """Time until the last evaluation [s], at the speed so far; infinite before the first one."""
        remaining, simulated = self.evaluations - self.count, self.count - self._logged
        return self._elapsed / simulated * remaining if simulated > 0 else float('inf')

    @property
    def _elapsed(self) -> float:
        return max(self._clock() - self._begun, 1e-6)
