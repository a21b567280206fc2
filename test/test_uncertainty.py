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

"""What a calibration says about what it does not know."""

from dataclasses import dataclass

import numpy as np
import pytest

from dlo_calibration.uncertainty import spread_of_best

TRUTH = np.array([0.4, 0.7])


@dataclass(frozen=True)
class Tried:
    point: np.ndarray
    score: float


def tried(count, seed=0, weights=(1.0, 1.0, 0.0)):
    """Return random evaluations whose score grows with the distance from the truth in the weighted ones."""
    points = np.random.default_rng(seed).random((count, len(weights)))
    away = points - [*TRUTH, *[0.5] * (len(weights) - 2)]
    return [Tried(point, float(np.linalg.norm(np.multiply(weights, offset))))
            for point, offset in zip(points, away, strict=True)]


def spread(evaluations):
    best = min(evaluations, key=lambda one: one.score).point
    return best, spread_of_best(evaluations, best)


@pytest.mark.parametrize('seed', range(10))
def test_a_parameter_with_effect_is_identifiable_and_one_without_is_not(seed):
    _, found = spread(tried(150, seed))
    assert found.identifiable.tolist() == [True, True, False]
    assert (found.std[:2] < 0.15).all()
    assert found.std[2] > found.std[:2].max()


@pytest.mark.parametrize('seed', range(10))
def test_the_bounds_contain_the_best_and_what_made_the_good_ones_good(seed):
    best, found = spread(tried(150, seed))
    assert (found.lower <= best).all()
    assert (best <= found.upper).all()
    assert (found.lower[:2] <= TRUTH + 0.05).all()
    assert (found.upper[:2] >= TRUTH - 0.05).all()
    assert (found.lower >= 0).all()
    assert (found.upper <= 1).all()


@pytest.mark.parametrize('count', [1, 3, 15])
def test_from_few_evaluations_nothing_is_identifiable(count):
    _, found = spread(tried(count))
    assert not found.identifiable.any()
    assert found.lower.tolist() == [0, 0, 0]
    assert found.upper.tolist() == [1, 1, 1]
    assert found.std == pytest.approx(np.full(3, 12**-0.5))  # as of any value between 0 and 1


def test_failed_evaluations_do_not_count():
    good = tried(150)
    failed = [Tried(np.full(3, 0.99), float('inf'))] * 100
    best, found = spread(good)
    with_failed = spread_of_best(failed + good, best)
    for name in ('std', 'lower', 'upper', 'identifiable'):
        assert getattr(with_failed, name).tolist() == getattr(found, name).tolist()
    assert not spread_of_best(failed + good[:5], best).identifiable.any()
