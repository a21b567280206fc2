# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""CMA-ES (covariance matrix adaptation evolution strategy) of the library `cma`; it uses only the score."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.plan import Plan, PlannedSearch
from dlo_calibration.search.protocol import Hints, Observation

DONE_SIGMA = 1e-3  # standard deviation of new points, in the unit cube, below which it has converged


class CmaEs(PlannedSearch):
    """
    Minimise the score with a population whose covariance adapts (Hansen, arXiv:1604.00772).

    Only the ranking of the scores matters.  Each batch is one generation.

    :param dimension: number of parameters.
    :param seed: of the `numpy.random.Generator`.
    :param hints: `hints.start` is the first mean of the population.
    """

    name = 'cma_es'

    def __init__(self, dimension: int, seed: int, hints: Hints | None = None) -> None:
        super().__init__(dimension)
        self._seed = seed
        self._hints = Hints.none(dimension) if hints is None else hints
        self._lowest: Observation | None = None

    @property
    def best(self) -> Floats | None:
        """The (d,) point of lowest score."""
        return None if self._lowest is None else self._lowest.point

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`."""
        for one in observations:
            if np.isfinite(one.score) and (self._lowest is None or one.score < self._lowest.score):
                self._lowest = one
        super().tell(observations)

    def _plan(self) -> Plan:
        try:
            import cma
        except ImportError as error:
            raise InputError('search cma_es', 'the Python library cma is not installed', 'that library',
                             'install it (pip install cma), or choose another search') from error
        generator = np.random.default_rng(self._seed)
        start = np.where(np.isnan(self._hints.start), 0.5, np.clip(self._hints.start, 0, 1))
        # A seed of cma would seed NumPy's global generator, so it gets `randn` instead.  The score has no
        # tolerance.  The first deviation is 0.25: the whole range lies within two of them from its centre.
        strategy = cma.CMAEvolutionStrategy(start, 0.25, {
            'bounds': [0, 1], 'seed': np.nan, 'randn': lambda *shape: generator.standard_normal(shape),
            'verbose': -9, 'tolx': DONE_SIGMA, 'tolfun': 0, 'tolfunhist': 0, 'maxiter': np.inf,
            'maxstd': np.inf})
        while not strategy.stop():
            points = np.clip(strategy.ask(), 0.0, 1.0)
            observations = yield points
            scores = np.array([one.score for one in observations])
            good = np.isfinite(scores)
            if not good.any():
                continue  # all failed: ask for another sample of the same distribution
            scores[~good] = 2 * np.abs(scores[good]).max() + 1  # failed points rank last
            strategy.tell(list(points), scores.tolist())
        if 'tolx' in strategy.stop():
            return f'converged: new points differ by less than {DONE_SIGMA * 100:g} of 100'
        if 'tolflatfitness' in strategy.stop():
            return 'stopped: the scores no longer differ'
        return f'stopped: {", ".join(sorted(strategy.stop()))}'
