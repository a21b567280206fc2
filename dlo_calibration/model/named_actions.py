# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Named actions: what to do with a DLO, in words; each becomes what the hands do.

On the wire an action is always what the hands did.  A named action is the short
way to say it: given the chain before it, `action` returns the paths of the
hands.  A hand closes where the chain is, moves at constant speed, and `hold`
says whether it holds the DLO afterwards.  Where it does, goal chains are to say so.

Positions are those of the hand [m], which is the gripped point.  The point is
either an index of the chain (negative: from its end) or a fraction of the length,
of which the nearest point of the chain is taken.  A target is either coordinates,
or a direction (of any length) and a distance.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats

Numbers = tuple[float, ...]

UP = np.array([0.0, 0.0, 1.0])
APART, TOGETHER = 'apart', 'together'
MOVING = ('both', 'first', 'second')
NO_TIME = 1e-9  # s: what is nearer is not gone to, for after MOST seconds a float cannot tell less
LEAST, MOST = 1e-9, 1e6  # of what follows, and of a start: beyond, it is no hand of a robot
POSITIVE = ('speed', 'height', 'distance')


@dataclass(frozen=True, kw_only=True)
class NamedAction:
    """
    What all named actions have.

    :param start: when the hands close, seconds since the start of the trial.
    :param hold: the hands hold the DLO afterwards; else they open at the end of their path.
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
        for name in POSITIVE:
            value = getattr(self, name, None)
            if value is not None and not LEAST <= value <= MOST and not (
                    name == 'height' and value == 0 and self.may_be_flat):
                raise self._refused(f'{name} {value:g}', f'a {name} above 0, of at most {MOST:g}')

    @property
    def name(self) -> str:
        """Its name in NAMED_ACTIONS."""
        return next(name for name, kind in NAMED_ACTIONS.items() if kind is type(self))

    @property
    def hand_names(self) -> tuple[str, ...]:
        """Names of the hands that it uses."""
        raise NotImplementedError

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """
        Return what the hands do.

        :param chain: the DLO as it is when the hands close.
        :param before: earlier actions of the trial, in order; only `Release` asks for them.
        :raises InputError: where it cannot be done with this chain.
        """
        raise NotImplementedError

    def _refused(self, came: str, expected: str, remedy: str = 'correct the action') -> InputError:
        return InputError(f'action {self.name}', came, expected, remedy)

    def _path(self, name: str, grip: int, points: Sequence[Floats], speed: float) -> Hand:
        """Return a hand that goes through (3,) points [m] at a speed, leaving out those where it is."""
        way = [points[0]]
        for point in points[1:]:
            if np.linalg.norm(point - way[-1]) > NO_TIME * speed:
                way.append(point)
        steps = np.linalg.norm(np.diff(way, axis=0), axis=1) / speed
        return Hand(name, (grip,), self.start + np.concatenate([[0.0], np.cumsum(steps)]), np.array(way))


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
        if (self.point is None) == (self.fraction is None):
            raise self._refused(f'point {self.point}, fraction {self.fraction}', 'one of the two',
                                'say where the hand grips')

    @property
    def hand_names(self) -> tuple[str, ...]:
        """The one hand."""
        return (self.hand,)

    def _grip(self, chain: Chain) -> tuple[int, Floats]:
        if self.point is not None:
            grip = _by_index(self, chain, self.point)
        else:
            assert self.fraction is not None
            grip = _by_fraction(self, chain, self.fraction)
        return grip, chain.points[grip]


@dataclass(frozen=True, kw_only=True)
class _Carrying(_OneHand):
    """
    A hand carries its point to a target.

    :param to: coordinates x y z [m]; or
    :param direction: x y z, of any length, and
    :param distance: [m] in it.
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
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _triple(self, name, getattr(self, name)))
        if self.direction is not None and not any(self.direction):
            raise self._refused('direction 0 0 0', 'a direction', 'say where the hand goes')

    def _target(self, point: Floats) -> Floats:
        if self.to is not None:
            return np.array(self.to)
        assert self.direction is not None and self.distance is not None
        # The largest component first: the square of a tiny or a huge one would not be finite.
        direction = np.array(self.direction) / np.abs(self.direction).max()
        target: Floats = point + direction / np.linalg.norm(direction) * self.distance
        return target


