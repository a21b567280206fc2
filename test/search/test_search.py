# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""One contract for every search method, and the properties of the paper's."""

from importlib.util import find_spec

import numpy as np
import pytest

from dlo_calibration.search import Hints, Observation, SEARCHES

NAMES = [pytest.param(name, marks=pytest.mark.skipif(
    name == 'cma_es' and find_spec('cma') is None, reason='the library cma is not installed'))
    for name in SEARCHES]
MEASURED = [name for name in NAMES if name.values != ('random',)]  # those that use the observations


class Problem:
    """
    Residuals in a curved valley of the box; parameters listed in `flat` have no effect.

    :param fails: every evaluation fails.
    """

    def __init__(self, dimension, flat=(), fails=False, fails_below=-1.0):
        generator = np.random.default_rng(dimension)
        self.truth = generator.uniform(0.25, 0.75, dimension)
        self.lean, self.bend = generator.normal(size=(2, 40, dimension))
        self.noise = generator.normal(scale=0.001, size=40)
        self.moves = np.isin(np.arange(dimension), flat, invert=True)
        self.fails, self.fails_below = fails, fails_below

    def observe(self, point):
        if self.fails or point[0] < self.fails_below:
            return Observation(point, float('inf'), None)
        away = (point - self.truth) * self.moves
        residuals = 0.1 * (self.lean @ away + 0.5 * np.sin(2 * self.bend @ away)) + self.noise
        return Observation(point, float(np.linalg.norm(residuals)), residuals)


def walk(name, dimension, seed, budget, limits=(1000,), problem=None, hints=None):
    """Ask and tell until the budget is spent, at most `limits` at a time, in turn."""
    problem = problem or Problem(dimension)
    search = SEARCHES[name](dimension, seed, hints)
    asked = np.zeros((0, dimension))
    turn = 0
    while len(asked) < budget:
        limit = min(limits[turn % len(limits)], budget - len(asked))
        points = search.ask(limit)
        if not len(points):
            break
        assert len(points) <= limit
        search.tell([problem.observe(point) for point in points])
        asked = np.concatenate([asked, points])
        turn += 1
    return search, asked


@pytest.mark.parametrize('dimension', [1, 2, 4, 8])
@pytest.mark.parametrize('name', NAMES)
def test_points_lie_in_the_unit_cube_and_stay_within_the_limit(name, dimension):
    search, asked = walk(name, dimension, 3, 60, limits=(1, 7, 100))
    assert asked.shape[1] == dimension
    assert 1 <= len(asked) <= 60
    assert asked.min() >= 0
    assert asked.max() <= 1
    assert isinstance(search.stop_reason, str)
    assert search.stop_reason or len(asked) == 60


@pytest.mark.parametrize('name', NAMES)
def test_it_has_a_result_after_the_smallest_budgets(name):
    for budget in range(1, 6):
        search, asked = walk(name, 3, 1, budget)
        assert len(asked) == budget
        assert (search.best == asked).all(axis=1).any()


@pytest.mark.parametrize('name', NAMES)
def test_the_same_seed_gives_the_same_points_bit_for_bit(name):
    np.random.seed(0)
    first = walk(name, 4, 5, 50)[1]
    np.random.seed(1)
    assert first.tobytes() == walk(name, 4, 5, 50)[1].tobytes()


@pytest.mark.parametrize('name', NAMES)
def test_another_seed_gives_other_points(name):
    assert walk(name, 4, 5, 50)[1].tobytes() != walk(name, 4, 6, 50)[1].tobytes()


@pytest.mark.parametrize('name', NAMES)
def test_numpys_shared_random_numbers_are_not_used(name):
    np.random.seed(3)
    wanted = np.random.random()
    np.random.seed(3)
    walk(name, 2, 5, 30)
    assert np.random.random() == wanted


@pytest.mark.parametrize('name', NAMES)
def test_points_do_not_depend_on_the_limits_of_ask(name):
    whole = walk(name, 4, 9, 60)
    split = walk(name, 4, 9, 60, limits=(1, 2, 13))
    assert whole[1].tobytes() == split[1].tobytes()
    assert (whole[0].best == split[0].best).all()
    assert whole[0].stop_reason == split[0].stop_reason


@pytest.mark.parametrize('name', NAMES)
def test_a_new_search_has_its_name_and_no_result(name):
    search = SEARCHES[name](2, 0)
    assert (search.name, search.best, search.stop_reason) == (name, None, '')


@pytest.mark.parametrize('name', NAMES)
def test_a_search_continues_elsewhere_if_all_its_points_fail(name):
    search, asked = walk(name, 2, 0, 40, problem=Problem(2, fails=True))
    assert np.isfinite(asked).all()
    assert len(np.unique(asked, axis=0)) == len(asked) > 10
    assert search.best is None


@pytest.mark.parametrize('name', MEASURED)
def test_a_search_avoids_failures_and_reaches_the_optimum_beside_them(name):
    problem = Problem(2)
    problem.fails_below = problem.truth[0] - 0.01
    search = walk(name, 2, 1, 150, problem=problem)[0]
    assert search.best == pytest.approx(problem.truth, abs=0.01)


@pytest.mark.parametrize('dimension', [1, 2, 3])
@pytest.mark.parametrize('name', MEASURED)
def test_the_optimum_of_a_curved_valley_is_reached(name, dimension):
    problem = Problem(dimension)
    for seed in range(3):
        search, asked = walk(name, dimension, seed, 300, problem=problem)
        assert search.best == pytest.approx(problem.truth, abs=0.01)
        assert search.stop_reason
        assert len(asked) < 300
        assert search.ask(10).shape == (0, dimension)


@pytest.mark.parametrize('name', MEASURED)
def test_a_parameter_without_effect_does_not_disturb_the_others(name):
    problem = Problem(3, flat=(1,))
    search = walk(name, 3, 1, 300, problem=problem)[0]
    assert search.best[[0, 2]] == pytest.approx(problem.truth[[0, 2]], abs=0.01)


@pytest.mark.parametrize('name', MEASURED)
def test_a_search_ends_if_no_parameter_has_an_effect(name):
    search, asked = walk(name, 2, 1, 300, problem=Problem(2, flat=(0, 1)))
    assert search.stop_reason
    assert len(asked) < 100


@pytest.mark.parametrize('name', MEASURED)
def test_a_search_begins_at_a_hint(name):
    hints = Hints([0.7, np.nan], [True, True])
    asked = walk(name, 2, 1, 20, hints=hints)[1]
    assert np.abs(asked[:6, 0] - 0.7).min() < 0.35
    again = walk(name, 2, 1, 20)[1]
    assert asked.tobytes() != again.tobytes()


@pytest.mark.parametrize('name', NAMES)
def test_empty_hints_change_nothing(name):
    assert walk(name, 3, 1, 30)[1].tobytes() == walk(name, 3, 1, 30, hints=Hints.none(3))[1].tobytes()



def test_random_points_are_uniform_and_independent():
    points = walk('random', 4, 1, 4000)[1]
    quantiles = np.quantile(points, [0.25, 0.5, 0.75], axis=0)
    assert quantiles == pytest.approx(np.tile([[0.25], [0.5], [0.75]], (1, 4)), abs=0.04)
    assert points.var(axis=0) == pytest.approx(np.full(4, 1 / 12), rel=0.06)
    assert np.abs(np.corrcoef(points.T) - np.eye(4)).max() < 0.06


def test_the_search_of_the_paper_spends_its_whole_budget():
    search, asked = walk('random', 4, 1, 150)
    assert len(asked) == 150
    assert search.stop_reason == ''
