# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Slices: how the fit worsens when one or two parameters change and the others keep their found values."""

from __future__ import annotations

from concurrent.futures import CancelledError, Executor
from dataclasses import dataclass
from itertools import combinations, product
import time
from typing import Callable, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.evaluation.batch import BatchEvaluator
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.examination import Examination
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import PAPER_PARAMETERS, SCALE

LEVELS = (4, 8, 16)  # intervals of a line, coarse first: each level uses the points of the one before
NARROWEST = 10.0  # a slice extends at least this far to each side (0..100)
MOST_SECONDS = 6.0  # for all slices, which the page waits for
MOST_LINES = 6  # more would take too long to simulate, and to read


@dataclass(frozen=True)
class Line:
    """
    The fit while one parameter varies.

    :param name: of the parameter.
    :param values: (k,) of the parameter on the 0..100 scale.
    :param scores: (k,) difference scores [cm]; infinite if the simulation failed.
    :param errors: (k,) root mean square point errors [m]; infinite if the simulation failed.
    """

    name: str
    values: Floats
    scores: Floats
    errors: Floats


@dataclass(frozen=True)
class Plane:
    """
    The fit while two parameters vary.

    :param names: of the two parameters.
    :param values: (2, k) of the parameters on the 0..100 scale.
    :param scores: (k, k) difference scores [cm] as in `Line`; the first axis is the first parameter.
    :param errors: (k, k) root mean square point errors [m], likewise.
    """

    names: tuple[str, str]
    values: Floats
    scores: Floats
    errors: Floats


@dataclass(frozen=True)
class Slices:
    """
    Lines through the found values, and planes for the most correlated pairs of parameters.

    :param lines: one for each of the `varied_parameters`.
    :param evaluations: number of parameter sets that were simulated.
    :param complete: False if the time was too short, so that some slices are coarse or missing.
    """

    lines: tuple[Line, ...]
    planes: tuple[Plane, ...]
    evaluations: int
    complete: bool


def simulate_slices(evaluator: Evaluator, best: Evaluation, std: Floats, examination: Examination | None, *,
        executor: Executor | None = None, seconds: float = MOST_SECONDS,
        should_stop: Callable[[], bool] = lambda: False, clock: Callable[[], float] = time.monotonic
        ) -> Slices:
    """
    Simulate slices around the found values, coarse ones first, until the time is up.

    :param best: the evaluation of the found values.
    :param std: (d,) their standard deviations in units of a search.
    :param examination: of the found values; None if there was none.
    :param executor: its workers simulate, as in `Pool`.
    :param seconds: time limit [s].
    :param should_stop: polled; once it returns True, the slices so far are returned.
    :param clock: the time [s].
    """
    end = clock() + seconds
    pool = Pool(evaluator.simulator, executor, lambda: should_stop() or clock() > end)
    grid = _Grid(BatchEvaluator(evaluator, pool), best, std)
    dimension, varied = evaluator.space.dimension, varied_parameters(evaluator.space.free, std)
    lines: tuple[Line, ...] = ()
    planes: tuple[Plane, ...] = ()
    try:
        for level in LEVELS:
            # A plane of 16 intervals would take four times as long.
            drawn = pairs(dimension, examination) if level <= 8 else []
            grid.simulate(varied, drawn, level)
            lines = tuple(grid.line(k, level) for k in varied)
            planes = tuple(grid.plane(pair, level) for pair in drawn) or planes
    except CancelledError:
        return Slices(lines, planes, grid.count, False)
    return Slices(lines, planes, grid.count, True)


def varied_parameters(names: Sequence[str], std: Floats) -> list[int]:
    """Return the indices of the paper's parameters and of the least certain others, `MOST_LINES` at most."""
    others = [k for k in np.argsort(-std, kind='stable').tolist() if names[k] not in PAPER_PARAMETERS]
    first = [k for k, name in enumerate(names) if name in PAPER_PARAMETERS]
    return sorted((first + others)[:MOST_LINES])


