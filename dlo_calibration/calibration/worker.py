# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Worker: a thread that calibrates; it takes trials and options, and puts frozen events on a queue."""

from __future__ import annotations

from typing import Callable, Sequence, Union

from dlo_calibration.calibration.background import Background, Failure, Notice
from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.model.trial import Trial

__all__ = ['Event', 'Failure', 'Notice', 'Worker']

Event = Union[Evaluation, Notice, CalibrationResult, Failure]


class Worker(Background[Event]):
    """
    Calibrates in a thread of its own.

    `events` receives each finished `Evaluation`, in order, a `Notice` for anything else that the user
    should know, and at the end exactly one `CalibrationResult` or `Failure`.

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

        def work(should_stop: Callable[[], bool]) -> Event:
            if log is not None and log.resumed:
                self.events.put(Notice(log.resumed))
            return calibrate(trials, options, on_evaluation=self.events.put,
                             on_notice=lambda text: self.events.put(Notice(text)), should_stop=should_stop,
                             make_simulator=self._make_simulator, log=log)

        self.begin(work)
