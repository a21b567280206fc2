# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Information of each trial before a calibration, computed while the person works."""

from __future__ import annotations

import time
from typing import Any, Sequence

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.model.trial import Trial
from dlo_calibration.workspace.live_information import fingerprints, LiveInformation

QUIET = 1.0  # s without a change of the trials before they are simulated


class Information:
    """
    Appraises trials in the background; its methods return at once. It is not thread-safe.

    :param make_simulator: makes the engine.
    """

    def __init__(self, make_simulator: SimulatorFactory) -> None:
        self._appraiser = LiveInformation(make_simulator)
        self._wanted: tuple[tuple[Trial, ...], Options] = ((), Options())
        self._scene = ''
        self._appraised: tuple[object, ...] = ()  # key of the last appraisal
        self._changed = time.monotonic()
        self._entries: dict[str, dict[str, Any]] = {}  # by the name of the trial

    def want(self, trials: Sequence[Trial], options: Options, scene: str = '') -> None:
        """
        Set the trials to appraise; each has a name of its own.

        :param scene: digest of the obstacles in the scene of the options.
        """
        if _key(trials, options, scene) != _key(*self._wanted, self._scene):
            self._wanted, self._scene, self._changed = (tuple(trials), options), scene, time.monotonic()

    def pause(self) -> None:
        """Stop the appraisal, to leave the processor to a calibration; `take` starts it again."""
        if self._appraiser.alive:
            self._appraiser.stop()
            self._appraised = ()

    def take(self) -> bool:
        """Begin to appraise new trials; return whether information has arrived since the last call."""
        key = _key(*self._wanted, self._scene)
        if key != self._appraised and time.monotonic() - self._changed > QUIET:
            if key[:len(self._appraised)] != self._appraised:  # more than new trials at the end
                self._appraiser.stop()
                self._entries, self._appraised = {}, ()
            if self._appraiser.join(0.0):
                self._appraiser.start(*self._wanted)
                self._appraised = key
        news = False
        for information in self._appraiser.waiting_information():
            std = information.values
            values = None if information.failure else {
                name: {'before': std[f'std_before_{name}'], 'after': std[f'std_after_{name}']}
                for name in information.names}
            self._entries[information.trial] = {'parameters': values, 'sentence': information.words}
            news = True
        return news

    def plain(self, name: str) -> dict[str, Any] | None:
        """Return the information of a trial as the page shows it; None: it is not known yet."""
        return self._entries.get(name)

    def close(self) -> None:
        """End the simulations."""
        self._appraiser.stop()
        self._appraiser.join(1.0)


def _key(trials: Sequence[Trial], options: Options, scene: str) -> tuple[object, ...]:
    return ((repr(options), scene), *zip((trial.name for trial in trials), fingerprints(trials), strict=True))
