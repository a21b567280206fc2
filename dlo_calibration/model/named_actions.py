# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Named actions: short descriptions of manipulations, from which the paths of the hands follow.

A message always carries the paths themselves.  A named action computes them from the
chain before it: each hand closes at the point that it grips, and moves at constant
speed.  With `hold` it keeps holding the DLO afterwards.

The position of a hand [m] is that of the point that it grips.  This point is given
as an index of the chain (negative: from its end), or as a fraction of the length,
which may lie between two points of the chain.  A target is given as coordinates,
or as a direction (of any length) and a distance.

The docstring of each action tells how much it shows of each of the paper's four parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import InputError, meant, one_of
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats

Numbers = tuple[float, ...]

UP = np.array([0.0, 0.0, 1.0])
MOST = 1e6  # m, m/s, s: limit of distances, speeds and times, far beyond those of any robot
#: Which of two hands moves -> the share of the distance that each of them covers.
MOVING = {'both': (0.5, 0.5), 'first': (1.0, 0.0), 'second': (0.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class NamedAction:
    """
    The fields and checks that all named actions share.

    :param start: when the hands close, seconds since the start of the trial.
    :param hold: True: the hands hold the DLO afterwards; False: they open at the end of their path.
    """

    start: float = 0.0
    hold: bool = False

    may_be_flat: ClassVar[bool] = False  # a height of 0 means no lift

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, list):
                object.__setattr__(self, one.name, tuple(value))
            elif isinstance(value, (int, np.integer, np.floating)) and one.type == 'float':
                object.__setattr__(self, one.name, float(value))
        if not 0 <= self.start <= MOST:
            raise self._refused(f'start {self.start:g} s', f'0 to {MOST:g} s')
        for name in ('speed', 'height', 'distance'):
            value = getattr(self, name, None)
            if value is not None and not 1e-9 <= value <= MOST and not (
                    name == 'height' and value == 0 and self.may_be_flat):
                raise self._refused(f'{name} {value:g}', f'a {name} above 0, at most {MOST:g}')

    @property
    def name(self) -> str:
        """Its name in NAMED_ACTIONS."""
        return next(name for name, kind in NAMED_ACTIONS.items() if kind is type(self))

    @property
    def hand_names(self) -> tuple[str, ...]:
        """Names of the hands that it uses."""
        hands: tuple[str, ...] = vars(self)['hands'] if 'hands' in vars(self) else (vars(self)['hand'],)
        return hands

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """
        Return the paths of the hands.

        :param chain: the DLO when the hands close.
        :param before: earlier actions of the trial, in order; only `Release` needs them.
        :raises InputError: where the action is impossible with this chain.
        """
        raise NotImplementedError

    def _refused(self, came: str, expected: str, remedy: str = 'correct the action') -> InputError:
        return InputError(f'action {self.name}', came, expected, remedy)

    def _require_one(self, one: str, other: str, remedy: str) -> None:
        """Raise an error unless exactly one of two fields is given."""
        values = getattr(self, one), getattr(self, other)
        if (values[0] is None) == (values[1] is None):
            raise self._refused(f'{one} {values[0]}, {other} {values[1]}', 'one of the two', remedy)

    def _grip(self, chain: Chain, point: int | None, fraction: float | None) -> tuple[int, float]:
        """Return the gripped point, from 0, and the offset from it; given by an index or by a fraction."""
        if point is not None:
            count = len(chain)
            if not -count <= point < count:
                raise self._refused(f'point {point}', f'{-count} to {count - 1}', 'name a point of the chain')
            return int(point) % count, 0.0
        if fraction is None or not 0 <= fraction <= 1:
            raise self._refused(f'fraction {fraction:g}', '0 to 1', 'give a fraction of the length')
        return chain.grip(fraction * chain.length)


@dataclass(frozen=True, kw_only=True)
class _OneHand(NamedAction):
    """
    One hand grips one point.

    :param point: index of the gripped point; or
    :param fraction: of the length, 0 to 1, where it grips.
    :param speed: of the hand [m/s].
    """

    point: int | None = None
    fraction: float | None = None
    speed: float = 0.1
    hand: str = 'left_hand'

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_one('point', 'fraction', 'say where the hand grips')

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the path of the hand at constant speed, without repeated waypoints."""
        grip, offset = self._grip(chain, self.point, self.fraction)
        way = [chain.gripped([grip], offset)[0]]
        for point in self._way(way[0]):
            if np.linalg.norm(point - way[-1]) > 1e-9 * self.speed:  # in 1 ns, times may round to one float
                way.append(point)
        durations = np.linalg.norm(np.diff(way, axis=0), axis=1) / self.speed
        times = self.start + np.concatenate([[0.0], np.cumsum(durations)])
        return Action((Hand(self.hand, (grip,), times, np.array(way), offset=offset),))

    def _way(self, point: Floats) -> Sequence[Floats]:
        """Return the waypoints, (3,) [m] each, that follow the gripped point."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class _Carrying(_OneHand):
    """
    A hand carries its point to a target.

    :param to: coordinates x y z [m]; or
    :param direction: x y z, of any length, and
    :param distance: in this direction [m].
    """

    to: Numbers | None = None
    direction: Numbers | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.to is None) == (self.direction is None) or (self.direction is None) != (
                self.distance is None):
            raise self._refused(f'to {self.to}, direction {self.direction}, distance {self.distance}',
                                'coordinates, or a direction and a distance', 'say where the hand goes')
        for name in ('to', 'direction'):
            if (value := getattr(self, name)) is not None:
                numbers = np.asarray(value, dtype=float)
                if numbers.shape != (3,) or not (np.abs(numbers) <= MOST).all():
                    raise self._refused(f'{name} {value!r}', f'three numbers x y z of at most {MOST:g}')
                object.__setattr__(self, name, tuple(numbers.tolist()))
        if self.direction is not None and not any(self.direction):
            raise self._refused('direction 0 0 0', 'a direction', 'say where the hand goes')

    def _target(self, point: Floats) -> Floats:
        if self.to is not None:
            return np.array(self.to)
        # Divide by the largest component first: squares of huge or tiny numbers overflow or vanish.
        direction = np.array(self.direction) / np.abs(self.direction).max()  # type: ignore[arg-type]
        target: Floats = point + direction / np.linalg.norm(direction) * self.distance
        return target


