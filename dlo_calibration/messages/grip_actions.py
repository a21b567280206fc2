# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""GripActions: the used actions of a trial, where their hands grip the DLO, and what the hands do when."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field
from typing import Iterable, Iterator, NamedTuple, Sequence

import numpy as np

from dlo_calibration.messages.codec import ActionMessage, ChainMessage, Key, NANOSECONDS
from dlo_calibration.messages.keyed_list import KEY, KeyedList
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, MINIMUM_SPACING


@dataclass(frozen=True)
class GripAction:
    """
    An action that is used.

    :param grips: of each hand; so are `offsets`, and `nearest`: whether it grips the nearest place.
    :param stamps: of its waypoints [ns].
    """

    message: ActionMessage = field(compare=False)
    grips: tuple[tuple[int, ...], ...]
    offsets: tuple[float, ...]
    nearest: tuple[bool, ...]
    stamps: tuple[int, ...]

    @property
    def key(self) -> Key:
        """The place of the message in the order of all messages."""
        return self.message.key

    def action(self, zero: int) -> Action:
        """Return the action, whose times count from `zero` [ns]."""
        sent, times = self.message, seconds(self.stamps, zero)
        return Action(tuple(
            Hand(name, self.grips[k], times, sent.positions[:, k], sent.orientations[:, k], self.offsets[k],
                 self.nearest[k])
            for k, name in enumerate(sent.names)))


class HandState(NamedTuple):
    """
    What the hands do when a goal chain is observed.

    :param names: of the hands that the annotation of the chain numbers, in this order.
    :param stable: whether an action is over, and none is under way.
    :param held_by: names of the hands that hold the DLO.
    :param finished: number of actions that are over.
    :param end: when the last one of them was over [ns]; if none is, when the latest action will be.
    :param opened: whether a hand opened then.
    """

    names: tuple[str, ...]
    stable: bool
    held_by: tuple[str, ...]
    finished: int
    end: int
    opened: bool


class GripActions(KeyedList[GripAction]):
    """The used actions of a trial, and when they begin and end."""

    def __init__(self, actions: Iterable[GripAction] = ()) -> None:
        super().__init__(actions)
        self._begins = sorted(action.stamps[0] for action in self)
        self._ends = sorted((action.stamps[-1], action.key) for action in self)
        #: [ns] No action lasts longer.
        self._longest = max((action.stamps[-1] - action.message.stamp for action in self), default=0)

    def put(self, key: Key, entry: GripAction | None) -> GripAction | None:
        """Replace the action with a key, or delete it for None; return the previous one, if there was one."""
        previous = super().put(key, entry)
        if previous is not None:
            del self._begins[bisect_left(self._begins, previous.stamps[0])]
            del self._ends[bisect_left(self._ends, (previous.stamps[-1], key))]
        if entry is not None:
            insort(self._begins, entry.stamps[0])
            insort(self._ends, (entry.stamps[-1], key))
            self._longest = max(self._longest, entry.stamps[-1] - entry.message.stamp)
        return previous

    def hands(self, goal: ChainMessage, release: bool) -> HandState:
        """
        Return what the hands do when a used goal chain is observed.

        :param release: whether hands open at the end of an action, if the goal chain is not annotated.
        """
        latest = self.before(goal.key)
        assert latest is not None
        names, last = latest.message.names, latest
        finished = bisect_left(self._ends, (goal.stamp,))
        under_way = bisect_right(self._begins, goal.stamp) > finished
        if finished:  # at equal ends, the first one
            _, key = self._ends[bisect_left(self._ends, (self._ends[finished - 1][0],))]
            last = self.at(key) or latest
        held_by: tuple[str, ...] = ()
        if goal.chain.hands is not None:
            held_by = tuple(names[k - 1] for k in np.unique(goal.chain.hands).tolist() if k)
        elif not release:
            held_by = tuple(dict.fromkeys(name for action in self if action.stamps[-1] < goal.stamp
                                          for name in action.message.names))
        return HandState(names, bool(finished) and not under_way, held_by, finished, last.stamps[-1],
                         not set(last.message.names) <= set(held_by))

    def offset(self, action: ActionMessage, name: str, grip: tuple[int, ...]) -> float:
        """Return the offset of a hand that holds annotated points: that of its last grip of them."""
        for previous in self._backwards(action.key):
            if name in previous.message.names:
                k = previous.message.names.index(name)
                return previous.offsets[k] if previous.grips[k] == grip else 0.0
        return 0.0

    def continued_grip(self, action: ActionMessage, name: str, position: Floats,
                       since: int) -> tuple[tuple[int, ...], float] | None:
        """Return the grip of a hand that begins where its last action ended, later than `since` [ns]."""
        for previous in self._backwards(action.key):
            if previous.message.stamp + self._longest <= since:
                break
            if name in previous.message.names and previous.stamps[-1] > since:
                k = previous.message.names.index(name)
                there = np.linalg.norm(previous.message.positions[-1, k] - position) <= MINIMUM_SPACING
                return (previous.grips[k], previous.offsets[k]) if there else None
        return None

    def _backwards(self, key: Key) -> Iterator[GripAction]:
        """Yield the actions before a key, the latest one first."""
        for k in range(bisect_left(self, key, key=KEY) - 1, -1, -1):
            yield self[k]


def waypoint_stamps(action: ActionMessage) -> tuple[int, ...]:
    """Return the stamps of the waypoints [ns]."""
    return tuple(action.stamp + round(float(t) * NANOSECONDS) for t in action.times)


def annotated_grips(chain: Chain, numbered: Sequence[str], names: Sequence[str]) -> list[tuple[int, ...]]:
    """
    Return the points that hands grip according to the annotation of a chain; empty without one.

    :param numbered: names of the hands that the annotation numbers, in this order.
    :param names: of the hands asked for.
    """
    return [() if chain.hands is None or name not in numbered else
            tuple(np.flatnonzero(chain.hands == numbered.index(name) + 1).tolist()) for name in names]


def seconds(stamps: Iterable[int], zero: int) -> Floats:
    """Return stamps [ns] as seconds since `zero`; equal stamps give equal numbers."""
    return np.array([(stamp - zero) / NANOSECONDS for stamp in stamps])
