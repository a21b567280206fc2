# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A tracker's stream shows from when on the DLO rests, where, and until when."""

import numpy as np
import pytest

from dlo_calibration.model.chain import Chain
from dlo_calibration.observation.rest import OPENING, Stream

STRAIGHT = np.stack([np.linspace(0, 1, 21), np.zeros(21), np.zeros(21)], axis=1)
UP = np.array([0.0, 0.0, 1.0])


def follow(place, rate=30.0, seconds=5.0, noise=1e-3, seed=1, limit=10.0):
    """Return what a stream tells of chains at heights `place(t)` [m], (21,) or one, and their instants."""
    generator, stream = np.random.default_rng(seed), Stream(0.25, 0.0005, limit)
    instants = np.arange(1 / rate, seconds, 1 / rate)
    for instant in instants:
        points = STRAIGHT + np.multiply.outer(np.broadcast_to(place(instant), 21), UP)
        stream.add(instant, Chain(points + generator.normal(0, noise, points.shape)))
    return stream.rest(), instants


def falling(instant, begin=0.0, height=0.4):
    return max(height - 4.9 * max(instant - begin, 0.0)**2, 0.0)


@pytest.mark.parametrize('rate', [5.0, 30.0, 200.0])
@pytest.mark.parametrize('noise', [0.0, 1e-3, 4e-3])
def test_a_dlo_that_lies_still_is_the_mean_of_nearly_all_chains(rate, noise):
    rest, instants = follow(lambda t: 0.0, rate=rate, noise=noise, seconds=8.0)
    assert OPENING <= instants[rest.first] < OPENING + 1 / rate + 1e-9
    assert rest.moved is None
    if noise:
        assert rest.count > 0.7 * len(instants)
        assert np.std(rest.points - STRAIGHT) == pytest.approx(noise / np.sqrt(rest.count), rel=0.4)
    else:
        np.testing.assert_allclose(rest.points, STRAIGHT, atol=1e-12)


def test_a_fall_is_no_rest():
    rest, instants = follow(falling)
    assert 0.28 < instants[rest.first] < 0.8  # it lies from 0.286 s on
    assert np.abs(rest.points - STRAIGHT).max() < 1e-3


def test_a_hand_that_opens_late_holds_no_dlo_at_rest():
    rest, instants = follow(lambda t: falling(t, begin=0.7))
    assert instants[rest.first] > 0.98
    assert np.abs(rest.points - STRAIGHT).max() < 1e-3
    assert rest.moved is None


def test_a_swing_rests_when_it_has_faded_not_where_it_turns():
    rest, instants = follow(lambda t: 0.1 * np.exp(-t) * np.cos(2 * np.pi * t / 2), seconds=9.0, limit=20.0)
    assert 2.0 < instants[rest.first] < 7
    assert np.abs(rest.points - STRAIGHT).max() < 2e-3


def test_it_rests_at_the_latest_when_a_simulation_would_not_wait_any_longer():
    def swinging(t):
        return 0.1 * np.sin(4 * t)

    assert follow(swinging, seconds=2.9, limit=3.0)[0] is None
    rest, instants = follow(swinging, seconds=9.0, limit=3.0)
    assert 3.0 <= instants[rest.first] < 3.5


def test_chains_after_it_was_moved_are_left_out():
    end = np.linspace(0, 1, 21) > 0.7
    still, _ = follow(lambda t: 0.0, seconds=6.0)
    rest, instants = follow(lambda t: 0.02 * end * (t > 3.1))
    assert 2.7 < instants[rest.moved] <= 3.2
    assert rest.count < 95
    assert np.abs(rest.points - STRAIGHT).max() < 1e-3
    assert still.moved is None


def test_a_single_wrong_chain_does_not_end_rest():
    rest, _ = follow(lambda t: 0.3 * (abs(t - 2.5) < 0.01) + 0.3 * (abs(t - 4) < 0.01), rate=100.0)
    assert rest.moved is None
    assert np.abs(rest.points - STRAIGHT).max() < 2e-3


def test_a_tracker_that_sends_each_chain_three_times_is_no_other():
    generator, stream = np.random.default_rng(1), Stream(0.25, 0.0005, 10.0)
    for k in range(100):
        chain = Chain(STRAIGHT + generator.normal(0, 1e-3, STRAIGHT.shape))
        for again in range(3):
            stream.add((3 * k + again) / 30, chain)
    assert stream.rest().first == 3
    assert 80 < stream.rest().count < 150  # of 300: a chain that is repeated has not less noise


def test_a_filtered_tracker_shows_rest_too():
    generator, stream, state = np.random.default_rng(1), Stream(0.25, 0.0005, 10.0), 0.0
    for k in range(600):
        state = 0.8 * state + 0.2 * generator.normal(0, 1.5e-3, STRAIGHT.shape)
        stream.add(k / 30, Chain(STRAIGHT + state))
    rest = stream.rest()
    assert rest.first < 30
    assert rest.moved is None
