# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Slices: how the fit worsens when one or two parameters leave the found values, and the others stay."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import combinations
import time
from typing import Callable, Iterator, Sequence

import numpy as np

from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.inference.examination import Examination
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import SCALE

LEVELS = (4, 8, 16)  # intervals of a line, coarse first
FINEST_PLANE = 8  # intervals of a plane: twice as many would take four times as long
REACH = 4.0  # standard deviations that a slice goes to each side,
NARROWEST = 10.0  # but so far at least (0..100)
CORRELATED = 0.5  # from which on a second pair of parameters is looked at


@dataclass(frozen=True)
class Line:
    """
    One parameter varies.

    :param values: (k,) on the 0..100 scale.
    :param scores: (k,) difference scores [cm]; infinite where a simulation failed.
    :param errors: (k,) root mean square point errors [m]; infinite where it failed.
    """

    name: str
    values: Floats
    scores: Floats
    errors: Floats


@dataclass(frozen=True)
class Plane:
    """
    Two parameters vary: as `Line`, with (k, k) scores and errors, the first parameter along the first axis.

    :param values: (2, k) on the 0..100 scale.
    """

    names: tuple[str, str]
    values: Floats
    scores: Floats
    errors: Floats


@dataclass(frozen=True)
class Slices:
    """
    A line through what was found per parameter, and planes of the pairs that depend on each other most.

    :param evaluations: parameter sets that were simulated for them.
    :param complete: False where there was no time for all of it: slices are coarse or missing then.
    """

    lines: tuple[Line, ...]
    planes: tuple[Plane, ...]
    evaluations: int
    complete: bool


def cut(evaluator: Evaluator, best: Evaluation, std: Floats, examination: Examination | None, *,
        seconds: float, should_stop: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] = time.monotonic) -> Slices:
    """
    Simulate slices around what was found, the coarse ones first, until the time is up.

    :param best: what was found.
    :param std: (d,) its standard deviations in the unit cube.
    :param examination: of it; None where there was none.
    :param seconds: that it may take.
    :param should_stop: asked between trials; once True, what is there is returned.
    """
    end = clock() + seconds
    cutter = _Cutter(evaluator, best, std, lambda: should_stop() or clock() > end)
    dimension = evaluator.space.dimension
    lines: tuple[Line, ...] = ()
    planes: tuple[Plane, ...] = ()
    try:
        for level in LEVELS:
            lines = tuple(cutter.line(k, level) for k in range(dimension))
            if level <= FINEST_PLANE:
                planes = tuple(cutter.plane(pair, level) for pair in pairs(dimension, examination))
    except CancelledError:
        return Slices(lines, planes, cutter.count, False)
    return Slices(lines, planes, cutter.count, True)


def seconds_for(calibration: float) -> float:
    """Return how long slices may take [s], by how long the calibration took: a fifth, 5 to 60 s."""
    return min(max(5.0, 0.2 * calibration), 60.0)


def pairs(dimension: int, examination: Examination | None) -> list[tuple[int, int]]:
    """Return the indices of a pair or two of parameters, those that depend on each other most."""
    possible = list(combinations(range(dimension), 2))
    if examination is None or examination.uncertainty.correlations is None:
        return possible[:1]
    size, excited = np.abs(examination.uncertainty.correlations), examination.uncertainty.excited
    order = sorted((pair for pair in possible if excited[pair[0]] and excited[pair[1]]),
                   key=lambda pair: -float(size[pair]))
    return order[:1] + [pair for pair in order[1:2] if size[pair] >= CORRELATED]


class _Cutter:
    """Evaluates points of slices, each once."""

    def __init__(self, evaluator: Evaluator, best: Evaluation, std: Floats, late: Callable[[], bool]) -> None:
        self._evaluator, self._late = evaluator, late
        self._best = best
        reach = np.maximum(REACH * std, NARROWEST / SCALE)
        self._ends = [(max(0.0, value - one), min(1.0, value + one))
                      for value, one in zip(best.point.tolist(), reach.tolist(), strict=True)]
        self._seen: dict[tuple[float, ...], Evaluation] = {}
        self._names = evaluator.space.free

    @property
    def count(self) -> int:
        """How many were simulated."""
        return len(self._seen)

    def line(self, k: int, level: int) -> Line:
        """Vary one parameter; the found value is among its values."""
        values = np.unique([*self._grid(k, level), self._best.point[k]])
        found = [self._at({k: float(value)}) for value in values]
        scores, errors = _outcomes(found)
        return Line(self._names[k], frozen_array(values * SCALE), frozen_array(scores), frozen_array(errors))

    def plane(self, pair: tuple[int, int], level: int) -> Plane:
        """Vary two parameters."""
        one, two = (self._grid(k, level) for k in pair)
        found = [self._at({pair[0]: float(a), pair[1]: float(b)}) for a in one for b in two]
        scores, errors = (values.reshape(len(one), len(two)) for values in _outcomes(found))
        return Plane((self._names[pair[0]], self._names[pair[1]]), frozen_array(np.stack([one, two]) * SCALE),
                     frozen_array(scores), frozen_array(errors))

    def _grid(self, k: int, level: int) -> Floats:
        low, high = self._ends[k]
        return np.linspace(low, high, level + 1)

    def _at(self, changes: dict[int, float]) -> Evaluation:
        point = self._best.point.copy()
        for k, value in changes.items():
            point[k] = value
        if np.array_equal(point, self._best.point):
            return self._best
        key = tuple(point.tolist())
        if key not in self._seen:
            if self._late():
                raise CancelledError
            self._seen[key] = self._evaluator.evaluate(0, point, self._late)
        return self._seen[key]


def _outcomes(found: Sequence[Evaluation]) -> Iterator[Floats]:
    """Give the scores [cm] and the root mean square errors [m]."""
    yield np.array([one.score for one in found])
    yield np.array([np.inf if one.errors is None else one.errors.rms for one in found])
