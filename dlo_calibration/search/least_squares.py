# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bounded robust least squares from several start points, with few evaluations."""

from __future__ import annotations

from dataclasses import replace
from typing import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import both_sides, inward, Linearisation, slope, STEP
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.descent import Descent, NEAR
from dlo_calibration.search.plan import Plan, PlannedSearch
from dlo_calibration.search.protocol import Hints, Observation
from dlo_calibration.search.sobol import Sobol

# Steps and distances are in the unit cube.
FIRST_STEP = 0.015  # of a finite difference; larger steps mislead beside a narrow valley
SHORTER = 1 / 4  # radius of the second step that is tried, relative to the first
DONE_STEP = 1e-3  # converged where the next step changes every parameter by no more than this
DONE_GAIN = 1e-4  # or is predicted to lower the cost by no more than this share
COARSE_GAIN = 0.01  # the same for a coarse search: cross-validation would not notice less
SCAN_RADIUS = 0.1  # of a step from a scanned point; points nearer than this to the minimum are not scanned
MOST_ITERATIONS = 25  # of one descent


def costs_less(one: Floats, other: Floats) -> bool:
    """Tell whether the first residuals [m] cost less than the second, by the narrower of their losses."""
    loss = min(Huber.of(one), Huber.of(other))
    return loss.cost(one) < loss.cost(other)


