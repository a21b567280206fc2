# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""BeamSearch: a search over sequences of moves, which asks for rehearsals and never simulates itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generator, Mapping, Protocol, Sequence, TypeVar

import numpy as np

from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.planning.crossings import crossings
from dlo_calibration.planning.moves import carrying, clash, Move
from dlo_calibration.planning.objective import Objective
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.refinement import Best, refine, Refinement, SHARES
from dlo_calibration.planning.rehearsal import in_turn, Job, Rehearsal, Step

WIDTH = 3  # sequences that are continued
KEPT = 4  # moves after each sequence that are refined
ALIKE = 0.2  # of the cost; of sequences that end nearer to each other, the better one is continued
PRICE = 1.08  # factor on the cost that an action must save
NEAR = 2.0  # times the cost that is enough, below which all displacements are refined together
TOGETHER = 3  # Gauss-Newton steps for all displacements of a sequence
PATIENCE = 1  # actions that need not gain anything, before one that may

Result = TypeVar('Result')
Asking = Generator[list[Job], Sequence[Rehearsal], Result]


class Refusing(Protocol):
    """Tells what the limits of the hands do not permit."""

    def refusal(self, action: Action) -> str:
        """Return why the hands must not move like this; empty if they may."""

    def entered(self, chains: Floats) -> str:
        """Return which forbidden box (m, n, 3) chains [m] enter; empty if none."""


@dataclass(frozen=True, eq=False)
class Course:
    """
    A sequence of moves, and the DLO at rest before and after each.

    :param chains: (k + 1, n, 3) [m] with the found parameters, the first one before the first move.
    :param cost: of the last chain [m].
    """

    moves: tuple[Move, ...]
    chains: Floats
    cost: float

    @property
    def end(self) -> Floats:
        """The points after the last move, (n, 3) [m]."""
        return np.asarray(self.chains[-1])

    @cached_property
    def chain(self) -> Chain:
        """The chain after the last move; one for all that follows, as finding its noise takes its time."""
        return Chain(self.end)


@dataclass(frozen=True, eq=False)
class Draft:
    """
    Moves after a course that have not been simulated.

    :param before: (k, n, 3) [m] where the DLO is expected before each of the k moves.
    """

    base: Course
    moves: tuple[Move, ...]
    before: Floats

    def shifted(self, shifts: Floats) -> Draft:
        """Return the same moves with other displacements, (d,) [m] one after the other."""
        parts = np.split(shifts, np.cumsum([move.shifts.size for move in self.moves])[:-1])
        return replace(self, moves=tuple(replace(move, shifts=part)
                                         for move, part in zip(self.moves, parts, strict=True)))

    @property
    def shifts(self) -> Floats:
        """All displacements, (d,) [m]."""
        return np.concatenate([move.shifts.ravel() for move in self.moves])


@dataclass(frozen=True, eq=False)
class Judged:
    """
    A course that was simulated at once, with the found parameters and with draws from the posterior.

    :param best: with the found parameters; `drawn` with the draws.
    :param cost: mean over the draws [m].
    """

    course: Course
    steps: tuple[Step, ...]
    best: Rehearsal
    drawn: tuple[Rehearsal, ...]
    cost: float


