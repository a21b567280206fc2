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
- Wrenches belong to no trial: each goal takes those that its hands measured then,
  see `wrenches`.

A message that does not fit those with earlier stamps is refused, but stored: it is used
if a late message with an earlier stamp makes it fit.  Actions and goal chains before the
first initial chain wait (see `incomplete`).  If the first initial chain has a later stamp,
they are refused together (see `take_refusals`; goal chains alone come from a tracker that
is on already, see `take_early`).  A second message of the same kind and stamp (and the
same hands) is refused, unless the first one was refused: then it replaces that one.

Of the messages that no trial uses, the latest are stored, between half of KEPT and KEPT
of them; a message that is older than these is refused.  If all stored messages together
are too large, those that no trial uses are deleted; further ones are then refused.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from heapq import nlargest
from itertools import islice, pairwise
import math
from typing import Iterator, Sequence

from dlo_calibration.calibration.choice import hand_warnings
from dlo_calibration.calibration.options import names_of, OBSERVATION, Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import (
    ACTION,
    ActionMessage,
    GOAL,
    INITIAL,
    InputMessage,
    Key,
    Message,
    NANOSECONDS,
    WRENCH,
    WrenchMessage,
)
from dlo_calibration.messages.trial_builder import TrialBuilder
from dlo_calibration.messages.wrenches import force_problems, same_forces, with_forces, Wrenches
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.named_actions import Manipulation
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.observation.plausibility import implausible, in_order, repeated

