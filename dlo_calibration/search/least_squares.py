# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bounded robust least squares from several start points, with few evaluations."""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import Differences, Linearisation, STEP
from dlo_calibration.evaluation.residuals import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.descent import Descent, NEAR
from dlo_calibration.search.protocol import Batches, Hints, Observation, Search
from dlo_calibration.search.sobol import Sobol

# Steps and distances are in units of a search.
FIRST_STEP = 0.015  # of a finite difference; larger steps mislead beside a narrow valley
SHORTER = 1 / 4  # radius of the second step that is tried, relative to the first
DONE_STEP = 1e-3  # converged where the next step changes every parameter by no more than this
DONE_GAIN = 1e-4  # or is predicted to lower the cost by no more than this share
COARSE_GAIN = 0.01  # the same for a coarse search: cross-validation would not notice less
SCAN_RADIUS = 0.1  # of a step from a scanned point; points nearer than this to the minimum are not scanned
MOST_ITERATIONS = 25  # of one descent
STALLED = 0.02  # share of the cost; a descent had stalled before its minimum if polishing saves more
MOST_RESUMED = 4  # times that a polished descent continues
MOST_VALLEYS = 3  # times that a lower minimum is sought along a valley
# Largest costs, in units of that of the minimum: as predicted beside a point of the valley, so that
# this place is simulated; as simulated, to descend from there; and to fit perhaps as well.
PROMISING, LOWER, RIVAL = 1.2, 0.98, 1.05
MOST_PROMISING = 8  # places that are simulated beside the points of a valley
CONFIRMED = 2  # independent descents that end in a minimum, or find none lower, confirm it


def costs_less(residuals: Floats, others: Floats, share: float = 1.0) -> bool:
    """Tell whether residuals [m] cost less than a share of others, by the narrower of their losses."""
    loss = min(Huber.of(residuals), Huber.of(others))
    return loss.cost(residuals) < share * loss.cost(others)