class BeamSearch:
    """
    Search for the shortest sequence of moves that reaches a goal, or the one that gets nearest.

    Each sequence is continued by the moves that carry a point to its place in the goal.  The best of them
    are refined, and the best sequences are continued.  All displacements of a sequence that nearly
    reaches the goal are refined together.

    :param start: the DLO before the first move.
    :param enough: cost [m] at which the goal counts as reached.
    :param levels: (n,) heights [m] at which the points are put down.
    :param physical: found parameters; `draws` from the posterior (SI units).
    """

    def __init__(self, start: Chain, objective: Objective, enough: float, options: PlanOptions,
                 limits: Refusing, levels: Floats, physical: Mapping[str, float],
                 draws: Sequence[Mapping[str, float]]) -> None:
        self._start = start
        self._objective, self._enough, self._options, self._limits = objective, enough, options, limits
        self._levels, self._physical, self._draws = levels, physical, draws
        self._crossings = max(crossings(start.points), crossings(objective.goal))
        self._root = Course((), start.points[None], objective.cost(start.points))
        self.best: Course = self._root  # the sequence that gets nearest with the found parameters, so far
        self.actions = 0  # of the sequences that are tried now
        self.judged: Judged | None = None  # the best one that was simulated with draws
        self.refusals: dict[str, int] = {}  # why moves were refused -> how often
        self._watched = bool(options.no_go)  # whether the way of the DLO matters
        self._pool: list[Course] = []  # all sequences that were kept
        self._known: set[Course] = set()  # those that were judged
        self.stop_reason = ''
        self._asking = self._search()
        self._jobs: list[Job] = next(self._asking, [])

    def ask(self) -> list[Job]:
        """Return sequences to rehearse; none once the search has ended."""
        return self._jobs

    def tell(self, rehearsals: Sequence[Rehearsal]) -> None:
        """Take the rehearsals of the last `ask`, in the order asked."""
        try:
            self._jobs = self._asking.send(rehearsals)
        except StopIteration:
            self._jobs = []

    def stop(self) -> None:
        """Ask from now on only for what the best sequence so far needs to be a plan."""
        self._asking = self._conclude('stopped')
        self._jobs = next(self._asking, [])

    @property
    def reached(self) -> bool:
        """Whether the start, or the end of the best judged sequence, is within the tolerance of the goal."""
        return not self._judged_rank[0]

    @property
    def expected(self) -> int:
        """Number of actions to simulate if all permitted actions are needed; an estimate."""
        actions = self._options.actions
        moves = len(carrying(self._start.points, self._objective.goal, self._options.kinds,
                             self._options.hands))
        following = moves + KEPT * (2 * self._options.hands + len(SHARES))
        displacements = 2 * actions * self._options.hands
        return int(following * (1 + WIDTH * (actions - 1))
                   + actions * (displacements + TOGETHER * len(SHARES) + 1 + len(self._draws)))

    def _search(self) -> Asking[None]:
        if self.reached:
            self.stop_reason = 'the start is within the tolerance of the goal'
            return
        beam, reason, stalled = [self._root], '', 0
        for count in range(1, self._options.actions + 1):
            self.actions, before = count, min(map(self._rank_of, [self._root, *self._pool]))
            beam = yield from self._grown(beam)
            if not beam:
                reason = 'no further action is permitted'
                break
            stalled = 0 if self._rank_of(beam[0]) < before else stalled + 1
            if stalled > PATIENCE:
                reason = 'no further action brings it nearer'
                break
            beam = yield from self._completed(beam, last=count == self._options.actions)
            if self.reached:
                reason = 'the goal is reached'
                break
        yield from self._conclude(reason)

    @property
    def _spent(self) -> str:
        """Why the search ended where it has tried as many actions as it may."""
        most, used = self._options.actions, 0 if self.judged is None else len(self.judged.steps)
        return f'the largest number of actions, {most}, is used up' if used == most else \
            f'further actions, up to {most} in all, save less than {1 - PRICE:.0%} of the error each'

    def _rank(self, cost: float, actions: int) -> tuple[bool, float]:
        """Return what is less for a better sequence: one that reaches the goal, or is worth its actions."""
        return cost > self._enough, cost * PRICE**actions

    def _rank_of(self, course: Course) -> tuple[bool, float]:
        return self._rank(course.cost, len(course.moves))

    @property
    def _judged_rank(self) -> tuple[bool, float]:
        """Rank of the best judged sequence, or of no action."""
        return self._rank_of(self._root) if self.judged is None else self._rank(
            self.judged.cost, len(self.judged.steps))

    def _completed(self, beam: list[Course], last: bool) -> Asking[list[Course]]:
        """
        Refine the sequences that nearly reach the goal, and judge those that do.

        :param last: they cannot be continued, so they are all refined and judged.
        :returns: all sequences, best first.
        """
        near = [course for course in beam if last or course.cost < NEAR * self._enough]
        for group in (near[:1], near[1:]):  # the others are seldom needed
            refined = yield from self._together(group)
            yield from self._judge([one for one in refined if last or one.cost <= self._enough])
            beam = [*(one for one in beam if one not in group), *refined]
            if self.reached:
                break
        beam.sort(key=lambda course: course.cost)
        self._pool += beam
        return beam

    def _conclude(self, reason: str) -> Asking[None]:
        """Judge the most promising sequences so far, until one of them is permitted."""
        pool = sorted((course for course in dict.fromkeys([*self._pool, self.best])
                       if course not in self._known and self._rank_of(course) < self._judged_rank),
                      key=self._rank_of)
        for first in range(0, len(pool), WIDTH):
            if not self.reached and (first == 0 or self.judged is None):
                yield from self._judge(pool[first:first + WIDTH])
        self.stop_reason = reason or self._spent

    def _grown(self, beam: Sequence[Course]) -> Asking[list[Course]]:
        """Return the best sequences with one more move, best first."""
        drafts = []
        for course in beam:
            for choices in carrying(course.end, self._objective.goal, self._options.kinds,
                                    self._options.hands):
                permitted = [draft for move in choices
                             if self._permits(draft := Draft(course, (move,), course.chains[-1:]))]
                drafts += permitted[:1]
        seen = yield from self._tried(drafts)
        first: list[tuple[Course, Course, Draft]] = []
        for draft, one in zip(drafts, seen, strict=True):
            if one is not None:
                first.append((draft.base, one, draft))
        chosen = []
        for course in beam:
            own = sorted((entry for entry in first if entry[0] is course), key=lambda entry: entry[1].cost)
            chosen += own[:KEPT]
        refined = yield from self._refined([entry[2] for entry in chosen], [entry[1] for entry in chosen], 1)
        return self._distinct(sorted(refined, key=lambda course: course.cost))[:WIDTH]

    def _distinct(self, courses: Sequence[Course]) -> list[Course]:
        """Return courses, best first, without those that end almost like a better one."""
        found: list[Course] = []
        for course in courses:
            if all(np.linalg.norm(course.end - other.end, axis=1).mean() > ALIKE * course.cost
                   for other in found):
                found.append(course)
        return found

    def _together(self, courses: Sequence[Course]) -> Asking[list[Course]]:
        """Return sequences whose displacements were refined all at once."""
        drafts = [Draft(self._root, course.moves, course.chains[:-1]) for course in courses]
        return (yield from self._refined(drafts, courses, TOGETHER))

    def _refined(self, drafts: Sequence[Draft], seen: Sequence[Course], iterations: int
                 ) -> Asking[list[Course]]:
        """Refine the displacements of drafts, which were seen to become courses, side by side."""
        under_way: dict[int, tuple[Refinement[Course], list[Floats]]] = {}
        best = list(seen)
        for k, (draft, course) in enumerate(zip(drafts, seen, strict=True)):
            refinement = refine(Best(draft.shifts, course), lambda one: self._objective.residuals(one.end),
                                iterations)
            under_way[k] = refinement, next(refinement)
        while under_way:
            asked = [(k, drafts[k].shifted(point))
                     for k, (_, points) in under_way.items() for point in points]
            told = yield from self._tried([draft for _, draft in asked])
            for k, (refinement, _) in list(under_way.items()):
                own = [one for (index, _), one in zip(asked, told, strict=True) if index == k]
                best[k] = min([best[k], *(one for one in own if one is not None)], key=lambda one: one.cost)
                try:
                    under_way[k] = refinement, refinement.send(own)
                except StopIteration:
                    del under_way[k]
        return best

    def _tried(self, drafts: Sequence[Draft]) -> Asking[list[Course | None]]:
        """Return the courses that drafts become; None where one is not permitted or cannot be simulated."""
        permitted = [draft for draft in drafts if self._permits(draft)]
        jobs = [Job(self._chain(draft.base), self._steps(draft.moves, draft.before), self._physical,
                    self._watched) for draft in permitted]
        told = (yield jobs) if jobs else []
        found = {id(draft): self._course(draft, one) for draft, one in zip(permitted, told, strict=True)}
        return [found.get(id(draft)) for draft in drafts]

    def _chain(self, course: Course) -> Chain:
        return course.chain if course.moves else self._start

    def _steps(self, moves: Sequence[Move], before: Floats) -> tuple[Step, ...]:
        return in_turn([move.step(points, self._levels, self._options.height, self._options.speed)
                        for move, points in zip(moves, before, strict=True)])

    def _permits(self, draft: Draft) -> bool:
        for step in self._steps(draft.moves, draft.before):
            if not self._allowed(self._limits.refusal(step.action) or clash(step.action)):
                return False
        return True

    def _allowed(self, refusal: str) -> bool:
        """Count a refusal; tell whether there was none."""
        if refusal:
            self.refusals[refusal] = self.refusals.get(refusal, 0) + 1
        return not refusal

    def _course(self, draft: Draft, seen: Rehearsal) -> Course | None:
        """Return the course that a draft becomes; None if it failed or is not permitted."""
        if seen.failure or not self._allowed(self._forbidden(seen)):
            return None
        found = Course((*draft.base.moves, *draft.moves), np.concatenate([draft.base.chains, seen.chains]),
                       self._objective.cost(seen.chains[-1]))
        if found.cost < self.best.cost:
            self.best = found
        return found

    def _forbidden(self, seen: Rehearsal) -> str:
        """Return why the DLO must not move like this; empty if it may."""
        if not self._options.crossings and any(crossings(chain) > self._crossings for chain in seen.chains):
            return 'the DLO crosses itself'
        return self._limits.entered(np.concatenate([*seen.courses, seen.chains]))

    def _judge(self, courses: Sequence[Course]) -> Asking[None]:
        """Simulate courses at once, with the found parameters and with the draws."""
        each = [self._physical, *self._draws]
        planned = [self._steps(course.moves, course.chains[:-1]) for course in courses]
        jobs = [Job(self._start, steps, physical, self._watched) for steps in planned for physical in each]
        told = (yield jobs) if jobs else []
        self._known.update(courses)
        for k, (course, steps) in enumerate(zip(courses, planned, strict=True)):
            best, *drawn = told[k * len(each):(k + 1) * len(each)]
            drawn = [one for one in drawn if not one.failure]
            if best.failure or not all(self._allowed(self._forbidden(one)) for one in (best, *drawn)):
                continue
            cost = float(np.mean([self._objective.cost(one.chains[-1]) for one in drawn or [best]]))
            if self._rank(cost, len(steps)) < self._judged_rank:
                self.judged = Judged(course, steps, best, tuple(drawn), cost)
