# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trial: one observed manipulation of a DLO."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
import math
from typing import Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, check_grips, Hand, MAXIMUM_TIME
from dlo_calibration.model.chain import Chain, check_ends, Floats, frozen_array

VIEWS = 25  # largest number of goals that estimate the places of unseen points of an initial chain


LARGEST_FORCE = 1e6  # N; larger ones are errors


@dataclass(frozen=True, eq=False)
class Force:
    """
    A measured force that the DLO exerts on a hand; that of a rope hanging from the hand points down.

    :param hand: its name.
    :param vector: (3,) [N] in the frame of the chains.
    :param tared: whether it is 0 where the hand holds nothing. If not, the sensor has an unknown offset, the
        same in the whole trial, and only differences between goals count.
    """

    hand: str
    vector: Floats
    tared: bool = True

    def __post_init__(self) -> None:
        vector = frozen_array(self.vector)
        if vector.shape != (3,) or not (np.abs(vector) <= LARGEST_FORCE).all():  # neither is NaN
            raise InputError(f'force on hand {self.hand!r}', ' '.join(f'{x:g}' for x in vector.ravel()[:4]),
                             f'three finite numbers up to {LARGEST_FORCE:g} N', 'give x, y and z in N')
        object.__setattr__(self, 'vector', vector)


@dataclass(frozen=True)
class Goal:
    """
    The DLO as it was observed during or after an action.

    :param chain: its point i is the same material point as point i of the initial chain.
    :param time: seconds since the start of the trial.
    :param stable: True: the simulated DLO is compared when it has come to rest
        after `time`; False: it is compared at that instant.
    :param held_by: names of the hands that still hold the DLO in this goal.
    :param count: number of chains of which `chain` is the mean: its noise is that much lower.
    :param forces: measured on hands that hold the DLO then, at most one for each.
    """

    chain: Chain
    time: float
    stable: bool = True
    held_by: tuple[str, ...] = ()
    count: int = 1
    forces: tuple[Force, ...] = ()

    def __post_init__(self) -> None:
        if not abs(self.time) <= MAXIMUM_TIME:
            raise InputError('goal chain', f'a time of {self.time:g} s', f'at most {MAXIMUM_TIME:g} s',
                             'count seconds from the start of the trial')


