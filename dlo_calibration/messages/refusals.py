# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Refusals: counts the refusals for each reason, so that each is reported a few times, not 10,000."""

from __future__ import annotations

from dataclasses import dataclass
import re
from typing import Iterable

FIRST_INTERVAL, LONGEST_INTERVAL = 1.0, 60.0  # s between two reports of one reason; it doubles each time
MOST_REASONS = 100  # that are distinguished; input can be wrong in any number of ways
OTHER = 'other'  # the reason of all refusals beyond these

#: What may differ between refusals for the same reason: quoted texts, and numbers.
_VALUES = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?""")


@dataclass
class _Reason:
    """
    The refusals for one reason.

    :param text: of the newest one.
    :param count: number of refusals.
    :param reported: number of them when they were last reported.
    :param due: time of the next report, if there are more by then [s].
    :param interval: from that report to the next [s].
    """

    text: str
    count: int = 0
    reported: int = 0
    due: float = float('-inf')
    interval: float = FIRST_INTERVAL

    def __str__(self) -> str:
        """Return the newest refusal, and how many there were."""
        return self.text if self.count == 1 else f'{self.text} ({self.count} times)'

    def report(self, now: float) -> str:
        """Return a report at the time `now` [s]."""
        self.reported, self.due = self.count, now + self.interval
        self.interval = min(2 * self.interval, LONGEST_INTERVAL)
        return str(self)


class Refusals:
    """Counts refusals; each reason is reported at once, then after 1, 2, 4, ... 60 s."""

    def __init__(self) -> None:
        self._reasons: dict[str, _Reason] = {}

    def add(self, text: str) -> str:
        """Count a refusal; return its text, with the number of refusals for this reason if there are more."""
        name = reason(text)
        if name not in self._reasons and len(self._reasons) >= MOST_REASONS:
            name = OTHER
        entry = self._reasons.setdefault(name, _Reason(text))
        entry.text, entry.count = text, entry.count + 1
        return str(entry)

    def due(self, now: float) -> list[str]:
        """Return the reports that are due at the time `now` [s]."""
        return [each.report(now) for each in self._reasons.values()
                if each.count > each.reported and now >= each.due]

    def rest(self) -> list[str]:
        """Return the reports of all that has not been reported."""
        return self.due(float('inf'))


def reason(text: str) -> str:
    """Return the reason in the text of a refusal: the text without stamps, numbers and names."""
    return _VALUES.sub('#', text)


def counted(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the first refusal of each reason in order, and how many more like it there are."""
    by_reason: dict[str, list[str]] = {}
    for text in dict.fromkeys(texts):
        name = reason(text)
        if name not in by_reason and len(by_reason) >= MOST_REASONS:
            name = OTHER
        by_reason.setdefault(name, []).append(text)
    return tuple(first if not more else f'{first} (and {len(more)} more like it)'
                 for first, *more in by_reason.values())
