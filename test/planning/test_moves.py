# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Moves, objectives and the refinement of displacements."""

from made_up_dlo import LEVEL, straight
import numpy as np
import pytest

from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import Drag, GraspAndPlace
from dlo_calibration.model.score import difference_score
from dlo_calibration.planning.beam import Objective, refine
from dlo_calibration.planning.moves import carrying, clash, Move

LEVELS = np.full(21, LEVEL)
TO = (0.2, 0.1, LEVEL)


@pytest.mark.parametrize(('name', 'named'), [
    ('grasp_and_place', GraspAndPlace(point=7, to=TO, height=0.04, speed=0.2, hand='hand_1')),
    ('drag', Drag(point=7, to=TO, speed=0.2, hand='hand_1'))])
def test_one_hand_moves_as_in_the_named_action(name, named):
    points = straight().points
    move = Move(name, (7,), ('hand_1',), np.array(TO[:2]) - points[7, :2])
    hand, = move.step(points, LEVELS, 0.04, 0.2).action.hands
    expected, = named.action(straight()).hands
    np.testing.assert_allclose(hand.positions, expected.positions, atol=1e-12)
    np.testing.assert_allclose(hand.times, expected.times, atol=1e-12)
    assert (hand.name, hand.grips) == (expected.name, expected.grips)


def test_two_hands_arrive_together_and_the_faster_one_has_the_speed():
    move = Move('grasp_and_place', (2, 18), ('hand_2', 'hand_1'), np.array([[0.0, 0.1], [0.05, 0.0]]))
    first, second = move.step(straight().points, LEVELS, 0.05, 0.1).action.hands
    np.testing.assert_array_equal(first.times, second.times)
    np.testing.assert_allclose(first.times, [0.0, 0.5, 1.5, 2.0])
    assert (first.name, second.name) == ('hand_2', 'hand_1')


@pytest.mark.parametrize(('second', 'near'), [
    ([-0.3, 0.02], True), ([-0.3, 0.06], False), ([-0.6, 0.0], True), ([-0.05, 0.05], False)])
def test_hands_that_come_near_each_other_are_refused(second, near):
    start = straight().points  # the hands are 0.3 m apart
    shifts = np.array([[0.0, 0.0], second])
    action = Move('drag', (5, 15), ('hand_1', 'hand_2'), shifts).step(start, LEVELS, 0.05, 0.1).action
    way = [np.linalg.norm(action.hands[0].positions_at(time) - action.hands[1].positions_at(time))
           for time in np.linspace(0, action.end, 500)]
    assert bool(min(way) < 0.04) is near
    assert ('hand_1 and hand_2' in clash(action)) is near


def test_one_hand_alone_is_never_refused():
    step = Move('drag', (5,), ('hand_1',), np.zeros(2)).step(straight().points, LEVELS, 0.05, 0.1)
    assert clash(step.action) == ''


def test_a_move_without_displacement_only_lifts():
    still, lifted = (Move(name, (3,), ('hand_1',), np.zeros(2)).step(straight().points, LEVELS, 0.05, 0.1)
                     for name in ('drag', 'grasp_and_place'))
    assert still.action.start == still.action.end == 0
    np.testing.assert_allclose(lifted.action.hands[0].positions[:, 2] - LEVEL, [0, 0.05, 0], atol=1e-12)


def test_moves_carry_points_to_their_places_in_the_goal():
    start, goal = straight().points, straight().points + [0.1, 0.2, 0.0]
    single = carrying(start, goal, ('drag',), 1)
    assert {choices[0].grips for choices in single} >= {(0,), (10,), (20,)}
    assert all(len(choices) == 1 for choices in single)
    paired = carrying(start, goal, ('drag', 'grasp_and_place'), 2)
    assert {choices[0].name for choices in paired} == {'drag', 'grasp_and_place'}
    assert (0, 20) in {choices[0].grips for choices in paired}
    for choices in paired:
        assert len({move.hands for move in choices}) == 2
        for move in choices:
            np.testing.assert_allclose(move.shifts, np.tile([0.1, 0.2], (len(move.grips), 1)))


def test_the_cost_is_the_mean_distance():
    start, goal = straight(), Chain(straight().points + [0.01, 0.02, 0.0])
    points = Objective(start, goal, 'points')
    assert points.cost(start.points) == pytest.approx(np.hypot(0.01, 0.02)) == points.error(start.points)
    assert np.linalg.norm(points.residuals(start.points)) == pytest.approx(np.hypot(0.01, 0.02))


def test_the_score_counts_if_asked():
    bent = np.array(straight().points)
    bent[10:15, 1] += 0.03
    for features, expected in ((np.zeros(21, bool), [0, 20]), (np.arange(21) == 12, [12])):
        objective = Objective(straight(), Chain(bent, features=features), 'score')
        score = difference_score(bent, straight().points, 0, expected)
        assert objective.score(straight().points) == pytest.approx(score) != 0
        distance, per_term = 0.03 * 5 / 21, score / 100 / (21 + len(expected))
        assert objective.cost(straight().points) == pytest.approx(distance + per_term)
        assert np.sum(objective.residuals(straight().points)**2) == pytest.approx(
            0.03**2 * 5 / 21 + per_term**2)


def refined(residuals, start, iterations=5):
    """Return the best point (d,) [m], and how many points were tried."""
    tried = [np.array(start)]
    asking = refine(tried[0], residuals(tried[0]), iterations, 0.6)
    points = next(asking)
    while True:
        tried.extend(points)
        try:
            points = asking.send([residuals(point) for point in points])
        except StopIteration:
            possible = [point for point in tried if residuals(point) is not None]
            return min(possible, key=lambda point: np.sum(residuals(point)**2)), len(tried) - 1


def test_refinement_solves_a_linear_problem_at_once():
    matrix = np.random.default_rng(1).normal(size=(12, 3))
    best, tried = refined(lambda point: matrix @ (point - [0.02, -0.01, 0.03]), [0.0, 0.0, 0.0], 2)
    np.testing.assert_allclose(best, [0.02, -0.01, 0.03], atol=2e-3)
    assert tried == 3 + 3 + 3


def test_refinement_continues_where_some_points_are_impossible():
    def half_plane(point):
        x, y = point - [0.05, 0.02]
        return None if x > 0.0005 else np.array([x, 2 * y, x])

    best, _ = refined(half_plane, [0.045, 0.0])
    np.testing.assert_allclose(best, [0.05, 0.02], atol=6e-3)


def test_refinement_stays_where_nothing_is_better():
    best, tried = refined(lambda point: np.zeros(4), [0.01, 0.02])
    np.testing.assert_array_equal(best, [0.01, 0.02])
    assert tried == 5
