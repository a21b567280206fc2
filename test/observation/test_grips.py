# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What chains alone show of the hands: late stamps, shifted hands, and hands that have lost the DLO."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.grips import GripEvidence

COUNT, LENGTH, RATE = 21, 0.6, 30.0
ALONG = np.linspace(0.0, LENGTH, COUNT)
WAYS = {0.0: (0.2, 0.1, 0.05), 0.5: (-0.1, 0.2, 0.0), 1.0: (0.05, -0.25, 0.05), 0.25: (0.15, 0.15, 0.1)}
SIGMA = 0.7e-3  # m


def headed(points, heading):
    """Return points (..., 3) turned about z."""
    c, s = np.cos(heading), np.sin(heading)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def path(place, way, turn=0.0):
    """Return the path of a real hand: it closes at 0.3 s, and moves from 0.6 s to 1.8 s."""
    times = np.array([0.3, 0.6, 1.8, 2.1])
    share = np.array([0.0, 0.0, 1.0, 1.0])[:, None]
    start = np.array([place * LENGTH, 0.03 * np.sin(6 * place), 0.0])
    half = turn * share[:, 0] / 2
    turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return times, start + share * np.array(way), turns


def chains(at, hands, lost=np.inf, rigid=0.0):
    """
    Return chains, (t, n, 3): each hand, of (place, path), moves the points beside it until it is lost.

    :param rigid: [m] to both sides of the hand, which move as one piece.
    """
    start = np.stack([ALONG, 0.03 * np.sin(6 * ALONG / LENGTH), 0 * ALONG], axis=1)
    points = np.repeat(start[None], len(at), axis=0)
    for place, (times, positions, turns) in hands:
        share = np.exp(-np.maximum(np.abs(ALONG - place * LENGTH) - rigid, 0.0) / 0.06)
        for k, time in enumerate(np.minimum(at, lost)):
            here = np.stack([np.interp(time, times, axis) for axis in positions.T])
            angle = 2 * np.interp(time, times, np.arcsin(turns[:, 2]))
            moved = here + headed(start - positions[0], angle)
            points[k] += share[:, None] * (moved - start)
    return points


def trial(name='trial 1', places=(0.25,), *, late=0.0, shift=(0, 0, 0), lost=np.inf, missed=False, turn=0.0,
          nearest=True, grips=None, sigma=SIGMA, seed=0, hidden=0.0,
          heading=0.0):
    """Return a trial that a tracker observes; `late` are the stamps of its hands, `shift` is their error."""
    generator = np.random.default_rng(seed)
    real = [(place, path(place, WAYS[place], turn)) for place in places]
    at = np.arange(1, round(3.0 * RATE)) / RATE
    seen = headed(chains(at, real, -1.0 if missed else lost, 0.03 * bool(turn)), heading)
    seen = seen + generator.normal(0, sigma, seen.shape)
    first = headed(chains(np.zeros(1), real)[0], heading) + generator.normal(0, sigma, (COUNT, 3))
    hands = []
    for k, (_, (times, positions, turns)) in enumerate(real):
        where = headed(positions, heading) + np.array(shift)
        point, offset, _ = Chain(first).nearest(where[0])
        hands.append(Hand(f'hand_{k}', (point,) if grips is None else grips, times + late, where, turns,
                          offset if grips is None else 0.0, nearest and grips is None))
    end = max(hand.end for hand in hands)
    goals = []
    for time, points in zip(at.tolist(), seen, strict=True):
        missing = generator.random(COUNT) < hidden
        points = np.where(missing[:, None], np.nan, points)
        if missing.sum() < COUNT // 2:
            goals.append(Goal(Chain(points), time, stable=False))
    timed = [goal for goal in goals if goal.time <= end]
    return Trial(name, Chain(first), (Action(tuple(hands)),), (*timed, Goal(Chain(seen[-1]), 3.0)))


def trials(**changes):
    """Return a trial for each of the WAYS, in which the DLO lies in another direction."""
    return [trial(f'trial {k}', (place,), seed=k, heading=1.2 * k, **changes)
            for k, place in enumerate(WAYS, start=1)]