@dataclass(frozen=True, kw_only=True)
class GraspAndPlace(_Carrying):
    """
    Lift a point, carry it through the air, put it down and open.

    The hand goes up by `height` above the higher one of the two places, across,
    and down to the target.

    What it can tell, and what it cannot:

    flexibility
        Some, together with friction: the bends that stay near the placed point are those which
        friction can hold against bending.
    elasticity
        Nothing: nothing pulls at the other end but friction.
    friction
        Some, together with flexibility: how much of the DLO follows.
    self_collision
        Nothing, unless the point is placed on or across the DLO (folding it); then much.

    :param height: of the lift [m].
    """

    height: float = 0.05

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the path up, across and down."""
        grip, point = self._grip(chain)
        target = self._target(point)
        top = max(point[2], target[2]) + self.height
        return Action((self._path(self.hand, grip, [point, _at_height(point, top), _at_height(target, top),
                                                    target], self.speed),))


@dataclass(frozen=True, kw_only=True)
class Drag(_Carrying):
    """
    Pull a point straight to a target, along the table, and open.

    What it can tell, and what it cannot:

    flexibility
        Much, together with friction: how wide the bend beside the point is.  Dragging an end
        along the DLO tells next to nothing.
    elasticity
        Nothing: friction alone is too weak to stretch a DLO visibly.
    friction
        Much, together with flexibility: how much of the DLO follows, and where it stops.  An end
        dragged along the DLO tells some of friction alone.  Fast hands add inertia to it.
    self_collision
        Nothing, unless the DLO is dragged against itself.
    """

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the straight path."""
        grip, point = self._grip(chain)
        return Action((self._path(self.hand, grip, [point, self._target(point)], self.speed),))


@dataclass(frozen=True, kw_only=True)
class LiftAndHold(_OneHand):
    """
    Lift a point straight up and hold it there.

    What it can tell, and what it cannot:

    flexibility
        Much, and little else, so that it is the action to begin with: how the free part bends
        under its weight.  Without a known mass, only the ratio of both.  Where a limp DLO hangs
        straight down, only that it is limp.
    elasticity
        Nothing, unless the DLO stretches visibly under its weight.
    friction
        Some: how far the part on the table was pulled in.  Nothing where all of it hangs.
    self_collision
        Nothing, unless two hanging parts touch.

    :param height: of the lift [m].
    """

    height: float = 0.1
    hold: bool = True

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the path up."""
        grip, point = self._grip(chain)
        return Action((self._path(self.hand, grip, [point, point + self.height * UP], self.speed),))


@dataclass(frozen=True, kw_only=True)
class PushDown(_OneHand):
    """
    Push a raised point straight down, and stay there.

    For a DLO that another hand holds up, or that bridges a gap.  A point that lies
    on the table cannot be pushed down.

    What it can tell, and what it cannot:

    flexibility
        Much: the shape between the pushed point and what holds the DLO up.
    elasticity
        Some, where both sides of the point are held and the DLO is pushed beyond
        straight; nothing else.
    friction
        Some: how far the part on the table is pushed out or pulled in.
    self_collision
        Nothing, unless the point is pushed onto the DLO.

    :param distance: that the hand moves down [m].
    """

    distance: float = 0.05
    hold: bool = True

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the path down."""
        grip, point = self._grip(chain)
        return Action((self._path(self.hand, grip, [point, point - self.distance * UP], self.speed),))


