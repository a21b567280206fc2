# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Bounded robust least squares from several start points: few evaluations, from what the residuals tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.linearisation import both_sides, inward, slope, STEP
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.descent import Descent, NEAR
from dlo_calibration.search.plan import Plan, PlannedSearch
from dlo_calibration.search.protocol import Hints, Observation

FIRST_STEP = 0.015  # of a finite difference; beside a narrow valley larger ones lead astray
SMALLEST_STEP, LARGEST_STEP = 0.005, 0.2  # below, contacts that come and go are all that one sees
VISIBLE = 0.2  # share of the loss's threshold by which a finite difference is to change the residuals
STEP_OVER_ROUGHNESS = 10.0  # a column's change over what the model could not predict
SPECULATIVE = 1 / 4  # radius of the second point tried, in radii of the first
DONE_STEP = 1e-3  # converged where the next step is not longer, in any parameter
DONE_GAIN = 1e-4  # or would not lower the cost by more than this share of it
NOISE_GAIN = 0.1  # or, where the residuals are rough, than this share of their roughness over their spread,
MOST_ROUGHNESS = 0.03  # which counts no more than that
SLOW_GAIN = 0.2  # share of the cost; a descent is slow where a step gains less
SAME_COST = 1e-3  # two descents that end that near in cost, as a share, found the same minimum
BEYOND = (0.1, 0.3, 0.5, 0.7, 0.9)  # where the parameter of least effect is tried, too
WORTH_A_LOOK = 0.02  # share of the cost that such a place promises to save
REACH = 0.1  # from such a place, in each parameter; a place that is nearer is not tried
SMOOTH = 0.01  # share of the loss's threshold: the model that predicts so well sees no kinks
DONE_POLISH = 2e-3  # share of the cost that is worth another look for kinks
MOST_ITERATIONS = 25  # of a descent


def lower(one: Floats, other: Floats) -> bool:
    """Return whether the first residuals [m] cost less, by the narrower of the two losses."""
    loss = min(Huber.of(one), Huber.of(other))
    return loss.cost(one) < loss.cost(other)


