# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Encoder: the messages that a robot sends when it does given trials."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.messages.codec import (
    ActionMessage,
    ChainMessage,
    GOAL,
    INITIAL,
    InputMessage,
    Message,
    NANOSECONDS,
    WrenchMessage,
)
from dlo_calibration.messages.wrenches import axes, EMPTY
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats, MINIMUM_SPACING
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.episodes import Episode

SAME_OFFSET = 1e-3  # of a segment
BEFORE = NANOSECONDS // 100  # time between the two initial chains that give a velocity


def trial_messages(trials: Sequence[Trial], frame_id: str) -> list[InputMessage]:
    """
    Return messages from which a `TrialCollector` makes the same trials, to a nanosecond.

    A hand that keeps holding the DLO during a later action takes part in it, at rest.
    Forces are those of hands that do not turn, at goals 0.05 s apart.
    Three cases cannot be sent, and are lost: two hands that grip one point of a chain; a hand
    that closes far from its point in the latest chain, if other hands act alone between that
    chain and its action; and a hand that holds the DLO in a goal, but still moved when
    another hand's last action began.
    """
    messages: list[InputMessage] = []
    zero = 1_700_000_000 * NANOSECONDS  # a time in 2023, as real stamps are
    for trial in trials:
        messages += _messages(trial, frame_id, zero)
        end = max([goal.time for goal in trial.goals] + [hand.end for hand in trial.hands])
        zero += round(end * NANOSECONDS) + 10 * NANOSECONDS
    return messages


def episode_messages(cut: Sequence[Episode], frame_id: str, zero: int) -> list[Message]:
    """
    Return messages from which a `TrialCollector` makes the trials of episodes of a film.

    :param zero: stamp of the film's time 0 [ns], > 0.
    """
    def at(time: float) -> int:
        return zero + round(time * NANOSECONDS)

    messages: list[Message] = []
    for episode in cut:
        start = min(hand.start for hand in episode.hands)
        messages.append(ChainMessage(INITIAL, at(start) - BEFORE, frame_id, episode.initial))
        messages.append(action_message(episode.hands, at(start), frame_id))
        messages += [ChainMessage(GOAL, at(time), frame_id, Chain(points)) for time, points in episode.goals]
    return messages


def _messages(trial: Trial, frame_id: str, zero: int) -> list[InputMessage]:
    def at(time: float) -> int:
        return zero + round(time * NANOSECONDS)

    groups, initial = _numbered(trial, _groups(trial))
    messages: list[InputMessage] = []
    if trial.velocity is None:
        messages.append(ChainMessage(INITIAL, zero - BEFORE, frame_id, initial))
    else:
        earlier = replace(initial, points=initial.points - trial.velocity * (BEFORE / NANOSECONDS))
        messages += [ChainMessage(INITIAL, zero - BEFORE, frame_id, earlier),
                     ChainMessage(INITIAL, zero, frame_id, initial)]
    for hands in groups:
        messages.append(action_message(hands, at(min(hand.start for hand in hands)), frame_id))
    for goal in trial.goals:
        messages.append(ChainMessage(GOAL, at(goal.time), frame_id, _annotated_goal(trial, goal, groups)))
    closed = {hand.name: hand for hand in reversed(trial.hands)}
    for name in {hand.name for _, hand, force in trial.forces if force.tared}:
        messages.append(WrenchMessage(at(closed[name].start + sum(EMPTY) / 2), name, np.zeros(3)))
    for k, hand, force in trial.forces:
        time = trial.goals[k].time
        messages.append(WrenchMessage(at(time), hand.name, force.vector @ axes(hand, time)))
    return sorted(messages, key=lambda message: message.key)


def action_message(hands: Sequence[Hand], stamp: int, frame_id: str) -> ActionMessage:
    """
    Return the message of hands that act together, with waypoints at the times of all of them.

    :param stamp: when the first hand closes [ns].
    """
    times = np.unique(np.concatenate([hand.times for hand in hands]))
    poses = [_poses(hand, times) for hand in hands]
    return ActionMessage(stamp, frame_id, tuple(hand.name for hand in hands), times - times[0],
                         np.stack([positions for positions, _ in poses], axis=1),
                         np.stack([turns for _, turns in poses], axis=1))


