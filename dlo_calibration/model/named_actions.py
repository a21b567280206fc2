# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Named actions: short descriptions of what hands do, from which their paths follow; and manipulations of them.

A message always carries the paths themselves.  A named action computes them from the
chain before it: each hand closes at the point that it grips, and moves at constant
speed.  With `hold`, it holds the DLO afterwards, too.

The position of a hand [m] is that of the point that it grips.  This point is given
as an index of the chain (negative: from its end), or as a fraction of the length,
which may lie between two points of the chain.  A target is given as coordinates,
or as a direction (of any length) and a distance.

The docstring of each action says how much it shows of each of the paper's four parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar, Iterable, Mapping, Sequence, Union

import numpy as np

from dlo_calibration.errors import InputError, one_of, suggestion
from dlo_calibration.model.action import Action, check_grips, Hand, PATHS
from dlo_calibration.model.chain import Chain, check_ends, Floats, frozen_array

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

    name: ClassVar[str]  # of its element in a request
    may_be_flat: ClassVar[bool] = False  # a height of 0 means no lift

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
            elif isinstance(value, (int, np.integer, np.floating)) and field.type == 'float':
                object.__setattr__(self, field.name, float(value))
        if not 0 <= self.start <= MOST:
            raise self._refused(f'start {self.start:g} s', f'0 to {MOST:g} s')
        for name in ('speed', 'height', 'distance'):
            value = getattr(self, name, None)
            if value is not None and not 1e-9 <= value <= MOST and not (
                    name == 'height' and value == 0 and self.may_be_flat):
                raise self._refused(f'{name} {value:g}', f'a {name} above 0, at most {MOST:g}')

    @property
    def hand_names(self) -> tuple[str, ...]:
        """Names of the hands that it uses."""
        return tuple(vars(self)['hands'] if 'hands' in vars(self) else (vars(self)['hand'],))

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

    def _require_either(self, name: str, other: str, remedy: str) -> None:
        """Raise an error unless exactly one of two fields is given."""
        values = getattr(self, name), getattr(self, other)
        if (values[0] is None) == (values[1] is None):
            raise self._refused(f'{name} {values[0]}, {other} {values[1]}', 'one of the two', remedy)

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
        self._require_either('point', 'fraction', 'say where the hand grips')

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
        return np.asarray(point + direction / np.linalg.norm(direction) * self.distance)