class LeastSquares(PlannedSearch):
    """
    Minimise the robust sum of squared residuals within the unit cube.

    Start points fill the space; from the best of them, Gauss-Newton steps
    within a box (Nocedal and Wright, Numerical Optimization, 2nd ed., 10.3)
    whose Jacobian comes from finite differences and, between them, from
    Broyden's update (ibid., 11.1).  Other starts are followed until the lowest
    minimum was found twice.

    :param dimension: number of parameters.
    :param seed: of the start points.
    :param hints: their start is tried first.
    """

    name = 'least_squares'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        super().__init__(dimension)
        self._seed = seed
        self._hints = Hints.none(dimension) if hints is None else hints
        # Contacts that come and go make columns too large, never too small.
        self._least_effect = np.full(dimension, np.inf)  # [m] root mean square, from 0 to 1
        self._lowest: Observation | None = None

    @property
    def best(self) -> Floats | None:
        """The (d,) point of lowest robust cost; its difference score may not be the lowest."""
        return None if self._lowest is None else self._lowest.point

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`."""
        for one in observations:
            if one.residuals is not None and (
                    self._lowest is None or self._lowest.residuals is None
                    or lower(one.residuals, self._lowest.residuals)):
                self._lowest = one
        super().tell(observations)

    def _plan(self) -> Plan:
        starts = self._in_turn((yield from self._starts()))
        best = yield from self._descend(self._begin(starts.pop(0)), None, starts)
        beyond: list[Descent] = []
        found, checks, looked = 1, 0, False  # `found`: times that the best minimum was reached
        while found < 2 and checks < 2 and not self._hints.refines:
            starts = [one for one in starts if np.abs(one.point - best.point).max() > NEAR]
            if not best.ended and not best.rivals(starts):
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
            same, better = self._same(descent, best), lower(descent.residuals, best.residuals)
            found = found + independent if same else 1 if better else found
            if better:
                best = descent
        if not best.ended:
            best = yield from self._descend(best, None, ())
        if not looked and not self._hints.refines:
            self._to_lowest(best)
            for begun in (yield from self._look_beyond(best)):
                descent = yield from self._descend(begun, best, ())
                if lower(descent.residuals, best.residuals):
                    best, found = descent, 1
            if not best.ended:
                best = yield from self._descend(best, None, ())
        best = yield from self._polish(best)
        return best.ended + (f'; reached from {found} starts' if found > 1 else '')

    def _polish(self, here: Descent) -> Generator[Floats, Sequence[Observation], Descent]:
        """
        Look from the minimum to both sides of each parameter, over the kinks that narrow differences see.

        :returns: where that leads to, which is here where nothing costs visibly less.
        """
        for _ in range(3):  # looks, each from where the one before led
            columns = np.flatnonzero(here.measured())
            if not len(columns) or here.roughness < SMOOTH * here.loss.threshold:
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
            steps = [there.step(radius) for radius in (REACH, NEAR, NEAR / 3)]
            tried = yield np.clip([here.point + step for step in steps], 0.0, 1.0)
            best = min((*seen, *tried), key=lambda one: here.loss.cost(one.residuals))
            if here.loss.cost(best.residuals) >= (1 - DONE_POLISH) * here.cost:
                break
            here = replace(here, jacobian=wide, origin=here.point)
            here.move(best)
        return here

    def _begin(self, start: Observation) -> Descent:
        assert start.residuals is not None
        return Descent(start.point, start.residuals, Huber.of(start.residuals),
                       np.zeros((len(start.residuals), self._dimension)))

    def _look_beyond(self, here: Descent) -> Generator[Floats, Sequence[Observation], list[Descent]]:
        """
        Look along the whole range of the parameter of least effect: minima lie side by side there.

        :returns: the best place there, if it promises a lower cost.
        """
        free = np.flatnonzero(here.measured())
        if not len(free):
            return []
        weakest = free[np.argmin(self._least_effect[free])]
        targets = np.array([value for value in BEYOND if abs(value - here.point[weakest]) > REACH])
        points = np.tile(here.point, (len(targets), 1))
        points[:, weakest] = targets
        observations = yield points
        found = []
        for one in observations:
            if one.residuals is not None:
                there = Descent(one.point, one.residuals, here.loss, here.jacobian, NEAR, origin=here.origin)
                predicted = there.predicted(there.step(REACH))
                found.append((min(predicted, there.cost), there))
        found.sort(key=lambda pair: pair[0])
        return [there for predicted, there in found[:1] if predicted < (1 - WORTH_A_LOOK) * here.cost]

    def _starts(self) -> Generator[Floats, Sequence[Observation], list[Observation]]:
        """Ask for start points until one can be simulated."""
        from scipy.stats import qmc

        # Two a parameter, and eight at least; powers of two keep a Sobol sequence balanced.
        count = 2 ** int(np.ceil(np.log2(max(8, 2 * self._dimension))))
        sobol = qmc.Sobol(self._dimension, scramble=True, seed=self._seed)
        hint = np.clip(self._hints.start, 0, 1)
        if self._hints.refines:
            observations = yield hint[None, :]
            if observations[0].residuals is not None:
                return list(observations)
        while True:
            points = sobol.random(count)
            # Half of them keep to the estimate: where it is good it saves a lot, where it is wrong not all.
            points[::2] = np.where(np.isnan(hint), points[::2], hint)
            points[:, ~self._hints.excited] = np.where(np.isnan(hint), 0.5, hint)[~self._hints.excited]
            order = np.unique(points, axis=0, return_index=True)[1]
            observations = yield points[np.sort(order)]
            starts = [one for one in observations if one.residuals is not None]
            if starts:
                return starts

    @staticmethod
    def _in_turn(starts: Sequence[Observation]) -> list[Observation]:
        """Sort start points by their cost, all by the narrowest of their losses."""
        loss = min(Huber.of(one.residuals) for one in starts if one.residuals is not None)
        return sorted(starts, key=lambda one: loss.cost(one.residuals))

    @staticmethod
    def _same(one: Descent, other: Descent) -> bool:
        loss = min(one.loss, other.loss)
        costs = loss.cost(one.residuals), loss.cost(other.residuals)
        both = one.measured() & other.measured()
        apart = np.abs(one.point - other.point)[both].max(initial=0.0)
        return bool(apart < NEAR or abs(costs[0] - costs[1]) <= SAME_COST * max(costs))

    def _to_lowest(self, descent: Descent) -> None:
        """Move to where another descent came by, if that costs less and is near."""
        lowest = self._lowest
        if lowest is not None and np.abs(lowest.point - descent.point).max() <= NEAR:
            descent.move(lowest)

    def _descend(self, here: Descent, known: Descent | None, rivals: Sequence[Observation]
                 ) -> Generator[Floats, Sequence[Observation], Descent]:
        """
        Go down from where a descent stands.

        Leave it, with nothing in `ended`, where it leads to the `known` minimum or to
        a higher one, or is slow while one of its `rivals` costs hardly more.
        """
        slow = 0
        if here.origin is None:
            yield from self._measure(here, np.flatnonzero(self._hints.excited))
        for _ in range(MOST_ITERATIONS):
            step = here.step(np.inf)
            gain = here.cost - here.predicted(step)
            length = float(np.abs(step).max(initial=0.0))
            if known is not None and self._leads_nowhere(here, step, known):
                return here
            visible = max(DONE_GAIN, NOISE_GAIN * min(here.roughness / here.loss.threshold, MOST_ROUGHNESS))
            if length <= DONE_STEP or gain <= visible * here.cost:
                if here.known_here:
                    here.ended = (
                        f'converged: the next step would change no parameter by more than '
                        f'{DONE_STEP * 100:g} of 100' if length <= DONE_STEP else
                        f'converged: the next step would lower the cost by less than {visible * 100:.2g} %')
                    return here
                yield from self._measure(here, np.flatnonzero(here.measured()))
                continue
            before = here.cost
            reach = min(length, here.radius)
            moved = yield from self._try(here)
            gained = 1 - here.cost / before
            if here.known_here and reach < NEAR and gained <= visible:
                here.ended = f'converged: the last step lowered the cost by less than {visible * 100:.2g} %'
                return here
            slow = slow + 1 if gained < SLOW_GAIN else 0
            if slow and known is not None and known.loss.cost(here.residuals) > 2 * known.cost:
                return here
            if slow > 1 and here.rivals(rivals):
                return here
            if not moved and here.updates:
                yield from self._measure(here, np.flatnonzero(here.measured()))
        here.ended = f'stopped after {MOST_ITERATIONS} steps'
        return here

    @staticmethod
    def _leads_nowhere(here: Descent, step: Floats, known: Descent) -> bool:
        """Return whether a descent nears the known minimum, or flattens out above it."""
        target = here.point + step
        both = here.measured() & known.measured()
        near = np.abs(target - known.point)[both].max(initial=0.0) < NEAR and (
            np.abs(here.point - known.point)[both].max(initial=0.0) < 2 * NEAR)
        higher = known.loss.cost(here.residuals) > known.cost
        flat = float(np.abs(step).max(initial=0.0)) < NEAR / 3
        return bool(higher and (near or flat))

    def _try(self, here: Descent) -> Generator[Floats, Sequence[Observation], bool]:
        """Try the step within the radius and a shorter one; move to the better if it costs less."""
        steps = [here.step(here.radius)]
        shorter = here.step(here.radius * SPECULATIVE)
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
                here.radius = max(length, here.radius * SPECULATIVE) if good else length / 2
        else:
            here.radius = min(float(np.abs(step).max()) for step in steps) / 4
        # The shortest first: the longest one's update then holds exactly.
        for one in sorted(observations, key=lambda seen: float(np.linalg.norm(seen.point - base))):
            here.learn(one, base, before)
        here.updates = here.updates + 1 if moved else here.updates
        return moved

    def _measure(self, here: Descent, columns: NDArray[np.intp]
                 ) -> Generator[Floats, Sequence[Observation], None]:
        """Measure columns of the Jacobian by finite differences at once; move where one costs less."""
        here.origin, here.updates = here.point, 0
        here.jacobian = here.jacobian.copy()
        sizes = self._difference_steps(here)
        seen = yield from self._differences(here, columns, sizes)
        effect = np.sqrt(np.mean(here.jacobian ** 2, axis=0))
        self._least_effect = np.where(effect > 0, np.minimum(self._least_effect, effect), self._least_effect)
        nearest = min(seen, key=lambda one: here.loss.cost(one.residuals), default=None)
        if nearest is not None and here.loss.cost(nearest.residuals) < here.cost:
            here.move(nearest)

    def _differences(self, here: Descent, columns: NDArray[np.intp], sizes: Floats
                     ) -> Generator[Floats, Sequence[Observation], list[Observation]]:
        """Set columns of the Jacobian from steps of those sizes; the other way, where one fails."""
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
        """Return the (d,) steps of finite differences that change the residuals visibly."""
        if not here.jacobian.any():
            return np.full(self._dimension, FIRST_STEP)
        most = here.loss.threshold
        wanted = min(max(VISIBLE * most, STEP_OVER_ROUGHNESS * here.roughness), most)
        # Only a parameter that is weak beside the others is moved far.
        furthest = FIRST_STEP * self._least_effect[np.isfinite(self._least_effect)].max() / self._least_effect
        return np.asarray(np.clip(
            np.minimum(wanted / self._least_effect, furthest), SMALLEST_STEP, LARGEST_STEP))
