# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What each trial tells before a calibration, and what to do next, computed while the person works."""

from __future__ import annotations

import time
from typing import Any, Callable, Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.model.trial import Trial
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.workspace.live_information import Appraised, fingerprints, LiveInformation, Then
from dlo_calibration.workspace.next_action import next_action, NextAction, resting

QUIET = 1.0  # s without a change of the trials before they are simulated


class Information:
    """
    Appraises trials in the background; its methods return at once. It is not thread-safe.

    :param make_simulator: makes the engine.
    :ivar advice: what to do after the last trial; None: it is not known yet, or nobody asked.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._make_simulator, self._appraiser = make_simulator, LiveInformation(make_simulator)
        self._wanted: tuple[tuple[Trial, ...], Options] = ((), Options())
        self._scene = ''
        self._limits: AdviceOptions | None = None
        self._asked: AdviceOptions | None = None  # with the last appraisal
        self.advice: NextAction | None = None
        self._appraised: tuple[object, ...] = ()  # key of the last appraisal
        self._changed = time.monotonic()
        self._entries: dict[str, dict[str, Any]] = {}  # by the name of the trial

    def want(self, trials: Sequence[Trial], options: Options, scene: str = '',
             limits: AdviceOptions | None = None) -> None:
        """
        Set the trials to appraise; each has a name of its own.

        :param scene: digest of the obstacles in the scene of the options.
        :param limits: what the hands may do after the last trial; None: no advice is sought.
        """
        if (_key(trials, options, scene), limits) != (_key(*self._wanted, self._scene), self._limits):
            self._wanted, self._scene, self._limits = (tuple(trials), options), scene, limits
            self._changed, self.advice = time.monotonic(), None

    def pause(self) -> None:
        """Stop the appraisal, to leave the processor to a calibration; `take` starts it again."""
        if self._appraiser.alive:
            self._appraiser.stop()
            self._appraised = ()

    def take(self) -> bool:
        """Begin to appraise new trials; return whether information has arrived since the last call."""
        key = _key(*self._wanted, self._scene)
        if (key, self._limits) != (self._appraised, self._asked) and time.monotonic() - self._changed > QUIET:
            if key[:len(self._appraised)] != self._appraised:  # more than new trials at the end
                self._appraiser.stop()
                self._entries, self._appraised = {}, ()
            if self._appraiser.join(0.0):
                self._appraiser.start(*self._wanted, then=self._asking(self._limits))
                self._appraised, self._asked = key, self._limits
        news = False
        for event in self._appraiser.waiting_events():
            if isinstance(event, NextAction) and (key, self._limits) == (self._appraised, self._asked):
                self.advice, news = event, True
            elif isinstance(event, TrialInformation):
                std = event.values
                values = None if event.failure else {
                    name: {'before': std[f'std_before_{name}'], 'after': std[f'std_after_{name}']}
                    for name in event.names}
                self._entries[event.trial] = {'parameters': values, 'sentence': event.words}
                news = True
        return news

    def _asking(self, limits: AdviceOptions | None) -> Then | None:
        trials, make = self._wanted[0], self._make_simulator

        def ask(appraised: Appraised, options: Options, should_stop: Callable[[], bool]) -> NextAction:
            assert limits is not None
            try:
                return next_action(appraised, options, limits, resting(trials), make, should_stop)
            except (InputError, SimulationError) as error:
                return NextAction.failed(options.space.free, str(error))

        return None if limits is None else ask

    def plain(self, name: str) -> dict[str, Any] | None:
        """Return the information of a trial as the page shows it; None: it is not known yet."""
        return self._entries.get(name)

    def close(self) -> None:
        """End the simulations."""
        self._appraiser.stop()
        self._appraiser.join(1.0)


def _key(trials: Sequence[Trial], options: Options, scene: str) -> tuple[object, ...]:
    return ((repr(options), scene), *zip((trial.name for trial in trials), fingerprints(trials), strict=True))
