# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""CMA-ES, beyond the contract of every search."""

import sys

import numpy as np
import pytest

from dlo_calibration import InputError
from dlo_calibration.search import CmaEs, Observation

TRUTH = np.array([0.62, 0.35])


def solve(search, residuals_at, budget=300, unit=1.0):
    """Evaluate what the search asks for; return the points asked."""
    asked = []
    while len(asked) < budget:
        points = search.ask(budget - len(asked))
        if not len(points):
            break
        search.tell([Observation(p, unit * float(np.linalg.norm(residuals_at(p))), residuals_at(p))
                     for p in points])
        asked.extend(points)
    return np.array(asked)


def bowl(point):
    return np.concatenate([0.2 * (point - TRUTH), [0.001]])


@pytest.mark.parametrize('unit', [1e-6, 1e6])
def test_the_unit_of_the_score_does_not_matter(unit):
    pytest.importorskip('cma')
    usual, other = CmaEs(2, 3), CmaEs(2, 3)
    assert solve(usual, bowl).tobytes() == solve(other, bowl, unit=unit).tobytes()
    assert usual.stop_reason.startswith('converged')


def test_the_evolution_strategy_prints_nothing(capfd):
    pytest.importorskip('cma')
    solve(CmaEs(2, 3), bowl)
    assert capfd.readouterr() == ('', '')


def test_without_the_library_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'cma', None)
    with pytest.raises(InputError, match='pip install cma'):
        CmaEs(2, 3).ask(10)
