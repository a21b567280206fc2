# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The noise level of observed chains, and its removal."""

from dataclasses import replace

import numpy as np
import pytest
from rods_at_rest import trial_of

from dlo_calibration import Action, Goal, Hand, Trial
from dlo_calibration.model.chain import Chain
from dlo_calibration.observation.noise import noise, places_along, smooth

MILLIMETRE = 1e-3


def arc(places, radius):
    angle = places / radius
    return radius * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)


def places_of(count, even, random):
    steps = np.ones(count - 1) if even else random.uniform(0.3, 1.7, count - 1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()


def noisy_arcs(count, even, radii=(0.3, -0.5)):
    """Return 20 trials whose points have a noise of 1 mm."""
    random = np.random.default_rng(1)
    trials = []
    for _ in range(20):
        places = places_of(count, even, random)
        chains = [arc(places, radius) + random.normal(0, MILLIMETRE, (count, 3)) for radius in radii]
        trials.append(trial_of(chains[1], [(0,)], chains[0]))
    return trials


@pytest.mark.parametrize('count', [21, 51])
@pytest.mark.parametrize('even', [True, False])
def test_noise_on_bent_chains_is_estimated_within_a_tenth(count, even):
    assert noise(noisy_arcs(count, even)) == pytest.approx(MILLIMETRE, rel=0.1)


def test_a_bend_alone_is_no_noise():
    places = np.linspace(0, 1, 31)
    assert noise([trial_of(arc(places, 0.2), [(0,)], arc(places, 0.3))]) < 0.05 * MILLIMETRE


def test_noise_does_not_depend_on_the_frame_and_follows_the_scale():
    random = np.random.default_rng(2)
    places = np.linspace(0, 1, 21)
    first, second = (arc(places, radius) + random.normal(0, MILLIMETRE, (21, 3)) for radius in (0.3, 0.4))
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    level = noise([trial_of(second, [(0,)], first)])
    assert noise([trial_of(second @ turn + 5, [(0,)], first @ turn + 5)]) == pytest.approx(level)
    assert noise([trial_of(second[::-1], [(0,)], first[::-1])]) == pytest.approx(level)
    assert noise([trial_of(3 * second, [(0,)], 3 * first)]) == pytest.approx(3 * level)


def test_one_kink_is_no_noise():
    trials = noisy_arcs(31, True)
    kinked = np.array(trials[0].initial.points)
    kinked[15] += 0.1
    trials[0] = trial_of(trials[0].goals[0].chain.points, [(0,)], kinked)
    assert noise(trials) == pytest.approx(MILLIMETRE, rel=0.1)


@pytest.mark.parametrize('count', [5, 7, 10])
def test_few_points_give_the_size_at_least(count):
    assert noise(noisy_arcs(count, True, (50, 50))) == pytest.approx(MILLIMETRE, rel=0.1)


@pytest.mark.parametrize('count', [3, 4])
def test_fewer_points_give_no_noise_level(count):
    chain = np.eye(4, 3)[:count]
    assert np.isnan(noise([trial_of(chain, [(0,)], chain)]))


def swinging(rate, sigma, *, frequency=0.5, seconds=4.0, rest=0.0, stable=False, seed=3):
    """Return a trial with a stream of a few markers [1/s, m]: rest [s], then a swing of 0.1 m."""
    random = np.random.default_rng(seed)
    times = np.arange(round(rate * seconds)) / rate
    along = np.linspace(0, 1, 12)
    turn = 2 * np.pi * frequency * np.maximum(times - rest, 0)[:, None]
    points = np.stack([along + 0 * turn, 0.1 * np.sin(9 * along) * np.cos(turn),
                       0.3 * along**2 + 0.1 * along * np.sin(1.7 * turn)], axis=2)
    points += random.normal(0, sigma, points.shape)
    hand = Hand('hand', (0,), [0.0, 1e-3 if stable else seconds], np.zeros((2, 3)))
    goals = [Goal(Chain(chain), time, stable) for chain, time in zip(points[1:], times[1:], strict=True)]
    return Trial('stream', Chain(points[0]), (Action((hand,)),), goals)


@pytest.mark.parametrize(('rate', 'frequency'), [(100, 0.3), (100, 3), (30, 0.3), (30, 1)])
@pytest.mark.parametrize('size', [0.05, 1.0])
def test_a_stream_shows_the_noise_of_points_with_bends_between_them(rate, frequency, size):
    level = noise([swinging(rate, size * MILLIMETRE, frequency=frequency)])
    assert level == pytest.approx(size * MILLIMETRE, rel=0.1)


def test_a_stream_of_a_dlo_at_rest_shows_the_noise_too():
    assert noise([swinging(30, 0.1 * MILLIMETRE, rest=9.0, stable=True)]) == pytest.approx(
        0.1 * MILLIMETRE, rel=0.1)


def test_motion_that_is_too_fast_for_the_stream_is_no_noise():
    slow_at_first = swinging(20, 0.1 * MILLIMETRE, frequency=4, rest=2.0)
    assert noise([slow_at_first]) == pytest.approx(0.1 * MILLIMETRE, rel=0.15)
    fast = swinging(10, MILLIMETRE, frequency=3)
    few = Trial('few', fast.initial, fast.actions, fast.goals[::4])  # too few for differences over time
    assert 0.9 * MILLIMETRE < noise([fast]) < 1.1 * noise([few])


def test_a_tracker_that_misses_frames_sends_some_twice_or_stamps_them_unevenly_shows_the_same_noise():
    random = np.random.default_rng(4)
    swing = swinging(60, 0.1 * MILLIMETRE)
    missed = Trial('m', swing.initial, swing.actions, [goal for goal in swing.goals if random.random() < 0.7])
    twice = Trial('t', swing.initial, swing.actions, [Goal(swing.goals[k - k % 3].chain, goal.time, False)
                                                      for k, goal in enumerate(swing.goals)])
    for seen in (missed, twice):
        assert noise([seen]) == pytest.approx(0.1 * MILLIMETRE, rel=0.1)


def test_trials_with_and_without_streams_count_alike():
    streams = [swinging(100, 0.1 * MILLIMETRE, seconds=0.4, seed=seed) for seed in range(20)]
    assert noise([*streams, *noisy_arcs(21, True)]) == pytest.approx(
        np.sqrt((0.01 + 1) / 2) * MILLIMETRE, rel=0.1)


def wave(places):
    """Return a bent curve in space, at places along it from 0 to about 0.6 m."""
    return np.stack([places, 0.06 * np.sin(7 * places), 0.02 * np.cos(5 * places)], axis=1)


def smoothed(truth, noise=MILLIMETRE, draws=40, believed=None):
    """Return (draws, n, 3) smoothed noisy copies."""
    random = np.random.default_rng(6)
    return np.array([smooth(truth + random.normal(0, noise, truth.shape), believed or noise)
                     for _ in range(draws)])


def size(errors):
    return np.sqrt(np.mean(np.square(errors), axis=tuple(range(errors.ndim - 1))))


@pytest.mark.parametrize(('believed', 'limit'), [(0.75, 0.8), (1.0, 0.7), (1.25, 0.7)])
@pytest.mark.parametrize('count', [21, 41])
def test_smoothing_takes_noise_away_along_the_curve_as_across_it(count, believed, limit):
    truth = wave(np.linspace(0, 0.6, count))
    truth = Chain(truth).resample(np.linspace(0, Chain(truth).length, count))
    assert (size(smoothed(truth, believed=believed * MILLIMETRE) - truth) < limit * MILLIMETRE).all()


def test_smoothing_leaves_the_length_true_that_noise_makes_longer():
    truth = Chain(wave(np.linspace(0, 0.6, 21)))
    truth = Chain(truth.resample(np.linspace(0, truth.length, 21)))
    random = np.random.default_rng(7)
    longer, errors = [], []
    for _ in range(200):
        rough = truth.points + random.normal(0, MILLIMETRE, (21, 3))
        longer.append(Chain(rough).length - truth.length)
        errors.append(Chain(smooth(rough, MILLIMETRE)).length - truth.length)
    assert np.mean(longer) > 1.0 * MILLIMETRE
    assert abs(np.mean(errors)) < 0.4 * MILLIMETRE
    assert np.std(errors) < 1.2 * np.sqrt(2) * MILLIMETRE  # that of its two ends


def test_a_straight_line_keeps_the_noise_of_a_parabola():
    # It is in three of 21 the parts, of each coordinate, that third differences do not see.
    places = np.linspace(0, 0.6, 21)
    truth = np.stack([places, 0.3 * places, 0 * places], axis=1)
    errors = np.sqrt(np.mean(np.square(smoothed(truth, draws=200) - truth)))
    least = np.sqrt(3 / 21) * MILLIMETRE
    assert 0.95 * least < errors < 1.4 * least


@pytest.mark.parametrize('count', [3, 4, 5, 13, 31])
@pytest.mark.parametrize('noise', [0.0, 1e-6])
def test_uneven_exact_points_stay_where_they_are(count, noise):
    random = np.random.default_rng(8)
    truth = wave(0.6 * places_of(count, False, random))
    assert smooth(truth, noise) == pytest.approx(truth, abs=3e-6)


def test_uneven_noisy_points_are_not_made_even_and_lose_the_noise_across_the_curve():
    places = 0.6 * places_of(21, False, np.random.default_rng(9))
    along, *across = size(smoothed(wave(places)) - wave(places))
    assert along < 1.05 * MILLIMETRE
    assert max(across) < 0.8 * MILLIMETRE


@pytest.mark.parametrize('count', [3, 4])
def test_few_points_can_be_smoothed(count):
    zigzag = np.stack([np.arange(count), np.arange(count) % 2, np.zeros(count)], axis=1) * 0.1
    assert smooth(zigzag, 1e-3) == pytest.approx(zigzag, abs=1e-4)
    assert np.isfinite(smooth(zigzag, 1.0)).all()


def test_smoothing_does_not_depend_on_the_frame_or_the_direction():
    random = np.random.default_rng(10)
    rough = wave(np.linspace(0, 0.6, 21)) + random.normal(0, MILLIMETRE, (21, 3))
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    smoothed = smooth(rough, MILLIMETRE)
    assert smooth(rough @ turn + 1, MILLIMETRE) == pytest.approx(smoothed @ turn + 1)
    assert smooth(rough[::-1], MILLIMETRE) == pytest.approx(smoothed[::-1])
    assert smooth(3 * rough, 3 * MILLIMETRE) == pytest.approx(3 * smoothed)


def test_places_are_even_where_noise_explains_that_they_are_not():
    even = np.linspace(0, 0.6, 21)
    truth = np.stack([even, 0 * even, 0 * even], axis=1)
    random = np.random.default_rng(11)
    raw, places = [], []
    for _ in range(50):
        rough = truth + random.normal(0, MILLIMETRE, truth.shape)
        steps = np.linalg.norm(np.diff(rough, axis=0), axis=1)
        raw.append(np.std(steps))
        places.append(np.std(np.diff(places_along(rough, MILLIMETRE))))
        assert places_along(rough, MILLIMETRE)[-1] == pytest.approx(steps.sum())
    assert np.mean(raw) == pytest.approx(np.sqrt(2) * MILLIMETRE, rel=0.1)
    assert np.mean(places) < 0.3 * np.mean(raw)
    uneven = np.stack([even**2, 0 * even, 0 * even], axis=1)
    assert places_along(uneven, 1e-6) == pytest.approx(even**2, rel=1e-4)
    assert places_along(uneven, 0.0).tolist() == pytest.approx((even**2).tolist(), abs=1e-15)


def hiding(trial, share):
    """Return a trial in whose goals a share of the points, at random, was not seen."""
    random = np.random.default_rng(5)

    def hidden(chain):
        points = chain.points.copy()
        points[random.choice(len(points), round(share * len(points)), replace=False)] = np.nan
        return Chain(points)

    return replace(trial, goals=tuple(replace(goal, chain=hidden(goal.chain)) for goal in trial.goals))


@pytest.mark.parametrize('share', [0.1, 0.3])
def test_points_that_were_not_seen_do_not_change_the_noise(share):
    stream = swinging(60, 0.1 * MILLIMETRE)
    assert noise([hiding(stream, share)]) == pytest.approx(0.1 * MILLIMETRE, rel=0.1)
    trials = noisy_arcs(40, True)
    assert noise([hiding(trial, share) for trial in trials]) == pytest.approx(noise(trials), rel=0.12)