def test_nothing_is_reported_of_hands_that_are_right():
    evidence = GripEvidence.of(trials())
    assert evidence.errors == {}
    assert evidence.losses == ()
    assert evidence.words(evidence.errors) == ''
    assert abs(float(evidence.delay.value)) < 3 * float(evidence.delay.std) + 0.005
    assert np.abs(evidence.shift.value).max() < 0.004
    assert evidence.usable(some := trials()) == tuple(some)


@pytest.mark.parametrize('late', [-0.16, -0.04, 0.04, 0.16])
def test_late_and_early_stamps_come_back_with_their_sign(late):
    evidence = GripEvidence.of(trials(late=late))
    assert evidence.errors.keys() == {'hand_delay'}
    assert evidence.errors['hand_delay'] == pytest.approx(late, abs=0.005)
    assert f'{"late" if late > 0 else "early"}' in evidence.words(evidence.errors)
    assert evidence.losses == ()


@pytest.mark.parametrize('shift', [(0.015, 0, 0), (0, -0.015, 0), (-0.01, 0.01, 0)])
def test_shifted_hands_come_back_with_their_signs(shift):
    evidence = GripEvidence.of(trials(shift=shift))
    assert {'hand_shift_x', 'hand_shift_y'} <= evidence.errors.keys()
    assert 'hand_delay' not in evidence.errors
    assert evidence.shift.value == pytest.approx(shift, abs=0.003)
    assert 'off in' in evidence.words(evidence.errors)
    assert evidence.losses == ()


def test_late_and_shifted_hands_are_distinguished():
    evidence = GripEvidence.of(trials(late=0.08, shift=(0.012, 0.0, 0.0)))
    assert evidence.errors['hand_delay'] == pytest.approx(0.08, abs=0.005)
    assert evidence.shift.value == pytest.approx((0.012, 0, 0), abs=0.003)


def test_annotated_pins_do_not_show_a_shift():
    some = [replace(pinned, actions=tuple(Action(tuple(replace(hand, nearest=False) for hand in action.hands))
                                          for action in pinned.actions))
            for pinned in trials(shift=(0.015, 0, 0))]
    assert GripEvidence.of(some).errors == {}


def test_a_hand_that_missed_is_named_and_its_trial_is_not_used():
    some = trials()
    some[1] = trial('trial 2', (0.5,), missed=True, heading=2.4)
    evidence = GripEvidence.of(some)
    loss, = evidence.losses
    assert (loss.trial, loss.hand, loss.missed) == ('trial 2', 'hand_0', True)
    assert 'hand_0 has missed the DLO' in str(loss) and 'repeat the trial' in str(loss)
    assert [remaining.name for remaining in evidence.usable(some)] == ['trial 1', 'trial 3', 'trial 4']
    assert evidence.errors == {}


def test_a_slipped_dlo_is_used_until_it_slipped():
    some = trials()
    some[2] = trial('trial 3', (1.0,), lost=1.2, seed=9, heading=3.6)
    evidence = GripEvidence.of(some)
    loss, = evidence.losses
    assert (loss.trial, loss.missed) == ('trial 3', False)
    assert loss.time == pytest.approx(1.2, abs=0.15)
    assert f'slipped from {loss.hand}' in str(loss)
    used = {remaining.name: remaining for remaining in evidence.usable(some)}
    assert used['trial 1'] is some[0]
    assert 10 < len(used['trial 3'].goals) < len(some[2].goals)
    assert used['trial 3'].goals[-1].time <= loss.time


def test_noise_is_neither_a_loss_nor_an_error():
    for seed in range(3):
        some = [replace(original, name=f'trial {k}') for k, original in enumerate(
            (trial(places=(place,), sigma=4e-3, seed=10 * seed + k) for k, place in enumerate(WAYS)))]
        evidence = GripEvidence.of(some)
        assert evidence.losses == ()
        assert evidence.errors == {}


def test_unseen_points_hide_nothing_and_add_nothing():
    some = trials(hidden=0.3)
    assert GripEvidence.of(some).errors == {}
    assert GripEvidence.of(some).losses == ()
    late = GripEvidence.of(trials(hidden=0.3, late=0.08))
    assert late.errors['hand_delay'] == pytest.approx(0.08, abs=0.006)
    missed = trial('trial 2', (0.5,), missed=True, hidden=0.3, heading=2.4)
    assert [loss.missed for loss in GripEvidence.of([*some[:1], missed]).losses] == [True]


