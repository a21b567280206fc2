# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""
Collector: messages to trials, by the stamps in their headers.

The trials follow from the collected messages alone: the same messages give the
same trials in whatever order they arrive (topics are not ordered among each
other, and a robot may know what its hands did only when they have done it).

- Messages are ordered by stamp; of equal stamps first the initial chain, then
  the action, then the goal chain.
- An initial chain begins a trial where an action or a goal chain came since the
  last one.  Else it takes the place of that one, which gives the velocity where
  it is less than 0.1 s older; of several older ones, the latest counts.
- A trial's clock begins with its initial chain.  Where that is at rest, nothing
  happens before the first hand closes, so the clock begins then (or with the
  first goal, if that is earlier): nobody need simulate a DLO that waits.
- A hand grips the points that the latest chain before the action annotates with
  its number; in a goal chain, the number counts in the action before that goal,
  and the hand is the one of that name.  Without annotation it grips the point
  nearest to its first waypoint.
- A goal chain stamped while a hand moves, or before any has closed, is compared
  at that instant; otherwise with the stable configuration.
- A goal chain stamped before the first action of its trial says nothing, and
  waits unused: its action may be late.

A message that does not fit those before it is refused, and has no effect.  It is
remembered, though, without effect: where a message arrives later that was
stamped earlier, and it fits then, it is used.  Actions and goal chains without
any initial chain wait in silence; they are refused once an initial chain is
known that is later than they are.  A message of the same kind and stamp (and of
the same hands) as one before is refused; it replaces one that was refused.

Of the messages that no trial uses, the latest KEPT (at least half of them) are
remembered; what arrives later than that is refused.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Iterable, Union

import numpy as np

from dlo_calibration.action import Action, Hand
from dlo_calibration.chain import Floats
from dlo_calibration.config import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages import ACTION, ActionMessage, ChainMessage, GOAL, INITIAL, NANOSECONDS
from dlo_calibration.trial import Goal, Trial

Message = Union[ChainMessage, ActionMessage]
Key = tuple[int, int, tuple[str, ...]]

VELOCITY_WINDOW = NANOSECONDS // 10  # an initial chain at least that much older gives no velocity
KEPT = 10_000  # messages that no trial uses: more than 5 minutes of a tracker at 30 Hz
RANKS = {INITIAL: 0, ACTION: 1, GOAL: 2}


def order(message: Message) -> Key:
    """Return what messages are sorted by; no two collected ones have the same."""
    names = message.names if isinstance(message, ActionMessage) else ()
    return message.stamp, RANKS[message.kind], names


@dataclass(frozen=True)
class _Move:
    """An action that can be used: which points each of its hands grips, and when it moves [ns]."""

    message: ActionMessage
    grips: tuple[tuple[int, ...], ...]
    instants: tuple[int, ...]


@dataclass(frozen=True)
class _Sight:
    """A goal chain that can be used; its annotation numbers the hands of `names`."""

    message: ChainMessage
    names: tuple[str, ...]
    stable: bool
    held_by: tuple[str, ...]


