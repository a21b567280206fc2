# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One contract for every search method, and what each promises by itself."""

import numpy as np
import pytest

from dlo_calibration.search import Observation, SEARCHES


def bowl(points):
    """Return what a smooth valley gives at points of the unit cube."""
    away = np.asarray(points) - 0.3
    return [Observation(point, float(np.linalg.norm(offset)), offset)
            for point, offset in zip(points, away, strict=True)]


def walk(name, dimension, seed, budget, limits=(1000,)):
    """Ask and tell until the budget is spent, at most `limits` at a time, in turn."""
    search = SEARCHES[name](dimension, seed)
    asked = np.zeros((0, dimension))
    turn = 0
    while len(asked) < budget:
        limit = min(limits[turn % len(limits)], budget - len(asked))
        points = search.ask(limit)
        if not len(points):
            break
        assert len(points) <= limit
        search.tell(bowl(points))
        asked = np.concatenate([asked, points])
        turn += 1
    return search, asked


@pytest.mark.parametrize('dimension', [1, 4, 7])
@pytest.mark.parametrize('name', SEARCHES)
def test_points_lie_in_the_unit_cube_and_stay_within_the_limit(name, dimension):
    search, asked = walk(name, dimension, 3, 40, limits=(1, 7, 100))
    assert asked.shape[1] == dimension
    assert 1 <= len(asked) <= 40
    assert asked.min() >= 0
    assert asked.max() <= 1
    assert isinstance(search.stop_reason, str)
    assert bool(search.stop_reason) == (len(asked) < 40)


@pytest.mark.parametrize('name', SEARCHES)
def test_the_same_seed_gives_the_same_points_bit_for_bit(name):
    first, again, other = (walk(name, 4, seed, 50)[1] for seed in (5, 5, 6))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


@pytest.mark.parametrize('name', SEARCHES)
def test_it_is_known_by_its_name(name):
    assert SEARCHES[name](2, 0).name == name


@pytest.mark.parametrize('name', SEARCHES)
def test_failed_evaluations_are_taken(name):
    search = SEARCHES[name](2, 0)
    points = search.ask(10)
    search.tell([Observation(point, float('inf'), None) for point in points])
    following = search.ask(10)
    assert following.shape[1:] == (2,)
    assert np.isfinite(following).all()


def test_random_points_do_not_depend_on_how_the_asking_is_split():
    whole = walk('random', 4, 9, 60)[1]
    split = walk('random', 4, 9, 60, limits=(1, 2, 13))[1]
    assert whole.tobytes() == split.tobytes()


def test_random_points_are_uniform_and_independent():
    points = walk('random', 4, 1, 4000)[1]
    quantiles = np.quantile(points, [0.25, 0.5, 0.75], axis=0)
    assert quantiles == pytest.approx(np.tile([[0.25], [0.5], [0.75]], (1, 4)), abs=0.04)
    assert points.var(axis=0) == pytest.approx(np.full(4, 1 / 12), rel=0.06)
    assert np.abs(np.corrcoef(points.T) - np.eye(4)).max() < 0.06


def test_the_papers_search_spends_its_budget_and_never_ends_by_itself():
    search, asked = walk('random', 4, 1, 150)
    assert len(asked) == 150
    assert search.stop_reason == ''
