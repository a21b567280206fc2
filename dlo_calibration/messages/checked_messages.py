# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
CheckedMessages: the messages of one trial, and which of them can be used.

Whether a message can be used depends on those with earlier stamps, but only on a few of them:

- a goal chain on the last initial chain and the latest used action;
- an action on the latest used goal chain, on what the hands do then, and on the last grips of its hands.

So after a late message, only those that depend on it are checked again, in the order of their keys, and
only up to the key that is asked for.  Each check with another outcome marks the messages that depend on it.
Thus the work is in proportion to the messages, in any order of arrival.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import replace
from typing import Iterable, NamedTuple

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import ACTION, ActionMessage, ChainMessage, INITIAL, Key, Message, RANKS
from dlo_calibration.messages.grip_actions import annotated_grips, GripAction, GripActions, waypoint_stamps
from dlo_calibration.messages.keyed_list import KEY, KeyedList
from dlo_calibration.model.chain import length_change

SAME = 0.1  # of a segment; two hands do not grip nearer to each other


class Refusal(NamedTuple):
    """A message that is not used at present, and why."""

    message: Message
    error: InputError

    @property
    def key(self) -> Key:
        """The place of the message in the order of all messages."""
        return self.message.key


class CheckedMessages:
    """
    The messages of one trial, complete or not, in any order of arrival.

    :param first: key of the first initial chain.
    :param until: key up to which the messages were discarded; there are none. None: they were not.
    :ivar starts: initial chains; the last one counts, and the one before it for the velocity.
    """

    def __init__(self, first: Key, options: Options, until: Key | None = None) -> None:
        self.first, self.until, self._options = first, until, options
        self.starts: KeyedList[ChainMessage] = KeyedList()
        self._actions: KeyedList[ActionMessage] = KeyedList()
        self._goals: KeyedList[ChainMessage] = KeyedList()  # as they came
        self._unchecked: list[Key] = []  # of actions and goals, sorted
        self._used_actions = GripActions()
        self._used_goals: KeyedList[ChainMessage] = KeyedList()
        self._refusals: KeyedList[Refusal] = KeyedList()
        self._goal_before: dict[Key, ChainMessage | None] = {}  # each action, when it was last checked

    def add(self, message: Message) -> InputError | None:
        """Add a message; return the reason if it cannot be used."""
        key = message.key
        if isinstance(message, ActionMessage):
            self._actions.put(key, message)
        elif message.kind == INITIAL:
            self.starts.put(key, message)
            following = self.starts.after(key)
            self._check_again(key, None if following is None else following.key)
            return None
        else:
            self._goals.put(key, message)
        if self.starts:
            self._uncheck(key)
            self._check(key)
        refusal = self._refusals.at(key)
        return None if refusal is None else refusal.error

    def _move(self, key: Key, late: CheckedMessages) -> None:
        """Move the messages from a key on to those of a later trial, which are none so far."""
        self.starts, late.starts = self.starts.parted(key)
        self._actions, late._actions = self._actions.parted(key)
        self._goals, late._goals = self._goals.parted(key)
        self._used_actions, late._used_actions = self._used_actions.parted(key)
        self._used_goals, late._used_goals = self._used_goals.parted(key)
        self._refusals, late._refusals = self._refusals.parted(key)
        place = bisect_left(self._unchecked, key)
        self._unchecked, late._unchecked = self._unchecked[:place], self._unchecked[place:]
        late._goal_before = self._goal_before
        if late._used_actions or late._used_goals:
            self._changed(key)

    def join(self, earlier: CheckedMessages) -> None:
        """Take over the initial chains of messages that make no trial, and their refused actions."""
        self.first = earlier.first
        self.starts[:0] = earlier.starts
        self._actions[:0] = earlier._actions
        self._refusals[:0] = earlier._refusals

    def remove(self, messages: Iterable[Message]) -> None:
        """Remove messages on which no other one depends."""
        for message in messages:
            for entries in (self.starts, self._actions, self._goals, self._refusals):
                entries.put(message.key, None)

    @property
    def messages(self) -> list[Message]:
        """All messages, in their order."""
        return sorted([*self.starts, *self._actions, *self._goals], key=KEY)

    @property
    def refusals(self) -> KeyedList[Refusal]:
        """The messages that cannot be used at present."""
        self._check()
        return self._refusals

    @property
    def actions(self) -> GripActions:
        """The actions that are used."""
        self._check()
        return self._used_actions

    @property
    def goals(self) -> KeyedList[ChainMessage]:
        """The goal chains that are used, their unseen points put back."""
        self._check()
        return self._used_goals

    @property
    def waiting(self) -> list[Message]:
        """The messages for which an initial chain or an action is still missing, in their order."""
        if not self.starts:
            return sorted([*self._actions, *self._goals], key=KEY)
        return list(self._goals.parted(self.actions[0].key)[0] if self.actions else self._goals)

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
        second = self.starts.after(min(keys)) if keys else None
        return None if second is None else second.key

    @property
    def complete(self) -> bool:
        """Whether the messages make a trial."""
        return bool(self.goals)

    @property
    def spare(self) -> int:
        """Number of messages that no trial uses."""
        if not self.complete:
            return len(self.starts) + len(self._actions) + len(self._goals)
        return max(len(self.starts) - 2, 0) + len(self.waiting) + len(self._refusals)

    def _changed(self, key: Key) -> None:
        """Notice that the used messages from a key on have changed."""

    # Which messages to check

    def _uncheck(self, key: Key) -> None:
        """Check a message again when it is asked for."""
        place = bisect_left(self._unchecked, key)
        if self._unchecked[place:place + 1] != [key]:
            self._unchecked.insert(place, key)

    def _check_again(self, key: Key, until: Key | None) -> None:
        """Check all messages between two keys again, as if they had just come."""
        del self._used_goals[self._used_goals.between(key, until)]
        del self._refusals[self._refusals.between(key, until)]
        del self._used_actions[self._used_actions.between(key, until)]
        self._used_actions = GripActions(self._used_actions)
        for action in self._actions[self._actions.between(key, until)]:
            self._uncheck(action.key)
        for goal in self._goals[self._goals.between(key, until)]:
            self._uncheck(goal.key)
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
        goal, action = self._goals.at(key), self._used_actions.before(key)
        assert goal is not None
        used, refusal = None, None
        if action is not None:
            try:
                used = self._used_goal(goal, action.message)
            except InputError as error:
                refusal = Refusal(goal, error)
        self._refusals.put(key, refusal)
        previous = self._used_goals.put(key, used)
        if (previous is None) != (used is None):
            self._changed(key)
            self._uncheck_next_action(key)

    def _check_action(self, key: Key) -> None:
        action, goal = self._actions.at(key), self._used_goals.before(key)
        assert action is not None
        if self._goal_before.get(key, goal) is not goal:
            self._uncheck_next_action(key)  # the same goal chain may be its latest, too
        self._goal_before[key] = goal
        used, refusal = None, None
        try:
            used = self._used_action(action)
        except InputError as error:
            refusal = Refusal(action, error)
        self._refusals.put(key, refusal)
        previous = self._used_actions.put(key, used)
        if previous == used:
            return
        self._changed(key)
        if self._all_unchecked(key):
            return
        if previous is None or used is None:
            self._uncheck_goals(action)
        self._uncheck_actions(action)

    def _all_unchecked(self, key: Key) -> bool:
        """Return whether all messages after a key will be checked again."""
        later = len(self._unchecked) - bisect_right(self._unchecked, key)
        return later == self._actions.count_after(key) + self._goals.count_after(key)

    def _uncheck_goals(self, changed: ActionMessage) -> None:
        """Check the goal chains up to the next used action again, whose hands this one numbers."""
        earlier, following = self._used_actions.before(changed.key), self._used_actions.after(changed.key)
        same = earlier is not None and earlier.message.names == changed.names  # only refusals name the action
        entries: KeyedList[Refusal] | KeyedList[ChainMessage] = self._refusals if same else self._goals
        for entry in entries[entries.between(changed.key, None if following is None else following.key)]:
            self._uncheck(entry.key)

    def _uncheck_next_action(self, key: Key) -> None:
        """Check the next action again, as the goal chain before it has changed."""
        following = self._actions.after(key)
        if following is not None:
            self._uncheck(following.key)

    def _uncheck_actions(self, changed: ActionMessage) -> None:
        """
        Check the later actions again that depend on this one.

        After a successor, which has all its hands and ends no earlier, an action does so only if its latest
        goal chain came between the two.
        """
        successor: Key | None = None
        for action in self._actions[self._actions.between(changed.key, None)]:
            goal = self._used_goals.before(action.key)
            if successor is not None and not (goal is not None and changed.key < goal.key < successor):
                return
            self._uncheck(action.key)
            used = self._used_actions.at(action.key)
            if used and set(changed.names) <= set(action.names) \
                    and used.stamps[-1] >= waypoint_stamps(changed)[-1]:
                successor = successor or action.key

    # Whether a message can be used

    def _used_action(self, action: ActionMessage) -> GripAction:
        """
        Return an action with its grips.

        :raises InputError: if it cannot be used.
        """
        goal = self._used_goals.before(action.key)
        latest = goal or self.starts.before(action.key)
        assert latest is not None
        hands = None if goal is None else self._used_actions.hands(goal, self._options.release)
        chain, numbered = latest.chain, action.names if hands is None else hands.names
        grips: list[tuple[int, ...]] = []
        offsets: list[float] = []
        nearest: list[bool] = []
        for name, position, grip in zip(action.names, action.positions[0],
                                        annotated_grips(chain, numbered, action.names), strict=True):
            offset = 0.0
            nearest.append(not grip)
            if grip and hands is not None and name in hands.held_by:
                offset = self._used_actions.offset(action, name, grip)
            elif not grip and (continued := self._used_actions.continued_grip(
                    action, name, position, latest.stamp)):
                grip, offset = continued
            elif not grip:
                point, offset, distance = chain.nearest(position)
                grip = (point,)
                if distance > self._options.grip_tolerance:
                    raise InputError(
                        str(action), f'{name} closing {distance:.4g} m from any point of {latest}',
                        f'at most {self._options.grip_tolerance:g} m (grip_tolerance)',
                        'check the first waypoint, or number the gripped points in the field hand')
            twice = {point for other, beside in zip(grips, offsets, strict=True) for point in other
                     if abs(beside - offset) < SAME} & set(grip)
            if twice:
                raise InputError(
                    str(action), f'two hands that grip point {min(twice)} of {latest}',
                    'different points', 'number the gripped points in the field hand, or leave one hand out')
            grips.append(grip)
            offsets.append(offset)
        return GripAction(action, tuple(grips), tuple(offsets), tuple(nearest), waypoint_stamps(action))

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
            goal = replace(goal, chain=goal.chain.interpolated(start.chain.arc_lengths()))
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
