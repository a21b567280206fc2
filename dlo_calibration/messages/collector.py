# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Collector: trials from messages, by the stamps in their headers.

The trials depend only on the set of messages, not on the order of arrival: ROS
does not order different topics, and a robot may publish an action only when it is over.

- Messages are ordered by stamp; at equal stamps, the initial chain comes first,
  then the action, then the goal chain.
- An initial chain begins a new trial if an action or a goal chain came since the
  previous one.  Otherwise it replaces the previous one; if the two are less than
  0.1 s apart, they give the initial velocity.
- A trial's clock starts at its initial chain.  If the DLO is at rest then, the
  clock starts when the first hand closes (or at the first goal, if that is
  earlier), as nothing moves before.
- A hand grips the points that carry its number in the latest chain before the
  action.  In a goal chain, the number refers to the order of hands in the action
  before that goal; the name of that hand identifies it.  Without annotation, the
  hand grips the DLO at the place nearest to its first waypoint, also between points.
- A goal chain stamped while a hand moves, or before any hand has closed, is
  compared at that instant; any other with the DLO when it has come to rest.
- A goal chain stamped before the first action of its trial waits unused, as
  that action may still arrive.

A message that does not fit those with earlier stamps is refused, but remembered: it
is used when a late message with an earlier stamp makes it fit.  Actions and goal
chains before the first initial chain wait (see `incomplete`).  When an initial chain
with a later stamp arrives, they are refused together (see `take_news`, and `take_early` for
goal chains alone, which a tracker that is on already sends).  A second
message of the same kind and stamp (and the same hands) is refused, unless the first
one was refused: then it replaces that one.

Of the messages that no trial uses, between half of KEPT and KEPT are remembered, the
latest ones.  A message that is older than these is refused.  When all remembered messages
are too large together, those that no trial uses are forgotten; then further ones are refused.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from itertools import pairwise
from typing import Iterable, Iterator

from dlo_calibration.calibration.declaration import OBSERVATION
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import ACTION, ActionMessage, GOAL, INITIAL, NANOSECONDS
from dlo_calibration.messages.doubts import doubts
from dlo_calibration.messages.manipulations import manipulation_of
from dlo_calibration.messages.trial_builder import Key, Message, moved, order, TrialBuilder
from dlo_calibration.model.manipulation import Manipulation
from dlo_calibration.model.trial import Trial

USED = (*names_of(OBSERVATION), 'stable_distance', 'stable_time', 'settle_limit')  # options of messages
KEPT = 10_000  # messages that no trial uses: more than 5 minutes of a tracker at 30 Hz
LATE = NANOSECONDS  # that goal chains from before the first initial chain may come late [ns]
MOST_MESSAGES = 200_000  # nearly two hours of a tracker at 30 Hz, which take about 450 MB
MOST_NUMBERS = 20_000_000  # coordinates in them, which take 160 MB


