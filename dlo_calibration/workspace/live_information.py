# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""LiveInformation: the information that each new trial adds, computed in the background."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import CancelledError
from contextlib import closing, ExitStack
from dataclasses import dataclass
import queue
from typing import Any, Callable, Iterator, Sequence, Union

import numpy as np

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import one_line
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.evaluation.evaluation import mean_length, with_hands
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.inference.trial_information import (
    Appraisal,
    Appraiser,
    TrialInformation,
    without_repeated_goals,
)
from dlo_calibration.model.parameters import HANDS
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.observation.noise import noise
from dlo_calibration.observation.plausibility import implausible
from dlo_calibration.workspace.worker import Background

#: fingerprints -> the appraisal after these trials, or the reason why the last trial has none
_Appraisals = dict[tuple[tuple[str, int], ...], Union[Appraisal, str]]


#: What follows an appraisal: called with it, the options, and whether to stop; its outcome is an event.
Then = Callable[['Appraised', Options, Callable[[], bool]], Any]


class LiveInformation(Background[Any]):
    """
    Computes the information that each trial adds, in a thread of its own.

    `events` receives each `TrialInformation`, then what follows the appraisal, and None.

    A trial is simulated again only after the trial, the options or the last result have changed.

    :param make_simulator: makes the engine; called in the thread.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        super().__init__('appraisal')
        self._make_simulator = make_simulator
        # `_appraisals` is valid for these options and this result
        self._base: tuple[Options, CalibrationResult | None] | None = None
        self._appraisals: _Appraisals = {}

    def start(self, trials: Sequence[Trial], options: Options, result: CalibrationResult | None = None,
              whole: bool = True, then: Then | None = None) -> None:
        """
        Begin to appraise the trials that are new, and return immediately.

        :param result: of the last calibration, whose trials are not appraised again; ignored if it has other
            parameters.
        :param whole: whether the last trial is complete; if not, it is left out unless it ends at rest.
        :param then: called in the thread after the appraisal; None: nothing follows.
        :raises DloCalibrationError: while another appraisal is under way.
        """
        if not whole and trials and not trials[-1].goals[-1].stable:
            trials = trials[:-1]
        put = self.events.put

        def work(should_stop: Callable[[], bool]) -> None:
            try:
                evidence = GripEvidence.of(trials)  # takes a second for long streams
                chosen = choose(trials, options, evidence).options
                appraised = appraise(self._make_simulator, tuple(trials), chosen,
                                     *self._known(chosen, result), put, should_stop, evidence)
                if then is not None:
                    put(then(appraised, chosen, should_stop))
            except CancelledError:
                pass
            except Exception as error:  # an appraisal never disturbs the node
                put(TrialInformation.unknown(trials[-1].name if trials else 'nothing', options.space.free,
                                             one_line(error)))

        self.begin(work)

    def _known(self, options: Options, result: CalibrationResult | None
               ) -> tuple[CalibrationResult | None, _Appraisals]:
        """Return the last result, unless it has other parameters, and the appraisals that count with it."""
        if result is not None and result.space != options.space:
            result = None
        if self._base is None or self._base[0] != options or self._base[1] is not result:
            self._base, self._appraisals = (options, result), {}
        return result, self._appraisals

    def stop(self) -> None:
        """End the appraisal under way, delete its results, and return immediately."""
        super().stop()
        self.events, self._base = queue.SimpleQueue(), None

    def waiting_information(self) -> Iterator[TrialInformation]:
        """Yield the results so far, without waiting for more."""
        return (event for event in self.waiting_events() if isinstance(event, TrialInformation))


def fingerprints(trials: Sequence[Trial]) -> list[tuple[str, int]]:
    """Return a digest of each trial without its name, and a number that distinguishes equal trials."""
    counts: Counter[str] = Counter()
    numbered = []
    for trial in map(without_repeated_goals, trials):
        text = digest(trial.initial.points, trial.velocity, trial.hands,
                      [(goal.time, goal.stable, goal.held_by) for goal in trial.goals])
        numbered.append((text, counts[text]))
        counts[text] += 1
    return numbered


@dataclass(frozen=True, eq=False)
class Appraised:
    """
    The trials that count, and what they say so far.

    :param trials: as appraised; those without an appraisal are left out.
    """

    appraisal: Appraisal
    trials: tuple[Trial, ...]


def appraise(make_simulator: SimulatorFactory, trials: Sequence[Trial], options: Options,
             result: CalibrationResult | None = None, appraisals: _Appraisals | None = None,
             put: Callable[[Any], None] = lambda _: None,
             should_stop: Callable[[], bool] = lambda: False,
             evidence: GripEvidence | None = None) -> Appraised:
    """
    Appraise the trials that are new, one after another.

    :param options: decided, see `choose`.
    :param result: of a calibration, whose trials are not appraised again; None: there is none.
    :param appraisals: those so far, to which the new ones are added.
    :param put: called with the information that each new trial adds.
    :param evidence: what the trials show of the hands, if it is known already.
    :raises CancelledError: when stopped.
    """
    appraisals = {} if appraisals is None else appraisals
    space, height = options.space, options.table_top
    if not trials:
        return Appraised(Appraisal.before(space.free, space.default_point()), ())
    examination = None if result is None else result.examination
    done = fingerprints(result.trials) if result and examination and examination.regular else []
    keys = fingerprints(trials)
    new = [(k, tuple(keys[:k + 1])) for k, key in enumerate(keys) if key not in done]
    evidence = evidence or GripEvidence.of(trials)
    lost = {loss.trial: str(loss) for loss in evidence.losses}
    usable = {trial.name: trial for trial in evidence.usable(trials)}
    hands = {name: getattr(options, name) for name in HANDS}
    trials = with_shared_places([with_hands(usable.get(trial.name, trial), hands) for trial in trials])
    start, default = Prior.of(trials, options, evidence).hints.start, space.default_point()
    guessed = tuple(name for name, value in zip(space.free, start, strict=True) if np.isnan(value))
    before, appraised = Appraisal.before(space.free, np.where(np.isnan(start), default, start)), []
    if result is not None and done and examination is not None:
        before = Appraisal(before.names, result.best.point, examination.uncertainty)
        appraised = list(result.trials)
    with ExitStack() as stack:
        pool = None if all(key in appraisals for _, key in new) else Pool(
            stack.enter_context(closing(make_simulator(options))), stack.enter_context(closing(Threads(1))),
            should_stop)
        for k, key in new:
            trial, fresh = trials[k], key not in appraisals
            reasons = () if not fresh else (lost[trial.name],) if trial.name not in usable else \
                implausible(trial, height, bool(options.scene))
            if reasons:  # information from it would be wrong
                appraisals[key] = reasons[0]
            elif pool is not None and fresh:
                try:
                    appraisals[key] = Appraiser(
                        space, pool, mean_length(trials), height, noise(trials), guessed).after(
                        before, [*appraised, trial])
                except CancelledError:
                    raise
                except Exception as error:  # of the engine
                    appraisals[key] = one_line(error)
            appraisal = appraisals[key]
            if isinstance(appraisal, str):
                added = TrialInformation.unknown(trial.name, before.names, appraisal)
            else:
                added = TrialInformation(trial.name, before.names, before.uncertainty.std,
                                         appraisal.uncertainty.std, appraisal.uncertainty.verdicts,
                                         outlier=appraisal.outlier([*appraised, trial]))
                before, appraised = appraisal, [*appraised, trial]
            if fresh:
                put(added)
    return Appraised(before, tuple(appraised))