def pairs(dimension: int, examination: Examination | None) -> list[tuple[int, int]]:
    """Return the indices of the most correlated pair of parameters, and of a second pair above 0.5."""
    possible = list(combinations(range(dimension), 2))
    if examination is None or examination.uncertainty.correlations is None:
        return possible[:1]
    size, excited = np.abs(examination.uncertainty.correlations), examination.uncertainty.excited
    order = sorted((pair for pair in possible if excited[pair[0]] and excited[pair[1]]),
                   key=lambda pair: -float(size[pair]))
    return order[:1] + [pair for pair in order[1:2] if size[pair] >= 0.5]


class _Grid:
    """The points of the slices, each evaluated once; a slice extends 4 standard deviations to each side."""

    def __init__(self, evaluate: BatchEvaluator, best: Evaluation, std: Floats) -> None:
        self._evaluate = evaluate
        self._best = best
        upper = evaluate.evaluator.space.upper
        self._scale = SCALE / upper  # of 100 in a unit
        reach = np.maximum(4.0 * std, NARROWEST / self._scale)
        self._ends = list(zip(np.maximum(0.0, best.point - reach).tolist(),
                              np.minimum(upper, best.point + reach).tolist(), strict=True))
        self._evaluations: dict[tuple[float, ...], Evaluation] = {}
        self._names = evaluate.evaluator.space.free

    @property
    def count(self) -> int:
        """Number of simulated points."""
        return len(self._evaluations)

    def simulate(self, varied: Sequence[int], drawn: Sequence[tuple[int, int]], level: int) -> None:
        """Simulate the points of lines and planes, lines first, until the time is up."""
        changed = [{k: float(value)} for k in varied for value in self._values(k, level)]
        changed += [dict(zip(pair, map(float, values), strict=True)) for pair in drawn
                    for values in product(*(self._values(k, level) for k in pair))]
        evaluated = {tuple(self._best.point.tolist()), *self._evaluations}
        new = [point for point in dict.fromkeys(map(self._key, changed)) if point not in evaluated]
        if new:
            for point, evaluation in zip(new, self._evaluate(np.array(new), 0), strict=False):
                self._evaluations[point] = evaluation

    def line(self, k: int, level: int) -> Line:
        """Return the line of one parameter; its values include the found one."""
        values = np.unique([*self._values(k, level), self._best.point[k]])
        scores, errors = _outcomes([self._at({k: float(value)}) for value in values])
        return Line(self._names[k], frozen_array(values * self._scale[k]), frozen_array(scores),
                    frozen_array(errors))

    def plane(self, pair: tuple[int, int], level: int) -> Plane:
        """Return the plane of two parameters."""
        first, second = (self._values(k, level) for k in pair)
        evaluations = [self._at({pair[0]: float(a), pair[1]: float(b)}) for a in first for b in second]
        scores, errors = (values.reshape(len(first), len(second)) for values in _outcomes(evaluations))
        return Plane((self._names[pair[0]], self._names[pair[1]]),
                     frozen_array(np.stack([first, second]) * self._scale[list(pair), None]),
                     frozen_array(scores), frozen_array(errors))

    def _values(self, k: int, level: int) -> Floats:
        low, high = self._ends[k]
        return np.linspace(low, high, level + 1)

    def _key(self, changes: Mapping[int, float]) -> tuple[float, ...]:
        return tuple(changes.get(k, value) for k, value in enumerate(self._best.point.tolist()))

    def _at(self, changes: Mapping[int, float]) -> Evaluation:
        """
        Return the evaluation of the best point with changes.

        :raises CancelledError: if there was no time for it.
        """
        point = self._key(changes)
        if point == self._key({}):
            return self._best
        if point not in self._evaluations:
            raise CancelledError
        return self._evaluations[point]


def _outcomes(evaluations: Sequence[Evaluation]) -> Iterator[Floats]:
    """Yield the scores [cm], then the root mean square errors [m]."""
    yield np.array([evaluation.score for evaluation in evaluations])
    yield np.array([np.inf if evaluation.errors is None else evaluation.errors.rms
                    for evaluation in evaluations])
