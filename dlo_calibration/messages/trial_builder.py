# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""TrialBuilder: the messages of one trial, from its initial chain to the next one."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field, replace
from typing import Iterable, Sequence, Union

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import ACTION, ActionMessage, ChainMessage, GOAL, INITIAL, NANOSECONDS
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, length_change, MINIMUM_SPACING
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.rest import Rest, STILL, STREAM, Stream

Message = Union[ChainMessage, ActionMessage]
Key = tuple[int, int, tuple[str, ...]]

SAME = 0.1  # of a segment; two hands do not grip nearer to each other
RANKS = {INITIAL: 0, ACTION: 1, GOAL: 2}  # order of messages with equal stamps


def order(message: Message) -> Key:
    """Return the key by which messages are sorted; it is unique among collected messages."""
    names = message.names if isinstance(message, ActionMessage) else ()
    return message.stamp, RANKS[message.kind], names


def moved(message: Message, pose: Pose) -> Message:
    """Return a message in another frame, in which its own has a pose."""
    if isinstance(message, ActionMessage):
        return replace(message, positions=pose.points(message.positions),
                       orientations=pose.orientations(message.orientations))
    return ChainMessage(message.kind, message.stamp, message.frame_id, pose.chain(message.chain))


@dataclass(frozen=True)
class Move:
    """A usable action: the grips and the offset of each hand, and the instants of its waypoints [ns]."""

    message: ActionMessage
    grips: tuple[tuple[int, ...], ...]
    offsets: tuple[float, ...]
    instants: tuple[int, ...]

    def action(self, zero: int) -> Action:
        """Return the action, whose times count from `zero` [ns]."""
        sent, times = self.message, seconds(self.instants, zero)
        return Action(tuple(
            Hand(name, self.grips[k], times, sent.positions[:, k], sent.orientations[:, k], self.offsets[k])
            for k, name in enumerate(sent.names)))


@dataclass(frozen=True)
class GoalView:
    """A usable goal chain; its annotation numbers the hands in `names`."""

    message: ChainMessage
    names: tuple[str, ...]
    stable: bool
    held_by: tuple[str, ...]
    after: int  # number of actions that are over
    end: int  # when the last one of them was over [ns]
    opened: bool  # whether a hand opened then


@dataclass
class Stretch:
    """Successive goal chains with the same actions before them, all stable or all timed."""

    stream: Stream
    views: list[GoalView] = field(default_factory=list)

    def goes_on_with(self, view: GoalView) -> bool:
        """Tell whether a later goal chain belongs to it."""
        last = self.views[-1]
        return (last.stable, last.after, last.held_by) == (view.stable, view.after, view.held_by)

    def add(self, view: GoalView) -> None:
        """Take the next goal chain."""
        self.views.append(view)
        if view.stable:
            self.stream.add((view.message.stamp - view.end) / NANOSECONDS, view.message.chain)

    @property
    def rest(self) -> Rest | None:
        """Where the DLO rests; None for a few chains, each of which counts, and while it moves."""
        return self.stream.rest() if self.stream.count >= STREAM else None

    @property
    def left_out(self) -> list[GoalView]:
        """The goal chains that show the DLO after it came to rest, and moved again."""
        rest = self.rest
        return [] if rest is None or rest.moved is None else self.views[rest.moved:]

    def goals(self, zero: int) -> list[Goal]:
        """
        Return the goals; those of a stream that shows the DLO at rest are one, their mean.

        The chains before are goals at their instants, unless a hand has opened: a message does not tell to
        0.1 s when it did, and a fall of 0.1 s is 5 cm. They are left out then; if none shows rest, the last
        one counts.
        """
        rest, streamed = self.rest, self.stream.count >= STREAM
        seen = self.views if rest is None else self.views[:rest.first + 1]
        if streamed and seen[-1].opened:
            seen = seen[-1:]
        times = seconds((view.message.stamp for view in seen), zero).tolist()
        goals = [Goal(view.message.chain, time, view.stable and (view.opened or not streamed), view.held_by)
                 for view, time in zip(seen, times, strict=True)]
        if rest is not None:
            chain = seen[-1].message.chain
            goals[-1] = replace(goals[-1], stable=True, count=rest.count,
                                chain=Chain(rest.points, chain.hands, chain.features))
        return goals


def _message_order(entry: Move | GoalView) -> Key:
    return order(entry.message)


