# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""LiveInformation: how much each new trial adds, computed in the background before a calibration."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import CancelledError
from contextlib import closing
import json
import queue
import threading
from typing import Any, Iterator, Sequence, Union

import numpy as np

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import prior
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.evaluator import mean_length
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.inference.appraiser import Appraiser, Knowledge, without_repeated_goals
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import noise
from dlo_calibration.observation.plausibility import implausible
from dlo_calibration.observation.rest_lengths import with_shared_places

#: fingerprints -> what is known after these trials; or why the last one tells nothing, in words
_Known = dict[tuple[tuple[bytes, int], ...], Union[Knowledge, str]]


class _Job:
    """One appraisal: its results so far, and a request to stop."""

    def __init__(self, found: queue.SimpleQueue[TrialInformation],
                 thread: threading.Thread | None = None) -> None:
        self.stop = threading.Event()
        self.found = found
        self.thread = thread


class LiveInformation:
    """
    Appraises trials in a thread: it computes the information that each of them adds.

    A trial is simulated again only after the trial, the options or the last result have changed.

    :param make_simulator: makes the engine; called in the thread.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator = make_simulator
        self._job = _Job(queue.SimpleQueue())
        # `_known` is valid for these options and this result
        self._base: tuple[str, CalibrationResult | None] | None = None
        self._known: _Known = {}

    @property
    def alive(self) -> bool:
        """Tell whether an appraisal is under way; afterwards, results may still be waiting."""
        return self._job.thread is not None and self._job.thread.is_alive()

    def start(self, trials: Sequence[Trial], options: Options, result: CalibrationResult | None = None,
              whole: bool = True) -> None:
        """
        Begin to appraise the trials that are new, and return immediately.

        :param result: of the last calibration, whose trials are not appraised again; it is ignored if it has
            other parameters.
        :param whole: False while the last trial is incomplete: it is then left out unless it ends at rest.
        :raises DloCalibrationError: while another appraisal is under way.
        """
        if self.alive:
            raise DloCalibrationError('an appraisal is under way already')
        if not whole and trials and not trials[-1].goals[-1].stable:
            trials = trials[:-1]
        options = choose(trials, options).options
        if result is not None and result.space != options.space:
            result = None
        text = json.dumps(options.flat(), sort_keys=True)
        if self._base is None or self._base[0] != text or self._base[1] is not result:
            self._base, self._known = (text, result), {}
        self._job = _Job(self._job.found)
        self._job.thread = threading.Thread(
            target=self._work, args=(self._job, tuple(trials), options, result, self._known),
            name='appraisal', daemon=True)
        self._job.thread.start()

    def stop(self) -> None:
        """End the appraisal under way, delete its results, and return immediately."""
        self._job.stop.set()
        self._job, self._base = _Job(queue.SimpleQueue(), self._job.thread), None

    def join(self, timeout: float | None = None) -> bool:
        """Wait until the thread has ended, `timeout` [s] at most; return whether it has."""
        if self._job.thread is not None:
            self._job.thread.join(timeout)
        return not self.alive

    def waiting_information(self) -> Iterator[TrialInformation]:
        """Yield the results so far, without waiting for more."""
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
        except Exception as error:  # an appraisal never disturbs the node
            job.found.put(TrialInformation.unknown(trials[-1].name, options.space.free, _one_line(error)))

    def _appraise(self, job: _Job, trials: Sequence[Trial], options: Options,
                  result: CalibrationResult | None, informations: _Known) -> None:
        space, height = options.space, options.table_height if options.table else None
        examination = None if result is None else result.examination
        done = fingerprints(result.trials) if result and examination and examination.regular else []
        keys = fingerprints(trials)
        new = [(k, tuple(keys[:k + 1])) for k, key in enumerate(keys) if key not in done]
        if all(key in informations for _, key in new):
            return
        trials = with_shared_places(trials)
        start, default = prior(trials, options).hints.start, space.default_point()
        guessed = tuple(name for name, one in zip(space.free, start, strict=True) if np.isnan(one))
        known, kept = Knowledge.before(space.free, np.where(np.isnan(start), default, start)), []
        if result is not None and done and examination is not None:
            known = Knowledge(known.names, result.best.point, examination.uncertainty)
            kept = list(result.trials)
        with (closing(self._make_simulator(options)) as simulator,
              closing(Threads(1)) as thread):
            pool = Pool(simulator, thread, job.stop.is_set)
            for k, key in new:
                trial, fresh = trials[k], key not in informations
                doubts = implausible(trial, height, bool(options.scene)) if fresh else ()
                if doubts:  # its information would be about another world
                    informations[key] = doubts[0]
                elif fresh:
                    try:
                        informations[key] = Appraiser(
                            space, pool, mean_length(trials), height, noise(trials), guessed).after(
                            known, [*kept, trial])
                    except CancelledError:
                        raise
                    except Exception as error:  # of the engine
                        informations[key] = _one_line(error)
                found = informations[key]
                if isinstance(found, str):
                    added = TrialInformation.unknown(trial.name, known.names, found)
                else:
                    added = TrialInformation(trial.name, known.names, known.uncertainty.std,
                                             found.uncertainty.std, found.uncertainty.verdicts)
                    known, kept = found, [*kept, trial]
                if fresh:
                    job.found.put(added)


def fingerprints(trials: Sequence[Trial]) -> list[tuple[bytes, int]]:
    """Return what distinguishes trials, apart from their names; equal ones are numbered."""
    seen: Counter[bytes] = Counter()
    found = []
    for trial in trials:
        text = _fingerprint(trial)
        found.append((text, seen[text]))
        seen[text] += 1
    return found


def _fingerprint(trial: Trial) -> bytes:
    """Return the initial chain of a trial, its hands and the times of its goals, as bytes."""
    trial = without_repeated_goals(trial)
    pieces: list[Any] = [trial.initial.points.tobytes(),
                         b'' if trial.velocity is None else trial.velocity.tobytes()]
    for hand in trial.hands:
        pieces += [hand.name, hand.grips, hand.offset, hand.times.tobytes(), hand.positions.tobytes(),
                   hand.orientations.tobytes()]
    pieces += [(goal.time, goal.stable, goal.held_by) for goal in trial.goals]
    return repr(pieces).encode()


def _one_line(error: BaseException) -> str:
    return ' '.join(f'{"" if isinstance(error, DloCalibrationError) else type(error).__name__ + ": "}{error}'
                    .split())