def test_a_clamp_that_turns_is_followed_in_its_own_frame():
    right = trial(places=(0.5,), turn=1.0, grips=(9, 10, 11))
    assert GripEvidence.of([right]).losses == ()
    assert GripEvidence.of([right]).errors == {}
    late = trial(places=(0.5,), turn=1.0, grips=(9, 10, 11), late=0.08)
    assert GripEvidence.of([late]).errors['hand_delay'] == pytest.approx(0.08, abs=0.006)
    lost = trial(places=(0.5,), turn=1.0, grips=(9, 10, 11), lost=1.2)
    assert [loss.missed for loss in GripEvidence.of([lost]).losses] == [False]


def photograph(missed=False, seed=0):
    """Return a trial of two photographs, annotated."""
    full = trial(places=(0.5,), grips=(10,), seed=seed)
    last = full.initial.points + np.random.default_rng(seed).normal(0, 1e-3, (COUNT, 3)) if missed \
        else full.goals[-1].chain.points
    return replace(full, name=f'photograph {seed}', goals=(Goal(Chain(last), 3.0),))


def test_photographs_show_a_hand_that_missed():
    some = [photograph(), photograph(missed=True, seed=1)]
    evidence = GripEvidence.of(some)
    loss, = evidence.losses
    assert (loss.trial, loss.missed) == ('photograph 1', True)
    assert evidence.usable(some) == (some[0],)
    assert evidence.delay is None and evidence.errors == {}


def test_of_two_hands_only_the_one_that_lost_the_dlo_is_named():
    both = trial(places=(0.0, 1.0))
    assert GripEvidence.of([both]).losses == ()
    missing = chains(np.array([goal.time for goal in both.goals]), [(0.0, path(0.0, WAYS[0.0]))])
    lost = replace(both, goals=tuple(replace(goal, chain=Chain(points)) for goal, points in zip(
        both.goals, missing + np.random.default_rng(3).normal(0, SIGMA, missing.shape), strict=True)))
    assert [loss.hand for loss in GripEvidence.of([lost]).losses] == ['hand_1']


def test_a_trial_from_the_other_end_says_nothing_of_its_hands():
    some = trials()
    some[1] = replace(some[1], goals=tuple(
        replace(goal, chain=Chain(goal.chain.points[::-1])) for goal in some[1].goals))
    evidence = GripEvidence.of(some)
    assert evidence.losses == () and evidence.errors == {}


def test_without_trials_or_views_nothing_is_known():
    assert GripEvidence.of([]) == GripEvidence(None, None, ())
    whole = trial()
    after = replace(whole, goals=tuple(
        replace(whole.goals[-1], time=whole.hands[0].end + k / 30, stable=False) for k in range(1, 9)))
    assert GripEvidence.of([after]).losses == ()


def test_a_hand_that_hides_what_it_grips_has_not_lost_it():
    some = []
    for original in trials():
        grip = original.hands[0].grips[0]
        hidden = slice(max(grip - 1, 0), grip + 2)

        def seen(goal, hidden=hidden):
            points = np.array(goal.chain.points)
            points[hidden] = np.nan
            return replace(goal, chain=Chain(points))

        some.append(replace(original, goals=tuple(map(seen, original.goals))))
    assert GripEvidence.of(some).losses == ()


def test_a_hand_that_hides_what_it_grips_shows_neither_delay_nor_shift():
    shown = trial(late=0.1, turn=0.6)
    at = round(shown.hands[0].grips[0] + shown.hands[0].offset)

    def hidden(goal):
        points = np.array(goal.chain.points)
        points[max(at - 1, 0):at + 2] = np.nan
        return replace(goal, chain=Chain(points))
    covered = replace(shown, goals=tuple(map(hidden, shown.goals)))
    assert GripEvidence.of([shown]).delay is not None
    evidence = GripEvidence.of([covered])
    assert not evidence.errors
    assert evidence.delay is None
