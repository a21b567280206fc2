# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Inquiries: moves that hands may do to learn about a DLO, and when it is observed in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.advice import centimetres
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.planning.limits import crossings, HANDS
from dlo_calibration.planning.moves import carrying, clash, LIFTING, Move
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.planning.rehearsal import ActionStep, Rehearsal, RehearsalJob, rehearse, REST
from dlo_calibration.planning.surroundings import Surroundings

GRIPS = (0.0, 0.25, 0.5, 0.75, 1.0)  # share of the length
PAIRS = ((0.0, 1.0), (0.0, 0.5), (0.25, 0.75))
SHARES = (0.15, 0.3)  # of the length, of a displacement
STRETCH = 1.03  # of the arc length between two hands, to which they pull it
BEYOND, ACROSS = 0.7, 0.1  # where an end that is laid over the DLO is put: along it, and beside it
SPREAD = 0.06  # of the length: standard deviation of a change of a displacement
GRASPED = 0.6  # least share of the points that some hand reaches after an action
HEAP = 0.3  # share of the length; a DLO whose points are all nearer to each other lies in a heap
SELDOM = 0.25  # share of the draws in which an action may end otherwise
STEADY = 0.25  # s before the end of a pause, when hands and DLO rest
UPRIGHT = 0.01  # share of the length; a hand that is carried less goes up and down
TIDIER = 0.8  # of the distance from where it is tidy that an action must leave, at most


@dataclass(frozen=True, eq=False)
class Inquiry:
    """
    A move, the paths of its hands with a pause, and its trial, whose goals are placeholders.

    :param pause: when the hands wait, (begin, end) [s]; None: they do not.
    """

    move: Move
    action: Action
    pause: tuple[float, float] | None
    trial: Trial

    def words(self, start: Chain) -> str:
        """Say what the hands do: `start` is the DLO before."""
        parts = []
        places = start.arc_lengths() / start.length
        for name, grip, shift in zip(self.move.hands, self.move.grips, self.move.shifts, strict=True):
            way, kind = float(np.linalg.norm(shift)), self.move.name
            hand = next(hand for hand in self.action.hands if hand.name == name)
            lift = float(hand.positions[:, 2].max() - hand.positions[0, 2])
            what = f'drag it by {centimetres(way)}' if kind != LIFTING else \
                f'lift it by {centimetres(lift)}' + (
                    f' and carry it by {centimetres(way)}' if way > UPRIGHT * start.length else '')
            end = {0: 'the first end', int(np.abs(places - 0.5).argmin()): 'the middle',
                   len(places) - 1: 'the last end'}
            parts.append(f'{name}: grip {end.get(grip, f"{places[grip]:.2f} of the length")}, {what}')
        wait = '' if self.pause is None else f'; wait for {self.pause[1] - self.pause[0]:.3g} s, in which ' \
            'the DLO is observed'
        return '; '.join(parts) + wait + (', then put it down' if self.move.name == LIFTING else '')


