# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Refusals: counts what is refused for one reason, so that one is told a few times, not 10,000."""

from __future__ import annotations

from dataclasses import dataclass
import re
from typing import Iterable

FIRST_INTERVAL, LONGEST_INTERVAL = 1.0, 60.0  # s between two reports of one reason; it doubles each time
MOST_REASONS = 100  # that are told apart; wrong input can be wrong in any number of ways
OTHER = 'other'  # the reason of all refusals beyond these

#: What may differ between refusals for the same reason: quoted texts, and numbers.
_VALUES = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?""")


@dataclass
class _Reason:
    """
    A reason, with the refusals that it had so far.

    :param text: of its newest refusal.
    :param count: of its refusals.
    :param told: how many of them have been told.
    :param due: when the next ones may be told [s].
    :param interval: from then to the next time [s].
    """

    text: str
    count: int = 0
    told: int = 0
    due: float = float('-inf')
    interval: float = FIRST_INTERVAL

    def words(self) -> str:
        """Return the newest refusal, and how many there were."""
        return self.text if self.count == 1 else f'{self.text} ({self.count} times)'

    def tell(self, now: float) -> str:
        """Return the words, and note that they were told."""
        self.told, self.due = self.count, now + self.interval
        self.interval = min(2 * self.interval, LONGEST_INTERVAL)
        return self.words()


class Refusals:
    """Counts refusals as they come, and says when to tell them: the first of a reason at once."""

    def __init__(self) -> None:
        self._reasons: dict[str, _Reason] = {}

    def add(self, text: str) -> str:
        """Count a refusal; return its text, with the number of refusals for this reason if there are more."""
        name = reason(text)
        if name not in self._reasons and len(self._reasons) >= MOST_REASONS:
            name = OTHER
        known = self._reasons.setdefault(name, _Reason(text))
        known.text, known.count = text, known.count + 1
        return known.words()

    def due(self, now: float) -> list[str]:
        """Return, once, what is to be told at the time `now` [s]: a reason again after 1, 2, 4, ... 60 s."""
        return [one.tell(now) for one in self._reasons.values() if one.count > one.told and now >= one.due]

    def rest(self) -> list[str]:
        """Return, once, all that has not been told."""
        return self.due(float('inf'))


def reason(text: str) -> str:
    """Return the reason in the text of a refusal: it is the same whatever the stamps, numbers and names."""
    return _VALUES.sub('#', text)


def counted(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the first refusal of each reason, and how many more there are of it, in the order they came."""
    found: dict[str, list[str]] = {}
    for text in dict.fromkeys(texts):
        name = reason(text)
        if name not in found and len(found) >= MOST_REASONS:
            name = OTHER
        found.setdefault(name, []).append(text)
    return tuple(first if not more else f'{first} (and {len(more)} more like it)'
                 for first, *more in found.values())