@dataclass(frozen=True, kw_only=True)
class GraspAndPlace(_Carrying):
    """
    Lift a point, carry it through the air, put it down and open.

    The hand rises to `height` above the higher of the two places, moves across, and down to the target.

    flexibility: some, together with friction: near the placed point, those bends stay that friction can hold
        against the bending stiffness.
    elasticity: nothing: only friction pulls at the other end.
    friction: some, together with flexibility: how much of the DLO follows.
    self_collision: nothing, unless the point is placed on or across the DLO (folding it); then much.

    :param height: of the lift [m].
    """

    height: float = 0.05

    name = 'grasp_and_place'

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

    name = 'drag'

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

    name = 'lift_and_hold'

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

    name = 'push_down'

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

    name = 'two_hands'
    may_be_flat: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_either('points', 'fractions', 'say where the hands grip')
        for name, values in (('points or fractions', self.points or self.fractions or ()),
                             ('hands', self.hands)):
            if len(values) != 2:
                raise self._refused(f'{len(values)} {name}', '2', 'give one for each hand')
        if self.fractions is not None:
            object.__setattr__(self, 'fractions', tuple(map(float, self.fractions)))
        for name, value, permitted in (('motion', self.motion, ('apart', 'together')),
                                   ('moving', self.moving, tuple(MOVING))):
            if value not in permitted:
                raise self._refused(f'{name} {value!r}', one_of(permitted, value),
                                    suggestion(value, permitted, 'correct the action'))

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
        return Action(tuple(Hand(name, (grips[k][0],), np.array(times), np.array(way)[:, k],
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

    name = 'release'

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


NAMED_ACTIONS: Mapping[str, type[NamedAction]] = {
    kind.name: kind for kind in (GraspAndPlace, Drag, LiftAndHold, PushDown, TwoHands, Release)}

MOST_STEPS = 200  # of a manipulation; each named action simulates all actions before it again


@dataclass(frozen=True)
class SimultaneousActions:
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
        return ' and '.join(dict.fromkeys(action.name for action in self.actions))


@dataclass(frozen=True)
class Manipulation:
    """
    A DLO at rest, and the actions to do with it in turn.

    :param start: the DLO before the first action.
    :param steps: one or more, at most MOST_STEPS; each begins when the DLO rests after the previous one.
    :param warnings: sentences for the user: what differs from the request or the recording.
    """

    name: str
    start: Chain
    steps: tuple[SimultaneousActions, ...]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        thing = f'trial {self.name!r}'
        if not self.steps:
            raise InputError(thing, 'no action', 'at least one', 'say what the hands do')
        if len(self.steps) > MOST_STEPS:
            raise InputError(thing, f'{len(self.steps)} actions in turn', f'at most {MOST_STEPS}',
                             'divide it into several trials')
        check_ends(thing, self.start)
        check_grips(thing, [hand for step in self.steps for action in step.actions
                            if isinstance(action, Action) for hand in action.hands], len(self.start))

    def with_shifted_hands(self, shift: Floats) -> Manipulation:
        """
        Return the manipulation with the recorded hands where they really were, if they are off by `shift`.

        :param shift: (3,) [m]. A hand that grips the nearest place of the start grips where that is then;
            named actions say where the DLO goes, and stay.
        """
        def shifted(hand: Hand) -> Hand:
            grips, offset = hand.grips, hand.offset
            if hand.nearest:
                point, offset, _ = self.start.nearest(hand.positions[0] - shift)
                grips = (point,)
            return replace(hand, grips=grips, offset=offset, positions=hand.positions - shift)

        def moved(action: Union[NamedAction, Action]) -> Union[NamedAction, Action]:
            if isinstance(action, RecordedPaths):
                return replace(action, positions=action.positions - shift)
            return Action(tuple(map(shifted, action.hands))) if isinstance(action, Action) else action

        return replace(self, steps=tuple(replace(step, actions=tuple(map(moved, step.actions)))
                                         for step in self.steps))


@dataclass(frozen=True)
class TimedAction:
    """
    An action with its time.

    :param end: when the last hand arrives [s].
    :param hold: whether its hands hold the DLO afterwards, if no observation shows it.
    """

    action: Union[NamedAction, Action]
    end: float
    hold: bool

    @property
    def names(self) -> frozenset[str]:
        """Names of its hands."""
        return frozenset(self.action.hand_names)


def manipulation_of(name: str, start: Chain, actions: Iterable[TimedAction],
                    holding: Sequence[tuple[float, Sequence[str] | None]] = ()) -> Manipulation:
    """
    Return the manipulation with actions of one clock.

    Actions of different hands that overlap in time are one step.

    :param holding: times [s] of observations in order, with the names of the hands that hold the DLO then;
        None: the hands that hold it after their actions.
    """
    groups: list[list[TimedAction]] = []
    warnings = []
    for timed in sorted(actions, key=lambda timed: timed.action.start):
        group, begin = groups[-1] if groups else [], timed.action.start
        busy = frozenset().union(*(other.names for other in group)) & timed.names
        if group and begin < max(other.end for other in group):
            if not busy:
                group.append(timed)
                continue
            if begin > group[0].action.start:
                warnings.append(f'trial {name!r}: {", ".join(sorted(busy))} acts again at '
                                f'{begin:g} s, while another hand moves; it is simulated afterwards')
        groups.append([timed])
    held: dict[str, None] = {}  # in the order in which they closed
    steps = []
    for k, group in enumerate(groups):
        acting = {hand: timed.hold for timed in group for hand in sorted(timed.names)}
        held = {hand: None for hand in (*held, *acting) if acting.get(hand, True)}
        until = groups[k + 1][0].action.start if k + 1 < len(groups) else np.inf
        end = max(timed.end for timed in group)
        observed = [hands for time, hands in holding if end < time <= until]
        if observed and observed[-1] is not None:
            held = dict.fromkeys(observed[-1])
        steps.append(SimultaneousActions(tuple(timed.action for timed in group), tuple(held)))
    return Manipulation(name, start, tuple(steps), tuple(warnings))


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

    name = PATHS

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ('times', 'positions', 'orientations'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def action(self, chain: Chain, before: Sequence[Action] = ()) -> Action:
        """Return the paths, whose hands grip points of this chain."""
        hands = []
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
            hands.append(Hand(name, grips, self.start + self.times, self.positions[:, k],
                              self.orientations[:, k], offset))
        return Action(tuple(hands))
