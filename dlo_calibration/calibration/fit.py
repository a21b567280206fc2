# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The fit: a search within its budget, and the best evaluation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_calibration.calibration.setting import Setting
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.residuals import Huber
from dlo_calibration.inference.examination import Examination
from dlo_calibration.inference.uncertainty import noise_alone
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.search import Observation, Search
from dlo_calibration.search.least_squares import costs_less, LOWER


@dataclass(frozen=True)
class Fit:
    """
    The outcome of a search.

    :param space: the parameters that were searched.
    :param search: name of the search.
    :param best: the best evaluation by the measure of the search.
    :param evaluations: all evaluations, without residuals.
    :param ended: why the search ended, in words.
    :param stopped: whether the user stopped it.
    :param examination: around the best evaluation; None if the user stopped before.
    :param parts: how the numbers of parts and knots were chosen, in words; empty if they were given.
    :param model: linear model of the residuals at the best evaluation; None if the search made none.
    :param validated: number of parameter sets simulated to choose the numbers of parts and knots.
    :param rivals: observations that may fit as well as the best evaluation.
    """

    space: ParameterSpace
    search: str
    best: Evaluation
    evaluations: tuple[Evaluation, ...]
    ended: str
    stopped: bool = False
    examination: Examination | None = None
    parts: str = ''
    model: Linearisation | None = None
    validated: int = 0
    rivals: tuple[Observation, ...] = ()

    @property
    def stop_reason(self) -> str:
        """Why the calibration ended, in words."""
        return '; '.join(filter(None, ('stopped on request' if self.stopped else self.ended, self.parts)))

    def explained(self, level: float) -> bool:
        """Tell whether noise of this level [m] alone explains the residuals."""
        residuals = self.best.residuals
        return residuals is not None and noise_alone(
            Huber.of(residuals).deviation(residuals, self.space.dimension), level)

    def with_search(self, other: Fit) -> Fit:
        """Return the better one of this fit and a later one of the same space, with all evaluations."""
        here, there = self.best.residuals, other.best.residuals
        better = there is not None and (here is None or costs_less(there, here))
        return replace(other if better else self, evaluations=self.evaluations + other.evaluations,
                       stopped=other.stopped, parts=self.parts, validated=self.validated,
                       rivals=self.rivals + other.rivals)

    def clearly_better(self, other: Fit) -> bool:
        """Tell whether this fit costs so much less than another one of the same space that a search pays."""
        here, there = self.best.residuals, other.best.residuals
        return here is not None and (there is None or costs_less(here, there, LOWER))


def fit(setting: Setting, space: ParameterSpace, search: Search, budget: int, first: int = 0) -> Fit:
    """
    Evaluate the parameter sets that a search asks for, until it ends, its budget is spent, or it is stopped.

    The outcome does not depend on the number of threads: the search receives evaluations in the order in
    which it asked for them.

    :param budget: largest number of evaluations.
    :param first: index of the first evaluation.
    :raises SimulationError: if no evaluation could be simulated.
    """
    evaluate = setting.evaluate(space)
    evaluations: list[Evaluation] = []
    best: Evaluation | None = None
    stopped = False
    while len(evaluations) < budget and not stopped:
        points = search.ask(budget - len(evaluations))
        if not len(points):
            break
        batch: list[Evaluation] = []
        for evaluation in evaluate(points, first + len(evaluations)):
            batch.append(evaluation)
            setting.on_evaluation(evaluation)
        stopped = len(batch) < len(points)
        search.tell([Observation(evaluation.point, evaluation.score, evaluation.residuals)
                     for evaluation in batch])
        best = _better(best, batch, search)
        evaluations.extend(replace(evaluation, residuals=None) for evaluation in batch)
    if best is None:
        raise SimulationError('stopped before the first evaluation had finished')
    if not best.scores:
        raise SimulationError(f'none of {len(evaluations)} evaluations could be simulated: {best.failure}')
    spent, most = first + budget, setting.options.evaluations
    ended = search.stop_reason or (
        f'budget of {most} evaluations spent' if spent >= most else
        f'{spent} of at most {most} evaluations made, as many as this search may take')
    return Fit(space, search.name, best, tuple(evaluations), ended, stopped, model=search.model,
               rivals=search.rivals)


def _better(best: Evaluation | None, batch: list[Evaluation], search: Search) -> Evaluation | None:
    """Return the best evaluation by the measure of the search; until it has one, the lowest score counts."""
    chosen = search.best
    for evaluation in batch:
        if best is None or best.residuals is None and evaluation.score < best.score or (
                evaluation.residuals is not None and chosen is not None
                and np.array_equal(evaluation.point, chosen)):
            best = evaluation
    return best
