# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rest lengths: which trials share them, and how true they are."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.observation import with_shared_places
from dlo_calibration.observation.material import VIEWS

PLACES = np.array([0.0, 0.03, 0.12, 0.2, 0.31, 0.4, 0.5, 0.58, 0.66, 0.77, 0.85, 0.95, 1.0])  # m
TIMES = np.arange(61) / 30


def waving(seed, places=PLACES, noise=1e-4, stable=False, strength=1.5):
    """Return a trial in which a DLO that does not stretch waves between two clamps, with markers on it."""
    random = np.random.default_rng(seed)
    fine = np.linspace(0, 1, 401)
    waves = random.normal(0, strength, (5, 2)) / np.arange(1, 6)[:, None]
    turns = np.array([sum(wave[0] * np.sin(k * np.pi * fine + wave[1] * k + 2 * time)
                          for k, wave in enumerate(waves, start=1)) for time in TIMES])
    tangents = np.stack([np.cos(turns), 0.8 * np.sin(turns), 0.6 * np.sin(turns)], axis=2)
    curves = np.cumsum((tangents[:, 1:] + tangents[:, :-1]) / 2, axis=1) * fine[1]
    curves = np.concatenate([np.zeros((len(TIMES), 1, 3)), curves], axis=1)
    points = curves[:, np.round(places * 400).astype(int)]
    points = points + random.normal(0, noise, points.shape)
    end = 1e-3 if stable else TIMES[-1]
    last = len(places) - 1
    hands = [Hand(name, grips, [0.0, end], np.zeros((2, 3)))
             for name, grips in (('left', (0, 1)), ('right', (last - 1, last)))]
    goals = [Goal(Chain(chain), time, stable, ('left', 'right'))
             for chain, time in zip(points[1:], TIMES[1:], strict=True)]
    return Trial(f'trial {seed}', Chain(points[0]), (Action(hands),), goals)


def segments(trial):
    return np.diff(trial.initial.arc_lengths() if trial.places is None else trial.places)


def error(trial):
    return np.sqrt(np.mean((segments(trial) - np.diff(PLACES))[1:-1]**2))  # without the clamps


def test_trials_with_the_same_markers_share_more_accurate_arc_lengths():
    trials = [waving(seed) for seed in range(6)]
    shared = with_shared_places(trials)
    for trial in shared[1:]:
        assert segments(trial)[1:-1] == pytest.approx(segments(shared[0])[1:-1], abs=1e-12)
    chain_error, stream_error = (np.sqrt(np.mean([error(trial)**2 for trial in some]))
                                 for some in (trials, [with_shared_places([trial])[0] for trial in trials]))
    assert error(shared[0]) < 0.8 * stream_error < 0.6 * chain_error


def test_a_segment_in_a_clamp_keeps_the_distance_that_was_measured():
    for trial in with_shared_places([waving(seed) for seed in range(3)]):
        measured = np.linalg.norm(np.diff(trial.initial.points, axis=0), axis=1)
        assert segments(trial)[[0, -1]] == pytest.approx(measured[[0, -1]], abs=1e-12)


def test_trials_whose_points_lie_elsewhere_share_nothing():
    moved = PLACES + np.where(np.arange(13) == 6, 0.04, 0.0)
    other = waving(9, places=moved)
    trials = [*(waving(seed) for seed in range(4)), other]
    shared = with_shared_places(trials)
    alone, = with_shared_places([other])
    np.testing.assert_array_equal(shared[-1].places, alone.places)
    for trial, before in zip(shared[:-1], with_shared_places(trials[:-1]), strict=True):
        np.testing.assert_array_equal(trial.places, before.places)
    more = waving(10, places=np.delete(PLACES, 5))
    assert len(with_shared_places([*trials, more])[-1].places) == 12


def test_photographs_share_nothing():
    # Whoever clicks points evenly gets the same number of points and similar lengths, but other points.
    still = [waving(seed, stable=True) for seed in range(3)]
    few = [replace(waving(seed), goals=waving(seed).goals[:VIEWS - 1]) for seed in range(3)]
    assert all(trial.places is None for trial in with_shared_places([*still, *few]))


def test_shared_arc_lengths_stay_and_their_cost_does_not_grow_with_the_stream():
    shared = with_shared_places([waving(seed) for seed in range(3)])
    again = with_shared_places(shared[:2])
    assert again[0] is shared[0] and again[1] is shared[1]
    assert VIEWS < len(TIMES)


def test_noise_does_not_make_the_shared_lengths_longer():
    rough = with_shared_places([waving(seed, noise=2e-3, strength=0.5) for seed in range(6)])
    longer = np.mean([segments(waving(seed, noise=2e-3, strength=0.5)).sum() for seed in range(6)]) - 1
    assert longer > 1e-3
    assert abs(segments(rough[0]).sum() - 1) < 0.5 * longer


def test_a_calibration_uses_the_shared_lengths():
    trials = [waving(seed) for seed in range(2)]
    with closing(make_simulator(Options.of({'engine': 'compiled'}))) as simulator:
        used = Setting(trials, Options(), simulator).trials
    assert segments(used[1])[1:-1] == pytest.approx(segments(used[0])[1:-1], abs=1e-12)
    assert used[0].places.tolist() == with_shared_places(trials)[0].places.tolist()


def test_points_that_were_not_seen_do_not_spoil_the_lengths():
    random = np.random.default_rng(0)

    def hidden(chain):
        points = chain.points.copy()
        points[random.random(len(points)) < 0.1] = np.nan
        return Chain(points)

    trials = [waving(seed) for seed in range(3)]
    some = [replace(trial, goals=tuple(replace(goal, chain=hidden(goal.chain)) for goal in trial.goals))
            for trial in trials]
    assert error(with_shared_places(some)[0]) < 1.3 * error(with_shared_places(trials)[0])
