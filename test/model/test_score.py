# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The difference score against sums by hand, and the errors beside it."""

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.score import (
    difference_score,
    feature_points,
    focal_points,
    PointErrors,
    residuals,
    TrialScore,
)

STRAIGHT = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])


def hand(name, start, end, grips, position):
    return Hand(name, grips, [start, end], np.tile(np.asarray(position, float), (2, 1)))


def trial(points, *goals, hands=None):
    hands = hands or (hand('left', 0, 1, (0,), points[0]),)
    return Trial('t', Chain(points), (Action(hands),), goals)


def test_equation_1_summed_by_hand():
    goal = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]])
    current = np.array([[0.0, 0, 0], [1, 0, 0.5], [1, -1, 0], [1, -3, 0]])
    # From point 1, goal: (1, 0, 0) + 0 + (1, 0, 0) + (1, 1, 0) = (3, 1, 0).
    # Current: (1, 0, 0.5) + 0 + (0, 1, 0.5) + (0, 3, 0.5) = (1, 4, 1.5).  Difference: (2, -3, -1.5).
    assert difference_score(goal, current, 1, []) == pytest.approx(100 * np.sqrt(2**2 + 3**2 + 1.5**2))
    # Features 1 and 3: (0, 0, 0.5) + (1, 4, 0) = (1, 4, 0.5).  Together: (3, 1, -1).
    assert difference_score(goal, current, 1, [1, 3]) == pytest.approx(100 * np.sqrt(11))


def test_the_unit_is_the_centimetre():
    shorter = STRAIGHT * (0.995, 1, 1)  # 0.5 + 1 cm nearer to the focal point, nothing else
    assert difference_score(STRAIGHT, shorter, 0, []) == pytest.approx(1.5)
    assert difference_score(STRAIGHT, shorter, 0, [2]) == pytest.approx(2.5)


def test_a_mirrored_chain_changes_only_the_sum_over_features():
    mirrored = STRAIGHT * (-1, 1, 1)
    assert difference_score(STRAIGHT, mirrored, 0, []) == 0
    assert difference_score(STRAIGHT, mirrored, 0, [1]) == pytest.approx(200)


def test_differences_of_opposite_sign_cancel_as_in_the_paper():
    current = np.array([[0, 0, 0], [0.9, 0, 0], [2.1, 0, 0]])
    assert difference_score(STRAIGHT, current, 0, []) == pytest.approx(0, abs=1e-9)
    longer = np.array([[0, 0, 0], [1, 0, 0], [2.1, 0, 0]])
    assert difference_score(STRAIGHT, longer, 0, [2]) == pytest.approx(0, abs=1e-9)


def test_equal_chains_score_nothing():
    points = np.random.default_rng(0).random((20, 3))
    assert difference_score(points, points, 7, [0, 3, 19]) == 0


def test_a_translation_counts_only_through_the_features():
    points = np.random.default_rng(0).random((20, 3))
    moved = points + (0.03, -0.04, 0)
    assert difference_score(points, moved, 7, []) == pytest.approx(0, abs=1e-9)
    assert difference_score(points, moved, 7, [3]) == pytest.approx(5.0)
    assert difference_score(points, moved, 7, [3, 8, 9]) == pytest.approx(15.0)


LINE = np.stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)], axis=1)


def test_the_focal_point_is_the_goals_point_nearest_to_a_hand_that_holds_it():
    hands = (hand('left', 0, 1, (2,), (0.52, 0, 0)), hand('right', 0, 1, (8,), (0.71, 0, 0)))
    held = trial(LINE, Goal(Chain(LINE), 2.0, held_by=('left', 'right')), hands=hands)
    assert focal_points(held).tolist() == [7]  # 1 cm away, the other's is 2 cm away
    one_hand = trial(LINE, Goal(Chain(LINE), 2.0, held_by=('left',)), hands=hands)
    assert focal_points(one_hand).tolist() == [5]
    free = trial(LINE, Goal(Chain(LINE), 2.0), hands=hands)
    assert focal_points(free).tolist() == [0]


def test_the_focal_point_of_a_timed_goal_is_where_the_hand_is_then():
    moving = Hand('left', (2,), [0.0, 1.0], [[0.2, 0, 0], [1.0, 0, 0]])
    timed = trial(LINE, Goal(Chain(LINE), 0.5, stable=False), hands=(moving,))
    assert focal_points(timed).tolist() == [6]


