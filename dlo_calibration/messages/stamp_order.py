# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
StampOrder: tells a clock that went back from a message that came late.

ROS does not order different topics, and an action may be published only when it is
over, so a message may be late by minutes.  But on one topic, stamps hardly ever go
back, and none goes back behind the beginning of the newest trial.
"""

from __future__ import annotations

from heapq import nlargest

from dlo_calibration.messages.codec import INITIAL, INPUT_TYPES, NANOSECONDS
from dlo_calibration.messages.trial_builder import Message

# [ns] Two trackers on one topic may differ by less; a restarted clock goes back further.
MARGIN = NANOSECONDS


class StampOrder:
    """
    The newest stamps of messages, in the order in which they came.

    The clock went back if a message is stamped

    - more than MARGIN before the newest one of its own topic,
    - before the newest initial chain, and
    - before two other messages, as a single wrong stamp in the future is no clock.

    Messages of the former clock that are still under way then are `late`: they are stamped
    near its end, on a topic that has not yet gone back.
    """

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}  # of each topic
        self._latest: list[int] = [0]  # the two newest of all topics
        self._former = 0  # newest stamp before the clock went back
        self._waiting: set[str] = set()  # topics that have not yet gone back

    @property
    def newest(self) -> int:
        """The newest stamp [ns]; 0 before the first message."""
        return self._latest[0]

    def goes_back(self, message: Message) -> bool:
        """Tell whether the clock went back before this message."""
        return (message.stamp < self._newest.get(message.kind, 0) - MARGIN
                and message.stamp < self._newest.get(INITIAL, 0) and message.stamp < self._latest[-1])

    def late(self, message: Message) -> bool:
        """Tell whether this message was stamped before the clock went back."""
        return (message.kind in self._waiting and abs(message.stamp - self._former) <= MARGIN
                and message.stamp > self.newest + MARGIN)

    def restart(self) -> None:
        """Begin anew, as the clock went back."""
        former = self.newest
        self.__init__()  # type: ignore[misc]
        self._former, self._waiting = former, set(INPUT_TYPES)

    def add(self, message: Message) -> None:
        """Take a message that is not `late`."""
        if message.stamp < self._former - MARGIN:
            self._waiting.discard(message.kind)
        self._newest[message.kind] = max(self._newest.get(message.kind, 0), message.stamp)
        self._latest = nlargest(2, {*self._latest, message.stamp})


def went_back(before: int, now: int) -> str:
    """Return the sentence about a clock that went from one stamp [ns] back to another."""
    return (f'the clock went back by {(before - now) / NANOSECONDS:.6g} s (from '
            f'{before / NANOSECONDS:.3f} to {now / NANOSECONDS:.3f})')