class LeastSquares(PlannedSearch):
    """
    Minimise the robust sum of squared residuals within the unit cube.

    The start points fill the cube.  A descent from the best of them takes
    Gauss-Newton steps within a box (Nocedal and Wright, Numerical Optimization,
    2nd ed., 10.3).  Finite differences give the Jacobian, and Broyden's update
    (ibid., 11.1) corrects it after each step.  Descents from other start points
    follow until the lowest minimum was found twice.

    :param dimension: number of parameters.
    :param seed: of the start points.
    :param hints: half of the start points have its estimates; parameters that it calls not excited stay.
    """

    name = 'least_squares'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        super().__init__(dimension)
        self._seed = seed
        self._hints = Hints.none(dimension) if hints is None else hints
        # [m] root mean square change of the residuals over the whole range of each parameter.  The smallest
        # one measured is kept: contacts that come and go make columns too large, never too small.
        self._least_effect = np.full(dimension, np.inf)
        self._lowest: Observation | None = None
        self._descents: list[Descent] = []

    @property
    def best(self) -> Floats | None:
        """The (d,) point of lowest robust cost; its difference score may not be the lowest."""
        return None if self._lowest is None else self._lowest.point

    @property
    def model(self) -> Linearisation | None:
        """Linear model of the residuals at `best`; None where no descent came near it."""
        lowest = self._lowest
        if lowest is None or lowest.residuals is None:
            return None
        near = [(float(np.abs(one.point - lowest.point)[one.visible()].max(initial=0.0)), one.jacobian)
                for one in self._descents if one.origin is not None]
        distance, jacobian = min(near, key=lambda pair: pair[0], default=(np.inf, np.zeros(0)))
        return Linearisation(lowest.point, lowest.residuals, jacobian) if distance <= NEAR else None

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`."""
        for one in observations:
            if one.residuals is not None and (
                    self._lowest is None or self._lowest.residuals is None
                    or costs_less(one.residuals, self._lowest.residuals)):
                self._lowest = one
        super().tell(observations)

    def _plan(self) -> Plan:
        """Follow descents from the start points, lowest cost first, until the lowest minimum is confirmed."""
        starts = self._by_cost((yield from self._starts()))
        best = yield from self._descend(self._begin(starts.pop(0)), None, starts)
        beyond: list[Descent] = []
        found, checks, looked = 1, 0, False  # times that the best minimum was reached; starts that checked it
        while found < 2 and checks < 2 and not self._hints.refines:
            starts = [one for one in starts if np.abs(one.point - best.point).max() > NEAR]
            if not best.ended and not best.has_rival(starts):
                best = yield from self._descend(best, None, ())
            if best.ended:
                self._to_lowest(best)
                if not looked:
                    beyond = yield from self._look_beyond(best)
                    looked = True
            if not (beyond or starts):
                break
            independent = not beyond
            begun = beyond.pop() if beyond else self._begin(starts.pop(0))
            checks += independent and bool(best.ended)
            descent = yield from self._descend(begun, best, starts)
            same, better = self._same_minimum(descent, best), costs_less(descent.residuals, best.residuals)
            found = found + independent if same else 1 if better else found
            if better:
                best = descent
        if not best.ended:
            best = yield from self._descend(best, None, ())
        if not looked and not self._hints.refines:
            self._to_lowest(best)
            for begun in (yield from self._look_beyond(best)):
                descent = yield from self._descend(begun, best, ())
                if costs_less(descent.residuals, best.residuals):
                    best, found = descent, 1
            if not best.ended:
                best = yield from self._descend(best, None, ())
        if self._hints.jacobian is None:
            best = yield from self._polish(best)
            self._descents.append(best)
        return best.ended + (f'; reached from {found} starts' if found > 1 else '')

    def _polish(self, here: Descent) -> Generator[Floats, Sequence[Observation], Descent]:
        """
        Improve a minimum with wide differences, which kinks of the residuals disturb less than narrow ones.

        :returns: the improved descent, or `here` where no point costs clearly less.
        """
        for _ in range(3):
            columns = np.flatnonzero(here.visible())
            if not len(columns) or here.roughness < 0.01 * here.loss.threshold:  # smooth: there are no kinks
                break
            least = self._least_effect[columns].max(initial=0.0) / self._least_effect
            reach = np.clip(STEP * np.sqrt(least), STEP, 5 * STEP)
            points = both_sides(here.point, columns, reach)
            seen = yield points
            wide = here.jacobian.copy()
            for j, k in enumerate(columns):
                two = seen[2 * j:2 * j + 2]
                column = slope([one.point[k] for one in two], [one.residuals for one in two])
                wide[:, k] = wide[:, k] if column is None else column
            there = Descent(here.point, here.residuals, here.loss, wide, NEAR, origin=here.point)
            steps = [there.step(radius) for radius in (SCAN_RADIUS, NEAR, NEAR / 3)]
            tried = yield np.clip([here.point + step for step in steps], 0.0, 1.0)
            best = min((*seen, *tried), key=lambda one: here.loss.cost(one.residuals))
            if here.loss.cost(best.residuals) >= (1 - 2e-3) * here.cost:
                break  # a gain of less than 0.2 % is not worth another iteration
            here = replace(here, jacobian=wide, origin=here.point)
            here.move(best)
        return here

    def _begin(self, start: Observation) -> Descent:
        assert start.residuals is not None
        begun = Descent(start.point, start.residuals, Huber.of(start.residuals),
                        np.zeros((len(start.residuals), self._dimension)))
        if self._hints.jacobian is not None and np.array_equal(start.point, np.clip(self._hints.start, 0, 1)):
            begun.jacobian, begun.moves = self._hints.jacobian, 1
            begun.origin = np.full(self._dimension, np.inf)  # not fresh, as it is not quite that of here
            self._see_effects(begun)
        return begun

    def _look_beyond(self, here: Descent) -> Generator[Floats, Sequence[Observation], list[Descent]]:
        """
        Try points along the range of the parameter of least effect, where minima often lie side by side.

        :returns: a descent at the best of them, if its predicted cost is at least 2 % lower; else none.
        """
        free = np.flatnonzero(here.visible())
        if not len(free):
            return []
        weakest = free[np.argmin(self._least_effect[free])]
        values = np.array([value for value in (0.1, 0.3, 0.5, 0.7, 0.9)
                           if abs(value - here.point[weakest]) > SCAN_RADIUS])
        points = np.tile(here.point, (len(values), 1))
        points[:, weakest] = values
        observations = yield points
        found = []
        for one in observations:
            if one.residuals is not None:
                there = Descent(one.point, one.residuals, here.loss, here.jacobian, NEAR, origin=here.origin)
                predicted = there.predicted(there.step(SCAN_RADIUS))
                found.append((min(predicted, there.cost), there))
        found.sort(key=lambda pair: pair[0])
        return [there for predicted, there in found[:1] if predicted < (1 - 0.02) * here.cost]

    def _starts(self) -> Generator[Floats, Sequence[Observation], list[Observation]]:
        """Ask for start points until at least one can be simulated."""
        # Two per parameter and at least eight; a Sobol sequence is balanced only for powers of two.
        count = 2 ** int(np.ceil(np.log2(max(8, 2 * self._dimension))))
        sobol = Sobol(self._dimension, self._seed)
        hint = np.clip(self._hints.start, 0, 1)
        if self._hints.refines:
            observations = yield hint[None, :]
            if observations[0].residuals is not None:
                return list(observations)
        while True:
            points = sobol.random(count)
            # Half of them have the prior estimate: a good one saves a lot, a wrong one spoils only half.
            points[::2] = np.where(np.isnan(hint), points[::2], hint)
            points[:, ~self._hints.excited] = np.where(np.isnan(hint), 0.5, hint)[~self._hints.excited]
            order = np.unique(points, axis=0, return_index=True)[1]
            observations = yield points[np.sort(order)]
            starts = [one for one in observations if one.residuals is not None]
            if starts:
                return starts

    @staticmethod
    def _by_cost(starts: Sequence[Observation]) -> list[Observation]:
        """Sort start points by their cost, using the narrowest of their losses for all."""
        loss = min(Huber.of(one.residuals) for one in starts if one.residuals is not None)
        return sorted(starts, key=lambda one: loss.cost(one.residuals))

    @staticmethod
    def _same_minimum(one: Descent, other: Descent) -> bool:
        """Tell whether two descents are near each other, or equal in cost within 0.1 %."""
        loss = min(one.loss, other.loss)
        costs = loss.cost(one.residuals), loss.cost(other.residuals)
        both = one.visible() & other.visible()
        apart = np.abs(one.point - other.point)[both].max(initial=0.0)
        return bool(apart < NEAR or abs(costs[0] - costs[1]) <= 1e-3 * max(costs))

    def _to_lowest(self, descent: Descent) -> None:
        """Move to the lowest point of all descents, if it is near."""
        lowest = self._lowest
        if lowest is not None and np.abs(lowest.point - descent.point).max() <= NEAR:
            descent.move(lowest)

    def _descend(self, here: Descent, known: Descent | None, rivals: Sequence[Observation]
                 ) -> Generator[Floats, Sequence[Observation], Descent]:
        """
        Continue a descent until it ends or is given up; `ended` stays empty when it is given up.

        It is given up where it leads to the `known` minimum or to a higher one, or where it is
        slow and one of the start points `rivals` is as promising.
        """
        self._descents = [one for one in self._descents if one is not here] + [here]
        slow = 0
        if here.origin is None:
            yield from self._measure(here, np.flatnonzero(self._hints.excited))
        for _ in range(MOST_ITERATIONS):
            step = here.step(np.inf)
            gain = here.cost - here.predicted(step)
            length = float(np.abs(step).max(initial=0.0))
            if known is not None and self._leads_nowhere(here, step, known):
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
            if slow and known is not None and known.loss.cost(here.residuals) > 2 * known.cost:
                return here
            if slow > 1 and here.has_rival(rivals):
                return here
            if not moved and (here.moves or not here.jacobian_is_fresh):
                yield from self._measure(here, np.flatnonzero(here.visible()))
        here.ended = f'stopped after {MOST_ITERATIONS} steps'
        return here

    @staticmethod
    def _leads_nowhere(here: Descent, step: Floats, known: Descent) -> bool:
        """Tell whether a descent approaches the known minimum, or flattens out at a higher cost."""
        target = here.point + step
        both = here.visible() & known.visible()
        near = np.abs(target - known.point)[both].max(initial=0.0) < NEAR and (
            np.abs(here.point - known.point)[both].max(initial=0.0) < 2 * NEAR)
        higher = known.loss.cost(here.residuals) > known.cost
        flat = float(np.abs(step).max(initial=0.0)) < NEAR / 3
        return bool(higher and (near or flat))

    def _try(self, here: Descent) -> Generator[Floats, Sequence[Observation], bool]:
        """Try the step within the radius and a shorter one; move to the better one if it lowers the cost."""
        steps = [here.step(here.radius)]
        shorter = here.step(here.radius * SHORTER)
        if np.abs(steps[0] - shorter).max() > 0.1 * np.abs(steps[0]).max():
            steps.append(shorter)
        observations = yield np.clip([here.point + step for step in steps], 0.0, 1.0)
        costs = [here.loss.cost(one.residuals) for one in observations]
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
        for one in sorted(observations, key=lambda seen: float(np.linalg.norm(seen.point - base))):
            here.update_jacobian(one, base, before)
        here.moves += moved
        return moved

    def _measure(self, here: Descent, columns: NDArray[np.intp]
                 ) -> Generator[Floats, Sequence[Observation], None]:
        """Measure columns of the Jacobian by finite differences; move to the best point if it costs less."""
        here.origin, here.moves = here.point, 0
        here.jacobian = here.jacobian.copy()
        sizes = self._difference_steps(here)
        seen = yield from self._differences(here, columns, sizes)
        self._see_effects(here)
        nearest = min(seen, key=lambda one: here.loss.cost(one.residuals), default=None)
        if nearest is not None and here.loss.cost(nearest.residuals) < here.cost:
            here.move(nearest)

    def _see_effects(self, here: Descent) -> None:
        effect = np.sqrt(np.mean(here.jacobian ** 2, axis=0))
        self._least_effect = np.where(effect > 0, np.minimum(self._least_effect, effect), self._least_effect)

    def _differences(self, here: Descent, columns: NDArray[np.intp], sizes: Floats
                     ) -> Generator[Floats, Sequence[Observation], list[Observation]]:
        """Set columns of the Jacobian from steps of given sizes; where one fails, try the other side."""
        seen: list[Observation] = []
        for _ in range(2):
            if not len(columns):
                break
            sizes = inward(here.point, sizes)
            told = yield np.clip(here.point + np.diag(sizes)[columns], 0.0, 1.0)
            for k, one in zip(columns, told, strict=True):
                column = slope((here.point[k], one.point[k]), (here.residuals, one.residuals))
                here.jacobian[:, k] = 0.0 if column is None else column
            seen.extend(told)
            columns = columns[[one.residuals is None for one in told]]
            sizes = -sizes / 2
        return seen

    def _difference_steps(self, here: Descent) -> Floats:
        """Return (d,) steps of finite differences that change the residuals well beyond their roughness."""
        if not here.jacobian.any() or self._hints.jacobian is not None:
            return np.full(self._dimension, FIRST_STEP)
        most = here.loss.threshold
        change = min(max(0.2 * most, 10 * here.roughness), most)  # [m] of the residuals by one difference
        # Only a parameter of little effect compared with the others takes a large step.
        furthest = FIRST_STEP * self._least_effect[np.isfinite(self._least_effect)].max() / self._least_effect
        # Differences below 0.005 show little but contacts that come and go.
        return np.asarray(np.clip(np.minimum(change / self._least_effect, furthest), 0.005, 0.2))