def _groups(trial: Trial) -> list[tuple[Hand, ...]]:
    """Return groups of hands that close and open together, in the order of their closing."""
    groups: dict[tuple[int, float, float], list[Hand]] = {}
    for k, action in enumerate(trial.actions):
        for hand in action.hands:
            groups.setdefault((k, hand.start, hand.end), []).append(hand)
    complete: list[tuple[Hand, ...]] = []
    for (_, start, end), hands in sorted(groups.items(), key=lambda item: item[0][1]):
        names = {hand.name for hand in hands}
        after = [goal for goal in trial.goals if goal.time > end]
        holding = trial.holding(after[0]) if after else ()
        complete.append((*hands, *(_at_rest(hand, start, end) for hand in holding
                                   if hand.end <= start and hand.name not in names)))
    return complete


def _numbered(trial: Trial, groups: list[tuple[Hand, ...]]) -> tuple[list[tuple[Hand, ...]], Chain]:
    """
    Return the groups, with their hands in the order to send, and the initial chain with numbers of hands.

    The numbers are those of the first group if they give the grips of all groups before the first goal.
    Else, only grips that a hand's place does not give get a number.
    """
    initial, first_goal = trial.initial, min(goal.time for goal in trial.goals)
    early = [hands for hands in groups if hands[0].start <= first_goal]
    annotated = _annotated(initial, groups[0], [
        hand.name for hand in groups[0]
        if not (hand.offset or hand.nearest) or not _grips_nearest(initial, hand)])
    if all(_give_grips(annotated, hands) for hands in early):
        return groups, annotated
    needed = Counter(hand.grips for hands in early for hand in hands if not _grips_nearest(initial, hand))
    numbers = np.zeros(len(initial), np.uint8)
    order = [grips for grips, _ in needed.most_common()]
    for k, grips in enumerate(order, start=1):
        numbers[list(grips)] = k
    renumbered = replace(initial, hands=numbers)
    place = {grips: k for k, grips in enumerate(order)}
    ordered = [tuple(sorted(hands, key=lambda hand: place.get(hand.grips, len(place)))) for hands in early]
    if all(_give_grips(renumbered, hands) for hands in ordered):
        return [*ordered, *groups[len(early):]], renumbered
    return groups, annotated


def _give_grips(chain: Chain, hands: Sequence[Hand]) -> bool:
    """Return whether an annotated chain and the places of the hands give their grips."""
    for k, hand in enumerate(hands, start=1):
        held = np.flatnonzero(chain.hands == k)
        if (tuple(held.tolist()) != tuple(sorted(hand.grips)) or hand.offset) if len(held) else \
                not _grips_nearest(chain, hand):
            return False
    return True


def _grips_nearest(chain: Chain, hand: Hand) -> bool:
    """Return whether a hand grips only the place of a chain at which it closes."""
    point, offset, distance = chain.nearest(hand.positions[0])
    return hand.grips == (point,) and abs(hand.offset - offset) < SAME_OFFSET and distance <= (
        Options().grip_tolerance if hand.offset or hand.nearest else MINIMUM_SPACING)


def _at_rest(hand: Hand, start: float, end: float) -> Hand:
    """Return the path of a hand that stays at the last pose of `hand`."""
    times = [start, end] if end > start else [start]
    return Hand(hand.name, hand.grips, np.array(times), np.repeat(hand.positions[-1:], len(times), axis=0),
                np.repeat(hand.orientations[-1:], len(times), axis=0), hand.offset, hand.nearest)


def _annotated_goal(trial: Trial, goal: Goal, groups: Sequence[tuple[Hand, ...]]) -> Chain:
    latest = [hands for hands in groups if hands[0].start <= goal.time]
    return _annotated(goal.chain, latest[-1] if latest else (), [hand.name for hand in trial.holding(goal)])


def _annotated(chain: Chain, hands: Sequence[Hand], holding: Sequence[str]) -> Chain:
    """Return the chain with the number of the holding hand at each gripped point."""
    numbers = np.zeros(len(chain), np.uint8)
    for k, hand in enumerate(hands, start=1):
        if hand.name in holding:
            numbers[list(hand.grips)] = k
    return replace(chain, hands=numbers)


def _poses(hand: Hand, times: Floats) -> tuple[Floats, Floats]:
    """Return (k, 3) positions [m] and (k, 4) quaternions of a hand at (k,) times [s]."""
    if len(hand.times) == len(times):
        return hand.positions, hand.orientations
    if (hand.orientations == hand.orientations[0]).all():
        return hand.positions_at(times), np.repeat(hand.orientations[:1], len(times), axis=0)
    from scipy.spatial.transform import Rotation, Slerp  # slow to load

    turns = Rotation.from_quat(hand.orientations)
    at = np.clip(times, hand.start, hand.end)  # a hand rests before and after its path
    return hand.positions_at(times), np.asarray(Slerp(hand.times, turns)(at).as_quat())
