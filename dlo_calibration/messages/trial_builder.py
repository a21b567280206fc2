# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""TrialBuilder: the messages of one trial, from its initial chain to the next one, and what they make."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, Iterable, Iterator, NamedTuple, Sequence, Union

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import (
    ACTION,
    ActionMessage,
    ChainMessage,
    INITIAL,
    Key,
    Message,
    NANOSECONDS,
    RANKS,
)
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, length_change, MINIMUM_SPACING
from dlo_calibration.model.named_actions import Manipulation, manipulation_of, RecordedPaths, TimedAction
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.rest import Rest, STILL, STREAM, Stream

SAME = 0.1  # of a segment; two hands do not grip nearer to each other
KEY = attrgetter('key')


class Refusal(NamedTuple):
    """A message that is not used at present, and why."""

    message: Message
    error: InputError

    @property
    def key(self) -> Key:
        """The place of the message in the order of all messages."""
        return self.message.key


@dataclass(frozen=True)
class GripAction:
    """An action that is used: the grips and the offset of each hand, and the stamps of its waypoints [ns]."""

    message: ActionMessage
    grips: tuple[tuple[int, ...], ...]
    offsets: tuple[float, ...]
    stamps: tuple[int, ...]

    @property
    def key(self) -> Key:
        """The place of the message in the order of all messages."""
        return self.message.key

    def action(self, zero: int) -> Action:
        """Return the action, whose times count from `zero` [ns]."""
        sent, times = self.message, seconds(self.stamps, zero)
        return Action(tuple(
            Hand(name, self.grips[k], times, sent.positions[:, k], sent.orientations[:, k], self.offsets[k])
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


@dataclass
class Phase:
    """Successive goal chains with the same finished actions and holding hands, all stable or all timed."""

    hands: HandState
    stream: Stream
    goals: list[ChainMessage] = field(default_factory=list)

    def continues(self, hands: HandState) -> bool:
        """Return whether a later goal chain belongs to it."""
        return (hands.stable, hands.finished, hands.held_by) == (
            self.hands.stable, self.hands.finished, self.hands.held_by)

    def add(self, goal: ChainMessage) -> None:
        """Add the next goal chain."""
        self.goals.append(goal)
        if self.hands.stable:
            self.stream.add((goal.stamp - self.hands.end) / NANOSECONDS, goal.chain)

    @property
    def rest(self) -> Rest | None:
        """Where the DLO rests; None while it moves, and for a few chains, each of which counts."""
        return self.stream.rest() if self.stream.count >= STREAM else None

    @property
    def disturbed(self) -> list[ChainMessage]:
        """The goal chains from when the DLO moved again after it had come to rest."""
        rest = self.rest
        return [] if rest is None or rest.moved is None else self.goals[rest.moved:]

    def trial_goals(self, zero: int) -> list[Goal]:
        """
        Return the goals of the trial; a stream that shows the DLO at rest gives one, its mean.

        The chains before are goals at their instants, unless a hand has opened: messages give the time of
        that only to 0.1 s, in which a DLO falls by 5 cm. Such chains are left out; if none shows rest, the
        last one counts.
        """
        rest, streamed = self.rest, self.stream.count >= STREAM
        used = self.goals if rest is None else self.goals[:rest.first + 1]
        if streamed and self.hands.opened:
            used = used[-1:]
        times = seconds((goal.stamp for goal in used), zero).tolist()
        stable = self.hands.stable and (self.hands.opened or not streamed)
        goals = [Goal(goal.chain, time, stable, self.hands.held_by)
                 for goal, time in zip(used, times, strict=True)]
        if rest is not None:
            chain = used[-1].chain
            goals[-1] = replace(goals[-1], stable=True, count=rest.count,
                                chain=Chain(rest.points, chain.hands, chain.features))
        return goals


class TrialBuilder:
    """
    The messages of one trial, complete or not, in any order of arrival.

    The first builder of a collector has no initial chain: it holds the messages before the first one.
    Whether a message can be used depends on those with earlier stamps, but only on a few of them: a goal
    chain on the initial chain and the latest action; an action on the latest chain and on the actions of its
    hands.  So after a message that comes late, only those are checked again that depend on it, and only when
    a result is asked for.

    :param first: key of the first initial chain.
    :param until: key up to which the messages were discarded; it then stays empty. None: they were not.
    :ivar starts: initial chains; the last one counts, and the one before it for the velocity.
    :ivar trial: as it was built since the last change, if it was.
    :ivar warned: whether there was a warning about the trial.
    """

    def __init__(self, first: Key, options: Options, until: Key | None = None) -> None:
        self.first, self.until, self._options = first, until, options
        self.starts: list[ChainMessage] = []
        self._actions: list[ActionMessage] = []
        self._goals: list[ChainMessage] = []  # as they came
        self._unchecked: list[Key] = []  # of actions and goals
        self._used_actions: list[GripAction] = []
        self._used_goals: list[ChainMessage] = []
        self._refusals: list[Refusal] = []
        self._goal_before: dict[Key, ChainMessage | None] = {}  # each action, when it was last checked
        self._begins: list[int] = []  # of the used actions [ns]
        self._ends: list[tuple[int, Key]] = []  # of the used actions [ns], and their keys
        self._longest = 0  # duration of a used action [ns]
        self.trial: Trial | None = None
        self._phases: list[Phase] = []
        self._affordable = 0  # goal chains that may be added to phases only to look for warnings
        self._inspected = 0, False  # see `due`
        self.warned = False

    # Messages

    def add(self, message: Message) -> InputError | None:
        """Add a message; return the reason if it cannot be used."""
        if message.kind == INITIAL:
            _put(self.starts, message.key, message)
            self._check_again(message.key, _next_key(self.starts, message.key))
            return None
        _put(self._actions if message.kind == ACTION else self._goals, message.key, message)
        self._affordable += 2
        if self.starts:
            self._uncheck(message.key)
            self._check(message.key)
        refusal = _at(self._refusals, message.key)
        return None if refusal is None else refusal.error

    def split(self, key: Key) -> TrialBuilder:
        """Move the messages from a key on into a builder of their own, and return that."""
        late = TrialBuilder(key, self._options)
        for name in ('starts', '_actions', '_goals', '_used_actions', '_used_goals', '_refusals'):
            entries = getattr(self, name)
            place = bisect_left(entries, key, key=KEY)
            setattr(late, name, entries[place:])
            del entries[place:]
        late._goal_before = self._goal_before
        place = bisect_left(self._unchecked, key)
        self._unchecked, late._unchecked = self._unchecked[:place], self._unchecked[place:]
        if late._used_actions or late._used_goals:
            for builder in (self, late):
                builder._time_actions()
            self._changed(key)
        if late._used_goals and not self._used_goals:  # it was the late trial that was inspected
            late._inspected, self._inspected = self._inspected, late._inspected
            late.warned, self.warned = self.warned, False
        return late

    def join(self, earlier: TrialBuilder) -> None:
        """Take over the initial chains of a builder that make no trial, and its refused actions."""
        self.first = earlier.first
        for name in ('starts', '_actions', '_refusals'):
            getattr(self, name)[:0] = getattr(earlier, name)
        self.trial = None

    def remove(self, messages: Iterable[Message]) -> None:
        """Remove messages on which no other one depends."""
        for message in messages:
            for entries in (self.starts, self._actions, self._goals, self._refusals):
                _put(entries, message.key, None)

    @property
    def messages(self) -> list[Message]:
        """All messages, in their order."""
        return sorted([*self.starts, *self._actions, *self._goals], key=KEY)

    @property
    def refusals(self) -> list[Refusal]:
        """The messages that cannot be used at present, in their order."""
        self._check()
        return self._refusals

    @property
    def actions(self) -> list[GripAction]:
        """The actions that are used, in their order."""
        self._check()
        return self._used_actions

    @property
    def waiting(self) -> list[Message]:
        """The messages for which an initial chain or an action is still missing, in their order."""
        if not self.starts:
            return sorted([*self._actions, *self._goals], key=KEY)
        end = bisect_left(self._goals, self.actions[0].key, key=KEY) if self.actions else None
        return list(self._goals[:end])

    def refused(self, key: Key) -> Message | None:
        """Return the message with a key if it is refused."""
        refusal = _at(self.refusals, key)
        return None if refusal is None else refusal.message

    def busy(self, key: Key | None = None) -> bool:
        """Return whether an initial chain, with a key if given, begins a new trial after these messages."""
        if not self.starts or self._goals and (key is None or self._goals[0].key < key):
            return True
        self._check(key)
        return bool(self._used_actions) and (key is None or self._used_actions[0].key < key)

    @property
    def second_start(self) -> Key | None:
        """Key of the initial chain that begins a new trial, as an action or a goal chain came before it."""
        if not self.starts:
            return None
        self._check(self.starts[-1].key)
        keys = [entries[0].key for entries in (self._used_actions, self._goals) if entries]
        return _next_key(self.starts, min(keys)) if keys else None

    @property
    def complete(self) -> bool:
        """Whether the messages make a trial."""
        self._check()
        return bool(self._used_goals)

    @property
    def spare(self) -> int:
        """Number of messages that no trial uses."""
        if not self.complete:
            return len(self.starts) + len(self._actions) + len(self._goals)
        return max(len(self.starts) - 2, 0) + len(self.waiting) + len(self._refusals)

    # Which messages can be used

    def _uncheck(self, key: Key) -> None:
        place = bisect_left(self._unchecked, key)
        if self._unchecked[place:place + 1] != [key]:
            self._unchecked.insert(place, key)

    def _check_again(self, key: Key, until: Key | None) -> None:
        """Forget whether the messages between two keys can be used."""
        for entries in (self._used_actions, self._used_goals, self._refusals):
            begin, end = _span(entries, key, until)
            del entries[begin:end]
        for messages in (self._actions, self._goals):
            begin, end = _span(messages, key, until)
            for message in messages[begin:end]:
                self._uncheck(message.key)
        self._time_actions()
        self._changed(key)

    def _check(self, until: Key | None = None) -> None:
        """Find out which of the messages up to a key can be used."""
        while self._unchecked and (until is None or self._unchecked[0] <= until):
            key = self._unchecked.pop(0)
            if key[1] == RANKS[ACTION]:
                self._check_action(key)
            else:
                self._check_goal(key)

    def _check_goal(self, key: Key) -> None:
        goal, action = _at(self._goals, key), _latest(self._used_actions, key)
        assert goal is not None
        used, refusal = None, None
        if action is not None:
            try:
                used = self._used_goal(goal, action.message)
            except InputError as error:
                refusal = Refusal(goal, error)
        _put(self._refusals, key, refusal)
        before = _put(self._used_goals, key, used)
        if (before is None) != (used is None):
            self._changed(key)
            self._uncheck_next_action(key)

    def _check_action(self, key: Key) -> None:
        action = _at(self._actions, key)
        assert action is not None
        used, refusal, goal = None, None, _latest(self._used_goals, key)
        if self._goal_before.get(key, goal) is not goal:
            self._uncheck_next_action(key)
        self._goal_before[key] = goal
        try:
            used = self._used_action(action)
        except InputError as error:
            refusal = Refusal(action, error)
        _put(self._refusals, key, refusal)
        before = _put(self._used_actions, key, used)
        if (before and (before.grips, before.offsets)) == (used and (used.grips, used.offsets)):
            return
        self._changed(key)
        if before is None and used:
            self._time(used)
        elif used is None:
            self._time_actions()
        if self._all_unchecked(key):
            return
        if before is None or used is None:
            earlier = _latest(self._used_actions, key)
            # The action numbers the hands of the goal chains after it, and their refusals name it.
            same = earlier is not None and earlier.message.names == action.names
            entries: Sequence[Refusal | ChainMessage] = self._refusals if same else self._goals
            begin, end = _span(entries, key, _next_key(self._used_actions, key))
            for entry in entries[begin:end]:
                self._uncheck(entry.key)
        self._uncheck_actions(action)

    def _all_unchecked(self, key: Key) -> bool:
        """Return whether all messages after a key will be checked again."""
        later = len(self._unchecked) - bisect_right(self._unchecked, key)
        spans = _span(self._actions, key, None), _span(self._goals, key, None)
        return later == sum(end - begin for begin, end in spans)

    def _uncheck_next_action(self, key: Key) -> None:
        """Check the next action again, as the goal chain before it has changed."""
        following = _next_key(self._actions, key)
        if following is not None:
            self._uncheck(following)

    def _uncheck_actions(self, changed: ActionMessage) -> None:
        """Check the later actions again that depend on this one."""
        hidden: Key | None = None  # of an action that takes its place
        for k in range(bisect_right(self._actions, changed.key, key=KEY), len(self._actions)):
            action = self._actions[k]
            goal = _latest(self._used_goals, action.key)
            if hidden is not None and not (goal is not None and changed.key < goal.key < hidden):
                return
            self._uncheck(action.key)
            used = _at(self._used_actions, action.key)
            if used and set(changed.names) <= set(action.names) \
                    and used.stamps[-1] >= waypoint_stamps(changed)[-1]:
                hidden = hidden or action.key

    def _time_actions(self) -> None:
        """Note when the used actions begin and end."""
        self._begins, self._ends, self._longest = [], [], 0
        for action in self._used_actions:
            self._time(action)

    def _time(self, action: GripAction) -> None:
        begin, end = action.stamps[0], action.stamps[-1]
        insort(self._begins, begin)
        insort(self._ends, (end, action.key))
        self._longest = max(self._longest, end - action.message.stamp)

    def _changed(self, key: Key) -> None:
        """Forget what was made of the goal chains from a key on."""
        self.trial = None
        while self._phases and self._phases[-1].goals[-1].key >= key:
            self._phases.pop()

    def _used_action(self, action: ActionMessage) -> GripAction:
        """
        Return an action with its grips.

        :raises InputError: if it cannot be used.
        """
        goal = _latest(self._used_goals, action.key)
        latest = goal or _latest(self.starts, action.key)
        assert latest is not None
        hands = None if goal is None else self._hands(goal)
        chain, numbered = latest.chain, action.names if hands is None else hands.names
        grips: list[tuple[int, ...]] = []
        offsets: list[float] = []
        for name, position, held in zip(action.names, action.positions[0],
                                        annotated_grips(chain, numbered, action.names), strict=True):
            offset = 0.0
            if held and hands is not None and name in hands.held_by:
                offset = self._offset(action, name, held)
            elif not held and (continued := self._continued_grip(action, name, position, latest.stamp)):
                held, offset = continued
            elif not held:
                point, offset, distance = chain.nearest(position)
                held = (point,)
                if distance > self._options.grip_tolerance:
                    raise InputError(
                        str(action), f'{name} closing {distance:.4g} m from any point of {latest}',
                        f'at most {self._options.grip_tolerance:g} m (grip_tolerance)',
                        'check the first waypoint, or number the gripped points in the field hand')
            twice = {grip for other, beside in zip(grips, offsets, strict=True) for grip in other
                     if abs(beside - offset) < SAME} & set(held)
            if twice:
                raise InputError(
                    str(action), f'two hands that grip point {min(twice)} of {latest}',
                    'different points', 'number the gripped points in the field hand, or leave one hand out')
            grips.append(held)
            offsets.append(offset)
        return GripAction(action, tuple(grips), tuple(offsets), waypoint_stamps(action))

    def _actions_before(self, key: Key) -> Iterator[GripAction]:
        """Yield the used actions before a key, the latest one first."""
        for k in range(bisect_left(self._used_actions, key, key=KEY) - 1, -1, -1):
            yield self._used_actions[k]

    def _offset(self, action: ActionMessage, name: str, held: tuple[int, ...]) -> float:
        """Return the offset of a hand that holds annotated points: that of its last grip of them."""
        for used in self._actions_before(action.key):
            if name in used.message.names:
                k = used.message.names.index(name)
                return used.offsets[k] if used.grips[k] == held else 0.0
        return 0.0

    def _continued_grip(self, action: ActionMessage, name: str, position: Floats,
                        since: int) -> tuple[tuple[int, ...], float] | None:
        """Return the grip of a hand that begins where its last action ended, later than `since` [ns]."""
        for used in self._actions_before(action.key):
            if used.message.stamp + self._longest <= since:
                break
            if name in used.message.names and used.stamps[-1] > since:
                k = used.message.names.index(name)
                there = np.linalg.norm(used.message.positions[-1, k] - position) <= MINIMUM_SPACING
                return (used.grips[k], used.offsets[k]) if there else None
        return None

    def _used_goal(self, goal: ChainMessage, action: ActionMessage) -> ChainMessage:
        """
        Return a goal chain, its unseen points put back; `action` is the latest one before it.

        :raises InputError: if it cannot be used.
        """
        start = self.starts[-1]
        if len(goal.chain) != len(start.chain):
            raise InputError(
                str(goal), f'{len(goal.chain)} points',
                f'{len(start.chain)} points as in {start}',
                'send the same material points before and after the action')
        if not goal.chain.seen.all():
            goal = replace(goal, chain=goal.chain.put_back(start.chain.arc_lengths()))
        change = length_change(start.chain, goal.chain)
        if change > self._options.length_tolerance:
            raise InputError(
                str(goal), f'a length of {goal.chain.length:.4g} m ({change:.0f} % from the '
                f'{start.chain.length:.4g} m of {start})',
                f'at most {self._options.length_tolerance:g} % (length_tolerance)',
                'check that both chains run along the whole DLO, in metres')
        highest = 0 if goal.chain.hands is None else int(goal.chain.hands.max())
        if highest > len(action.names):
            raise InputError(
                str(goal), f'points held by hand {highest}', f'hands 1 to {len(action.names)} as in {action}',
                'number the hands in the order of joint_names')
        return goal

    def _hands(self, goal: ChainMessage) -> HandState:
        """Return what the hands do when a used goal chain is observed."""
        latest = _latest(self._used_actions, goal.key)
        assert latest is not None
        names, last = latest.message.names, latest
        finished = bisect_left(self._ends, (goal.stamp,))
        under_way = bisect_right(self._begins, goal.stamp) > finished
        if finished:  # at equal ends, the first one
            _, key = self._ends[bisect_left(self._ends, (self._ends[finished - 1][0],))]
            last = _at(self._used_actions, key) or latest
        held_by: tuple[str, ...] = ()
        if goal.chain.hands is not None:
            held_by = tuple(names[k - 1] for k in np.unique(goal.chain.hands).tolist() if k)
        elif not self._options.release:
            held_by = tuple(dict.fromkeys(name for action in self._used_actions
                                          if action.stamps[-1] < goal.stamp for name in action.message.names))
        return HandState(names, bool(finished) and not under_way, held_by, finished, last.stamps[-1],
                         not set(last.message.names) <= set(held_by))

    # What the messages make

    def build(self, name: str) -> Trial:
        """Return the trial once it is complete; the same object until a message changes it."""
        self._check()
        if self.trial is None:
            start, velocity = self.starts[-1], self._velocity()
            zero = start.stamp
            if velocity is None:
                zero = min(self._used_goals[0].stamp, self._begins[0])
            actions = tuple(action.action(zero) for action in self._used_actions)
            goals = tuple(goal for phase in self._all_phases() for goal in phase.trial_goals(zero))
            self.trial = Trial(name, start.chain, actions, goals, velocity)
        elif self.trial.name != name:
            self.trial = replace(self.trial, name=name)
        return self.trial

    def _velocity(self) -> Floats | None:
        if len(self.starts) < 2:
            return None
        earlier, start = self.starts[-2:]
        elapsed = start.stamp - earlier.stamp
        if elapsed >= NANOSECONDS // 10 or len(earlier.chain) != len(start.chain):
            return None
        velocity = (start.chain.points - earlier.chain.points) * (NANOSECONDS / elapsed)
        both = start.chain.seen & earlier.chain.seen
        if both.all() or not both.any():
            return velocity if both.any() else None
        places = start.chain.arc_lengths()
        return np.stack([np.interp(places, places[both], axis[both]) for axis in velocity.T], axis=1)

    def _all_phases(self) -> list[Phase]:
        """Return the goal chains in phases; those before the earliest change are not looked at again."""
        self._check()
        for goal in self._used_goals[sum(len(phase.goals) for phase in self._phases):]:
            hands = self._hands(goal)
            if not self._phases or not self._phases[-1].continues(hands):
                self._phases.append(Phase(hands, Stream(
                    self._options.stable_time, self._options.stable_distance, self._options.settle_limit)))
            self._phases[-1].add(goal)
        return self._phases

    @property
    def due(self) -> bool:
        """
        Whether to look for warnings now: whenever the goal count has doubled, and at the first goal at rest.

        It is too early while a stream does not yet show the DLO at rest.
        """
        if self.warned or self._unchecked or not self._used_goals:
            return False
        goals, newest = self._used_goals, self._hands(self._used_goals[-1])
        state = len(goals).bit_length(), self._inspected[1] or newest.stable
        if state == self._inspected:
            return False
        if len(goals) > 1 and goals[-1].stamp - goals[-2].stamp < STILL * NANOSECONDS and newest.stable:
            missing = len(goals) - sum(len(phase.goals) for phase in self._phases)
            if missing > self._affordable:  # else each chain that comes late would cost as much as all others
                return False
            self._affordable -= missing
            if self._all_phases()[-1].rest is None:
                return False
        self._inspected = state
        return True

    def disturbed(self) -> tuple[InputError, ...]:
        """Return why goal chains after a DLO came to rest are left out, if some are."""
        if not self.complete:
            return ()
        left_out = [goal for phase in self._all_phases() for goal in phase.disturbed]
        if not left_out:
            return ()
        return InputError(
            str(left_out[0]), 'a DLO that had come to rest and moves again', 'an action before that',
            'the goal chains from then on are left out, as they should be if it was laid out for the next '
            'trial; if a hand moved it in this trial, send that action'),

    def missing(self) -> str:
        """Return a description of the messages that are missing; empty where the trial is complete."""
        if self.complete:
            return ''
        waiting = self.waiting
        if not self.starts:
            return f'an initial_chain before {waiting[0]}' if waiting else ''
        if not self.actions:
            early = f' ({len(waiting)} goal_chain waiting for it)' if waiting else ''
            return f'an action after {self.starts[-1]}{early}' + ('' if early else ', and a goal_chain')
        early = f'; {waiting[-1]} is before it' if waiting else ''
        return f'a goal_chain after {self.actions[0].message}{early}'

    def incomplete(self, until: str, remedy: str) -> tuple[InputError, ...]:
        """Return why the messages make no trial although more than initial chains came; `until` what came."""
        actions, waiting = self.actions, self.waiting
        if self.complete or not (actions or waiting):
            return ()
        if actions:
            came = f'no goal_chain between {actions[0].message} {until}'
        else:
            came = f'{len(waiting)} goal_chain, but no action between {self.starts[-1]} {until}'
        return InputError(f'trial that begins with {self.starts[-1]}', came, 'at least one', remedy),

    def manipulation(self, name: str) -> tuple[Manipulation | None, list[InputError]]:
        """
        Return what the hands did, whether or not there is a goal chain.

        Goal chains only show which hands hold the DLO.  Without an annotation, a hand grips the nearest
        place of the latest chain, if no action has moved the DLO since, else of the predicted chain.

        :returns: None if there is no usable action; and the reasons why actions are not used.
        """
        refused = {refusal.key: refusal.error for refusal in self.refusals
                   if isinstance(refusal.message, ActionMessage)}
        if not self._actions or not self.starts:
            return None, list(refused.values())
        zero = min(waypoint_stamps(action)[0] for action in self._actions)
        ends: list[int] = []
        timed, problems = [], []
        for message in self._actions:
            stamps = waypoint_stamps(message)
            used = _at(self._used_actions, message.key)
            seen = max([self.starts[-1].stamp, *(goal.stamp for goal in self._used_goals
                                                 if goal.stamp <= stamps[0])])
            action: Union[Action, RecordedPaths]
            if any(seen < end <= stamps[0] for end in ends):
                action = self._recorded(message, (stamps[0] - zero) / NANOSECONDS)
            elif used is not None:
                action = used.action(zero)
            else:
                problems.append(refused[message.key])
                continue
            ends.append(stamps[-1])
            timed.append(TimedAction(action, (stamps[-1] - zero) / NANOSECONDS, not self._options.release))
        if not timed:
            return None, problems
        holding = [((goal.stamp - zero) / NANOSECONDS,
                    None if goal.chain.hands is None else self._hands(goal).held_by)
                   for goal in self._used_goals]
        return manipulation_of(name, self.starts[-1].chain, timed, holding), problems

    def _recorded(self, message: ActionMessage, start: float) -> RecordedPaths:
        """Return an action that begins after another one has moved the DLO, at `start` [s]."""
        goal = _latest(self._used_goals, message.key)
        chain, numbered = (self.starts[-1].chain, message.names) if goal is None else (
            goal.chain, self._hands(goal).names)
        return RecordedPaths(
            start=start, hands=message.names, grips=tuple(annotated_grips(chain, numbered, message.names)),
            times=message.times - message.times[0], positions=message.positions,
            orientations=message.orientations, tolerance=self._options.grip_tolerance)


# Lists that are sorted by key

def _at(entries: Sequence[Any], key: Key) -> Any:
    """Return the entry with a key; None if there is none."""
    place = bisect_left(entries, key, key=KEY)
    return entries[place] if place < len(entries) and entries[place].key == key else None


def _latest(entries: Sequence[Any], key: Key) -> Any:
    """Return the last entry before a key; None if there is none."""
    place = bisect_left(entries, key, key=KEY)
    return entries[place - 1] if place else None


def _next_key(entries: Sequence[Any], key: Key) -> Key | None:
    """Return the key of the first entry after a key; None if there is none."""
    place = bisect_right(entries, key, key=KEY)
    return entries[place].key if place < len(entries) else None


def _span(entries: Sequence[Any], key: Key, until: Key | None) -> tuple[int, int]:
    """Return the first place after a key, and the first one from another key on."""
    end = len(entries) if until is None else bisect_left(entries, until, key=KEY)
    return bisect_right(entries, key, key=KEY), end


def _put(entries: list[Any], key: Key, entry: Any) -> Any:
    """Put an entry at its place, or none if it is None; return the entry that was there, or None."""
    place = bisect_left(entries, key, key=KEY)
    before = entries[place] if place < len(entries) and entries[place].key == key else None
    entries[place:place + (before is not None)] = [] if entry is None else [entry]
    return before


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
