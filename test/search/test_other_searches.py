# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the evolution strategy and the line searches promise by themselves."""

import sys

import numpy as np
import pytest

from dlo_calibration import InputError
from dlo_calibration.search import CmaEs, Hints, Observation, Sequential

TRUTH = np.array([0.62, 0.35])


def solve(search, residuals_at, budget=300, unit=1.0):
    """Tell the search what it asks for; return the points asked."""
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
def test_the_evolution_strategy_does_not_care_for_the_unit_of_the_score(unit):
    pytest.importorskip('cma')
    one, other = CmaEs(2, 3), CmaEs(2, 3)
    assert solve(one, bowl).tobytes() == solve(other, bowl, unit=unit).tobytes()
    assert one.stop_reason.startswith('converged')


def test_the_evolution_strategy_prints_nothing(capfd):
    pytest.importorskip('cma')
    solve(CmaEs(2, 3), bowl)
    assert capfd.readouterr() == ('', '')


def test_without_the_library_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'cma', None)
    with pytest.raises(InputError, match='pip install cma'):
        CmaEs(2, 3).ask(10)


def test_line_searches_move_one_parameter_at_a_time():
    search = Sequential(2, 0)
    lines = []
    while len(points := search.ask(100)):
        search.tell([Observation(p, float(np.linalg.norm(bowl(p))), bowl(p)) for p in points])
        if len(points) > 1:
            moved = np.ptp(points, axis=0) > 0
            assert moved.sum() == 1
            lines.append(int(moved.argmax()))
    assert lines[0] == 0
    assert set(lines) == {0, 1}
    assert lines[:6] == sorted(lines[:6])


def test_line_searches_look_only_at_the_trials_that_excite_the_parameter():
    def residuals(point):  # the second trial misleads about the first parameter, and the other way round
        return np.array([point[0] - 0.62, point[1] - 0.9, point[0] - 0.1, point[1] - 0.35])

    hints = Hints([np.nan] * 2, [0, 0], [1, 1], (1, 1, 1, 1),
                  [[True, False], [False, False], [False, False], [False, True]])
    search = Sequential(2, 0, hints)
    solve(search, residuals)
    assert search.best == pytest.approx(TRUTH, abs=0.005)


def test_line_searches_leave_what_nothing_excites_and_keep_to_the_range_at_first():
    hints = Hints([np.nan, 0.77], [0.4, 0], [0.8, 1], (3,), [[True, False]])
    search = Sequential(2, 0, hints)
    asked = solve(search, bowl)
    assert (asked[:, 1] == 0.77).all()
    assert asked[:6, 0].min() >= 0.4
    assert asked[:6, 0].max() <= 0.8
    assert search.best[0] == pytest.approx(TRUTH[0], abs=0.005)
