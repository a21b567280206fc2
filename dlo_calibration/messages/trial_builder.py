# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""TrialBuilder: what the messages of one trial make, from its initial chain to the next one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Union

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.checked_messages import CheckedMessages
from dlo_calibration.messages.codec import ActionMessage, ChainMessage, INITIAL, Key, Message, NANOSECONDS
from dlo_calibration.messages.grip_actions import annotated_grips, HandState, seconds, waypoint_stamps
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import Manipulation, manipulation_of, RecordedPaths, TimedAction
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.rest import Rest, STILL, STREAM, Stream


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
        """Where the DLO rests; None while it moves, and where there are too few chains for a stream."""
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


class TrialBuilder(CheckedMessages):
    """
    What the messages of one trial make: a trial, what its hands did, warnings, and what is missing.

    The first builder of a collector has no initial chain: it holds the messages before the first one.

    :ivar trial: None from a change until it is built again.
    :ivar zero: stamp of its time 0 [ns], once it is built.
    :ivar warned: whether a warning was given that the trial is implausible.
    :ivar lost: whether a warning was given about a hand that has lost the DLO.
    """

    def __init__(self, first: Key, options: Options, until: Key | None = None) -> None:
        super().__init__(first, options, until)
        self.trial: Trial | None = None
        self.zero = 0
        self._phases: list[Phase] = []
        self._affordable = 0  # goal chains that may be added to phases only to look for warnings
        self._inspected = 0, False  # see `due`
        self.warned = self.lost = False

    def add(self, message: Message) -> InputError | None:
        """Add a message; return the reason if it cannot be used."""
        self._affordable += 0 if message.kind == INITIAL else 2
        return super().add(message)

    def split(self, key: Key) -> TrialBuilder:
        """Move the messages from a key on into a builder of their own, and return that."""
        late = TrialBuilder(key, self._options)
        self._move(key, late)
        if late._used_goals and not self._used_goals:  # it was the late trial that was inspected
            late._inspected, self._inspected = self._inspected, late._inspected
            late.warned, self.warned = self.warned, False
            late.lost, self.lost = self.lost, False
        return late

    def join(self, earlier: CheckedMessages) -> None:
        """Take over the initial chains of messages that make no trial, and their refused actions."""
        super().join(earlier)
        self.trial = None

    def _changed(self, key: Key) -> None:
        """Forget what was made of the used messages from a key on."""
        self.trial = None
        while self._phases and self._phases[-1].goals[-1].key >= key:
            self._phases.pop()

    def build(self, name: str) -> Trial:
        """Return the trial once it is complete; the same object until a message changes it."""
        goals = self.goals
        if self.trial is None:
            start, velocity = self.starts[-1], self._velocity()
            zero = start.stamp if velocity is not None else min(
                goals[0].stamp, *(action.stamps[0] for action in self.actions))
            self.zero = zero
            actions = tuple(action.action(zero) for action in self.actions)
            self.trial = Trial(name, start.chain, actions, tuple(
                goal for phase in self._all_phases() for goal in phase.trial_goals(zero)), velocity)
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
        """Return the goal chains in phases; only those from the earliest change on are added again."""
        for goal in self.goals[sum(len(phase.goals) for phase in self._phases):]:
            hands = self.actions.hands(goal, self._options.release)
            if not self._phases or not self._phases[-1].continues(hands):
                self._phases.append(Phase(hands, Stream(
                    self._options.stable_time, self._options.stable_distance, self._options.settle_limit)))
            self._phases[-1].add(goal)
        return self._phases

    @property
    def due(self) -> bool:
        """
        Whether to look for warnings: when the goal count has doubled, and at the first goal at rest.

        It is too early while a stream does not yet show the DLO at rest.
        """
        if self._unchecked or not self._used_goals:
            return False
        goals = self._used_goals
        newest = self._used_actions.hands(goals[-1], self._options.release)
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
        timed, unused = [], []
        for message in self._actions:
            stamps = waypoint_stamps(message)
            used = self.actions.at(message.key)
            seen = max([self.starts[-1].stamp, *(goal.stamp for goal in self.goals
                                                 if goal.stamp <= stamps[0])])
            action: Union[Action, RecordedPaths]
            if any(seen < end <= stamps[0] for end in ends):
                action = self._recorded(message, (stamps[0] - zero) / NANOSECONDS)
            elif used is not None:
                action = used.action(zero)
            else:
                unused.append(refused[message.key])
                continue
            ends.append(stamps[-1])
            timed.append(TimedAction(action, (stamps[-1] - zero) / NANOSECONDS, not self._options.release))
        if not timed:
            return None, unused
        holding = [((goal.stamp - zero) / NANOSECONDS, None if goal.chain.hands is None else
                    self.actions.hands(goal, self._options.release).held_by) for goal in self.goals]
        return manipulation_of(name, self.starts[-1].chain, timed, holding), unused

    def _recorded(self, message: ActionMessage, start: float) -> RecordedPaths:
        """Return an action that begins after another one has moved the DLO, at `start` [s]."""
        goal = self.goals.before(message.key)
        chain, numbered = (self.starts[-1].chain, message.names) if goal is None else (
            goal.chain, self.actions.hands(goal, self._options.release).names)
        return RecordedPaths(
            start=start, hands=message.names, grips=tuple(annotated_grips(chain, numbered, message.names)),
            times=message.times - message.times[0], positions=message.positions,
            orientations=message.orientations, tolerance=self._options.grip_tolerance)
