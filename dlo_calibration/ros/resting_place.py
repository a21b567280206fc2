# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where a DLO rests, as far as messages tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.messages.codec import INITIAL, Message, NANOSECONDS
from dlo_calibration.messages.collector import MARGIN
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Goal

ELSEWHERE = 0.01  # m that the points of a DLO at rest move on average, if it was moved
LAID = 3.0  # s besides the pause of an action, for which a DLO lies still that no message says to rest


def is_near(chain: Chain, other: Chain) -> bool:
    """Tell whether two chains show a DLO at the same place."""
    if len(chain) != len(other):
        return False
    away = np.linalg.norm(chain.observed - other.observed, axis=1)
    away = away[np.isfinite(away)]
    return len(away) > 0 and bool(away.mean() < ELSEWHERE)


@dataclass
class Place:
    """
    Where a DLO is seen.

    :param chain: the first one that shows it there.
    :param told: whether that is an initial chain, so that the DLO rests.
    :param since: stamp of that one, and `until` of the last one that shows it there [ns].
    """

    chain: Chain
    told: bool
    since: int
    until: int


class RestingPlace:
    """Follows messages, as they come, to where the DLO rests; a tracker may show it all the time."""

    def __init__(self) -> None:
        self._seen: Place | None = None  # None: an action followed
        self._acted = 0  # stamp of the newest action [ns]

    def take(self, message: Message, chain: Chain | None) -> None:
        """Take an action, or a message with a chain: that in the frame of the table."""
        seen, stamp = self._seen, message.stamp
        if chain is None:
            # A tracker tells an action when it is over, and has shown since where the DLO went.
            if seen is None or stamp >= seen.since:
                self._seen, self._acted = None, stamp
            return
        told = message.kind == INITIAL
        if self._acted - MARGIN < stamp < self._acted or told and seen and stamp < seen.until:
            return  # it came late, and shows where the DLO was
        if not told and seen and stamp >= seen.since and is_near(seen.chain, chain):
            seen.until = stamp
        else:
            self._seen = Place(chain, told, stamp, stamp)

    def find(self, last: Goal | None, quiet: bool, pause: float) -> Chain | None:
        """
        Return where the DLO rests; None while it moves, a hand holds it, or it is unknown.

        :param last: goal of the newest trial, if that one is complete.
        :param quiet: whether no message has come for a while; a stream itself must show that the DLO rests.
        :param pause: of the actions that are advised [s].
        """
        seen = self._seen
        if seen is None or seen.told:
            return None if seen is None else seen.chain
        if last is not None:
            if last.held_by:
                return None
            if last.stable and (quiet or last.count > 1) and is_near(seen.chain, last.chain):
                return last.chain
        return seen.chain if (seen.until - seen.since) / NANOSECONDS > pause + LAID else None
