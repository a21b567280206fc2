# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Situation: what the node knows of its session, besides the messages."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.collector import KEPT
from dlo_calibration.messages.refusals import Refusals


@dataclass
class Pace:
    """
    When to repeat something that is repeated if needed, but not too often.

    :param wanted: whether it is needed.
    :param last: time when it was done last [s].
    """

    wanted: bool = False
    last: float = float('-inf')


@dataclass
class Dropped:
    """
    Messages that were dropped.

    :param counts: how many of each kind.
    :param told: how many of them have been told, when last at the time `last` [s].
    """

    counts: Counter[str] = field(default_factory=Counter)
    told: Counter[str] = field(default_factory=Counter)
    last: float = float('-inf')

    def due(self, now: float, at_once: bool) -> list[str]:
        """Return, once, what is to be told at the time `now` [s], at most once a second."""
        new = self.counts - self.told
        if not new or not at_once and now - self.last <= 1.0:
            return []
        self.told, self.last = Counter(self.counts), now
        return [f'{kind}: {count} message(s) were dropped, as they came faster than they can be read; '
                'publish fewer a second' for kind, count in new.items()]


@dataclass
class Situation:
    """
    What a reset forgets, besides the trials.

    :param detail: about the state, e.g. why the calibration failed.
    :param refusals: the latest ones, which are not reported again.
    :param counted: the same, by their reason.
    :param heard: time of the last action or goal chain [s].
    :param started: whether a calibration was started, so that `start_after_trials` starts none.
    :param result: of the last calibration.
    :param information: about the newest trial that was appraised.
    """

    state: str = 'collecting'
    detail: str = ''
    last_refusal: str = ''
    refusals: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT))
    counted: Refusals = field(default_factory=Refusals)
    heard: float = float('-inf')
    started: bool = False
    result: CalibrationResult | None = None
    information: TrialInformation | None = None
    dropped: Dropped = field(default_factory=Dropped)
    markers: Pace = field(default_factory=Pace)
    appraisal: Pace = field(default_factory=Pace)


@dataclass
class Calibration:
    """
    A calibration under way.

    :param situation: of the session in which it started, which may have ended since.
    :param sent: time of its last progress message [s].
    """

    options: Options
    progress: Progress
    situation: Situation
    sent: float = float('-inf')