class TrialCollector:
    """
    Collects messages, and makes trials from them.

    It must not be shared between threads.

    :param options: those of the observation are used; `frame_pose` brings chains and actions into the table's
        frame.
    :ivar pose: of the messages' frame in that of the trials; None: they are the same.
    """

    def __init__(self, options: Options) -> None:
        self._options, self.pose = options, options.pose
        self._frame: str | None = None
        self._builders = [TrialBuilder((0, 0, ()))]
        self._known: dict[Key, Message] = {}
        self._numbers = 0  # coordinates in them
        self._newest: Key = (0, 0, ())
        self._spare = 0
        self._forgotten: list[tuple[Key, Key]] = []  # the first key of each span, and the key after it
        self._news: list[InputError] = []
        self._doubts: list[str] = []
        self._early: list[InputError] = []

    def with_options(self, options: Options) -> tuple[TrialCollector, Iterator[int]]:
        """
        Return a collector with other options, and steps that fill it with the same messages.

        Each step collects one message, refused ones too, and gives how many are left. Where the options of
        the observation are the same, the collector is this one, and there is no step.
        """
        if all(getattr(options, name) == getattr(self._options, name) for name in USED):
            return self, iter(())
        other = TrialCollector(options)
        return other, self._filling(other)

    def _filling(self, other: TrialCollector) -> Iterator[int]:
        gone = [builder for builder in self._builders if builder.until is not None]
        for left, key in zip(range(len(self._known), 0, -1), sorted(self._known), strict=True):
            while gone and gone[0].first < key:
                other._leave_out(gone.pop(0))
            try:
                other.add(self._known[key])
            except InputError:
                pass  # it is among `other.problems`
            yield left
        for one in gone:
            other._leave_out(one)
        other._early = []  # they were told
        for begin, end in self._forgotten:
            other._close(begin, end)

    def add(self, message: Message) -> None:
        """
        Take one message, of any stamp.

        :raises InputError: where the message is refused; the trials do not change.
        """
        key = order(message)
        self._check(message, key)
        place = self._place(key)
        until = self._builders[place].until
        if until is not None and (message.kind != INITIAL or key <= until):
            return  # it belongs to the trial that was taken back, of which a tracker may send more
        self._frame = message.frame_id
        self._known[key] = message
        self._numbers += _size(message)
        if self.pose is not None:
            message = moved(message, self.pose)
        last, without_start = self._builders[-1], len(self._builders) == 1
        if key > self._newest:
            self._newest = key
            if message.kind == INITIAL and last.busy:
                self._news += last.disturbed(self._options)
                last = TrialBuilder(key)
                self._builders.append(last)
            before = last.spare
            error = last.extend(message, self._options)
            self._spare += last.spare - before
        elif until is not None:
            self._builders.insert(place + 1, TrialBuilder(key))
            error = self._builders[place + 1].extend(message, self._options)
            self._spare += 1
        else:
            error = self._insert(message, key)
        if without_start and len(self._builders) > 1:
            streamed = all(one.kind == GOAL for one in self._builders[0].waiting)
            (self._early if streamed else self._news).extend(self._orphans())
        if self._spare > KEPT:
            self._forget(KEPT // 2)
        if error is not None:
            raise error
        self._doubts += doubts(self._builders, self._place(key), self._options)

    def take_back(self) -> tuple[int, int]:
        """
        Forget the messages of the newest trial, also of an incomplete one.

        Initial chains that came since stay; what else comes before the next one is not used.

        :returns: the stamps between which messages are left out [ns].
        :raises InputError: if there is none.
        """
        place = max((k for k, one in enumerate(self._builders) if one.starts and one.busy), default=0)
        if not place:
            raise InputError('~/discard_last', 'no trial', 'one', 'there is nothing to take back')
        builder = self._builders[place]
        messages = builder.messages()
        until = order(messages[-1]) if place < len(self._builders) - 1 else self._newest
        self._drop(messages)
        self._spare -= builder.spare
        self._builders[place] = TrialBuilder(builder.first, until)
        return builder.first[0], until[0]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The complete trials in the order of their stamps: ``trial 1``, ``trial 2``, ..."""
        complete = [builder for builder in self._builders if builder.complete]
        return tuple(builder.build(f'trial {k}', self._options)
                     for k, builder in enumerate(complete, start=1))

    def manipulations(self) -> tuple[tuple[Manipulation, ...], tuple[InputError, ...]]:
        """
        Return what the hands did in each trial, also in those without a goal chain.

        They are called ``trial 1``, ``trial 2``, ...; the errors tell why actions are not used.
        """
        found: list[Manipulation] = []
        problems: list[InputError] = []
        for builder in self._builders[1:]:
            one, errors = manipulation_of(builder, f'trial {len(found) + 1}', self._options)
            found += [] if one is None else [one]
            problems += errors
        return tuple(found), (*problems, *(self._orphans() if len(self._builders) == 1 else ()))

    @property
    def frame_id(self) -> str:
        """The frame_id of all messages; empty before the first one."""
        return self._frame or ''

    @property
    def count(self) -> int:
        """Number of complete trials."""
        return sum(builder.complete for builder in self._builders)

    @property
    def incomplete(self) -> str:
        """The messages that the newest trial lacks, in words; empty where it is complete."""
        return self._builders[-1].lacks()

    @property
    def problems(self) -> tuple[InputError, ...]:
        """
        The reasons why messages are unused at present, and why earlier trials are incomplete.

        They include those that later messages caused, but not those that `take_news` returns.
        """
        found = [error for builder in self._builders for _, error in builder.refused]
        found += [error for builder in self._builders for error in builder.disturbed(self._options)]
        for builder, following in pairwise(one for one in self._builders[1:] if one.until is None):
            found += _cut_off(builder, f'and {following.starts[0]}',
                              'send no initial chain before the trial is complete')
        return tuple(found)

    @property
    def loose_end(self) -> tuple[InputError, ...]:
        """The reason why the newest trial is incomplete if no more messages come, if there is one."""
        if len(self._builders) == 1:
            return self._orphans()
        return _cut_off(self._builders[-1], 'and the end', 'send all messages of a trial')

    def take_news(self) -> tuple[InputError, ...]:
        """Return, once, the refusals of waiting messages since the last call."""
        news, self._news = self._news, []
        return tuple(news)

    def take_doubts(self) -> tuple[str, ...]:
        """Return, once, what was found implausible about trials since the last call."""
        doubts, self._doubts = self._doubts, []
        return tuple(doubts)

    def take_early(self) -> tuple[InputError, ...]:
        """Return, once, why goal chains that came before any action or initial chain are not used."""
        early, self._early = self._early, []
        return tuple(early)

    def _check(self, message: Message, key: Key) -> None:
        """Refuse a message that can never be used; forget the refused message that it replaces."""
        if self._frame is not None and message.frame_id != self._frame:
            raise InputError(
                str(message), f'frame_id {message.frame_id!r}', f'{self._frame!r} as in the first message',
                'send all chains and actions in one frame, or reset to begin with another')
        if any(begin <= key < end for begin, end in self._forgotten):
            raise InputError(str(message), f'it after more than {KEPT // 2} later messages',
                             'messages in about the order of their stamps', 'send it earlier, or reset')
        if self._full(message) and self._spare:
            self._forget(0)
        if self._full(message):
            raise InputError(str(message), f'it after {len(self._known)} messages',
                             f'at most {MOST_MESSAGES} with {MOST_NUMBERS} coordinates',
                             'calibrate with these, or reset to begin anew')
        if key not in self._known:
            return
        builder = self._builders[self._place(key)]
        others = [(one, error) for one, error in builder.refused if order(one) != key]
        if len(others) == len(builder.refused):
            raise InputError(str(message), f'a second {message.kind} with this stamp', 'one',
                             'stamp every message with its own time, or reset to begin anew')
        self._drop(one for one, _ in builder.refused if order(one) == key)
        builder.refused = others
        self._spare -= 1

    def _full(self, message: Message) -> bool:
        """Tell whether a message would be too much."""
        return len(self._known) >= MOST_MESSAGES or self._numbers + _size(message) > MOST_NUMBERS

    def _place(self, key: Key) -> int:
        """Return the index of the builder to which a message belongs."""
        return bisect_right(self._builders, key, key=lambda builder: builder.first) - 1

    def _insert(self, message: Message, key: Key) -> InputError | None:
        """Take a message that is earlier than another; return the reason if it is not used."""
        begin = end = self._place(key)
        kept, later = self._builders[begin].divided(key)
        waiting, folded, found = [message, *later], [kept], None
        # Further builders change only until an initial chain begins the next trial.
        while waiting:
            for one in waiting:
                orphans = begin == 0 and len(folded) == 1
                if one.kind == INITIAL and folded[-1].busy and (folded[-1].starts or orphans):
                    folded.append(TrialBuilder(order(one)))
                error = folded[-1].extend(one, self._options)
                if one is message:
                    found = error
            end += 1
            more = end < len(self._builders) and not folded[-1].busy and self._builders[end].until is None
            waiting = self._builders[end].messages() if more else []
        self._spare += sum(s.spare for s in folded) - sum(s.spare for s in self._builders[begin:end])
        self._builders[begin:end] = folded
        if begin == 0 and len(self._builders) > 1 and order(message) < self._builders[1].first:
            error = self._no_start(message)
            if message.kind == ACTION or self._builders[1].first[0] - message.stamp > LATE:
                return error
            self._early.append(error)  # of a tracker that was on before, and slower than the initial chain
        return found

    def _no_start(self, message: Message, more: int = 0) -> InputError:
        started = next((builder for builder in self._builders[1:] if builder.starts), None)
        first = f'the first is {started.starts[0]}' if started else 'there is none'
        return InputError(
            f'{message} and {more} more' if more else str(message),
            f'no initial_chain before {"them" if more else "it"}', f'one stamped earlier ({first})',
            'send the chain before the action begins, and stamp all messages with one clock')

    def _orphans(self) -> tuple[InputError, ...]:
        """Return one refusal for all messages before the first initial chain, if there are any."""
        waiting = sorted(self._builders[0].waiting, key=order)
        return (self._no_start(waiting[0], len(waiting) - 1),) if waiting else ()

    def _forget(self, rest: int) -> None:
        """Forget the oldest messages that no trial uses, until `rest` of them are left."""
        surplus = self._spare - rest
        kept: list[TrialBuilder] = []
        for builder, following in zip(self._builders, [*self._builders[1:], None], strict=True):
            before = builder.spare
            if surplus <= 0:
                kept.append(builder)
            elif builder.starts and not builder.complete and following is not None:
                self._drop(builder.messages())
                self._close(builder.first, following.first)
                surplus -= before
            else:
                self._trim(builder, surplus)
                surplus -= before - builder.spare
                kept.append(builder)
        self._builders = kept
        self._spare = sum(builder.spare for builder in kept)

    def _trim(self, builder: TrialBuilder, surplus: int) -> None:
        """Forget the oldest spare messages of a builder that stays."""
        count = min(surplus, len(builder.starts) - 2)
        if count > 0:
            surplus -= count
            self._drop(builder.starts[:count])
            del builder.starts[:count]
            self._close(builder.first, order(builder.starts[0]))
            builder.first = order(builder.starts[0])
            early = sum(order(message) < builder.first for message, _ in builder.refused)
            surplus = max(surplus, early)
        count = max(min(surplus, len(builder.refused)), 0)
        self._drop(message for message, _ in builder.refused[:count])
        del builder.refused[:count]
        count = max(min(surplus - count, len(builder.waiting)), 0)
        self._drop(builder.waiting[:count])
        del builder.waiting[:count]

    def _leave_out(self, builder: TrialBuilder) -> None:
        """Note that a trial was taken back which is later than all messages so far."""
        assert builder.until is not None
        self._builders.append(TrialBuilder(builder.first, builder.until))
        self._newest = max(self._newest, builder.until)

    def _drop(self, messages: Iterable[Message]) -> None:
        for message in messages:
            del self._known[order(message)]
            self._numbers -= _size(message)

    def _close(self, begin: Key, end: Key) -> None:
        """From now on, refuse messages with keys from `begin` up to, but not including, `end`."""
        insort(self._forgotten, (begin, end))
        merged: list[tuple[Key, Key]] = []
        for span in self._forgotten:
            if merged and span[0] <= merged[-1][1]:
                merged[-1] = (merged[-1][0], max(span[1], merged[-1][1]))
            else:
                merged.append(span)
        self._forgotten = merged


def _size(message: Message) -> int:
    """Return the number of coordinates in a message."""
    if isinstance(message, ActionMessage):
        return message.positions.size + message.orientations.size
    return message.chain.points.size


def _cut_off(builder: TrialBuilder, until: str, remedy: str) -> tuple[InputError, ...]:
    """Return why a finished builder is no trial, if it has more than initial chains."""
    if builder.complete or not (builder.moves or builder.waiting):
        return ()
    if builder.moves:
        came = f'no goal_chain between {builder.moves[0].message} {until}'
    else:
        came = f'{len(builder.waiting)} goal_chain, but no action between {builder.starts[-1]} {until}'
    return InputError(f'trial that begins with {builder.starts[-1]}', came, 'at least one', remedy),
