# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a node knows of the next action."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dlo_calibration.model.chain import Chain
from dlo_calibration.ros.resting_place import is_near, RestingPlace
from dlo_calibration.workspace.next_action import NextAction


@dataclass
class Advising:
    """
    The newest advice, and when to seek another one.

    :param advice: what to do next; None: unknown yet.
    :param asked: number of trials, and where the DLO rested, when advice was sought last; None: seek it anew.
    :param resting_place: what is known of where the DLO rests.
    :param began: time of the first advice [s].
    :param minutes_left: until what is wanted is reached, at the speed so far; nan: unknown.
    """

    advice: NextAction | None = None
    asked: tuple[int, Chain] | None = None
    resting_place: RestingPlace = field(default_factory=RestingPlace)
    began: float | None = None
    minutes_left: float = float('nan')

    def is_due(self, trials: int, place: Chain) -> bool:
        """Tell whether advice for a DLO that rests somewhere was not sought yet, after so many trials."""
        return self.asked is None or self.asked[0] != trials or not is_near(self.asked[1], place)

    def take(self, advice: NextAction, trials: int, now: float) -> None:
        """Take advice that came at a time [s], after some trials."""
        self.advice = advice
        self.began = now if self.began is None else self.began
        if trials:
            self.minutes_left = advice.trials * (now - self.began) / trials / 60

    @property
    def told(self) -> dict[str, Any]:
        """What the status says about it."""
        advice = self.advice
        if advice is None:
            return {}
        told: dict[str, Any] = {'advice': advice.words, 'trials_left': advice.trials,
                                'minutes_left': self.minutes_left}
        for name, (now, then, wanted) in advice.distances.items():
            told.update({f'half_width_{name}': now, f'expected_half_width_{name}': then,
                         f'wanted_half_width_{name}': wanted})
        return told