@dataclass(frozen=True, kw_only=True)
class TwoHands(NamedAction):
    """
    Grip two points, lift both, and move them apart or together; hold them there.

    Hands move on the line through both points.

    What it can tell, and what it cannot:

    flexibility
        Together on the table: some, how it buckles.  In the air: little, as a DLO that hangs from
        two points sags much the same whatever its stiffness, unless it is stiff.  Apart: the less,
        the straighter it gets.
    elasticity
        Apart, beyond the straight DLO: the only action that shows it, if the distance between
        the hands stretches the DLO by more than the error of observation.  Else nothing.
    friction
        On the table, together: some.  In the air, or apart: nothing.
    self_collision
        Together, until parts touch: some.  Else nothing.

    :param points: indices of the two gripped points; or
    :param fractions: of the length, 0 to 1, where the hands grip.
    :param motion: `apart` or `together`.
    :param distance: by which the distance between the hands changes [m].
    :param moving: `both` hands by half of it, or the `first` or `second` hand alone.
    :param height: of a lift of both hands before that [m]; 0: on the table.
    :param speed: of each hand that moves [m/s].
    :param hands: the two names.
    """

    points: tuple[int, ...] | None = None
    fractions: Numbers | None = None
    motion: str = TOGETHER
    distance: float = 0.1
    moving: str = 'both'
    height: float = 0.0
    speed: float = 0.1
    hands: tuple[str, ...] = ('left_hand', 'right_hand')
    hold: bool = True

    may_be_flat: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.points is None) == (self.fractions is None):
            raise self._refused(f'points {self.points}, fractions {self.fractions}', 'one of the two',
                                'say where the hands grip')
        for name, values in (('points or fractions', self.points or self.fractions or ()),
                             ('hands', self.hands)):
            if len(values) != 2:
                raise self._refused(f'{len(values)} {name}', '2', 'give one for each hand')
        if self.fractions is not None:
            object.__setattr__(self, 'fractions', tuple(float(one) for one in self.fractions))
        if self.motion not in (APART, TOGETHER):
            raise self._refused(f'motion {self.motion!r}', f'{APART} or {TOGETHER}')
        if self.moving not in MOVING:
            raise self._refused(f'moving {self.moving!r}', f'one of {", ".join(MOVING)}')

    @property
    def hand_names(self) -> tuple[str, ...]:
        """Both hands."""
        return self.hands

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the paths of both hands, with waypoints at the same times."""
        if self.points is not None:
            grips = [_by_index(self, chain, one) for one in self.points]
        else:
            grips = [_by_fraction(self, chain, one) for one in self.fractions or ()]
        if grips[0] == grips[1]:
            raise self._refused(f'both hands at point {grips[0]}', 'two different points',
                                'grip further apart')
        begin = chain.points[grips]
        between = begin[1] - begin[0]
        gap = float(np.linalg.norm(between))
        if self.motion == TOGETHER and self.distance > gap:
            raise self._refused(f'{self.distance:g} m together of hands {gap:.4g} m apart',
                                'less than their distance', 'choose a smaller distance')
        if gap == 0:
            raise self._refused('two points at the same place', 'two places', 'grip elsewhere')
        shares = {'both': (0.5, 0.5), 'first': (1.0, 0.0), 'second': (0.0, 1.0)}[self.moving]
        step = between / gap * (self.distance if self.motion == TOGETHER else -self.distance)
        up = begin + self.height * UP
        end = up + np.array([shares[0] * step, -shares[1] * step])
        way, times = [begin], [self.start]
        for target, length in ((up, self.height), (end, max(shares) * self.distance)):
            if length > 0:
                way.append(target)
                times.append(times[-1] + length / self.speed)
        return Action(tuple(Hand(name, (grips[k],), np.array(times), np.array([one[k] for one in way]))
                            for k, name in enumerate(self.hands)))


@dataclass(frozen=True, kw_only=True)
class Release(NamedAction):
    """
    Open hands that an earlier action left holding, where they are.

    What it can tell, and what it cannot:

    flexibility
        Much, after a lift: the bends that remain when it has fallen.  The motion itself tells
        damping, if timed goals show it.
    elasticity
        Nothing, unless it was stretched before and timed goals show how it springs back.
    friction
        Some: which bends the table keeps.  What was bent with the hands on the table, and
        springs back, tells the most.
    self_collision
        Some where it falls onto itself; nothing else.

    :param hands: names of the hands that open.
    """

    hands: tuple[str, ...] = ('left_hand',)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold:
            raise self._refused('hold', 'hands that open', 'leave hold out')

    @property
    def hand_names(self) -> tuple[str, ...]:
        """The hands that open."""
        return self.hands

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return one waypoint for each hand: where it came to rest, holding the same points."""
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
                               hand.orientations[-1:]))
        return Action(tuple(opened))


#: By the names of the elements in a request.
NAMED_ACTIONS: Mapping[str, type[NamedAction]] = {
    'grasp_and_place': GraspAndPlace,
    'drag': Drag,
    'lift_and_hold': LiftAndHold,
    'push_down': PushDown,
    'two_hands': TwoHands,
    'release': Release,
}


def _by_index(action: NamedAction, chain: Chain, index: int) -> int:
    count = len(chain)
    if not -count <= index < count:
        raise action._refused(f'point {index}', f'{-count} to {count - 1}', 'name a point of the chain')
    return int(index) % count


def _by_fraction(action: NamedAction, chain: Chain, fraction: float) -> int:
    if not 0 <= fraction <= 1:
        raise action._refused(f'fraction {fraction:g}', '0 to 1', 'give a fraction of the length')
    along = chain.arc_lengths()
    return int(np.abs(along - fraction * along[-1]).argmin())


def _triple(action: NamedAction, name: str, values: ArrayLike) -> Numbers:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (3,) or not (np.abs(numbers) <= MOST).all():
        raise action._refused(f'{name} {values!r}', f'three numbers x y z of at most {MOST:g}')
    return tuple(float(one) for one in numbers)


def _at_height(point: Floats, z: float) -> Floats:
    return np.array([point[0], point[1], z])