USED = (*names_of(OBSERVATION), 'stable_distance', 'stable_time', 'settle_limit')  # options
KEPT = 10_000  # messages that no trial uses: more than 5 minutes of a tracker at 30 Hz
LATE = NANOSECONDS  # that goal chains from before the first initial chain may come late [ns]
RECENT = 3  # trials before a new one that are compared with it
MOST_HANDS = 200  # in all of these; with more, looking at their grips takes longer than messages may wait
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
        self._builders = [TrialBuilder((0, 0, ()), options)]
        self._known: dict[Key, Message] = {}
        self._numbers = 0  # coordinates in them
        self._newest: Key = (0, 0, ())
        self._room = KEPT  # messages until those that no trial uses are counted again
        self._exhausted = False  # whether nothing was left to forget when a message was too much
        self._forgotten: list[tuple[Key, Key]] = []  # the first key of each span, and the key after it
        self._new_refusals: list[InputError] = []
        self._warnings: list[str] = []
        self._early: list[str] = []
        self._wrenches = Wrenches()
        self._with_forces: dict[str, tuple[Trial, Trial]] = {}  # by name: without forces, and with them
        self._forces_reported: set[str] = set()
        self._hands_seen = False  # whether a warning was given about errors of all hands

    def with_options(self, options: Options) -> tuple[TrialCollector, Iterator[int]]:
        """
        Return a collector with other options, and steps that fill it with the same messages.

        Each step adds one message, refused ones included, and yields how many are left. If the options of the
        observation are the same, the collector is this one, and there is no step.
        """
        if all(getattr(options, name) == getattr(self._options, name) for name in USED):
            return self, iter(())
        other = TrialCollector(options)
        other._wrenches, other._forces_reported = self._wrenches, self._forces_reported
        return other, self._filling(other)

    def _filling(self, other: TrialCollector) -> Iterator[int]:
        discarded = [builder for builder in self._builders if builder.until is not None]
        for left, key in zip(range(len(self._known), 0, -1), sorted(self._known), strict=True):
            while discarded and discarded[0].first < key:
                other._leave_out(discarded.pop(0))
            try:
                other.add(self._known[key])
            except InputError:
                pass  # it is among `other.refusals`
            yield left
        for builder in discarded:
            other._leave_out(builder)
        other._early = []  # they were reported
        for begin, end in self._forgotten:
            other._close(begin, end)

    def add(self, message: InputMessage) -> None:
        """
        Add one message, of any stamp.

        :raises InputError: where the message is refused; the trials do not change.
        """
        if isinstance(message, WrenchMessage):
            self._wrenches.add(message)
            return
        key = message.key
        self._check(message)
        place = self._place(key)
        until = self._builders[place].until
        if until is not None and (message.kind != INITIAL or key <= until):
            return  # a tracker may send more of the discarded trial
        self._frame = message.frame_id
        self._known[key] = message
        self._numbers += _size(message)
        self._exhausted = False
        if self.pose is not None:
            message = _moved(message, self.pose)
        without_start, in_order = len(self._builders) == 1, key > self._newest
        self._newest = max(self._newest, key)
        if message.kind == INITIAL and self._builders[place].busy(key):
            if in_order:
                self._new_refusals += self._builders[place].disturbed()
            place += 1
            self._builders.insert(place, self._builders[place - 1].split(key))
        builder = self._builders[place]
        error = builder.add(message)
        if second := builder.second_start:
            self._builders.insert(place + 1, builder.split(second))
        elif place + 1 < len(self._builders) and self._builders[place + 1].until is None \
                and not builder.busy():
            self._builders.pop(place)
            self._builders[place].join(builder)
        if without_start and len(self._builders) > 1:
            streamed = all(waiting.kind == GOAL for waiting in self._builders[0].waiting)
            if streamed:
                self._early += map(_early, self._orphans())
            else:
                self._new_refusals += self._orphans()
        elif not in_order and len(self._builders) > 1 and key < self._builders[1].first:
            error = self._no_start(message)
            if message.kind != ACTION and self._builders[1].first[0] - message.stamp <= LATE:
                # A tracker was on before, and is slower than the initial chain.
                self._early.append(_early(error))
                error = None
        self._room -= 1
        if self._room < 0:
            self._forget(KEPT // 2)
        if error is not None:
            raise error
        self._inspect(self._place(key))

    def _inspect(self, place: int) -> None:
        """Look for warnings about the trial of a builder, if that is due."""
        builder = self._builders[place] if place < len(self._builders) else None
        if builder is None or not builder.due:
            return
        wrong, losses = self._looked_at(place, place)
        if wrong or losses:
            number = sum(other.complete for other in self._builders[:place + 1])
            if number != place:
                wrong, losses = self._looked_at(place, number)
            self._warnings += (*wrong, *losses)
            builder.warned |= bool(wrong)
            builder.lost |= bool(losses)

    def _looked_at(self, place: int, number: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """
        Return what is implausible about the trial of a builder, and how its hands have lost the DLO.

        What all hands have in common is among the warnings as soon as the recent trials show it.

        :param number: of the trial.
        """
        builder, options = self._builders[place], self._options
        complete = (self._builders[k] for k in range(place - 1, 0, -1) if self._builders[k].complete)
        earlier = [other.build(f'trial {number - k}')
                   for k, other in enumerate(islice(complete, RECENT), start=1)][::-1]
        trial, before = builder.build(f'trial {number}'), None
        wrong: tuple[str, ...] = ()
        if not builder.warned:
            for other in earlier:
                before = in_order(other, before)
            wrong = (*implausible(trial, options.table_top, bool(options.scene), before),
                     *repeated(trial, earlier))
        recent = (*earlier, trial)
        if builder.lost or trial.goals[-1].time < trial.hands[-1].end \
                or sum(len(each.hands) for each in recent) > MOST_HANDS:
            return wrong, ()
        evidence = GripEvidence.of(recent)
        if not self._hands_seen and (texts := hand_warnings(evidence, options)):
            self._hands_seen = True
            self._warnings += texts
        return wrong, tuple(str(loss) for loss in evidence.losses if loss.trial == trial.name)

    def take_back(self) -> tuple[int, int]:
        """
        Delete the messages of the newest trial, complete or not.

        Later initial chains stay; other messages that come before the next one are not used.

        :returns: the stamps between which messages are left out [ns].
        :raises InputError: if there is none.
        """
        place = max((k for k, builder in enumerate(self._builders) if builder.starts and builder.busy()),
                    default=0)
        if not place:
            raise InputError('~/discard_last', 'no trial', 'one', 'there is nothing to take back')
        builder = self._builders[place]
        messages = builder.messages
        until = messages[-1].key if place < len(self._builders) - 1 else self._newest
        self._drop(messages)
        self._exhausted = False
        self._builders[place] = TrialBuilder(builder.first, self._options, until)
        return builder.first[0], until[0]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The complete trials in the order of their stamps: ``trial 1``, ``trial 2``, ..."""
        complete = [builder for builder in self._builders if builder.complete]
        trials = tuple(builder.build(f'trial {k}') for k, builder in enumerate(complete, start=1))
        for place in range(1, len(self._builders)):
            self._inspect(place)  # of chains that came late, each was not
        tares: dict[str, Floats] = {}
        return tuple(self._measured(trial, builder.zero, tares)
                     for trial, builder in zip(trials, complete, strict=True)) if self._wrenches else trials

    def _measured(self, trial: Trial, zero: int, tares: dict[str, Floats]) -> Trial:
        """Return a trial with its forces; the same object until one changes."""
        forces = self._wrenches.forces(trial, zero, tares)
        before, after = self._with_forces.get(trial.name, (None, trial))
        if before is not trial or not same_forces(forces, [goal.forces for goal in after.goals]):
            after = with_forces(trial, forces) if any(forces) else trial
            self._with_forces[trial.name] = trial, after
        return after

    @property
    def force_problems(self) -> tuple[InputError, ...]:
        """Why wrenches are not used, if some are not."""
        return force_problems(self._wrenches, self.trials) if self._wrenches else ()

    def manipulations(self) -> tuple[tuple[Manipulation, ...], tuple[InputError, ...]]:
        """
        Return what the hands did in each trial, also in those without a goal chain.

        They are called ``trial 1``, ``trial 2``, ...; the errors say why actions are not used.
        """
        manipulations: list[Manipulation] = []
        errors: list[InputError] = []
        for builder in self._builders[1:]:
            manipulation, unused = builder.manipulation(f'trial {len(manipulations) + 1}')
            manipulations += [] if manipulation is None else [manipulation]
            errors += unused
        return tuple(manipulations), (*errors, *(self._orphans() if len(self._builders) == 1 else ()))

    @property
    def frame_id(self) -> str:
        """The frame_id of all messages; empty before the first message."""
        return self._frame or ''

    @property
    def count(self) -> int:
        """Number of complete trials."""
        return sum(builder.complete for builder in self._builders)

    @property
    def incomplete(self) -> str:
        """A description of the messages that the newest trial lacks; empty where it is complete."""
        return self._builders[-1].missing()

    @property
    def refusals(self) -> tuple[InputError, ...]:
        """
        The reasons why messages are unused at present, and why earlier trials are incomplete.

        They include those that later messages caused, but not those that `take_refusals` returns.
        """
        refusals = [refusal.error for builder in self._builders for refusal in builder.refusals]
        refusals += [error for builder in self._builders for error in builder.disturbed()]
        for builder, following in pairwise(each for each in self._builders[1:] if each.until is None):
            refusals += builder.incomplete(f'and {following.starts[0]}',
                                           'send no initial chain before the trial is complete')
        return tuple(refusals)

    @property
    def loose_end(self) -> tuple[InputError, ...]:
        """The reason why the newest trial is incomplete if no more messages come, if there is one."""
        if len(self._builders) == 1:
            return self._orphans()
        return self._builders[-1].incomplete('and the end', 'send all messages of a trial')

    def take_refusals(self) -> tuple[InputError, ...]:
        """Return, once, the refusals of waiting messages since the last call."""
        refusals, self._new_refusals = self._new_refusals, []
        return tuple(refusals)

    def take_warnings(self) -> tuple[str, ...]:
        """Return, once, the warnings about trials and their hands since the last call."""
        warnings, self._warnings = self._warnings, []
        return tuple(warnings)

    def take_early(self) -> tuple[str, ...]:
        """Return, once, notes about goal chains that came before any action or initial chain."""
        early, self._early = self._early, []
        return tuple(early)

    def _check(self, message: Message) -> None:
        """Refuse a message that can never be used; delete the refused message that it replaces."""
        key = message.key
        if self._frame is not None and message.frame_id != self._frame:
            raise InputError(
                str(message), f'frame_id {message.frame_id!r}', f'{self._frame!r} as in the first message',
                'send all chains and actions in one frame, or reset to begin with another')
        if any(begin <= key < end for begin, end in self._forgotten):
            raise InputError(str(message), f'it came after more than {KEPT // 2} later messages',
                             'messages in about the order of their stamps', 'send it earlier, or reset')
        if self._full(message) and not self._exhausted:
            self._forget(0)
            self._exhausted = True
        if self._full(message):
            raise InputError(str(message), f'it came after {len(self._known)} messages',
                             f'at most {MOST_MESSAGES} with {MOST_NUMBERS} coordinates',
                             'calibrate with these, or reset to begin anew')
        if key not in self._known:
            return
        builder = self._builders[self._place(key)]
        refusal = builder.refusals.at(key)
        if refusal is None:
            raise InputError(str(message), f'a second {message.kind} with this stamp', 'one',
                             'stamp every message with its own time, or reset to begin anew')
        builder.remove(self._drop([refusal.message]))

    def _full(self, message: Message) -> bool:
        """Return whether there is no room for a message."""
        return len(self._known) >= MOST_MESSAGES or self._numbers + _size(message) > MOST_NUMBERS

    def _place(self, key: Key) -> int:
        """Return the index of the builder to which a message belongs."""
        return bisect_right(self._builders, key, key=lambda builder: builder.first) - 1

    def _no_start(self, message: Message, more: int = 0) -> InputError:
        started = next((builder for builder in self._builders[1:] if builder.starts), None)
        first = f'the first is {started.starts[0]}' if started else 'there is none'
        return InputError(
            f'{message} and {more} more' if more else str(message),
            f'no initial_chain before {"them" if more else "it"}', f'one stamped earlier ({first})',
            'send the chain before the action begins, and stamp all messages with one clock')

    def _orphans(self) -> tuple[InputError, ...]:
        """Return one refusal for all messages before the first initial chain, if there are any."""
        waiting = self._builders[0].waiting
        return (self._no_start(waiting[0], len(waiting) - 1),) if waiting else ()

    def _forget(self, limit: int) -> None:
        """
        Forget the oldest messages that no trial uses until `limit` of them are left.

        Where `limit` is not 0, nothing is forgotten unless there are more than KEPT.
        """
        spare = sum(builder.spare for builder in self._builders)
        surplus = spare - limit if spare > KEPT or not limit else 0
        remaining: list[TrialBuilder] = []
        for builder, following in zip(self._builders, [*self._builders[1:], None], strict=True):
            if surplus <= 0:
                remaining.append(builder)
                continue
            forgotten = builder.spare
            if builder.starts and not builder.complete and following is not None:
                self._drop(builder.messages)
                self._close(builder.first, following.first)
            else:
                self._trim(builder, surplus)
                forgotten -= builder.spare
                remaining.append(builder)
            surplus -= forgotten
            spare -= forgotten
        self._builders, self._room = remaining, KEPT - spare

    def _trim(self, builder: TrialBuilder, surplus: int) -> None:
        """Forget the oldest spare messages of a builder that stays."""
        count = min(surplus, len(builder.starts) - 2)
        if count > 0:
            surplus -= count
            builder.remove(self._drop(builder.starts[:count]))
            self._close(builder.first, builder.starts[0].key)
            builder.first = builder.starts[0].key
            early = sum(refusal.key < builder.first for refusal in builder.refusals)
            surplus = max(surplus, early)
        refused = builder.refusals[:max(surplus, 0)]
        builder.remove(self._drop([refusal.message for refusal in refused]))
        builder.remove(self._drop(builder.waiting[:max(surplus - len(refused), 0)]))

    def _leave_out(self, builder: TrialBuilder) -> None:
        """Add a discarded trial that is later than all messages so far."""
        assert builder.until is not None
        self._builders.append(TrialBuilder(builder.first, self._options, builder.until))
        self._newest = max(self._newest, builder.until)

    def _drop(self, messages: Sequence[Message]) -> Sequence[Message]:
        for message in messages:
            del self._known[message.key]
            self._numbers -= _size(message)
        return messages

    def _close(self, begin: Key, end: Key) -> None:
        """Refuse from now on messages with keys from `begin` up to, but not including, `end`."""
        separate: list[tuple[Key, Key]] = []
        for span in self._forgotten:
            if span[1] < begin or end < span[0]:
                separate.append(span)
            else:
                begin, end = min(begin, span[0]), max(end, span[1])
        self._forgotten = [*separate, (begin, end)]


def _early(error: InputError) -> str:
    return f'{error.thing}: came before the first initial chain; not used'


def _size(message: Message) -> int:
    """Return the number of coordinates in a message."""
    if isinstance(message, ActionMessage):
        return message.positions.size + message.orientations.size
    return message.chain.points.size


def _moved(message: Message, pose: Pose) -> Message:
    """Return a message in another frame, in which its own has a pose."""
    if isinstance(message, ActionMessage):
        return replace(message, positions=pose.points(message.positions),
                       orientations=pose.orientations(message.orientations))
    return replace(message, chain=pose.chain(message.chain))


# [ns] Two trackers on one topic may differ by less; a restarted clock goes back further.
MARGIN = NANOSECONDS


class StampOrder:
    """
    The newest stamps of messages, which distinguish a clock that went back from a message that came late.

    An action may be published only when it is over, so a message may be late by minutes.  But on one topic,
    stamps hardly ever go back, and none goes back behind the beginning of the newest trial.
    A message goes back if it is stamped

    - more than MARGIN before the newest one of its own topic,
    - before the newest initial chain, and
    - before two other messages, as a single wrong stamp in the future is no clock.

    If an initial chain goes back, so did the clock.  An action or a goal chain that goes back may belong to
    either clock, so it is refused.

    :param former: the order until the clock went back; None: it never did.
    """

    def __init__(self, former: StampOrder | None = None) -> None:
        self._frame = ''
        self._newest: dict[str, int] = {}  # of each topic
        self._latest: list[int] = [0]  # the two newest of all topics
        self._first: float = math.inf  # of the initial chains
        self._former_end = 0 if former is None else former.newest
        self._former_newest = {} if former is None else {  # of the topics that have not yet gone back
            kind: former._newest.get(kind, 0) for kind in (INITIAL, ACTION, GOAL)}

    @property
    def newest(self) -> int:
        """The newest stamp [ns]; 0 before the first message."""
        return self._latest[0]

    def clock_went_back(self, message: InputMessage) -> bool:
        """Return whether the clock went back before this message."""
        return message.kind == INITIAL and message.frame_id == self._frame and self._goes_back(message)

    def left_over(self, message: InputMessage) -> bool:
        """
        Return whether this message was stamped before the clock went back, and was under way then.

        It is stamped near the end of the former clock, on a topic that has not yet gone back.
        """
        return (message.kind in self._former_newest and message.stamp > self._former_newest[message.kind]
                and abs(message.stamp - self._former_end) <= MARGIN and message.stamp > self.newest + MARGIN)

    def check(self, message: InputMessage) -> None:
        """
        Check that a message certainly belongs to the trials of the present clock.

        :raises InputError: if it does not.
        """
        if message.kind == WRENCH or message.frame_id != self._frame:
            return  # the collector refuses it
        # What is stamped before all trials can be used by none; the collector refuses it.
        if message.kind != INITIAL and message.stamp > self._first and self._goes_back(message):
            earlier = (self._newest[message.kind] - message.stamp) / NANOSECONDS
            raise InputError(
                str(message),
                f'its stamp is {earlier:.6g} s before the newest {message.kind}, in an earlier trial',
                'the order of stamps on each topic',
                'stamp all messages with one clock, and send an initial_chain first after it went back')

    def _goes_back(self, message: InputMessage) -> bool:
        return (message.stamp < self._newest.get(message.kind, 0) - MARGIN
                and message.stamp < self._newest.get(INITIAL, 0) and message.stamp < self._latest[-1])

    def add(self, message: InputMessage) -> None:
        """Add a message that `check` does not refuse; one in another frame than the first is ignored."""
        if message.kind == WRENCH:
            return
        self._frame = self._frame or message.frame_id
        if message.frame_id != self._frame:
            return
        if message.kind == INITIAL:
            self._first = min(self._first, message.stamp)
        if message.stamp < self._former_end - MARGIN:
            self._former_newest.pop(message.kind, None)
        self._newest[message.kind] = max(self._newest.get(message.kind, 0), message.stamp)
        self._latest = nlargest(2, {*self._latest, message.stamp})


def went_back(before: int, now: int) -> str:
    """Return the sentence about a clock that went from one stamp [ns] back to another."""
    return (f'the clock went back by {(before - now) / NANOSECONDS:.6g} s (from '
            f'{before / NANOSECONDS:.3f} to {now / NANOSECONDS:.3f})')
