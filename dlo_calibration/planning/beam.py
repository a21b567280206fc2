# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""BeamSearch: a search over sequences of moves, which asks for rehearsals and never simulates itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Generator, Mapping, Sequence, TypeVar

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import broyden, Differences, Linearisation
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.score import difference_score, difference_vector
from dlo_calibration.planning.limits import crossings
from dlo_calibration.planning.moves import carrying, clash, leading, Move, NOTHING
from dlo_calibration.planning.options import PlanOptions, SCORE
from dlo_calibration.planning.rehearsal import ActionStep, in_turn, Rehearsal, RehearsalJob
from dlo_calibration.planning.surroundings import passed_wrongly, Surroundings

REFERENCE = 0  # focal point of the score: the first point, because no hand holds the DLO after a plan

DIFFERENCE = 0.02  # of the length, step of a finite difference; friction makes smaller ones misleading
SHARES = (0.3, 1.0, 1.5)  # of the Gauss-Newton step that are tried together
LONGEST = 0.25  # of the length, of a step of one displacement
DAMPING = 0.02  # of the mean curvature
WORTH = 0.97  # share of the squares; a step that does not reduce them to less ends the refinement

WIDTH = 3  # sequences that are continued
REFINED = 4  # moves after each sequence that are refined
ALIKE = 0.2  # of the cost; if two sequences end nearer to each other, only the better one is continued
PRICE = 1.08  # factor on the cost that an action must save
NEAR = 2.0  # times the tolerance; below that cost, all displacements are refined together
TOGETHER = 3  # Gauss-Newton steps for all displacements of a sequence
PATIENCE = 1  # consecutive actions that need not gain anything
OTHER_SIDE = 0.15  # share of the length that counts as a distance for each body passed at the wrong side
SCREENS = 8  # draws in which a move that brings the DLO past a body is tried, at most
SELDOM = 0.1  # share of the draws in which the DLO may bear more than permitted

Result = TypeVar('Result')
Asking = Generator[list[RehearsalJob], Sequence[Rehearsal], Result]


class Objective:
    """
    The distance of chains from a goal.

    It is the mean distance of the points.  The kind `score` adds the paper's difference score per term;
    alone, the score would ignore differences that cancel.  Its features are the points that an annotator
    marked, else both ends, so that the place and the orientation of the DLO count.

    :param start: whose marked points are features, too.
    :param kind: `points` or `score`.
    :param surroundings: bodies that the DLO has to pass at the side at which the goal does.
    :ivar goal: points of the goal, (n, 3) [m].
    """

    def __init__(self, start: Chain, goal: Chain, kind: str, surroundings: Surroundings = NOTHING) -> None:
        self.goal = goal.points
        self.posts = surroundings.posts(start.points, goal.points)  # (p, 2) [m]
        self.length = start.length  # m
        self.detour = OTHER_SIDE * start.length  # m, for each of them
        self._scored = kind == SCORE
        marked = np.flatnonzero(start.features | goal.features)
        self._features: NDArray[np.intp] = marked if len(marked) else np.array([0, len(goal) - 1])
        self._terms = len(goal) + len(self._features)

    def cost(self, points: Floats) -> float:
        """Return what is minimised [m], for an (n, 3) [m] chain."""
        cost = self.error(points) + (self.score(points) / 100 / self._terms if self._scored else 0.0)
        return cost + self.detour * self.wrong(points)

    def wrong(self, points: Floats) -> int:
        """Return how often an (n, 3) [m] chain passes bodies at another side than the goal."""
        return passed_wrongly(points, self.goal, self.posts) if len(self.posts) else 0

    def residuals(self, points: Floats) -> Floats:
        """Return (m,) residuals [m], whose sum of squares is minimised in place of the cost."""
        distances: Floats = (points - self.goal).ravel() / np.sqrt(len(points))
        if not self._scored:
            return distances
        vector = difference_vector(self.goal, points, REFERENCE, self._features)
        return np.concatenate([distances, vector / self._terms])

    def error(self, points: Floats) -> float:
        """Return the mean distance [m] of the points of an (n, 3) [m] chain from those of the goal."""
        return float(np.linalg.norm(points - self.goal, axis=1).mean())

    def score(self, points: Floats) -> float:
        """Return the difference score [cm] of an (n, 3) [m] chain."""
        return difference_score(self.goal, points, REFERENCE, self._features)


