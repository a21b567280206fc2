# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

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
any initial chain wait (`incomplete` says so); they are refused once an initial
chain is known that is later than they are: those that had waited, together, as
`news`.  A message of the same kind and stamp (and of
the same hands) as one before is refused; it replaces one that was refused.

Of the messages that no trial uses, the latest KEPT (at least half of them) are
remembered; what arrives later than that is refused.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from itertools import pairwise
from typing import Iterable

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import INITIAL
from dlo_calibration.messages.trial_builder import Key, Message, order, TrialBuilder
from dlo_calibration.model.trial import Trial

KEPT = 10_000  # messages that no trial uses: more than 5 minutes of a tracker at 30 Hz


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
        self._segments = [TrialBuilder((0, 0, ()))]
        self._known: dict[Key, Message] = {}
        self._newest: Key = (0, 0, ())
        self._spare = 0
        self._forgotten: list[tuple[Key, Key]] = []  # from, up to but without
        self._news: list[InputError] = []

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
        last, without_start = self._segments[-1], len(self._segments) == 1
        if key > self._newest:
            self._newest = key
            if message.kind == INITIAL and last.busy:
                last = TrialBuilder(key)
                self._segments.append(last)
            before = last.spare
            error = last.extend(message, self._options)
            self._spare += last.spare - before
        else:
            error = self._insert(message, key)
        if without_start and len(self._segments) > 1:
            self._news += self._orphans()
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
    def frame_id(self) -> str:
        """That all messages share; empty where there was none yet."""
        return self._frame or ''

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

        Also what `add` could not know when the message arrived; but not what `take_news` gives.
        """
        found = [error for segment in self._segments for _, error in segment.refused]
        for segment, following in pairwise(self._segments[1:]):
            found += _cut_off(segment, f'and {following.starts[0]}',
                              'send no initial chain before the trial is complete')
        return tuple(found)

    @property
    def loose_end(self) -> tuple[InputError, ...]:
        """Why the newest trial is none, where nothing more comes; empty where it is one, or did not begin."""
        if len(self._segments) == 1:
            return self._orphans()
        return _cut_off(self._segments[-1], 'and the end', 'send all messages of a trial')

    def take_news(self) -> tuple[InputError, ...]:
        """Return the refusals of messages that had waited, which the last message made certain."""
        news, self._news = self._news, []
        return tuple(news)

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
        waiting, folded, found = [message], list[TrialBuilder](), None
        # further segments change only as long as the next start is not the next trial's
        while end < len(self._segments) and not (end > begin and folded[-1].busy):
            waiting = sorted([*waiting, *self._segments[end].messages()], key=order)
            if not folded:
                folded.append(TrialBuilder(self._segments[begin].first))
            for one in waiting:
                orphans = begin == 0 and len(folded) == 1
                if one.kind == INITIAL and folded[-1].busy and (folded[-1].starts or orphans):
                    folded.append(TrialBuilder(order(one)))
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

    def _no_start(self, message: Message, more: int = 0) -> InputError:
        first = f'the first is {self._segments[1].starts[0]}' if len(self._segments) > 1 else 'there is none'
        return InputError(
            f'{message} and {more} more' if more else str(message),
            f'no initial_chain before {"them" if more else "it"}', f'one stamped earlier ({first})',
            'send the chain before the action begins, and stamp all messages with one clock')

    def _orphans(self) -> tuple[InputError, ...]:
        """Return one refusal of all messages before the first initial chain, if there are any."""
        waiting = sorted(self._segments[0].waiting, key=order)
        return (self._no_start(waiting[0], len(waiting) - 1),) if waiting else ()

    def _forget(self) -> None:
        """Forget the oldest messages that no trial uses, until half of KEPT are left."""
        surplus = self._spare - KEPT // 2
        kept: list[TrialBuilder] = []
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

    def _trim(self, segment: TrialBuilder, surplus: int) -> None:
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


def _cut_off(segment: TrialBuilder, until: str, remedy: str) -> tuple[InputError, ...]:
    """Return why a segment to which nothing more comes is no trial, if more than its start came."""
    if segment.complete or not (segment.moves or segment.waiting):
        return ()
    if segment.moves:
        came = f'no goal_chain between {segment.moves[0].message} {until}'
    else:
        came = f'{len(segment.waiting)} goal_chain, but no action between {segment.starts[-1]} {until}'
    return InputError(f'trial that begins with {segment.starts[-1]}', came, 'at least one', remedy),
