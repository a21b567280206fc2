# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""One parameter after the other, each on the trials that excite it: what the paper plans as its next step."""

from __future__ import annotations

from typing import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.plan import Plan, PlannedSearch
from dlo_calibration.search.protocol import Hints, Observation

FIRST_POINTS = 5  # of a line, evenly spaced
REFINEMENTS = 2  # times that three points more are put beside the best
HALF_WIDTHS = (np.inf, 0.1, 0.03)  # of the line around the parameter's value, sweep by sweep
GOLDEN = (3 - np.sqrt(5)) / 2
SMALLEST_GAIN = 1e-4  # share of the cost: a parameter that lowers it by less stays where it is
DONE_CHANGE = 2e-3  # a sweep that moves no parameter further is the last


class Sequential(PlannedSearch):
    """
    Line searches along the parameters in turn, in three sweeps.

    A line search looks only at the residuals of the trials that excite its
    parameter.  It cannot follow a valley across two parameters well.

    :param dimension: number of parameters.
    :param seed: not used: nothing is random.
    :param hints: start, range and excited trials of each parameter.
    """

    name = 'sequential'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        super().__init__(dimension)
        self._hints = Hints.none(dimension) if hints is None else hints
        self._here: Observation | None = None

    @property
    def best(self) -> Floats | None:
        """The (d,) point where the line searches stand."""
        return None if self._here is None else self._here.point

    def _plan(self) -> Plan:
        hints = self._hints
        start = np.where(np.isnan(hints.start), (hints.lower + hints.upper) / 2, hints.start)
        observations = yield np.clip(start, 0.0, 1.0)[None]
        at = observations[0]
        self._here = at if at.residuals is not None else None
        for sweep, half_width in enumerate(HALF_WIDTHS, start=1):
            before = at.point
            for k in np.flatnonzero(hints.excited):
                at = yield from self._line(at, int(k), half_width)
                self._here = at if at.residuals is not None else None
            if at.residuals is None:
                return 'stopped: no point of any line could be simulated'
            change = float(np.abs(at.point - before).max())
            if change <= DONE_CHANGE:
                return (f'converged: sweep {sweep} changed no parameter by more than '
                        f'{DONE_CHANGE * 100:g} of 100')
        return f'finished {len(HALF_WIDTHS)} sweeps over the parameters'

    def _line(self, at: Observation, k: int, half_width: float
              ) -> Generator[Floats, Sequence[Observation], Observation]:
        """Return the best observation of a line through `at` along parameter k, `at` included."""
        value = float(at.point[k])
        low = max(float(self._hints.lower[k]) if np.isinf(half_width) else value - half_width, 0.0)
        high = min(float(self._hints.upper[k]) if np.isinf(half_width) else value + half_width, 1.0)
        line = [at]
        wanted = np.linspace(low, high, FIRST_POINTS if np.isinf(half_width) else 3)
        for refinement in range(REFINEMENTS + 1):
            wanted = wanted[np.abs(wanted[:, None] - [one.point[k] for one in line]).min(axis=1) > 1e-6]
            if len(wanted):
                points = np.tile(at.point, (len(wanted), 1))
                points[:, k] = wanted
                line.extend((yield points))
            if refinement < REFINEMENTS:
                line.sort(key=lambda one: float(one.point[k]))
                wanted = _between(np.array([one.point[k] for one in line]), self._costs(line, k))
        costs, cost = self._costs(line, k), self._costs([at, *line], k)[0]
        best = int(np.argmin(costs))
        return line[best] if costs[best] < (1 - SMALLEST_GAIN) * cost else at

    def _costs(self, line: Sequence[Observation], k: int) -> Floats:
        """Return the cost of each observation on the trials that excite parameter k."""
        parts = [None if one.residuals is None else one.residuals[self._rows(k, len(one.residuals))]
                 for one in line]
        losses = [Huber.of(part) for part in parts if part is not None]
        if not losses:
            return np.full(len(line), np.inf)
        loss = min(losses)
        return np.array([loss.cost(part) for part in parts])

    def _rows(self, k: int, count: int) -> NDArray[np.bool_]:
        """(count,) True for the residuals of the trials that excite parameter k; all if that is unknown."""
        if sum(self._hints.rows) != count or not self._hints.excites[:, k].any():
            return np.ones(count, dtype=np.bool_)
        return np.repeat(self._hints.excites[:, k], self._hints.rows)


def _between(values: Floats, costs: Floats) -> Floats:
    """Return where to look next beside the best of sorted `values`: parabola and golden section."""
    best = int(np.argmin(costs))
    wanted = []
    for other in (best - 1, best + 1):
        if 0 <= other < len(values):
            wanted.append(values[best] + GOLDEN * (values[other] - values[best]))
    if 0 < best < len(values) - 1 and np.isfinite(costs[best - 1:best + 2]).all():
        bend, slope, _ = np.polyfit(values[best - 1:best + 2] - values[best],
                                    costs[best - 1:best + 2] - costs[best], 2)
        if bend > 0:
            wanted.append(np.clip(values[best] - slope / (2 * bend), values[best - 1], values[best + 1]))
    return np.array(wanted)
