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

"""The noise that chains and residuals show of themselves."""

import numpy as np
import pytest
from resting import trial_of

from dlo_calibration.noise import noise, noise_of, smooth

MILLIMETRE = 1e-3


def arc(places, radius):
    angle = places / radius
    return radius * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)


def places_of(count, even, random):
    steps = np.ones(count - 1) if even else random.uniform(0.3, 1.7, count - 1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()


@pytest.mark.parametrize('count', [21, 51])
@pytest.mark.parametrize('even', [True, False])
def test_noise_on_bent_chains_is_found_within_a_tenth(count, even):
    random = np.random.default_rng(1)
    trials = []
    for _ in range(20):
        places = places_of(count, even, random)
        chains = [arc(places, radius) + random.normal(0, MILLIMETRE, (count, 3)) for radius in (0.3, -0.5)]
        trials.append(trial_of(chains[1], [(0,)], chains[0]))
    assert noise(trials) == pytest.approx(MILLIMETRE, rel=0.1)


def test_a_bend_alone_is_no_noise():
    places = np.linspace(0, 1, 31)
    assert noise([trial_of(arc(places, 0.2), [(0,)], arc(places, 0.3))]) < 0.05 * MILLIMETRE


def test_noise_does_not_depend_on_the_frame_and_follows_the_scale():
    random = np.random.default_rng(2)
    places = np.linspace(0, 1, 21)
    first, second = (arc(places, radius) + random.normal(0, MILLIMETRE, (21, 3)) for radius in (0.3, 0.4))
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    found = noise([trial_of(second, [(0,)], first)])
    assert noise([trial_of(second @ turn + 5, [(0,)], first @ turn + 5)]) == pytest.approx(found)
    assert noise([trial_of(second[::-1], [(0,)], first[::-1])]) == pytest.approx(found)
    assert noise([trial_of(3 * second, [(0,)], 3 * first)]) == pytest.approx(3 * found)


def test_one_kink_is_no_noise():
    chains = np.random.default_rng(3).normal(0, MILLIMETRE, (4, 31, 3))
    chains[0, 15] += 0.1
    assert noise_of(chains) == pytest.approx(MILLIMETRE, rel=0.15)


@pytest.mark.parametrize('count', [5, 7, 10])
def test_few_points_give_the_size_at_least(count):
    random = np.random.default_rng(4)
    found = noise_of(random.normal(0, MILLIMETRE, (40, count, 3)))
    assert found == pytest.approx(MILLIMETRE, rel=0.1)


@pytest.mark.parametrize('count', [3, 4])
def test_fewer_points_cannot_tell(count):
    chain = np.eye(4, 3)[:count]
    assert np.isnan(noise_of(chain))
    assert np.isnan(noise([trial_of(chain, [(0,)], chain)]))


def test_a_smooth_misfit_is_no_noise():
    places = np.linspace(0, 1, 31)
    misfit = 0.02 * np.stack([np.sin(2 * places), np.cos(3 * places), places**2], axis=1)
    rough = np.random.default_rng(5).normal(0, MILLIMETRE, (6, 31, 3))
    assert noise_of(misfit + rough) == pytest.approx(MILLIMETRE, rel=0.1)
    assert noise_of(misfit) < 0.01 * MILLIMETRE


def test_smoothing_comes_nearer_to_the_truth():
    places = np.linspace(0, 1, 41)
    truth = arc(places, 0.3)
    rough = truth + np.random.default_rng(6).normal(0, MILLIMETRE, truth.shape)
    assert np.std(smooth(rough, places, MILLIMETRE) - truth) < 0.6 * MILLIMETRE
    assert smooth(truth, places, 0.0) == pytest.approx(truth, abs=1e-6)