@dataclass
class _Segment:
    """
    Messages from one start to the next: a trial, complete or not.

    The first segment of a collector has no start: it holds what came before any.
    `extend` takes messages in order only.
    """

    first: Key
    starts: list[ChainMessage] = field(default_factory=list)
    moves: list[_Move] = field(default_factory=list)
    sights: list[_Sight] = field(default_factory=list)
    waiting: list[Message] = field(default_factory=list)
    refused: list[tuple[Message, InputError]] = field(default_factory=list)
    trial: Trial | None = None

    @property
    def busy(self) -> bool:
        """Tell whether an initial chain that comes now begins the next trial."""
        return bool(self.moves or self.sights or self.waiting or not self.starts)

    @property
    def complete(self) -> bool:
        return bool(self.moves and self.sights)

    @property
    def spare(self) -> int:
        """Number of messages that no trial uses."""
        if not self.complete:
            return len(self.starts) + len(self.moves) + len(self.waiting) + len(self.refused)
        return max(len(self.starts) - 2, 0) + len(self.waiting) + len(self.refused)

    def messages(self) -> list[Message]:
        """Return all its messages, sorted."""
        return sorted([*self.starts, *(m.message for m in self.moves), *(s.message for s in self.sights),
                       *self.waiting, *(message for message, _ in self.refused)], key=order)

    def extend(self, message: Message, options: Options) -> InputError | None:
        """Take a message that is later than all others; return why it is not used, if it is not."""
        try:
            if message.kind == INITIAL:
                self.starts.append(message)  # type: ignore[arg-type]
            elif not self.starts:
                self.waiting.append(message)
            elif isinstance(message, ActionMessage):
                self.moves.append(self._move(message, options))
            elif not self.moves:
                self.waiting.append(message)
            else:
                self.sights.append(self._sight(message, options))
        except InputError as error:
            self.refused.append((message, error))
            return error
        self.trial = None
        return None

    def _move(self, action: ActionMessage, options: Options) -> _Move:
        latest, numbered = (self.sights[-1].message, self.sights[-1].names) if self.sights else \
            (self.starts[-1], action.names)
        chain = latest.chain
        grips: list[tuple[int, ...]] = []
        for name, position in zip(action.names, action.positions[0], strict=True):
            held = np.zeros(0, int)
            if chain.hands is not None and name in numbered:
                held = np.flatnonzero(chain.hands == numbered.index(name) + 1)
            if not len(held):
                distances = np.linalg.norm(chain.points - position, axis=1)
                held = np.array([distances.argmin()])
                if distances.min() > options.grip_tolerance:
                    raise InputError(
                        str(action), f'{name} closing {distances.min():.4g} m from any point of {latest}',
                        f'at most {options.grip_tolerance:g} m (grip_tolerance)',
                        'check the first waypoint, or number the gripped points in the field hand')
            twice = {grip for other in grips for grip in other} & set(held.tolist())
            if twice:
                raise InputError(
                    str(action), f'two hands that grip point {min(twice)} of {latest}',
                    'different points', 'number the gripped points in the field hand, or leave one hand out')
            grips.append(tuple(held.tolist()))
        return _Move(action, tuple(grips),
                     tuple(action.stamp + round(float(t) * NANOSECONDS) for t in action.times))

    def _sight(self, goal: ChainMessage, options: Options) -> _Sight:
        start = self.starts[-1]
        if len(goal.chain) != len(start.chain):
            raise InputError(
                str(goal), f'{len(goal.chain)} points',
                f'{len(start.chain)} points as in {start}',
                'send the same material points before and after the action')
        change = abs(goal.length - start.length) / start.length * 100
        if change > options.length_tolerance:
            raise InputError(
                str(goal), f'a length of {goal.length:.4g} m ({change:.0f} % from the '
                f'{start.length:.4g} m of {start})',
                f'at most {options.length_tolerance:g} % (length_tolerance)',
                'check that both chains run along the whole DLO, in metres')
        under_way = any(move.instants[0] <= goal.stamp <= move.instants[-1] for move in self.moves)
        finished = [move for move in self.moves if move.instants[-1] < goal.stamp]
        latest = self.moves[-1].message
        held_by: tuple[str, ...] = ()
        if goal.chain.hands is not None:
            numbers = [int(k) for k in np.unique(goal.chain.hands) if k]
            if numbers and numbers[-1] > len(latest.names):
                raise InputError(
                    str(goal), f'points held by hand {numbers[-1]}',
                    f'hands 1 to {len(latest.names)} as in {latest}',
                    'number the hands in the order of joint_names')
            held_by = tuple(latest.names[k - 1] for k in numbers)
        elif not options.release:
            held_by = tuple(dict.fromkeys(name for move in finished for name in move.message.names))
        return _Sight(goal, latest.names, bool(finished) and not under_way, held_by)

    def build(self, name: str) -> Trial:
        """Return the trial of a complete segment; the same object as long as it is the same."""
        if self.trial is None:
            self.trial = self._build(name)
        elif self.trial.name != name:
            self.trial = replace(self.trial, name=name)
        return self.trial

    def _build(self, name: str) -> Trial:
        start, velocity = self.starts[-1], self._velocity()
        zero = start.stamp
        if velocity is None:
            zero = min([self.sights[0].message.stamp, *(move.instants[0] for move in self.moves)])
        actions = tuple(
            Action(tuple(Hand(hand, move.grips[k], _seconds(move.instants, zero),
                              move.message.positions[:, k], move.message.orientations[:, k])
                         for k, hand in enumerate(move.message.names)))
            for move in self.moves)
        goals = tuple(Goal(sight.message.chain, float(_seconds([sight.message.stamp], zero)[0]), sight.stable,
                           sight.held_by) for sight in self.sights)
        return Trial(name, start.chain, actions, goals, velocity)

    def _velocity(self) -> Floats | None:
        if len(self.starts) < 2:
            return None
        earlier, start = self.starts[-2:]
        elapsed = start.stamp - earlier.stamp
        if elapsed >= VELOCITY_WINDOW or len(earlier.chain) != len(start.chain):
            return None
        return (start.chain.points - earlier.chain.points) * (NANOSECONDS / elapsed)

    def lacks(self) -> str:
        """Say in words what it takes to complete it; empty where it is complete."""
        if self.complete:
            return ''
        if not self.starts:
            return f'an initial_chain before {self.waiting[0]}' if self.waiting else ''
        if not self.moves:
            early = f' ({len(self.waiting)} goal_chain waiting for it)' if self.waiting else ''
            return f'an action after {self.starts[-1]}{early}' + ('' if early else ', and a goal_chain')
        early = f'; {self.waiting[-1]} is before it' if self.waiting else ''
        return f'a goal_chain after {self.moves[0].message}{early}'


