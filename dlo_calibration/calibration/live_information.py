# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
LiveInformation: what each trial tells, found out beside whoever asks, before anything is calibrated.

It simulates in a process of its own: PyBullet and the import of Numba hold
the interpreter's lock, and a process can be ended at once, in the middle of a
simulation, when a calibration begins or the trials are forgotten.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import CancelledError, Future
from contextlib import closing
import json
import queue
import threading
from typing import Any, Iterator, Sequence, Union

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.evaluator import mean_length
from dlo_calibration.evaluation.processes import ProcessExecutor
from dlo_calibration.inference.trial_information import (
    Posterior,
    posterior,
    simulated_information,
    TrialInformation,
    without_repeated_goals,
)
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Simulator

LOOK = 0.05  # s between two looks at whether to stop

#: fingerprint -> (d, d) information of a trial, or in words why there is none
_Known = dict[tuple[bytes, int], Union[Floats, str]]


class _Job:
    """One appraisal: what it found so far, and whether it is to stop."""

    def __init__(self, found: queue.SimpleQueue[TrialInformation],
                 thread: threading.Thread | None = None) -> None:
        self.stop = threading.Event()
        self.found = found
        self.thread = thread


class LiveInformation:
    """
    Appraises trials in a thread, one session after the other.

    A trial is simulated once, unless it changes, or the options, or the last result do.

    :param make_simulator: called in the thread.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator = make_simulator
        self._job = _Job(queue.SimpleQueue())
        self._base: tuple[str, CalibrationResult | None] | None = None  # options and result of `_known`
        self._known: _Known = {}

    @property
    def alive(self) -> bool:
        """Tell whether an appraisal is under way; some of it may be waiting when it is not."""
        return self._job.thread is not None and self._job.thread.is_alive()

    def start(self, trials: Sequence[Trial], options: Options, result: CalibrationResult | None = None,
              whole: bool = True) -> None:
        """
        Begin to appraise the trials that were not yet; returns at once.

        :param result: of the last calibration; its trials are known, those of other parameters do not count.
        :param whole: False where more of the last trial is to come; it then waits for a goal at rest.
        :raises DloCalibrationError: while another appraisal is under way.
        """
        if self.alive:
            raise DloCalibrationError('an appraisal is under way already')
        if result is not None and result.space != options.space:
            result = None
        if not whole and trials and not trials[-1].goals[-1].stable:
            trials = trials[:-1]
        text = json.dumps(options.flat(), sort_keys=True)
        if self._base is None or self._base[0] != text or self._base[1] is not result:
            self._base, self._known = (text, result), {}
        self._job = _Job(self._job.found)
        self._job.thread = threading.Thread(
            target=self._work, args=(self._job, tuple(trials), options, result, self._known),
            name='appraisal', daemon=True)
        self._job.thread.start()

    def stop(self) -> None:
        """End the appraisal under way, and forget what was found so far; returns at once."""
        self._job.stop.set()
        self._job, self._base = _Job(queue.SimpleQueue(), self._job.thread), None

    def join(self, timeout: float | None = None) -> bool:
        """Wait until the thread has ended, `timeout` [s] at most; return whether it has."""
        if self._job.thread is not None:
            self._job.thread.join(timeout)
        return not self.alive

    def waiting_information(self) -> Iterator[TrialInformation]:
        """Take what was found, without waiting for more."""
        while True:
            try:
                yield self._job.found.get_nowait()
            except queue.Empty:
                return

    def _work(self, job: _Job, trials: Sequence[Trial], options: Options, result: CalibrationResult | None,
              known: _Known) -> None:
        try:
            self._appraise(job, trials, options, result, known)
        except CancelledError:
            pass
        except Exception as error:  # whatever it is, nobody else need care
            job.found.put(TrialInformation.unknown(trials[-1].name, options.space.free, _one_line(error)))

    def _appraise(self, job: _Job, trials: Sequence[Trial], options: Options,
                  result: CalibrationResult | None, informations: _Known) -> None:
        space, height = options.space, options.table_height if options.table else None
        best = None if result is None else result.best.point
        examination = None if result is None else result.examination
        done = _fingerprints(result.trials) if result and examination and examination.regular else []
        new = [(trial, key) for trial, key in zip(trials, _fingerprints(trials), strict=True)
               if key not in done]
        if all(key in informations for _, key in new):
            return
        known, length = posterior(trials, space, height, best, examination), mean_length(trials)
        with closing(self._make_simulator(options)) as simulator, closing(ProcessExecutor(1)) as process:
            for trial, key in new:
                fresh = key not in informations
                if fresh:
                    try:
                        informations[key] = _result(job, process.submit(
                            _simulated, trial, known, space, simulator, length, height))
                    except CancelledError:
                        raise
                    except Exception as error:  # of any kind: of an engine, or of a process that died
                        informations[key] = _one_line(error)
                found = informations[key]
                if isinstance(found, str):
                    told = TrialInformation.unknown(trial.name, known.names, found)
                else:
                    after = known.after(found)
                    told, known = TrialInformation(trial.name, known.names, known.std, after.std), after
                if fresh:
                    job.found.put(told)


def _simulated(trial: Trial, known: Posterior, space: ParameterSpace, simulator: Simulator, length: float,
               table_height: float | None) -> Floats:
    """Return the information of a trial; the work of a process."""
    with closing(simulator):
        return simulated_information(trial, known, space, simulator, length, table_height)


def _result(job: _Job, future: Future[Any]) -> Any:
    """
    Return the result of a future.

    :raises CancelledError: as soon as the job is to stop.
    """
    while not job.stop.is_set():
        try:
            return future.result(timeout=LOOK)
        except TimeoutError:
            if future.done():
                raise
    raise CancelledError


def _fingerprints(trials: Sequence[Trial]) -> list[tuple[bytes, int]]:
    """Return what tells trials apart, whatever their names; of equal ones, each has its own number."""
    seen: Counter[bytes] = Counter()
    found = []
    for trial in trials:
        text = _fingerprint(trial)
        found.append((text, seen[text]))
        seen[text] += 1
    return found


def _fingerprint(trial: Trial) -> bytes:
    """Return the start of a trial, its hands and its instants."""
    seen = without_repeated_goals(trial)
    pieces: list[Any] = [seen.initial.points.tobytes(), b'' if seen.velocity is None else
                         seen.velocity.tobytes()]
    for hand in seen.hands:
        pieces += [hand.name, hand.grips, hand.times.tobytes(), hand.positions.tobytes(),
                   hand.orientations.tobytes()]
    pieces += [(goal.time, goal.stable, goal.held_by) for goal in seen.goals]
    return repr(pieces).encode()


def _one_line(error: BaseException) -> str:
    return ' '.join(f'{"" if isinstance(error, DloCalibrationError) else type(error).__name__ + ": "}{error}'
                    .split())
