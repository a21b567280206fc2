# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Random starts and goals, and the reality in which plans are executed."""

from contextlib import closing

import numpy as np
import pytest
from reality import (
    clear_of_itself,
    KNOWN_DLOS,
    laid,
    random_pair,
    Reality,
    relative_distance,
    seen,
)

from dlo_calibration import Action, Chain, Hand
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options

ROPE, HOSE = KNOWN_DLOS[0], KNOWN_DLOS[4]


@pytest.fixture(scope='module')
def simulator():
    with closing(make_simulator(Options()).refined()) as made:
        yield made


@pytest.fixture(scope='module')
def pairs(simulator):
    return {dlo: tuple(random_pair(dlo, k, 5, simulator) for k in range(2)) for dlo in (ROPE, HOSE)}


@pytest.mark.parametrize('dlo', [ROPE, HOSE])
def test_start_and_goal_are_shapes_at_rest_that_lie_apart(dlo, pairs, simulator):
    for pair in pairs[dlo]:
        assert 0.15 <= relative_distance(dlo, pair.start.points, pair.goal.points) <= 0.3001
        for chain in (pair.start, pair.goal):
            assert np.abs(laid(dlo, chain.points, simulator) - chain.points).max() < 1e-3
            assert chain.length == pytest.approx(dlo.length, rel=0.01)
            assert clear_of_itself(dlo, chain.points)
            assert seen(chain.points).shape == (21, 3)


def test_a_pair_depends_on_the_seed_and_its_index_alone(pairs, simulator):
    same = random_pair(ROPE, 0, 5, simulator)
    other = random_pair(ROPE, 0, 6, simulator)
    np.testing.assert_array_equal(same.goal.points, pairs[ROPE][0].goal.points)
    assert not np.allclose(other.goal.points, same.goal.points, atol=0.01)


def test_a_dlo_that_crosses_or_nearly_touches_itself_is_not_clear():
    angle = np.linspace(0, 2.2 * np.pi, 81)
    circle = 0.6 / 2.2 / np.pi * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert clear_of_itself(ROPE, circle[:70])
    assert not clear_of_itself(ROPE, circle)


def straight():
    points = np.zeros((81, 3))
    points[:, 0], points[:, 2] = np.linspace(0, ROPE.length, 81), ROPE.radius
    return Chain(points)


def drag(place, by):
    place = np.array([*place, ROPE.radius])
    return Action((Hand('hand_1', (0,), np.array([0.0, 1.0]), place + np.array([[0, 0, 0], [*by, 0]])),))


def test_a_hand_grips_what_is_nearest_to_where_it_closes(simulator):
    reality = Reality(ROPE, straight(), simulator)
    assert reality.act(drag((0.3, 0.01), (0, 0.1)))  # it was to grip point 0, which is elsewhere
    assert np.abs(reality.points[40, :2] - (0.3, 0.1)).max() < 0.02
    assert np.linalg.norm(reality.points[0] - straight().points[0]) < 0.03


def test_a_hand_that_closes_on_nothing_does_nothing(simulator):
    reality = Reality(ROPE, straight(), simulator)
    assert not reality.act(drag((0.3, 0.03), (0, 0.1)))
    np.testing.assert_array_equal(reality.points, straight().points)


def test_the_next_action_finds_the_dlo_where_the_last_one_left_it(simulator):
    reality = Reality(ROPE, straight(), simulator)
    assert reality.act(drag((0.3, 0), (0, 0.1)))
    before = reality.points
    assert not reality.act(drag((0.3, 0), (0, 0.1)))
    assert reality.act(drag(before[40, :2], (0, -0.05)))
    assert reality.points[40, 1] == pytest.approx(before[40, 1] - 0.05, abs=0.01)
    assert len(reality.points) == 81