def _seconds(instants: Iterable[int], zero: int) -> Floats:
    """Return [ns] instants as seconds since `zero`; equal instants give equal numbers."""
    return np.array([(instant - zero) / NANOSECONDS for instant in instants])


class TrialCollector:
    """
    Collects messages, and gives the trials that they make.

    Not to be shared between threads.

    :param options: `grip_tolerance`, `length_tolerance` and `release` count here.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self.clear()

    def clear(self) -> None:
        """Forget all messages, and the frame_id that they shared."""
        self._frame: str | None = None
        self._segments = [_Segment((0, 0, ()))]
        self._known: dict[Key, Message] = {}
        self._newest: Key = (0, 0, ())
        self._spare = 0
        self._forgotten: list[tuple[Key, Key]] = []  # from, up to but without

    def with_options(self, options: Options) -> TrialCollector:
        """Return a collector of the same messages, also the refused ones, that judges by other options."""
        other = TrialCollector(options)
        for key in sorted(self._known):
            try:
                other.add(self._known[key])
            except InputError:
                pass  # it is among `other.problems`
        for begin, end in self._forgotten:
            other._close(begin, end)
        return other

    def add(self, message: Message) -> None:
        """
        Take one message, of any stamp.

        :raises InputError: where it is refused; the trials stay as they were.
        """
        key = order(message)
        self._check(message, key)
        self._frame = message.frame_id
        self._known[key] = message
        last = self._segments[-1]
        if key > self._newest:
            self._newest = key
            if message.kind == INITIAL and last.busy:
                last = _Segment(key)
                self._segments.append(last)
            before = last.spare
            error = last.extend(message, self._options)
            self._spare += last.spare - before
        else:
            error = self._insert(message, key)
        if self._spare > KEPT:
            self._forget()
        if error is not None:
            raise error

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The complete trials in the order of their stamps: ``trial 1``, ``trial 2``, ..."""
        complete = [segment for segment in self._segments if segment.complete]
        return tuple(segment.build(f'trial {k}') for k, segment in enumerate(complete, start=1))

    @property
    def count(self) -> int:
        """Number of complete trials."""
        return sum(segment.complete for segment in self._segments)

    @property
    def incomplete(self) -> str:
        """What the newest trial lacks, in words; empty where it is complete."""
        return self._segments[-1].lacks()

    @property
    def problems(self) -> tuple[InputError, ...]:
        """
        Why messages are not used, as things stand, and which trials stay incomplete.

        Also what `add` could not know when the message arrived.
        """
        found = [error for segment in self._segments for _, error in segment.refused]
        if len(self._segments) > 1:
            found += [self._no_start(message) for message in self._segments[0].waiting
                      if message.kind == ACTION]
        for segment, following in pairwise(self._segments[1:]):
            if segment.moves and not segment.complete:
                found.append(InputError(
                    f'trial that begins with {segment.starts[-1]}',
                    f'no goal_chain between {segment.moves[0].message} and {following.starts[0]}',
                    'at least one', 'send no initial chain before the goal chain of the trial'))
        return tuple(found)

    def _check(self, message: Message, key: Key) -> None:
        """Refuse what can never be used; forget the refused message that `message` corrects."""
        if self._frame is not None and message.frame_id != self._frame:
            raise InputError(
                str(message), f'frame_id {message.frame_id!r}', f'{self._frame!r} as in the first message',
                'send all chains and actions in one frame, or reset to begin with another')
        if any(begin <= key < end for begin, end in self._forgotten):
            raise InputError(str(message), f'it after more than {KEPT // 2} messages that are later',
                             'messages in about the order of their stamps', 'send it earlier, or reset')
        if key not in self._known:
            return
        segment = self._segments[self._place(key)]
        others = [(one, error) for one, error in segment.refused if order(one) != key]
        if len(others) == len(segment.refused):
            raise InputError(str(message), f'a second {message.kind} with this stamp', 'one',
                             'stamp every message with its own time, or reset to begin anew')
        segment.refused = others
        self._spare -= 1

    def _place(self, key: Key) -> int:
        """Return the index of the segment that a message belongs to."""
        return bisect_right(self._segments, key, key=lambda segment: segment.first) - 1

    def _insert(self, message: Message, key: Key) -> InputError | None:
        """Take a message that is earlier than another; return why it is not used, if it is not."""
        begin = end = self._place(key)
        waiting, folded, found = [message], list[_Segment](), None
        # further segments change only as long as the next start is not the next trial's
        while end < len(self._segments) and not (end > begin and folded[-1].busy):
            waiting = sorted([*waiting, *self._segments[end].messages()], key=order)
            if not folded:
                folded.append(_Segment(self._segments[begin].first))
            for one in waiting:
                orphans = begin == 0 and len(folded) == 1
                if one.kind == INITIAL and folded[-1].busy and (folded[-1].starts or orphans):
                    folded.append(_Segment(order(one)))
                error = folded[-1].extend(one, self._options)
                if one is message:
                    found = error
            waiting = []
            end += 1
        self._spare += sum(s.spare for s in folded) - sum(s.spare for s in self._segments[begin:end])
        self._segments[begin:end] = folded
        if begin == 0 and len(self._segments) > 1 and order(message) < self._segments[1].first:
            return self._no_start(message)
        return found

    def _no_start(self, message: Message) -> InputError:
        return InputError(
            str(message), 'no initial_chain before it',
            f'one stamped earlier (the first is {self._segments[1].starts[0]})',
            'send the chain before the action begins, and stamp all messages with one clock')

    def _forget(self) -> None:
        """Forget the oldest messages that no trial uses, until half of KEPT are left."""
        surplus = self._spare - KEPT // 2
        kept: list[_Segment] = []
        for segment, following in zip(self._segments, [*self._segments[1:], None], strict=True):
            before = segment.spare
            if surplus <= 0:
                kept.append(segment)
            elif segment.starts and not segment.complete and following is not None:
                self._drop(segment.messages())
                self._close(segment.first, following.first)
                surplus -= before
            else:
                self._trim(segment, surplus)
                surplus -= before - segment.spare
                kept.append(segment)
        self._segments = kept
        self._spare = sum(segment.spare for segment in kept)

    def _trim(self, segment: _Segment, surplus: int) -> None:
        """Forget the oldest spare messages of a segment that stays."""
        count = min(surplus, len(segment.starts) - 2)
        if count > 0:
            surplus -= count
            self._drop(segment.starts[:count])
            del segment.starts[:count]
            self._close(segment.first, order(segment.starts[0]))
            segment.first = order(segment.starts[0])
            early = sum(order(message) < segment.first for message, _ in segment.refused)
            surplus = max(surplus, early)
        count = max(min(surplus, len(segment.refused)), 0)
        self._drop(message for message, _ in segment.refused[:count])
        del segment.refused[:count]
        count = max(min(surplus - count, len(segment.waiting)), 0)
        self._drop(segment.waiting[:count])
        del segment.waiting[:count]

    def _drop(self, messages: Iterable[Message]) -> None:
        for message in messages:
            del self._known[order(message)]

    def _close(self, begin: Key, end: Key) -> None:
        """Refuse, from now on, what belongs between two keys."""
        insort(self._forgotten, (begin, end))
        merged: list[tuple[Key, Key]] = []
        for span in self._forgotten:
            if merged and span[0] <= merged[-1][1]:
                merged[-1] = (merged[-1][0], max(span[1], merged[-1][1]))
            else:
                merged.append(span)
        self._forgotten = merged