@dataclass
class TrialBuilder:
    """
    The messages of one trial, complete or not.

    The first builder of a collector has no initial chain: it holds the messages before the first one.
    `extend` takes messages in their order only.

    :param first: key of the first initial chain.
    :param until: key up to which the messages were taken back; it then stays empty. None: they were not.
    :param starts: initial chains; the last one counts, and the one before it for the velocity.
    :param waiting: messages for which an initial chain or an action is still missing.
    :param judged: how often the number of goals had doubled, and whether one was at rest, when `doubts` last
        looked at the trial.
    """

    first: Key
    until: Key | None = None
    starts: list[ChainMessage] = field(default_factory=list)
    moves: list[Move] = field(default_factory=list)
    views: list[GoalView] = field(default_factory=list)
    waiting: list[Message] = field(default_factory=list)
    refused: list[tuple[Message, InputError]] = field(default_factory=list)
    trial: Trial | None = None
    judged: tuple[int, bool] = (0, False)
    _stretches: list[Stretch] = field(default_factory=list)

    @property
    def busy(self) -> bool:
        """Tell whether the next initial chain begins a new trial."""
        return bool(self.moves or self.views or self.waiting or not self.starts)

    @property
    def complete(self) -> bool:
        """Tell whether the messages make a trial."""
        return bool(self.moves and self.views)

    @property
    def spare(self) -> int:
        """Number of messages that no trial uses."""
        if not self.complete:
            return len(self.starts) + len(self.moves) + len(self.waiting) + len(self.refused)
        return max(len(self.starts) - 2, 0) + len(self.waiting) + len(self.refused)

    def messages(self) -> list[Message]:
        """Return all messages of the trial, in order."""
        return sorted([*self.starts, *(one.message for one in self.moves), *self.waiting,
                       *(one.message for one in self.views),
                       *(message for message, _ in self.refused)], key=order)

    def divided(self, key: Key) -> tuple[TrialBuilder, list[Message]]:
        """Return a builder of the messages before a key, as it was then, and the later messages in order."""
        # What becomes of a message depends only on those before it, so nothing is judged anew.
        early, late = TrialBuilder(self.first), TrialBuilder(self.first)
        for name, place in (('starts', order), ('moves', _message_order), ('views', _message_order),
                            ('waiting', order), ('refused', lambda pair: order(pair[0]))):
            entries = getattr(self, name)
            count = bisect_left(entries, key, key=place)
            setattr(early, name, entries[:count])
            setattr(late, name, entries[count:])
        return early, late.messages()

    def extend(self, message: Message, options: Options) -> InputError | None:
        """Take a message that is later than all others; return the reason if it is refused."""
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
                self.views.append(self._view(message, options))
        except InputError as error:
            self.refused.append((message, error))
            return error
        self.trial = None
        return None

    def _move(self, action: ActionMessage, options: Options) -> Move:
        latest, numbered = self.starts[-1], action.names
        if self.views:
            latest, numbered = self.views[-1].message, self.views[-1].names
        chain = latest.chain
        grips: list[tuple[int, ...]] = []
        offsets: list[float] = []
        for name, position, held in zip(action.names, action.positions[0],
                                        annotated_grips(chain, numbered, action.names), strict=True):
            offset = self._offset(name, held)
            if not held and (goes_on := self._goes_on(name, position, latest.stamp)) is not None:
                held, offset = goes_on
            elif not held:
                point, offset, distance = chain.nearest(position)
                held = (point,)
                if distance > options.grip_tolerance:
                    raise InputError(
                        str(action), f'{name} closing {distance:.4g} m from any point of {latest}',
                        f'at most {options.grip_tolerance:g} m (grip_tolerance)',
                        'check the first waypoint, or number the gripped points in the field hand')
            twice = {grip for other, beside in zip(grips, offsets, strict=True) for grip in other
                     if abs(beside - offset) < SAME} & set(held)
            if twice:
                raise InputError(
                    str(action), f'two hands that grip point {min(twice)} of {latest}',
                    'different points', 'number the gripped points in the field hand, or leave one hand out')
            grips.append(held)
            offsets.append(offset)
        return Move(action, tuple(grips), tuple(offsets), instants_of(action))

    def _offset(self, name: str, held: tuple[int, ...]) -> float:
        """Return the offset of a hand that holds points by annotation: that of its last grip of them."""
        if not self.views or name not in self.views[-1].held_by:
            return 0.0
        last = [(move.grips[k], move.offsets[k]) for move in self.moves
                for k, other in enumerate(move.message.names) if other == name]
        return last[-1][1] if last and last[-1][0] == held else 0.0

    def _goes_on(self, name: str, position: Floats, since: int) -> tuple[tuple[int, ...], float] | None:
        """Return what a hand grips that goes on where its last action ended, later than `since` [ns]."""
        for move in reversed(self.moves):
            if name in move.message.names and move.instants[-1] > since:
                k = move.message.names.index(name)
                there = np.linalg.norm(move.message.positions[-1, k] - position) <= MINIMUM_SPACING
                return (move.grips[k], move.offsets[k]) if there else None
        return None

    def _view(self, goal: ChainMessage, options: Options) -> GoalView:
        start = self.starts[-1]
        if len(goal.chain) != len(start.chain):
            raise InputError(
                str(goal), f'{len(goal.chain)} points',
                f'{len(start.chain)} points as in {start}',
                'send the same material points before and after the action')
        if not goal.chain.seen.all():
            goal = replace(goal, chain=goal.chain.put_back(start.chain.arc_lengths()))
        change = length_change(start.chain, goal.chain)
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
        last = max(finished, key=lambda move: move.instants[-1], default=self.moves[-1])
        return GoalView(goal, latest.names, bool(finished) and not under_way, held_by, len(finished),
                        last.instants[-1], not set(last.message.names) <= set(held_by))

    def build(self, name: str, options: Options) -> Trial:
        """Return the trial once it is complete; the same object until a message changes it."""
        if self.trial is None:
            self.trial = self._build(name, options)
        elif self.trial.name != name:
            self.trial = replace(self.trial, name=name)
        return self.trial

    def _build(self, name: str, options: Options) -> Trial:
        start, velocity = self.starts[-1], self._velocity()
        zero = start.stamp
        if velocity is None:
            zero = min([self.views[0].message.stamp, *(move.instants[0] for move in self.moves)])
        actions = tuple(move.action(zero) for move in self.moves)
        goals = tuple(goal for stretch in self._followed(options) for goal in stretch.goals(zero))
        return Trial(name, start.chain, actions, goals, velocity)

    def _followed(self, options: Options) -> list[Stretch]:
        """Return the goal chains, action by action; only those that are new are looked at."""
        for view in self.views[sum(len(stretch.views) for stretch in self._stretches):]:
            if not self._stretches or not self._stretches[-1].goes_on_with(view):
                self._stretches.append(Stretch(Stream(
                    options.stable_time, options.stable_distance, options.settle_limit)))
            self._stretches[-1].add(view)
        return self._stretches

    def unsettled(self, options: Options) -> bool:
        """Tell whether the newest goal chain is one of a stream that does not yet show the DLO at rest."""
        soon = len(self.views) > 1 and (
            self.views[-1].message.stamp - self.views[-2].message.stamp < STILL * NANOSECONDS)
        return soon and self.views[-1].stable and self._followed(options)[-1].rest is None

    def disturbed(self, options: Options) -> tuple[InputError, ...]:
        """Return why goal chains after a DLO came to rest are left out, if some are."""
        if not self.complete:
            return ()
        left_out = [view for stretch in self._followed(options) for view in stretch.left_out]
        if not left_out:
            return ()
        return InputError(
            str(left_out[0].message), 'a DLO that had come to rest and moves again', 'an action before that',
            'the goal chains from then on are left out, as they should be if it was laid out for the next '
            'trial; if a hand moved it in this trial, send that action'),

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
        return np.stack([np.interp(places, places[both], one[both]) for one in velocity.T], axis=1)

    def lacks(self) -> str:
        """Return, in words, the messages that are missing; empty where the trial is complete."""
        if self.complete:
            return ''
        if not self.starts:
            return f'an initial_chain before {self.waiting[0]}' if self.waiting else ''
        if not self.moves:
            early = f' ({len(self.waiting)} goal_chain waiting for it)' if self.waiting else ''
            return f'an action after {self.starts[-1]}{early}' + ('' if early else ', and a goal_chain')
        early = f'; {self.waiting[-1]} is before it' if self.waiting else ''
        return f'a goal_chain after {self.moves[0].message}{early}'


def instants_of(action: ActionMessage) -> tuple[int, ...]:
    """Return the instants of the waypoints [ns]."""
    return tuple(action.stamp + round(float(t) * NANOSECONDS) for t in action.times)


def annotated_grips(chain: Chain, numbered: Sequence[str], names: Sequence[str]) -> list[tuple[int, ...]]:
    """
    Return the points that hands grip by the annotation of a chain; empty where it does not tell.

    :param numbered: names of the hands that the annotation numbers, in this order.
    :param names: of the hands asked for.
    """
    return [() if chain.hands is None or name not in numbered else
            tuple(np.flatnonzero(chain.hands == numbered.index(name) + 1).tolist()) for name in names]


def seconds(instants: Iterable[int], zero: int) -> Floats:
    """Return [ns] instants as seconds since `zero`; equal instants give equal numbers."""
    return np.array([(instant - zero) / NANOSECONDS for instant in instants])