@dataclass(frozen=True, kw_only=True)
class GraspAndPlace(_Carrying):
    """
    Lift a point, carry it through the air, put it down and open.

    The hand rises to `height` above the higher one of the two places, moves across, and down to the target.

    flexibility: some, together with friction: near the placed point, those bends stay that friction can hold
        against the bending stiffness.
    elasticity: nothing: only friction pulls at the other end.
    friction: some, together with flexibility: how much of the DLO follows.
    self_collision: nothing, unless the point is placed on or across the DLO (folding it); then much.

    :param height: of the lift [m].
    """

    height: float = 0.05

    def _way(self, point: Floats) -> Sequence[Floats]:
        target = self._target(point)
        top = max(point[2], target[2]) + self.height
        return [np.append(point[:2], top), np.append(target[:2], top), target]


@dataclass(frozen=True, kw_only=True)
class Drag(_Carrying):
    """
    Pull a point straight to a target, along the table, and open.

    flexibility: much, together with friction: how wide the bend beside the point is. Almost nothing where
        an end is dragged along the DLO.
    elasticity: nothing: friction alone is too weak to stretch a DLO visibly.
    friction: much, together with flexibility: how much of the DLO follows, and where it stops. An end dragged
        along the DLO shows some of friction alone. With fast hands, inertia matters too.
    self_collision: nothing, unless the DLO is dragged against itself.
    """

    def _way(self, point: Floats) -> Sequence[Floats]:
        return [self._target(point)]


@dataclass(frozen=True, kw_only=True)
class LiftAndHold(_OneHand):
    """
    Lift a point straight up and hold it there.

    flexibility: much, and almost separately from the others, so begin with this action: how the free part
        bends under its weight. Without a known mass, only the ratio of stiffness and weight. Where a limp DLO
        hangs straight down, only that it is limp.
    elasticity: nothing, unless the DLO stretches visibly under its weight.
    friction: some: how far the part on the table was pulled in. Nothing where all of it hangs.
    self_collision: nothing, unless two hanging parts touch.

    :param height: of the lift [m].
    """

    height: float = 0.1
    hold: bool = True

    def _way(self, point: Floats) -> Sequence[Floats]:
        return [point + self.height * UP]


@dataclass(frozen=True, kw_only=True)
class PushDown(_OneHand):
    """
    Push a raised point straight down and hold it there.

    This needs a DLO that another hand holds up, or that bridges a gap: a point on the
    table cannot be pushed down.

    flexibility: much: the shape between the pushed point and the support of the DLO.
    elasticity: some, where the DLO is held on both sides of the point and pushed beyond straight; otherwise
        nothing.
    friction: some: how far the part on the table is pushed out or pulled in.
    self_collision: nothing, unless the point is pushed onto the DLO.

    :param distance: by which the hand moves down [m].
    """

    distance: float = 0.05
    hold: bool = True

    def _way(self, point: Floats) -> Sequence[Floats]:
        return [point - self.distance * UP]