@dataclass(frozen=True, eq=False)
class MoveSequence:
    """
    A sequence of moves, and the DLO at rest before and after each.

    :param chains: (k + 1, n, 3) [m] with the best parameters, the first one before the first move.
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
        """The chain after the last move; made once, because estimating its noise takes time."""
        return Chain(self.end)


@dataclass(frozen=True, eq=False)
class Draft:
    """
    Moves after a sequence that have not been simulated.

    :param before: (k, n, 3) [m] where the DLO is expected before each of the k moves.
    """

    base: MoveSequence
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
class JudgedSequence:
    """
    A whole sequence, simulated with the best parameters and with draws from the posterior.

    :param best: with the best parameters; `drawn` with the draws.
    :param cost: mean over the draws [m].
    """

    sequence: MoveSequence
    steps: tuple[ActionStep, ...]
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
    :param tolerance: cost [m] at which the goal counts as reached.
    :param levels: (n,) heights [m] at which the points are put down.
    :param physical: the best parameters by name (SI units); `draws` are draws from their posterior.
    :param surroundings: bodies that the hands keep clear of.
    """

    def __init__(self, start: Chain, objective: Objective, tolerance: float, options: PlanOptions,
                 levels: Floats, physical: Mapping[str, float], draws: Sequence[Mapping[str, float]],
                 surroundings: Surroundings = NOTHING) -> None:
        self._start = start
        self._objective, self._tolerance, self._options = objective, tolerance, options
        self._limits, self._surroundings = options.limits, surroundings
        self._levels, self._physical, self._draws = levels, physical, draws
        self._crossings = max(crossings(start.points), crossings(objective.goal))
        self._root = MoveSequence((), start.points[None], objective.cost(start.points))
        self.best: MoveSequence = self._root  # the nearest so far, with the best parameters
        self.actions = 0  # number of actions of the sequences that are tried now
        self.judged: JudgedSequence | None = None  # the best one that was simulated with draws
        self.refusals: dict[str, int] = {}  # why moves were refused -> how often
        self._watched = bool(options.no_go)  # whether the trajectory of the DLO matters
        self._pool: list[MoveSequence] = []  # all sequences that were refined
        self._judged: set[MoveSequence] = set()  # those that were simulated with draws
        self.stop_reason = ''
        self._asking = self._search()
        self._jobs: list[RehearsalJob] = next(self._asking, [])

    def ask(self) -> list[RehearsalJob]:
        """Return sequences to rehearse; none once the search has ended."""
        return self._jobs

    def tell(self, rehearsals: Sequence[Rehearsal]) -> None:
        """Take the rehearsals of the last `ask`, in the order asked."""
        try:
            self._jobs = self._asking.send(rehearsals)
        except StopIteration:
            self._jobs = []

    def stop(self) -> None:
        """End the search; ask only for the rehearsals that turn the best sequence so far into a plan."""
        self._asking = self._conclude('stopped')
        self._jobs = next(self._asking, [])

    @property
    def reached(self) -> bool:
        """Whether the start, or the end of the best judged sequence, is within the tolerance of the goal."""
        return not self._judged_rank[0]

    def _moves(self, points: Floats) -> list[tuple[Move, ...]]:
        """Return the moves to try on a DLO with (n, 3) points [m], each with all choices of hands."""
        options, objective = self._options, self._objective
        given = points, objective.goal, options.kinds, options.hands, self._surroundings
        return [*carrying(*given), *leading(*given, objective.posts)]

    @cached_property
    def _first_moves(self) -> list[tuple[Move, ...]]:
        return self._moves(self._start.points)

    @property
    def expected(self) -> int:
        """Number of actions to simulate if all permitted actions are needed; an estimate."""
        actions = self._options.actions
        moves = len(self._first_moves)
        following = moves + REFINED * (2 * self._options.hands + len(SHARES))
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
        """Why the search ended after it had tried the largest number of actions."""
        most, used = self._options.actions, 0 if self.judged is None else len(self.judged.steps)
        return f'the largest number of actions, {most}, is used up' if used == most else \
            f'further actions, up to {most} in all, save less than {PRICE - 1:.0%} of the error each'

    def _rank(self, cost: float, actions: int) -> tuple[bool, float]:
        """Return a key that is lower for a better sequence: it reaches the goal, or is worth its actions."""
        return cost > self._tolerance, cost * PRICE**actions

    def _rank_of(self, sequence: MoveSequence) -> tuple[bool, float]:
        return self._rank(sequence.cost, len(sequence.moves))

    @property
    def _judged_rank(self) -> tuple[bool, float]:
        """Rank of the best judged sequence, or of no action."""
        return self._rank_of(self._root) if self.judged is None else self._rank(
            self.judged.cost, len(self.judged.steps))

    def _completed(self, beam: list[MoveSequence], last: bool) -> Asking[list[MoveSequence]]:
        """
        Refine the sequences that nearly reach the goal, and judge those that reach it.

        :param last: refine and judge them all, because they cannot be continued.
        :returns: all sequences, best first.
        """
        near = [sequence for sequence in beam if last or sequence.cost < NEAR * self._tolerance]
        for group in (near[:1], near[1:]):  # the others are seldom needed
            drafts = [Draft(self._root, sequence.moves, sequence.chains[:-1]) for sequence in group]
            refined = yield from self._refined(drafts, group, TOGETHER)
            yield from self._judge([sequence for sequence in refined
                                    if last or sequence.cost <= self._tolerance])
            beam = [*(sequence for sequence in beam if sequence not in group), *refined]
            if self.reached:
                break
        beam.sort(key=lambda sequence: sequence.cost)
        self._pool += beam
        return beam

    def _conclude(self, reason: str) -> Asking[None]:
        """Judge the most promising sequences so far, until one of them is permitted."""
        pool = sorted((sequence for sequence in dict.fromkeys([*self._pool, self.best])
                       if sequence not in self._judged and self._rank_of(sequence) < self._judged_rank),
                      key=self._rank_of)
        for first in range(0, len(pool), WIDTH):
            if not self.reached and (first == 0 or self.judged is None):
                yield from self._judge(pool[first:first + WIDTH])
        self.stop_reason = reason or self._spent

    def _grown(self, beam: Sequence[MoveSequence]) -> Asking[list[MoveSequence]]:
        """Return the best sequences with one more move, best first."""
        drafts: list[Draft] = []
        for sequence in beam:
            for choices in self._first_moves if sequence is self._root else self._moves(sequence.end):
                each = [Draft(sequence, (move,), sequence.chains[-1:]) for move in choices]
                drafts += list(filter(self._permits, each))[:1]
        simulated = yield from self._tried(drafts)
        pairs = [(draft, grown) for draft, grown in zip(drafts, simulated, strict=True) if grown is not None]
        screened = yield from self._screened([grown for _, grown in pairs])
        pairs = [(draft, grown) for (draft, _), grown in zip(pairs, screened, strict=True)]
        chosen: list[tuple[Draft, MoveSequence]] = []
        for sequence in beam:
            own = sorted((pair for pair in pairs if pair[0].base is sequence), key=lambda pair: pair[1].cost)
            chosen += own[:REFINED]
        refined = yield from self._refined([draft for draft, _ in chosen], [grown for _, grown in chosen], 1)
        refined = yield from self._screened(refined)
        return self._distinct(sorted(refined, key=lambda sequence: sequence.cost))[:WIDTH]

    def _screened(self, sequences: Sequence[MoveSequence]) -> Asking[list[MoveSequence]]:
        """
        Return sequences with the costs of draws in which the last move does not bring the DLO past a body.

        Only some of the moves that do so with the best parameters do so reliably.
        """
        objective = self._objective
        passing = [sequence for sequence in sequences
                   if objective.wrong(sequence.end) < objective.wrong(sequence.chains[-2])]
        draws = self._draws[:SCREENS]
        jobs = [RehearsalJob(self._start, steps, physical, self._watched) for sequence in passing
                for steps in [self._steps(sequence.moves, sequence.chains[:-1])] for physical in draws]
        rehearsals = iter((yield jobs) if jobs else [])
        costs = {}
        for sequence in passing:
            failed = [bool(draw.failure or self._refusal(draw))
                      or objective.wrong(draw.chains[-1]) > objective.wrong(sequence.end)
                      for draw in islice(rehearsals, len(draws))]
            costs[sequence] = sequence.cost + objective.detour * float(np.mean(failed or [False]))
        return [replace(sequence, cost=costs[sequence]) if sequence in costs else sequence
                for sequence in sequences]

    def _distinct(self, sequences: Sequence[MoveSequence]) -> list[MoveSequence]:
        """Return sequences, best first, without those that end nearly where a better one does."""
        distinct: list[MoveSequence] = []
        for sequence in sequences:
            if all(np.linalg.norm(sequence.end - other.end, axis=1).mean() > ALIKE * sequence.cost
                   for other in distinct):
                distinct.append(sequence)
        return distinct

    def _refined(self, drafts: Sequence[Draft], sequences: Sequence[MoveSequence], iterations: int
                 ) -> Asking[list[MoveSequence]]:
        """Refine the displacements of drafts side by side; `sequences` are the simulated drafts."""
        best = list(sequences)
        length = self._objective.length
        refinements = [refine(draft.shifts, self._objective.residuals(sequence.end), iterations, length)
                       for draft, sequence in zip(drafts, sequences, strict=True)]
        asked = {k: next(refinement) for k, refinement in enumerate(refinements)}
        while asked:
            tried = iter((yield from self._tried([
                drafts[k].shifted(shifts) for k, points in asked.items() for shifts in points])))
            for k, points in list(asked.items()):
                outcomes = list(islice(tried, len(points)))
                best[k] = min([best[k], *filter(None, outcomes)], key=lambda sequence: sequence.cost)
                try:
                    asked[k] = refinements[k].send([
                        None if outcome is None else self._objective.residuals(outcome.end)
                        for outcome in outcomes])
                except StopIteration:
                    del asked[k]
        return best

    def _tried(self, drafts: Sequence[Draft]) -> Asking[list[MoveSequence | None]]:
        """Return the sequences that drafts become; None if one is not permitted or cannot be simulated."""
        permitted = [draft for draft in drafts if self._permits(draft)]
        jobs = [RehearsalJob(draft.base.chain if draft.base.moves else self._start,
                             self._steps(draft.moves, draft.before), self._physical, self._watched,
                             self._limits.of_loads)
                for draft in permitted]
        rehearsals = (yield jobs) if jobs else []
        outcomes = {id(draft): self._sequence(draft, rehearsal)
                    for draft, rehearsal in zip(permitted, rehearsals, strict=True)}
        return [outcomes.get(id(draft)) for draft in drafts]

    def _steps(self, moves: Sequence[Move], before: Floats) -> tuple[ActionStep, ...]:
        return in_turn([move.step(points, self._levels, self._options.height, self._options.speed,
                                  self._surroundings)
                        for move, points in zip(moves, before, strict=True)])

    def _permits(self, draft: Draft) -> bool:
        return all(self._allowed(self._limits.refusal(step.action) or clash(step.action)
                                 or self._surroundings.refusal(step.action))
                   for step in self._steps(draft.moves, draft.before))

    def _allowed(self, refusal: str) -> bool:
        """Count a refusal; tell whether there was none."""
        if refusal:
            self.refusals[refusal] = self.refusals.get(refusal, 0) + 1
        return not refusal

    def _sequence(self, draft: Draft, rehearsal: Rehearsal) -> MoveSequence | None:
        """Return the sequence that a draft becomes; None if it failed or is not permitted."""
        if rehearsal.failure or not self._allowed(
                self._refusal(rehearsal) or self._limits.overload(rehearsal.loads)):
            return None
        sequence = MoveSequence(
            (*draft.base.moves, *draft.moves), np.concatenate([draft.base.chains, rehearsal.chains]),
            self._objective.cost(rehearsal.chains[-1]))
        if sequence.cost < self.best.cost:
            self.best = sequence
        return sequence

    def _refusal(self, rehearsal: Rehearsal) -> str:
        """Return why this motion of the DLO is not permitted; empty if it is."""
        if not self._options.crossings and any(
                crossings(chain) > self._crossings for chain in rehearsal.chains):
            return 'the DLO crosses itself'
        return self._limits.entered(np.concatenate([*rehearsal.trajectories, rehearsal.chains]))

    def _judge(self, sequences: Sequence[MoveSequence]) -> Asking[None]:
        """Simulate whole sequences with the best parameters and with the draws."""
        parameters = [self._physical, *self._draws]
        planned = [self._steps(sequence.moves, sequence.chains[:-1]) for sequence in sequences]
        jobs = [RehearsalJob(self._start, steps, physical, self._watched, loads=True)
                for steps in planned for physical in parameters]
        rehearsals = iter((yield jobs) if jobs else [])
        self._judged.update(sequences)
        for sequence, steps in zip(sequences, planned, strict=True):
            best, *drawn = islice(rehearsals, len(parameters))
            drawn = [draw for draw in drawn if not draw.failure]
            if best.failure or not all(self._allowed(self._refusal(draw)) for draw in (best, *drawn)):
                continue
            if not self._allowed(self._limits.overload(best.loads) or self._often_overloaded(drawn)):
                continue
            cost = float(np.mean([self._objective.cost(draw.chains[-1]) for draw in drawn or [best]]))
            if self._rank(cost, len(steps)) < self._judged_rank:
                self.judged = JudgedSequence(sequence, steps, best, tuple(drawn), cost)

    def _often_overloaded(self, drawn: Sequence[Rehearsal]) -> str:
        """Return which limit the loads pass in too many draws; empty if there is none."""
        overloads = list(filter(None, (self._limits.overload(draw.loads) for draw in drawn)))
        return overloads[0] if len(overloads) > SELDOM * len(drawn) else ''


