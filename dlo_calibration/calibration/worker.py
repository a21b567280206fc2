# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Worker: a thread that calibrates; it takes trials and options, and puts frozen events on a queue."""

from __future__ import annotations

from dataclasses import dataclass
import queue
import threading
import traceback
from typing import Iterator, Sequence, Union

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class Failure:
    """
    A calibration that ended without a result.

    :param text: one line that says why.
    :param details: the traceback if the reason is a defect of the program; else empty.
    """

    text: str
    details: str = ''


@dataclass(frozen=True)
class Notice:
    """
    Something that the user should know immediately, and that does not end the calibration.

    :param text: one line, e.g. about a process that died.
    """

    text: str


Event = Union[Evaluation, Notice, CalibrationResult, Failure]


class Worker:
    """
    Calibrates in a thread of its own.

    `events` receives each finished `Evaluation`, in order, a `Notice` for anything else that the user
    should know, and at the end exactly one `CalibrationResult` or `Failure`.

    :param make_simulator: makes the engine; called in the thread that uses the engine.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self.events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._make_simulator = make_simulator
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def alive(self) -> bool:
        """Tell whether the thread is running; afterwards, events may still be waiting."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stopped(self) -> bool:
        """Tell whether the last calibration was asked to end with the best so far."""
        return self._stop.is_set()

    def start(self, trials: Sequence[Trial], options: Options, log: EvaluationLog | None = None) -> None:
        """
        Begin to calibrate.

        :param log: of finished evaluations, see `calibrate`; it belongs to the calibration until its end.
        :raises DloCalibrationError: while it is calibrating already.
        """
        if self.alive:
            raise DloCalibrationError('a calibration is under way already')
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._work, args=(tuple(trials), options, log, self._stop), name='calibration',
            daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the calibration to end with the best so far, and return immediately."""
        self._stop.set()

    def waiting_events(self) -> Iterator[Event]:
        """Yield the waiting `events`, without waiting for more."""
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

    def _work(self, trials: Sequence[Trial], options: Options, log: EvaluationLog | None,
              stop: threading.Event) -> None:
        event: Event
        if log is not None and log.resumed:
            self.events.put(Notice(log.resumed))
        try:
            event = calibrate(trials, options, on_evaluation=self.events.put,
                              on_notice=lambda text: self.events.put(Notice(text)),
                              should_stop=stop.is_set, make_simulator=self._make_simulator, log=log)
        except DloCalibrationError as error:
            event = Failure(str(error))
        except BaseException as error:  # a thread that dies silently leaves the user waiting for ever
            text = ' '.join(str(error).split())
            event = Failure(f'{type(error).__name__}: {text}' if text else type(error).__name__,
                            traceback.format_exc())
        self.events.put(event)
