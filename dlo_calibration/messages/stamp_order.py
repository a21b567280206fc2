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
import math

from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import INITIAL, INPUT_TYPES, NANOSECONDS
from dlo_calibration.messages.trial_builder import Message

# [ns] Two trackers on one topic may differ by less; a restarted clock goes back further.
MARGIN = NANOSECONDS


class StampOrder:
    """
    The newest stamps of messages, in the order in which they came.

    A message goes back if it is stamped

    - more than MARGIN before the newest one of its own topic,
    - before the newest initial chain, and
    - before two other messages, as a single wrong stamp in the future is no clock.

    An initial chain that goes back tells that the clock did.  An action or a goal chain that does may
    belong to either clock, so it is refused.

    :param former: the order before the clock went back; None: it never did.
    """

    def __init__(self, former: StampOrder | None = None) -> None:
        self._frame = ''
        self._newest: dict[str, int] = {}  # of each topic
        self._latest: list[int] = [0]  # the two newest of all topics
        self._first: float = math.inf  # of the initial chains
        self._former_end = 0 if former is None else former.newest
        self._ahead = {} if former is None else {  # newest stamps on the topics that have not yet gone back
            kind: former._newest.get(kind, 0) for kind in INPUT_TYPES}

    @property
    def newest(self) -> int:
        """The newest stamp [ns]; 0 before the first message."""
        return self._latest[0]

    def clock_went_back(self, message: Message) -> bool:
        """Tell whether the clock went back before this message."""
        return message.kind == INITIAL and message.frame_id == self._frame and self._goes_back(message)

    def left_over(self, message: Message) -> bool:
        """
        Tell whether this message was stamped before the clock went back, and was under way then.

        It is stamped near the end of the former clock, on a topic that has not yet gone back.
        """
        return (message.kind in self._ahead and message.stamp > self._ahead[message.kind]
                and abs(message.stamp - self._former_end) <= MARGIN and message.stamp > self.newest + MARGIN)

    def check(self, message: Message) -> None:
        """
        Check that a message certainly belongs to the trials of the present clock.

        :raises InputError: if it does not.
        """
        if message.frame_id != self._frame:
            return  # the collector refuses it
        # What is stamped before all trials can be used by none; the collector refuses it.
        if message.kind != INITIAL and message.stamp > self._first and self._goes_back(message):
            earlier = (self._newest[message.kind] - message.stamp) / NANOSECONDS
            raise InputError(
                str(message), f'it {earlier:.6g} s before the newest {message.kind}, in an earlier trial',
                'the order of stamps on each topic',
                'stamp all messages with one clock, and send an initial_chain first after it went back')

    def _goes_back(self, message: Message) -> bool:
        return (message.stamp < self._newest.get(message.kind, 0) - MARGIN
                and message.stamp < self._newest.get(INITIAL, 0) and message.stamp < self._latest[-1])

    def after_jump(self) -> StampOrder:
        """Return the order of the messages from now on, as the clock went back."""
        return StampOrder(self)

    def add(self, message: Message) -> None:
        """Take a message that `check` does not refuse; ignore one in another frame than the first."""
        self._frame = self._frame or message.frame_id
        if message.frame_id != self._frame:
            return
        if message.kind == INITIAL:
            self._first = min(self._first, message.stamp)
        if message.stamp < self._former_end - MARGIN:
            self._ahead.pop(message.kind, None)
        self._newest[message.kind] = max(self._newest.get(message.kind, 0), message.stamp)
        self._latest = nlargest(2, {*self._latest, message.stamp})


def went_back(before: int, now: int) -> str:
    """Return the sentence about a clock that went from one stamp [ns] back to another."""
    return (f'the clock went back by {(before - now) / NANOSECONDS:.6g} s (from '
            f'{before / NANOSECONDS:.3f} to {now / NANOSECONDS:.3f})')
