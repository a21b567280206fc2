# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Searches that use only the scores: uniform random parameter sets (the paper's), and CMA-ES."""

from __future__ import annotations

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.search.protocol import Batches, Search

BATCH = 300  # random points; threads wait at the end of a batch, and its residuals are in memory until then
DONE_SIGMA = 1e-3  # standard deviation of new points, in units of a search, below which it has converged


class RandomSearch(Search):
    """Draw points uniformly from the box, whatever hints and results say; it never ends by itself."""

    name = 'random'

    def _batches(self) -> Batches[str]:
        generator = np.random.default_rng(self._seed)
        while True:
            yield self._upper * generator.random((BATCH, self._dimension))


class CmaEs(Search):
    """
    Minimise the score with a population whose covariance adapts (Hansen, arXiv:1604.00772).

    It is that of the library `cma`.  Only the ranking of the scores matters.  Each batch is one generation;
    `hints.start` is the first mean.
    """

    name = 'cma_es'

    def _batches(self) -> Batches[str]:
        try:
            import cma
        except ImportError as error:
            raise InputError('search cma_es', 'the Python library cma is not installed', 'that library',
                             'install it (pip install cma), or choose another search') from error
        generator = np.random.default_rng(self._seed)
        start = np.clip(self._hints.start, 0, self._upper)
        start = np.where(np.isnan(start), self._hints.spread(0.5), start)
        # A seed of cma would seed NumPy's global generator, so it gets `randn` instead.  The score has no
        # tolerance.  The first deviation is 0.25: most ranges lie within two of them from their centre.
        strategy = cma.CMAEvolutionStrategy(start, 0.25, {
            'bounds': [0, self._upper.tolist()], 'seed': np.nan, 'verbose': -9, 'tolx': DONE_SIGMA,
            'randn': lambda *shape: generator.standard_normal(shape), 'tolfun': 0, 'tolfunhist': 0,
            'maxiter': np.inf, 'maxstd': np.inf})
        while not strategy.stop():
            points = np.clip(strategy.ask(), 0.0, self._upper)
            observations = yield points
            scores = np.array([observation.score for observation in observations])
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