def test_each_goal_of_a_stream_has_a_focal_point_of_its_own():
    first = Action((Hand('left', (0,), [0.0, 1.0], [[0, 0, 0], [0.4, 0, 0]]),
                    Hand('right', (10,), [0.5, 1.0], [[0.9, 0, 0.2], [0.9, 0, 0.0]])))
    again = Action((Hand('left', (0,), [2.0, 3.0], [[0.4, 0, 0], [0.8, 0, 0]]),))
    goals = [Goal(Chain(LINE), time, stable=False, held_by=('right',))
             for time in (0.25, 0.75, 1.5, 2.5, 4.0)]
    # The left hand alone; it is the nearer one; it has opened; it has closed again; it has opened again.
    assert focal_points(Trial('t', Chain(LINE), (first, again), goals)).tolist() == [1, 3, 9, 6, 9]


def bumps():
    points = LINE.copy()
    points[:, 2] = [0, 1, 2, 1, 0, 0, 1, 1, 3, 2, 5]
    return points * 0.1


def features_of(trial):
    return [np.flatnonzero(goal).tolist() for goal in feature_points(trial)]


def test_features_are_strict_extrema_of_the_goal_grips_and_annotations():
    goal = Chain(bumps(), features=np.arange(11) == 4)
    initial = Chain(LINE, features=np.arange(11) == 6)
    hands = (hand('left', 0, 1, (0, 1), (0, 0, 0)),)
    marked = Trial('t', initial, (Action(hands),), (Goal(goal, 2.0),))
    # Extrema in z of the goal: 2 (maximum), 8 (maximum), 9 (minimum); no plateau, no end.
    assert features_of(marked) == [[0, 1, 2, 4, 6, 8, 9]]
    assert features_of(trial(bumps(), Goal(Chain(LINE), 2.0))) == [[0]]


def test_a_later_grip_is_no_feature():
    hands = (hand('left', 0, 1, (3,), (0, 0, 0)), hand('right', 5, 6, (7,), (0, 0, 0)))
    goals = (Goal(Chain(LINE), 2.0), Goal(Chain(LINE), 8.0))
    two = trial(LINE, *goals, hands=hands)
    assert features_of(two) == [[3], [3, 7]]


def test_the_score_of_a_trial_is_the_average_over_its_goals():
    goals = (Goal(Chain(STRAIGHT), 2.0), Goal(Chain(STRAIGHT), 3.0))
    two = trial(STRAIGHT, *goals)
    # The grip 0 is the only feature: 1 cm away in the second goal.
    chains = np.stack([STRAIGHT, STRAIGHT + (0, 0, 0.01)])
    assert TrialScore(two)(chains) == pytest.approx(0.5)
    with pytest.raises(ValueError):
        TrialScore(two)(chains[:1])


def test_residuals_are_simulated_minus_observed_goal_by_goal():
    goals = (Goal(Chain(STRAIGHT), 2.0), Goal(Chain(STRAIGHT), 3.0))
    moves = np.arange(18.0).reshape(2, 3, 3)
    assert residuals(trial(STRAIGHT, *goals), STRAIGHT + moves) == pytest.approx(np.arange(18.0))


def test_point_errors_by_hand():
    errors = PointErrors.of(np.array([0.003, 0.004, 0, 0, 0, 0, 0, -0.012, 0.009]))
    assert errors.mean == pytest.approx((0.005 + 0 + 0.015) / 3)
    assert errors.rms == pytest.approx(np.sqrt((0.005**2 + 0.015**2) / 3))
    assert errors.max == pytest.approx(0.015)
    assert errors.mean_abs == pytest.approx(0.028 / 9)


def test_unseen_points_do_not_count():
    random = np.random.default_rng(1)
    goal, current = random.random((9, 3)), random.random((9, 3))
    hidden = goal.copy()
    hidden[[0, 5]] = np.nan
    visible = [1, 2, 3, 4, 6, 7, 8]
    partial = trial(random.random((9, 3)), Goal(Chain(hidden), 2.0))
    action = Action((hand('left', 0, 1, (0,), (9, 9, 9)),))
    whole = Trial('w', Chain(partial.initial.points[visible]), (action,),
                  (Goal(Chain(goal[visible], features=feature_points(partial)[0][visible]), 2.0),))
    assert focal_points(partial).tolist() == [1]
    assert not feature_points(partial)[0][[0, 5]].any()
    assert residuals(partial, current[None]).tolist() == residuals(whole, current[None, visible]).tolist()
    reference, features = 0, np.flatnonzero(feature_points(partial)[0][visible])
    assert TrialScore(partial)(current[None]) == pytest.approx(
        difference_score(goal[visible], current[visible], reference, features))
