# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Manipulation: a DLO at rest, and the actions to do with it in turn; unlike a trial, without goal chains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterable, Sequence, Union

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, check_ends, Floats, frozen_array
from dlo_calibration.model.named_actions import NamedAction

PATHS = 'hand_paths'  # name of explicit paths
MOST_STEPS = 200  # of a manipulation; each named action simulates all actions before it again


@dataclass(frozen=True)
class Together:
    """
    Actions of different hands that overlap in time.

    :param actions: one or more; their starts count from one clock.
    :param held_by: names of the hands that hold the DLO afterwards.
    """

    actions: tuple[Union[NamedAction, Action], ...]
    held_by: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the action, or of all of them; explicit paths of hands are called `hand_paths`."""
        return ' and '.join(dict.fromkeys(
            one.name if isinstance(one, NamedAction) else PATHS for one in self.actions))


@dataclass(frozen=True)
class Manipulation:
    """
    A DLO at rest, and the actions to do with it in turn.

    :param start: the DLO before the first action.
    :param steps: one or more, at most MOST_STEPS; each begins when the DLO rests after the one before.
    :param remarks: sentences for the user: what differs from what was asked for or recorded.
    """

    name: str
    start: Chain
    steps: tuple[Together, ...]
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        thing = f'trial {self.name!r}'
        if not self.steps:
            raise InputError(thing, 'no action', 'at least one', 'say what the hands do')
        if len(self.steps) > MOST_STEPS:
            raise InputError(thing, f'{len(self.steps)} actions in turn', f'at most {MOST_STEPS}',
                             'divide it into several trials')
        check_ends(thing, self.start)
        for hand in (hand for step in self.steps for action in step.actions
                     if isinstance(action, Action) for hand in action.hands):
            if not all(0 <= grip < len(self.start) for grip in hand.grips):
                raise InputError(thing, f'hand {hand.name!r} gripping points {hand.grips}',
                                 f'points 0 to {len(self.start) - 1}', 'correct the gripped points')


@dataclass(frozen=True)
class Timed:
    """
    An action with its time.

    :param end: when the last hand arrives [s].
    :param hold: whether its hands hold the DLO afterwards, unless an observation tells.
    """

    action: Union[NamedAction, Action]
    end: float
    hold: bool

    @property
    def names(self) -> frozenset[str]:
        """Names of its hands."""
        if isinstance(self.action, NamedAction):
            return frozenset(self.action.hand_names)
        return frozenset(hand.name for hand in self.action.hands)


def in_steps(name: str, start: Chain, actions: Iterable[Timed],
             told: Sequence[tuple[float, Sequence[str] | None]] = ()) -> Manipulation:
    """
    Return the manipulation with actions of one clock.

    Actions of different hands that overlap in time are one step.

    :param told: times [s] of observations in order, and the names of the hands that hold the DLO then;
        None: those that still hold it after their actions.
    """
    groups: list[list[Timed]] = []
    remarks = []
    for one in sorted(actions, key=lambda timed: timed.action.start):
        group = groups[-1] if groups else []
        if not group or one.action.start >= max(other.end for other in group):
            groups.append([one])
            continue
        twice = frozenset().union(*(other.names for other in group)) & one.names
        if not twice:
            group.append(one)
            continue
        groups.append([one])
        if one.action.start > group[0].action.start:
            remarks.append(f'trial {name!r}: {", ".join(sorted(twice))} acts again at '
                           f'{one.action.start:g} s, while another hand moves; it is simulated afterwards')
    held: dict[str, None] = {}  # in the order in which they closed
    steps = []
    for k, group in enumerate(groups):
        acting = {hand: one.hold for one in group for hand in sorted(one.names)}
        held = {hand: None for hand in (*held, *acting) if acting.get(hand, True)}
        until = groups[k + 1][0].action.start if k + 1 < len(groups) else np.inf
        seen = [hands for time, hands in told if max(one.end for one in group) < time <= until]
        if seen and seen[-1] is not None:
            held = dict.fromkeys(seen[-1])
        steps.append(Together(tuple(one.action for one in group), tuple(held)))
    return Manipulation(name, start, tuple(steps), tuple(remarks))


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedPaths(NamedAction):
    """
    Explicit paths of hands; where a hand grips can depend on the chain before.

    :param hands: their h names.
    :param grips: for each hand, the points that it grips; empty: the place nearest to where it closes.
    :param times: (k,) [s] since `start`, increasing.
    :param positions: (k, h, 3) [m].
    :param orientations: (k, h, 4) quaternions x y z w.
    :param tolerance: largest distance of a hand that closes from the nearest place [m].
    """

    hands: tuple[str, ...]
    grips: tuple[tuple[int, ...], ...]
    times: Floats
    positions: Floats
    orientations: Floats
    tolerance: float

    def __post_init__(self) -> None:
        super().__post_init__()
        for one in ('times', 'positions', 'orientations'):
            object.__setattr__(self, one, frozen_array(getattr(self, one)))

    @property
    def name(self) -> str:
        """The name of explicit paths."""
        return PATHS

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the paths, whose hands grip points of this chain."""
        found = []
        for k, (name, grips) in enumerate(zip(self.hands, self.grips, strict=True)):
            offset = 0.0
            if not grips:
                point, offset, distance = chain.nearest(self.positions[0, k])
                grips = (point,)
                if distance > self.tolerance:
                    raise self._refused(
                        f'{name} closing {distance:.4g} m from any point of the predicted chain',
                        f'at most {self.tolerance:g} m (grip_tolerance)',
                        'check the first waypoint, or record the chain before this action')
            found.append(Hand(name, grips, self.start + self.times, self.positions[:, k],
                              self.orientations[:, k], offset))
        return Action(tuple(found))