class LeastSquares(Search):
    """
    Minimise the robust sum of squared residuals within the box.

    The start points fill the cube.  A descent from the best of them takes Gauss-Newton steps within a box
    (Nocedal and Wright, Numerical Optimization, 2nd ed., 10.3).  Finite differences give the Jacobian, and
    Broyden's update corrects it after each step.  Descents from other start points follow until two have
    ended in the lowest minimum.  The difference score of the result, `best`, may not be the lowest.

    :param dimension: number of parameters.
    :param seed: of the start points.
    :param hints: half of the start points have its estimates; parameters that are not excited stay.
    """

    name = 'least_squares'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        super().__init__(dimension, seed, hints)
        # [m] root mean square change of the residuals over a unit of each parameter: the smallest
        # one measured, as contacts that come and go make columns too large, never too small.
        self._least_effect = np.full(dimension, np.inf)
        self._descents: list[Descent] = []
        self._rivals: list[Observation] = []

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`; remember those that cost little."""
        super().tell(observations)
        if self._lowest is not None and self._lowest.residuals is not None:
            loss = Huber.of(self._lowest.residuals)
            most = RIVAL * loss.cost(self._lowest.residuals)
            self._rivals = [one for one in (*self._rivals, *observations) if loss.cost(one.residuals) <= most]

    @property
    def rivals(self) -> tuple[Observation, ...]:
        """The observations that cost up to `RIVAL` times as much as the lowest one, and that one."""
        return tuple(self._rivals)

    @property
    def model(self) -> Linearisation | None:
        """Linear model of the residuals at `best`; None where no descent came near it."""
        lowest = self._lowest
        if lowest is None or lowest.residuals is None:
            return None
        near = [(float(np.abs(descent.point - lowest.point)[descent.visible()].max(initial=0.0)),
                 descent.jacobian) for descent in self._descents if descent.jacobian.any()]
        distance, jacobian = min(near, key=lambda pair: pair[0], default=(np.inf, np.zeros(0)))
        return None if distance > NEAR else Linearisation(
            lowest.point, lowest.residuals, jacobian, self._upper)

    def _improves(self, observation: Observation) -> bool:
        """Tell whether an observation costs less than the lowest so far."""
        lowest = None if self._lowest is None else self._lowest.residuals
        return observation.residuals is not None and (
            lowest is None or costs_less(observation.residuals, lowest))

    def _batches(self) -> Batches[str]:
        """Descend from the best start point, then confirm and polish the minimum."""
        starts = yield from self._starts()
        narrowest = min(Huber.of(start.residuals) for start in starts if start.residuals is not None)
        starts.sort(key=lambda start: narrowest.cost(start.residuals))
        best, reached = (yield from self._descend(self._begin(starts.pop(0)), None, starts)), 1
        if not self._hints.refines:
            best, reached = yield from self._confirm(best, starts)
        best = yield from self._end(best)
        if self._hints.jacobian is None:
            polished = yield from self._finish(best)
            best, reached = polished, reached if self._same_minimum(polished, best) else 1
        if self._hints.follows_valley:
            best, reached = yield from self._follow_valley(best, reached)
        return best.ended + (f'; reached from {reached} starts' if reached > 1 else '')

    def _confirm(self, best: Descent, starts: list[Observation]) -> Batches[tuple[Descent, int]]:
        """
        Descend from other start points until the lowest minimum is confirmed.

        :returns: the descent that ended there, and the number of start points that led there.
        """
        reached, checks, scanned = 1, 0, False  # checks: descents that began after the best one had ended
        while reached < CONFIRMED and checks < CONFIRMED:
            starts = [start for start in starts if np.abs(start.point - best.point).max() > NEAR]
            if not best.has_rival(starts):
                best = yield from self._end(best)
            beyond: Descent | None = None
            if best.ended:
                self._to_lowest(best)
                if not scanned:
                    beyond, scanned = (yield from self._scan(best)), True
            if beyond is None and not starts:
                break
            checks += beyond is None and bool(best.ended)
            descent = yield from self._descend(beyond or self._begin(starts.pop(0)), best, starts)
            better = costs_less(descent.residuals, best.residuals)
            if self._same_minimum(descent, best):
                reached += beyond is None
            elif better:
                reached = 1
            best = descent if better else best
        best = yield from self._end(best)
        if not scanned:
            self._to_lowest(best)
            beyond = yield from self._scan(best)
            if beyond is not None:
                descent = yield from self._descend(beyond, best, ())
                if costs_less(descent.residuals, best.residuals):
                    best, reached = (yield from self._end(descent)), 1
        return best, reached

    def _end(self, descent: Descent) -> Batches[Descent]:
        """Continue a descent, without rivals, until it ends."""
        return descent if descent.ended else (yield from self._descend(descent, None, ()))

    def _finish(self, best: Descent) -> Batches[Descent]:
        """Polish a minimum; after a large gain, the descent had stalled in a rough valley, and continues."""
        for _ in range(MOST_RESUMED):
            polished = yield from self._polish(best)
            self._descents.append(polished)
            stalled = polished.cost < (1 - STALLED) * polished.loss.cost(best.residuals)
            best = polished
            if not stalled:
                break
            best.ended = ''
            best = yield from self._end(best)
        return best

    def _polish(self, here: Descent) -> Batches[Descent]:
        """
        Improve a minimum with wide differences, which kinks of the residuals disturb less than narrow ones.

        Steps along a single principal axis are tried, too, if they promise much: along a narrow valley, the
        model is right for longer than across it.

        :returns: the improved descent, or `here` where no point costs clearly less.
        """
        for _ in range(3):
            columns = np.flatnonzero(here.visible())
            if not len(columns) or here.roughness < 0.01 * here.loss.threshold:  # smooth: there are no kinks
                break
            least = self._least_effect[columns].max(initial=0.0) / self._least_effect
            reach = np.clip(STEP * np.sqrt(least), STEP, 5 * STEP)
            sides = Differences.central(here.point, columns, reach, self._upper)
            beside = yield sides.points
            wide = sides.jacobian(here.jacobian, [observation.residuals for observation in beside])
            there = replace(here, jacobian=wide, radius=NEAR, origin=here.point)
            steps = [there.step(radius) for radius in (SCAN_RADIUS, NEAR, NEAR / 3)]
            steps += [step for step in there.axis_steps(SCAN_RADIUS)
                      if there.predicted(step) < (1 - STALLED) * there.cost]
            tried = yield np.clip([here.point + step for step in steps], 0.0, self._upper)
            best = min((*beside, *tried), key=lambda observation: here.loss.cost(observation.residuals))
            if here.loss.cost(best.residuals) >= (1 - 2e-3) * here.cost:
                break  # a gain of less than 0.2 % is not worth another iteration
            here = replace(here, jacobian=wide, origin=here.point)
            here.move(best)
        return here

    def _follow_valley(self, best: Descent, reached: int) -> Batches[tuple[Descent, int]]:
        """
        Look for a lower minimum along the valley in which parameters make up for each other.

        A DLO that sticks and slips makes such a valley rough: it has many minima, in which descents from all
        start points may end far from the lowest one.

        :returns: the descent that ended in the lowest, and the number of start points that led there.
        """
        for _ in range(MOST_VALLEYS):
            points = best.valley()
            if not len(points):
                break
            beside = yield points
            led = []
            for observation in beside:
                if observation.residuals is not None:
                    there = self._from(observation, best)
                    step = there.step(SCAN_RADIUS)
                    led.append((there.predicted(step), there.point + step))
            led = sorted((pair for pair in led if pair[0] < PROMISING * best.cost), key=itemgetter(0))
            tried = (yield np.clip([point for _, point in led[:MOST_PROMISING]], 0.0, self._upper)
                     ) if led else ()
            lowest = min((*beside, *tried), key=lambda observation: best.loss.cost(observation.residuals))
            if best.loss.cost(lowest.residuals) > LOWER * best.cost:
                break
            descent = yield from self._descend(self._from(lowest, best), best, ())
            if not costs_less(descent.residuals, best.residuals):
                break
            descent = yield from self._end(descent)
            best, reached = (yield from self._finish(descent)), 1
        return best, reached

    def _from(self, observation: Observation, near: Descent) -> Descent:
        """Return a descent that begins at an observation, with the slopes of one nearby."""
        assert observation.residuals is not None
        return Descent(observation.point, observation.residuals, near.loss, near.jacobian, NEAR,
                       origin=near.origin, upper=self._upper)

    def _begin(self, start: Observation) -> Descent:
        assert start.residuals is not None
        begun = Descent(start.point, start.residuals, Huber.of(start.residuals),
                        np.zeros((len(start.residuals), self._dimension)), upper=self._upper)
        if self._hints.jacobian is not None and np.array_equal(
                start.point, np.clip(self._hints.start, 0, self._upper)):
            begun.jacobian, begun.moves = self._hints.jacobian, 1
            begun.origin = np.full(self._dimension, np.inf)  # not fresh, as it is not quite that of here
            self._update_effects(begun)
        return begun

    def _scan(self, here: Descent) -> Batches[Descent | None]:
        """
        Scan the range of the parameter of least effect, along which minima often lie side by side.

        :returns: a descent at the best scanned point, if its predicted cost is at least 2 % lower; else None.
        """
        free = np.flatnonzero(here.visible())
        if not len(free):
            return None
        weakest = free[np.argmin(self._least_effect[free])]
        values = np.array([value for value in np.arange(0.1, self._upper[weakest], 0.2)
                           if abs(value - here.point[weakest]) > SCAN_RADIUS])
        points = np.tile(here.point, (len(values), 1))
        points[:, weakest] = values
        observations = yield points
        lowest, best = LOWER * here.cost, None
        for observation in observations:
            if observation.residuals is not None:
                there = self._from(observation, here)
                predicted = min(there.predicted(there.step(SCAN_RADIUS)), there.cost)
                if predicted < lowest:
                    lowest, best = predicted, there
        return best

    def _starts(self) -> Batches[list[Observation]]:
        """Ask for start points until at least one can be simulated."""
        # Two per parameter and at least eight; a Sobol sequence is balanced only for powers of two.
        count = 2 ** int(np.ceil(np.log2(max(8, 2 * self._dimension))))
        hint = np.clip(self._hints.start, 0, self._upper)
        if self._hints.refines:
            observations = yield hint[None, :]
            if observations[0].residuals is not None:
                return list(observations)
        sobol = Sobol(self._dimension, self._seed)
        while True:
            points = self._hints.spread(sobol.random(count))
            # Half of them have the prior estimate: a good one saves a lot, a wrong one spoils only half.
            points[::2] = np.where(np.isnan(hint), points[::2], hint)
            idle = ~self._hints.excited
            points[:, idle] = np.where(np.isnan(hint), self._hints.spread(0.5), hint)[idle]
            order = np.unique(points, axis=0, return_index=True)[1]
            observations = yield points[np.sort(order)]
            starts = [start for start in observations if start.residuals is not None]
            if starts:
                return starts

    @staticmethod
    def _same_minimum(descent: Descent, other: Descent) -> bool:
        """Tell whether two descents are near each other, or equal in cost within 0.1 %."""
        loss = min(descent.loss, other.loss)
        costs = loss.cost(descent.residuals), loss.cost(other.residuals)
        both = descent.visible() & other.visible()
        distance = np.abs(descent.point - other.point)[both].max(initial=0.0)
        return bool(distance < NEAR or abs(costs[0] - costs[1]) <= 1e-3 * max(costs))

    def _to_lowest(self, descent: Descent) -> None:
        """Move to the lowest point of all descents, if it is near."""
        lowest = self._lowest
        if lowest is not None and np.abs(lowest.point - descent.point).max() <= NEAR:
            descent.move(lowest)

    def _descend(self, here: Descent, minimum: Descent | None, rivals: Sequence[Observation]
                 ) -> Batches[Descent]:
        """
        Continue a descent until it ends or is given up; `ended` stays empty when it is given up.

        It is given up if it leads to `minimum`, the best one so far, or to a higher one, or if it is slow
        and one of the start points `rivals` is as promising.
        """
        self._descents = [descent for descent in self._descents if descent is not here] + [here]
        slow = 0
        if here.origin is None:
            yield from self._measure(here, np.flatnonzero(self._hints.excited))
        for _ in range(MOST_ITERATIONS):
            step = here.step(np.inf)
            gain = here.cost - here.predicted(step)
            length = float(np.abs(step).max(initial=0.0))
            if minimum is not None and self._leads_nowhere(here, step, minimum):
                return here
            # Where the residuals are rough, a gain below a tenth of their relative roughness is chance.
            least = max(COARSE_GAIN if self._hints.coarse else DONE_GAIN,
                        0.1 * min(here.roughness / here.loss.threshold, 0.03))
            if length <= DONE_STEP or gain <= least * here.cost:
                if here.jacobian_is_fresh:
                    here.ended = (
                        f'converged: the next step would change no parameter by more than '
                        f'{DONE_STEP * 100:g} of 100' if length <= DONE_STEP else
                        f'converged: the next step would lower the cost by less than {least * 100:.2g} %')
                    return here
                yield from self._measure(here, np.flatnonzero(here.visible()))
                continue
            before = here.cost
            reach = min(length, here.radius)
            moved = yield from self._try(here)
            gained = 1 - here.cost / before
            if here.jacobian_is_fresh and reach < NEAR and gained <= least:
                here.ended = f'converged: the last step lowered the cost by less than {least * 100:.2g} %'
                return here
            slow = slow + 1 if gained < 0.2 else 0  # consecutive steps of little gain
            if slow and minimum is not None and minimum.loss.cost(here.residuals) > 2 * minimum.cost:
                return here
            if slow > 1 and here.has_rival(rivals):
                return here
            if not moved and (here.moves or not here.jacobian_is_fresh):
                yield from self._measure(here, np.flatnonzero(here.visible()))
        here.ended = f'stopped after {MOST_ITERATIONS} steps'
        return here

    @staticmethod
    def _leads_nowhere(here: Descent, step: Floats, minimum: Descent) -> bool:
        """Tell whether a descent approaches a minimum, or flattens out at a higher cost."""
        target = here.point + step
        both = here.visible() & minimum.visible()
        near = np.abs(target - minimum.point)[both].max(initial=0.0) < NEAR and (
            np.abs(here.point - minimum.point)[both].max(initial=0.0) < 2 * NEAR)
        higher = minimum.loss.cost(here.residuals) > minimum.cost
        flat = float(np.abs(step).max(initial=0.0)) < NEAR / 3
        return bool(higher and (near or flat))

    def _try(self, here: Descent) -> Batches[bool]:
        """Try the step within the radius and a shorter one; move to the better one if it lowers the cost."""
        steps = [here.step(here.radius)]
        shorter = here.step(here.radius * SHORTER)
        if np.abs(steps[0] - shorter).max() > 0.1 * np.abs(steps[0]).max():
            steps.append(shorter)
        observations = yield np.clip([here.point + step for step in steps], 0.0, self._upper)
        costs = [here.loss.cost(observation.residuals) for observation in observations]
        gains = [here.cost - here.predicted(step) for step in steps]
        chosen = int(np.argmin(costs))
        base, before = here.point, here.residuals
        moved = costs[chosen] < here.cost
        good = moved and here.cost - costs[chosen] > 0.5 * gains[chosen]
        length = float(np.abs(steps[chosen]).max())
        if moved:
            here.move(observations[chosen])
            if good and chosen == 0:
                here.radius = min(max(here.radius, 2 * length), 0.5)
            elif chosen == 1 or not good:
                here.radius = max(length, here.radius * SHORTER) if good else length / 2
        else:
            here.radius = min(float(np.abs(step).max()) for step in steps) / 4
        # The longest step comes last: the updated Jacobian then predicts it exactly.
        for observation in sorted(observations, key=lambda each: float(np.linalg.norm(each.point - base))):
            here.update_jacobian(observation, base, before)
        here.moves += moved
        return moved

    def _measure(self, here: Descent, columns: NDArray[np.intp]) -> Batches[None]:
        """
        Measure columns of the Jacobian by finite differences; move to the best point if it costs less.

        Where a difference fails, the other side is tried.
        """
        here.origin, here.moves = here.point, 0
        sizes = self._difference_steps(here)
        beside: list[Observation] = []
        jacobian = here.jacobian.copy()  # `model` uses that of `here` if the budget is spent meanwhile
        jacobian[:, columns] = 0.0
        for _ in range(2):
            if not len(columns):
                break
            leaving = (here.point + sizes > self._upper) | (here.point + sizes < 0)
            sizes = np.where(leaving, -sizes, sizes)
            sides = Differences.one_sided(here.point, columns, sizes)
            batch = yield sides.points
            residuals = [observation.residuals for observation in batch]
            here.jacobian = jacobian = sides.jacobian(jacobian, residuals, here.residuals)
            beside.extend(batch)
            columns = columns[[each is None for each in residuals]]
            sizes = -sizes / 2
        self._update_effects(here)
        best = min(beside, key=lambda observation: here.loss.cost(observation.residuals), default=None)
        if best is not None and here.loss.cost(best.residuals) < here.cost:
            here.move(best)

    def _update_effects(self, here: Descent) -> None:
        effect = np.sqrt(np.mean(here.jacobian ** 2, axis=0))
        self._least_effect = np.where(effect > 0, np.minimum(self._least_effect, effect), self._least_effect)

    def _difference_steps(self, here: Descent) -> Floats:
        """Return (d,) steps of finite differences that change the residuals far beyond their roughness."""
        if not here.jacobian.any() or self._hints.jacobian is not None:
            return np.full(self._dimension, FIRST_STEP)
        most = here.loss.threshold
        change = min(max(0.2 * most, 10 * here.roughness), most)  # [m] of the residuals by one difference
        # Only a parameter of little effect compared with the others takes a large step.
        furthest = FIRST_STEP * self._least_effect[np.isfinite(self._least_effect)].max() / self._least_effect
        # Differences below 0.005 show little but contacts that come and go.
        return np.asarray(np.clip(np.minimum(change / self._least_effect, furthest), 0.005, 0.2))