def refine(shifts: Floats, residuals: Floats, iterations: int, length: float
           ) -> Generator[Floats, Sequence[Floats | None], None]:
    """
    Lower the sum of squared residuals by damped Gauss-Newton steps.

    Yield (k, d) displacements [m] to try, and receive their residuals, None for impossible ones.  Unlike a
    search, it has no bounds, and tries three lengths of each step side by side, because a rollout takes long.

    :param shifts: (d,) initial displacements [m]; `residuals` (m,) [m] there.
    :param iterations: largest number of steps.
    :param length: of the DLO [m]; steps are shares of it.
    """
    difference = DIFFERENCE * length
    jacobian: Floats | None = None
    for _ in range(iterations):
        tried: list[tuple[Floats, Floats | None]] = []
        if jacobian is None:
            sides = Differences.one_sided(
                shifts, np.arange(len(shifts)), np.where(shifts < 0, -difference, difference))
            answers = yield sides.points
            tried += zip(sides.points, answers, strict=True)
            jacobian = sides.jacobian(np.zeros((len(residuals), len(shifts))), answers, residuals)
        points = shifts + np.outer(SHARES, _damped_step(
            Linearisation(shifts, residuals, jacobian), LONGEST * length))
        answers = yield points
        tried += zip(points, answers, strict=True)
        costs = [np.inf if answer is None else float(np.sum(answer**2)) for _, answer in tried]
        moved, after = tried[int(np.argmin(costs))]
        if after is None or min(costs) >= WORTH * float(residuals @ residuals):
            break
        step = moved - shifts
        jacobian = broyden(jacobian, step, after - residuals - jacobian @ step)
        shifts, residuals = moved, after


def _damped_step(model: Linearisation, longest: float) -> Floats:
    """Return the damped Gauss-Newton step, (d,) [m]; no displacement in it is longer than `longest` [m]."""
    curvature = model.information
    damping = DAMPING * np.trace(curvature) / len(curvature) + 1e-9
    step = model.step(damping * np.eye(len(curvature)))
    return np.asarray(step * min(1.0, longest / max(float(np.abs(step).max()), 1e-12)))