class Inquiries:
    """
    Makes inquiries from a DLO at rest, within the limits of the hands.

    :param start: the DLO.
    :param level: height at which points are put down [m].
    :ivar refusals: why moves are not permitted -> how often.
    """

    def __init__(self, start: Chain, level: float, limits: AdviceOptions, surroundings: Surroundings) -> None:
        self.start, self.limits = start, limits.of_length(start.length)
        self.refusals: dict[str, int] = {}
        self._regions, self._surroundings = limits.limits, surroundings
        self._levels = np.full(len(start), level)
        self._crossings = max(crossings(start.points), 1 if limits.crossings else 0)

    def coarse(self) -> list[Inquiry]:
        """Return moves that differ clearly."""
        return list(filter(None, map(self._inquiry, self._moves())))

    def beside(self, inquiry: Inquiry, count: int, generator: np.random.Generator) -> list[Inquiry]:
        """Return `count` inquiries at most, whose displacements differ a little from those of one."""
        shifts, length = inquiry.move.shifts, self.start.length
        return list(filter(None, (self._inquiry(replace(
            inquiry.move, shifts=shifts + SPREAD * length * generator.standard_normal(shifts.shape)))
            for _ in range(count))))

    def tidying(self, pool: Pool, draws: Sequence[Mapping[str, float]]) -> Inquiry | None:
        """Return the move that brings the DLO nearest to a straight line within reach; None: none does."""
        goal = self._tidy_goal()
        moves = [self._inquiry(choices[0], pause=0.0) for choices in carrying(
            self.start.points, goal, self.limits.kinds, self.limits.hands, self._surroundings)]
        inquiries = list(filter(None, moves))
        away = [np.mean([np.linalg.norm(rehearsal.chains[-1] - goal, axis=1).mean() for rehearsal in ends])
                if not self._forbidden(ends) else np.inf
                for ends in self._rehearsed(inquiries, pool, draws)]
        now = np.linalg.norm(self.start.points - goal, axis=1).mean()
        return inquiries[int(np.argmin(away))] if away and min(away) < TIDIER * now else None

    def refused(self, inquiries: Sequence[Inquiry], pool: Pool, draws: Sequence[Mapping[str, float]]
                ) -> list[str]:
        """
        Return why each inquiry is not permitted, as simulated with draws of the parameters; '' if it is.

        After it, the DLO must lie where the next action can be done.
        """
        return [self._forbidden(ends) or self._untidy(ends)
                for ends in self._rehearsed(inquiries, pool, draws)]

    def _moves(self) -> Iterator[Move]:
        chain, limits = self.start, self.limits
        points, length = chain.points[:, :2], chain.length
        tangents = np.gradient(points, axis=0)
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        places = chain.arc_lengths() / length
        grips = [int(np.abs(places - share).argmin()) for share in GRIPS]
        last = len(points) - 1
        for kind in limits.kinds:
            for grip in grips:
                shifts = [side * share * length * normals[grip] for side in (1, -1) for share in SHARES]
                if grip in (0, last):  # along the DLO
                    shifts += [(1 if grip == 0 else -1) * share * length * tangents[grip] for share in SHARES]
                shifts += [np.zeros(2)] * (kind == LIFTING and limits.pause > 0)
                for shift in shifts:
                    yield Move(kind, (grip,), HANDS[:1], shift)
            if limits.crossings and kind == LIFTING:
                for grip, share in ((0, BEYOND), (last, 1 - BEYOND)):
                    k = int(np.abs(places - share).argmin())
                    for side in (1, -1):
                        target = points[k] + side * ACROSS * length * normals[k]
                        yield Move(kind, (grip,), HANDS[:1], target - points[grip])
            for pair in PAIRS if limits.hands > 1 else ():
                a, b = (int(np.abs(places - share).argmin()) for share in pair)
                between = points[b] - points[a]
                gap = float(np.linalg.norm(between))
                along = between / max(gap, 1e-9)
                across = np.array([-along[1], along[0]])
                arc = float((places[b] - places[a]) * length)
                yield Move(kind, (a, b), HANDS, np.array([along, -along]) * gap / 6)
                yield Move(kind, (a, b), HANDS, np.array([-along, along]) * (STRETCH * arc - gap) / 2)
                yield Move(kind, (a, b), HANDS, np.array([across, -across]) * SHARES[0] * length)
                yield Move(kind, (a, b), HANDS, np.array([across, across]) * SHARES[0] * length)

    def _inquiry(self, move: Move, pause: float | None = None) -> Inquiry | None:
        """Return the inquiry of a move, with the first choice of hands that is permitted; None: none is."""
        count = len(move.grips)
        for hands in dict.fromkeys([HANDS[:count], HANDS[:self.limits.hands][::-1][:count]]):
            chosen = replace(move, hands=hands)
            action, waits = self._paths(chosen, self.limits.pause if pause is None else pause)
            refusal = (self._regions.refusal(action) or clash(action) or self._surroundings.refusal(action))
            if not refusal:
                return Inquiry(chosen, action, waits, self._trial(action, waits))
            self.refusals[refusal] = self.refusals.get(refusal, 0) + 1
        return None

    def _paths(self, move: Move, pause: float) -> tuple[Action, tuple[float, float] | None]:
        """Return the paths of the hands with a pause: before they put the DLO down, else where they end."""
        limits = self.limits
        action = move.step(self.start.points, self._levels, limits.height, limits.speed,
                           self._surroundings).action
        count = len(action.hands[0].times)
        if pause <= 0 or count < 2:
            return action, None
        at = count - (2 if move.name == LIFTING else 1)
        begin = float(action.hands[0].times[at])
        rows = [*range(at + 1), *range(at, count)]
        later = np.array([0.0] * (at + 1) + [pause] * (count - at))
        return Action(tuple(Hand(hand.name, hand.grips, hand.times[rows] + later, hand.positions[rows])
                            for hand in action.hands)), (begin, begin + pause)

    def _trial(self, action: Action, pause: tuple[float, float] | None) -> Trial:
        goals = [Goal(self.start, action.end + REST)]
        if pause is not None:
            names = tuple(hand.name for hand in action.hands)
            seen = max(pause[1] - STEADY, sum(pause) / 2)
            goals.insert(0, Goal(self.start, seen, stable=False, held_by=names))
        return Trial('inquiry', self.start, (action,), tuple(goals))

    def _rehearsed(self, inquiries: Sequence[Inquiry], pool: Pool, draws: Sequence[Mapping[str, float]]
                   ) -> list[list[Rehearsal]]:
        watched, loaded = bool(self.limits.no_go), self._regions.of_loads
        steps = [(ActionStep(inquiry.action),) for inquiry in inquiries]
        rehearsals = iter(rehearse(pool, [RehearsalJob(self.start, step, physical, watched, loaded)
                                          for step in steps for physical in draws]))
        return [[next(rehearsals) for _ in draws] for _ in steps]

    def _forbidden(self, ends: Sequence[Rehearsal]) -> str:
        """Return which limit the DLO breaks in too many draws; '' if none."""
        return self._too_often([
            rehearsal.failure or self._regions.overload(rehearsal.loads) or self._crossed(rehearsal)
            or self._regions.entered(np.concatenate([*rehearsal.trajectories, rehearsal.chains]))
            for rehearsal in ends])

    def _crossed(self, rehearsal: Rehearsal) -> str:
        return 'the DLO crosses itself' if any(
            crossings(chain) > self._crossings for chain in rehearsal.chains) else ''

    def _untidy(self, ends: Sequence[Rehearsal]) -> str:
        return self._too_often([self.untidy(rehearsal.chains[-1]) for rehearsal in ends])

    def _too_often(self, refusals: Sequence[str]) -> str:
        said = list(filter(None, refusals))
        if len(said) <= SELDOM * len(refusals):
            return ''
        self.refusals[said[0]] = self.refusals.get(said[0], 0) + 1
        return said[0]

    def untidy(self, points: Floats) -> str:
        """Return why a DLO, (n, 3) [m], lies where no hand can go on; '' if one can."""
        within = np.any([self._regions.reach[name].contains(points, points)
                         for name in HANDS[:self.limits.hands]], axis=0)
        if within.mean() < GRASPED:
            return 'the DLO would leave the reach of the hands'
        if np.linalg.norm(points[:, None] - points[None], axis=2).max() < HEAP * self.start.length:
            return 'the DLO would lie in a heap'
        return ''

    def _tidy_goal(self) -> Floats:
        """Return a straight DLO, (n, 3) [m], near the present one, where hands reach most of it."""
        points, places = self.start.points, self.start.arc_lengths() - self.start.length / 2
        along = (points[-1] - points[0])[:2]
        along = np.array([1.0, 0.0]) if np.linalg.norm(along) < 1e-6 else along / np.linalg.norm(along)
        middle, reach = points[:, :2].mean(axis=0), self._regions.reach
        side = np.linspace(-0.5, 0.5, 5) * self.start.length
        best: tuple[float, Floats] | None = None
        for heading in np.linspace(0, np.pi, 6, endpoint=False):
            turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
            line = np.column_stack([np.outer(places, turned @ along) + middle, points[:, 2]])
            for shift in np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2):
                goal = line + np.append(shift, 0.0)
                within = np.any([reach[name].contains(goal, goal) for name in HANDS[:self.limits.hands]],
                                axis=0).mean()
                cost = np.linalg.norm(goal - points, axis=1).mean() / self.start.length - 10 * within
                if best is None or cost < best[0]:
                    best = cost, goal
        assert best is not None
        return best[1]