@dataclass(frozen=True, kw_only=True)
class TwoHands(NamedAction):
    """
    Grip two points, lift both, move them apart or together, and hold them there.

    The hands move along the line through both points.

    flexibility: together on the table: some, how the DLO buckles. In the air: little, unless the DLO is
        stiff: the sag between two hands hardly depends on a low stiffness. Apart: the straighter the DLO
        gets, the less.
    elasticity: apart: this is the only action that shows it, if the hands stretch the DLO by more than the
        noise of the points. Otherwise nothing.
    friction: on the table, together: some. In the air, or apart: nothing.
    self_collision: together, until parts touch: some. Otherwise nothing.

    :param points: indices of the two gripped points; or
    :param fractions: of the length, 0 to 1, where the hands grip.
    :param motion: `apart` or `together`.
    :param distance: by which the distance between the hands changes [m].
    :param moving: `both` hands by half of it, or the `first` or `second` hand alone.
    :param height: by which both hands rise before that [m]; 0: they stay on the table.
    :param speed: of each moving hand [m/s].
    :param hands: their two names.
    """

    points: tuple[int, ...] | None = None
    fractions: Numbers | None = None
    motion: str = 'together'
    distance: float = 0.1
    moving: str = 'both'
    height: float = 0.0
    speed: float = 0.1
    hands: tuple[str, ...] = ('left_hand', 'right_hand')
    hold: bool = True

    may_be_flat: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_one('points', 'fractions', 'say where the hands grip')
        for name, values in (('points or fractions', self.points or self.fractions or ()),
                             ('hands', self.hands)):
            if len(values) != 2:
                raise self._refused(f'{len(values)} {name}', '2', 'give one for each hand')
        if self.fractions is not None:
            object.__setattr__(self, 'fractions', tuple(float(one) for one in self.fractions))
        if self.motion not in ('apart', 'together'):
            raise self._refused(f'motion {self.motion!r}', 'apart or together',
                                meant(self.motion, ('apart', 'together'), 'correct the action'))
        if self.moving not in MOVING:
            raise self._refused(f'moving {self.moving!r}', one_of(MOVING, self.moving),
                                meant(self.moving, MOVING, 'correct the action'))

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the paths of both hands, whose waypoints have the same times."""
        grips = [self._grip(chain, point, fraction) for point, fraction in zip(
            self.points or (None, None), self.fractions or (None, None), strict=True)]
        if grips[0] == grips[1]:
            raise self._refused(f'both hands at point {grips[0][0]}', 'two different points',
                                'grip further apart')
        begin = np.concatenate([chain.gripped([grip], offset) for grip, offset in grips])
        between = begin[1] - begin[0]
        gap = float(np.linalg.norm(between))
        if self.motion == 'together' and self.distance > gap:
            raise self._refused(f'{self.distance:g} m together of hands {gap:.4g} m apart',
                                'at most the distance between them', 'choose a smaller distance')
        if gap == 0:
            raise self._refused('two points at the same place', 'two places', 'grip elsewhere')
        shares = MOVING[self.moving]
        step = between / gap * (self.distance if self.motion == 'together' else -self.distance)
        up = begin + self.height * UP
        end = up + np.array([shares[0] * step, -shares[1] * step])
        way, times = [begin], [self.start]
        for target, length in ((up, self.height), (end, max(shares) * self.distance)):
            if length > 0:
                way.append(target)
                times.append(times[-1] + length / self.speed)
        return Action(tuple(Hand(name, (grips[k][0],), np.array(times), np.array([one[k] for one in way]),
                                 offset=grips[k][1]) for k, name in enumerate(self.hands)))


@dataclass(frozen=True, kw_only=True)
class Release(NamedAction):
    """
    Open hands that still hold the DLO after an earlier action, where they are.

    flexibility: much, after a lift: the bends that remain when the DLO has fallen. Timed goals also show
        damping, during the fall.
    elasticity: nothing, unless the DLO was stretched before and timed goals show how it springs back.
    friction: some: the bends that the table keeps. It shows most where a DLO that was bent on the table
        springs back.
    self_collision: some where the DLO falls onto itself; otherwise nothing.

    :param hands: names of the hands that open.
    """

    hands: tuple[str, ...] = ('left_hand',)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold:
            raise self._refused('hold', 'hands that open', 'leave hold out')

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return one waypoint for each hand, at its last position, with the same gripped points."""
        last = {hand.name: hand for action in before for hand in action.hands}
        opened = []
        for name in self.hands:
            if name not in last:
                raise self._refused(f'hand {name!r}, which holds nothing',
                                    'a hand of an earlier action', 'name a hand that holds the DLO')
            hand = last[name]
            if hand.end > self.start:
                raise self._refused(f'start {self.start:g} s, while hand {name!r} moves',
                                    f'{hand.end:g} s or later', 'let the hand arrive first')
            opened.append(Hand(name, hand.grips, np.array([self.start]), hand.positions[-1:],
                               hand.orientations[-1:], hand.offset))
        return Action(tuple(opened))


#: Name of the element in a request -> class.
NAMED_ACTIONS: Mapping[str, type[NamedAction]] = {
    'grasp_and_place': GraspAndPlace,
    'drag': Drag,
    'lift_and_hold': LiftAndHold,
    'push_down': PushDown,
    'two_hands': TwoHands,
    'release': Release,
}