@dataclass(frozen=True)
class Trial:
    """
    One observed manipulation: the DLO before it, the actions of the hands, and the observed goals.

    :param initial: the DLO before the action; point i is the same material point in all chains. The arc
        lengths of its unseen points come from the goals that show them.
    :param actions: one or more, in the order of their start.
    :param goals: one or more, in the order of their time.
    :param velocity: (n, 3) [m/s] of the initial points; None: the DLO is at rest.
    :param places: (n,) [m] arc lengths of the points at rest, from 0; None: those of the initial chain.
    :param session: number of the session, from 1; sessions may have parameters of their own.
    :param loads: whether a simulation shall measure the loads of the DLO on its way, which takes time.
    :param force_scale: in x, y and z, how far a point must be off to count as much as a force that is off by
        1 N [m/N]; a calibration estimates it.
    """

    name: str
    initial: Chain
    actions: tuple[Action, ...]
    goals: tuple[Goal, ...]
    velocity: Floats | None = None
    places: Floats | None = None
    loads: bool = False
    session: int = 1
    force_scale: tuple[float, float, float] = (0.05, 0.05, 0.05)

    def __post_init__(self) -> None:
        thing = f'trial {self.name!r}'
        actions = tuple(sorted(self.actions, key=lambda action: action.start))
        goals = tuple(sorted(self.goals, key=lambda goal: goal.time))
        n = len(self.initial)
        if not actions:
            raise InputError(thing, 'no action', 'at least one', 'say what the hands did')
        if not goals:
            raise InputError(thing, 'no goal chain', 'at least one', 'observe the DLO after the action')
        for goal in goals:
            if len(goal.chain) != n:
                raise InputError(
                    thing, f'a goal of {len(goal.chain)} points', f'{n} points as in the initial chain',
                    'resample both chains to the same material points')
        hands = [hand for action in actions for hand in action.hands]
        stable = [*(goal.time for goal in goals if goal.stable), math.inf]
        for hand in hands:
            time = stable[bisect_right(stable, hand.start)]
            if time < hand.end:
                raise InputError(thing, f'a stable goal at {time:g} s, while hand {hand.name!r} moves',
                                 'a goal after its last waypoint', 'make it a timed goal')
        check_grips(thing, hands, n)
        check_ends(thing, self.initial)
        for k, goal in enumerate(goals):
            names = [force.hand for force in goal.forces]
            holding = [hand.name for hand in self.holding(goal)] if names else []
            for name in names:
                if name not in holding or names.count(name) > 1:
                    raise InputError(
                        thing, f'a force on {name!r} in goal {k + 1}' + ' twice' * (names.count(name) > 1),
                        f'one for each hand that holds the DLO then ({", ".join(holding) or "none"})',
                        'correct the name of the hand, or leave the force out')
        object.__setattr__(self, 'actions', actions)
        object.__setattr__(self, 'goals', goals)
        if not self.initial.seen.all():
            # From what was seen alone, so that a copy of this trial has the same points, digit for digit.
            initial = replace(self.initial, points=self.initial.observed)
            places, held = _shown_places(initial, goals), self._held_places()
            initial = initial.interpolated(places, held)
            if not np.array_equal(initial.points, self.initial.points):
                object.__setattr__(self, 'initial', initial)
        if self.velocity is not None:
            velocity = frozen_array(self.velocity)
            if velocity.shape != (n, 3) or not np.isfinite(velocity).all():
                raise InputError(thing, f'a velocity of shape {velocity.shape}',
                                 f'({n}, 3) finite numbers in m/s', 'give one vector per point')
            object.__setattr__(self, 'velocity', velocity)
        if self.places is not None:
            places = frozen_array(self.places)
            if places.shape != (n,) or not np.isfinite(places).all() or places[0] != 0 \
                    or not (np.diff(places) > 0).all():
                raise InputError(thing, f'arc lengths {places}', f'{n} increasing numbers from 0, in m',
                                 'give one for each point')
            object.__setattr__(self, 'places', places)

    @cached_property
    def hands(self) -> tuple[Hand, ...]:
        """All hands of all actions, in the order of their start."""
        return tuple(sorted((hand for action in self.actions for hand in action.hands),
                            key=lambda hand: hand.start))

    @cached_property
    def forces(self) -> tuple[tuple[int, Hand, Force], ...]:
        """The measured forces, goal by goal: index of the goal, the hand, and the force on it."""
        return tuple((k, hand, force) for k, goal in enumerate(self.goals) for force in goal.forces
                     for hand in self.holding(goal) if hand.name == force.hand)

    @property
    def clamped(self) -> tuple[int, ...]:
        """The segments inside clamps that hold from the start, each by the index of its first point."""
        grips = [sorted(hand.grips) for hand in self.hands if hand.times[0] <= 0]
        return tuple(sorted({a for each in grips for a, b in zip(each[:-1], each[1:], strict=True)
                             if b == a + 1}))

    def with_shifted_hands(self, shift: Floats) -> Trial:
        """
        Return the trial with the hands where they really were, if they are off by `shift`, (3,) [m].

        A hand that grips the nearest place grips where the DLO is nearest to it then.
        """
        anew: dict[tuple[str, tuple[int, ...], float], tuple[tuple[int, ...], float]] = {}

        def shifted(hand: Hand) -> Hand:
            held = hand.name, hand.grips, hand.offset
            if hand.nearest and held not in anew:
                chain = [self.initial, *(goal.chain for goal in self.goals if goal.time < hand.start)][-1]
                point, place, _ = chain.nearest(hand.positions[0] - shift)
                anew[held] = (point,), place
            grips, offset = anew.get(held, held[1:])  # a hand that goes on from where it was grips the same
            return replace(hand, grips=grips, offset=offset, positions=hand.positions - shift)

        actions = tuple(Action(tuple(map(shifted, action.hands))) for action in self.actions)
        return replace(self, actions=actions)

    def with_late_hands(self, late: float) -> Trial:
        """
        Return the trial with the hands when they really moved, if their stamps are late.

        Stable goals still follow the hands, and a hand that holds the DLO from the start still does.

        :param late: [s]; negative: early, by less than the time from any stable goal to the next goal.
        """
        goals = self.goals
        if late > 0 and self.velocity is None:  # the hands have begun before the clock of the trial
            return replace(self, goals=tuple(replace(goal, time=goal.time + late) for goal in goals))
        gaps = [after.time - goal.time for goal, after in pairwise(goals) if goal.stable]
        late = max([late, *(-0.9 * gap for gap in gaps)])
        if late < 0:
            goals = tuple(replace(goal, time=goal.time - late) if goal.stable else goal for goal in goals)

        def moved(hand: Hand) -> Hand:
            times = hand.times - late
            if not hand.start <= 0 < times[0]:
                return replace(hand, times=times)
            rows = [0, *range(len(times))]
            return replace(hand, times=np.append(0.0, times), positions=hand.positions[rows],
                           orientations=hand.orientations[rows])

        actions = tuple(Action(tuple(map(moved, action.hands))) for action in self.actions)
        return replace(self, actions=actions, goals=goals)

    def _held_places(self) -> dict[int, Floats]:
        """
        Return the initial positions of gripped points that the initial chain lacks, (3,) [m] by index.

        Goals show them while the hand holds them, at the same offset from the hand, unless it turns. At an
        end, extrapolation of the curve would be wrong by a few mm, and the hand would move the whole DLO by
        this error.
        """
        places: dict[int, Floats] = {}
        for hand in self.hands:
            if hand.start > self.hands[0].start or hand.start > 0 and self.velocity is not None \
                    or hand.offset or (hand.orientations != hand.orientations[0]).any():
                continue
            held = [goal for goal in self.goals if any(hand is other for other in self.holding(goal))]
            for grip in hand.grips:
                offsets = [goal.chain.points[grip] - hand.positions_at(np.array([goal.time]))[0]
                         for goal in held if goal.chain.seen[grip]]
                if offsets and not self.initial.seen[grip]:
                    places[grip] = hand.positions[0] + np.mean(offsets, axis=0)
        return places

    def holding(self, goal: Goal) -> tuple[Hand, ...]:
        """Return the hands that hold the DLO when `goal` is observed, the last of each name."""
        last = {hand.name: hand for hand in self.hands if hand.start <= goal.time}
        return tuple(hand for hand in last.values() if self.holds(hand, goal))

    def holds(self, hand: Hand, goal: Goal) -> bool:
        """Return whether `hand`, or a later path of the same name, holds the DLO when `goal` is observed."""
        if goal.time <= hand.end:
            return goal.time >= hand.start
        return hand.name in goal.held_by


def _shown_places(initial: Chain, goals: Sequence[Goal]) -> Floats:
    """
    Return arc lengths, (n,) [m] from 0, of the points of an initial chain with unseen points.

    An unseen segment gets its mean length in the goals, or else the mean of all segments.
    """
    few = [goals[k].chain for k in np.linspace(0, len(goals) - 1, min(len(goals), VIEWS)).astype(int)]
    chains = [initial, *few]
    lengths = np.array([np.diff(chain.arc_lengths()) for chain in chains])
    shown = np.array([chain.seen[1:] & chain.seen[:-1] for chain in chains])
    shown[1:] &= ~shown[0]
    counts = shown.sum(axis=0)
    means = (lengths * shown).sum(axis=0) / np.maximum(counts, 1)
    usual = means[counts > 0].mean() if counts.any() else 1.0
    return np.concatenate([[0.0], np.cumsum(np.where(counts > 0, means, usual))])


def shown_goals(count: int) -> list[int]:
    """Return the indices of at most five of `count` goals to show, evenly spread, with the last."""
    return sorted({int(k) for k in np.linspace(count - 1, 0, min(count, 5)).round()})
