# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The places of the nodes, the observed points that they give, and the height at which a DLO rests."""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration import Action, Chain, Goal, Hand, InputError, Trial
from dlo_calibration.observation.table import rest_on, resting_level
from dlo_calibration.simulation.nodes import feature_shares, NodeLayout, spread_places


def arc(count=21, height=0.0):
    """Return a quarter of a circle of radius 0.4 m."""
    angle = np.linspace(0, np.pi / 2, count)
    return np.stack([0.4 * np.sin(angle), 0.4 * (1 - np.cos(angle)), 0 * angle + height], axis=1)


def trial(points, grips=((0,),), goals=None, velocity=None):
    hands = [Hand(f'hand {k}', grip, [0.0, 1.0], np.zeros((2, 3))) for k, grip in enumerate(grips)]
    goals = goals or (Goal(Chain(points), 2.0),)
    return Trial('t', Chain(points), (Action(hands),), goals, velocity)


@drawing(50)
@given(st.lists(st.floats(0.001, 1.0), min_size=1, max_size=8), st.integers(0, 60))
def test_places_contain_the_fixed_ones_and_are_as_even_as_these_allow(widths, more):
    fixed = np.concatenate([[0.0], np.cumsum(widths)])
    count = len(fixed) + more
    places = spread_places(fixed, count)
    assert len(places) == count
    assert (np.diff(places) > 0).all()
    assert np.isin(fixed, places).all()
    # More pieces would be needed if all were narrower than the widest one.
    widest = np.diff(places).max()
    fewest = sum(max(1, int(np.ceil(width / (0.999 * widest) - 1e-9))) for width in widths)
    assert fewest > count - 1


@drawing(30)
@given(st.lists(st.integers(0, 20), min_size=1, max_size=10, unique=True), st.integers(12, 60))
def test_every_gripped_point_has_a_node_of_its_own(grips, count):
    layout = NodeLayout.of(trial(arc(), (tuple(grips),)), count)
    assert layout.places.shape == (count,)
    assert layout.points.shape == layout.velocities.shape == (count, 3)
    nodes = layout.nodes(trial(arc(), (tuple(grips),)).hands[0])
    assert len(set(nodes)) == len(grips)
    assert layout.places[list(nodes)] == pytest.approx(layout.point_places[grips], abs=1e-12)
    assert layout.points[list(nodes)] == pytest.approx(arc()[grips], abs=1e-9)


@drawing(30)
@given(st.integers(0, 18), st.integers(12, 80))
def test_a_clamp_that_holds_from_the_start_has_no_node_within(first, count):
    gripped = trial(arc(), ((first, first + 1),))
    a, b = NodeLayout.of(gripped, count).nodes(gripped.hands[0])
    assert b == a + 1
    free = np.delete(np.diff(NodeLayout.of(gripped, count).places), a)
    assert free.max() < 2.1 * free.min() + 1e-9 or count < 20


def test_a_grip_between_points_has_a_node_there():
    def gripping(*places):
        hands = [Hand(f'hand {k}', (point,), [0.0, 1.0], np.zeros((2, 3)), offset=offset)
                 for k, (point, offset) in enumerate(places)]
        return Trial('t', Chain(arc()), (Action(hands),), (Goal(Chain(arc()), 2.0),))

    gripped = gripping((4, 0.4), (13, -0.3))
    layout = NodeLayout.of(gripped, 30)
    along = Chain(arc()).arc_lengths()
    expected = [along[4] + 0.4 * (along[5] - along[4]), along[13] - 0.3 * (along[13] - along[12])]
    nodes = [node for hand in gripped.hands for node in layout.nodes(hand)]
    assert layout.places[nodes] == pytest.approx(expected, abs=1e-12)
    assert layout.points[nodes] == pytest.approx(Chain(arc()).resample(expected), abs=1e-9)
    near = gripping((4, 0.4), (4, 0.41), (20, -0.02))  # gripped anew, and at the end
    layout = NodeLayout.of(near, 30)
    assert np.diff(layout.places).min() > 0.5 * np.diff(layout.places).max()
    first, second, end = (layout.nodes(hand) for hand in near.hands)
    assert first == second
    assert end == (29,)


def test_points_between_those_that_a_hand_grips_keep_their_nodes():
    gripped = trial(arc(), ((2, 6),))
    a, b = NodeLayout.of(gripped, 61).nodes(gripped.hands[0])
    assert b > a + 4


def test_a_piece_that_is_clamped_later_has_nodes_inside():
    later = Hand('late', (10, 11), [0.5, 1.0], np.zeros((2, 3)))
    gripped = Trial('t', Chain(arc()), (Action((later,)),), (Goal(Chain(arc()), 2.0),))
    layout = NodeLayout.of(gripped, 81)
    assert layout.places == pytest.approx(spread_places(layout.point_places[[0, 10, 11, 20]], 81))
    a, b = layout.nodes(later)
    assert b > a + 1


@pytest.mark.parametrize('count', [15, 31, 61])
def test_nodes_lie_on_the_curve_and_give_the_observed_points_back(count):
    layout = NodeLayout.of(trial(arc()), count)
    assert layout.places == pytest.approx(np.linspace(0, 0.2 * np.pi, count), rel=1e-4)
    radius = np.linalg.norm(layout.points - (0, 0.4, 0), axis=1)
    assert radius == pytest.approx(np.full(count, 0.4), abs=2e-5)
    assert layout.observe @ layout.points == pytest.approx(arc(), abs=1e-4)


def test_a_trial_starts_at_rest_or_with_the_velocity_between_its_points():
    assert not NodeLayout.of(trial(arc()), 31).velocities.any()
    points = arc()
    turning = np.cross((0, 0, 2.0), points)
    layout = NodeLayout.of(trial(points, velocity=turning), 47)
    assert layout.velocities == pytest.approx(np.cross((0, 0, 2.0), layout.points), abs=1e-4)


def test_more_grips_than_nodes_are_refused():
    with pytest.raises(InputError) as refusal:
        NodeLayout.of(trial(arc(), (tuple(range(1, 20)),)), 20)
    text = str(refusal.value)
    assert text.startswith("trial 't': 19 gripped points; expected fewer than the 20 nodes; ")
    assert len(NodeLayout.of(trial(arc(), (tuple(range(1, 20)),)), 21).places) == 21


def test_a_layout_is_read_only():
    layout = NodeLayout.of(trial(arc()), 31)
    for array in (layout.places, layout.points, layout.velocities, layout.observe):
        with pytest.raises(ValueError):
            array[0] = 1


@drawing(30)
@given(st.integers(0, 2**32 - 1), st.floats(-2, 2), st.floats(0.002, 0.03))
def test_a_resting_chain_shows_its_level_through_noise(seed, table, radius):
    noise = np.random.default_rng(seed).normal(0, 0.001, (21, 3))
    points = arc(height=table + radius) + noise
    assert resting_level(trial(points), table) == pytest.approx(table + radius, abs=0.0015)


def test_a_lifted_part_does_not_raise_the_level():
    points = arc(height=0.008)
    points[10:, 2] += np.linspace(0.01, 0.3, 11)
    assert resting_level(trial(points), 0.0) == pytest.approx(0.008)


def test_the_level_is_seen_in_a_goal_where_the_chain_hung_at_the_start():
    lifted = arc(height=0.3)
    lifted[:, 2] += np.linspace(0, 0.2, 21)
    laid = trial(lifted, goals=(Goal(Chain(arc(height=0.005)), 2.0),))
    assert resting_level(laid, 0.0) == pytest.approx(0.005)
    flown = trial(lifted, goals=(Goal(Chain(arc(height=0.005)), 0.5, stable=False),))
    assert resting_level(flown, 0.0) is None  # it may be on its way down


@pytest.mark.parametrize('points', [
    np.stack([np.zeros(21), np.zeros(21), np.linspace(0.5, 0.001, 21)], axis=1),  # it hangs, and just touches
    arc(height=0.5),  # level, but high above the table
], ids=['upright', 'high'])
def test_a_chain_that_does_not_lie_on_the_table_shows_no_level(points):
    assert resting_level(trial(points), 0.0) is None


def test_a_moving_chain_shows_no_level_at_its_start():
    moving = trial(arc(height=0.005), goals=(Goal(Chain(arc(height=0.5)), 2.0),), velocity=np.zeros((21, 3)))
    assert resting_level(moving, 0.0) is None


def test_points_that_rest_are_moved_to_the_level_and_others_are_not():
    points = arc(height=0.008)
    points[:, 2] += np.linspace(-0.004, 0.05, 21)
    rested = rest_on(points, 0.008)
    assert (rested[:, 2] >= 0.008).all()
    assert rested[:, :2].tolist() == points[:, :2].tolist()
    high = points[:, 2] > 0.015
    assert rested[high].tolist() == points[high].tolist()
    low = points[:, 2] < 0.010
    assert (rested[low, 2] == 0.008).all()
    assert points[0, 2] == pytest.approx(0.004)  # the given ones stay as they were


def test_a_raised_part_of_a_dlo_of_1_cm_keeps_its_height():
    points = arc(height=0.008)
    points[:11, 2] += np.linspace(0.05, 0.01, 11)
    points *= 0.01 / Chain(points).length
    np.testing.assert_array_equal(rest_on(points, points[-1, 2]), points)


@pytest.mark.parametrize('diameter', [0.003, 0.008])
@pytest.mark.parametrize('first_above', [True, False])
def test_a_strand_that_lies_on_another_keeps_its_height(diameter, first_above):
    turn = np.linspace(-0.4, 2 * np.pi + 0.4, 61)  # more than a turn, and outwards: it crosses itself once
    points = np.stack([0.05 * np.sin(turn), 0.05 * np.cos(turn), np.full(61, diameter / 2)], axis=1)
    points[:, 0] += 0.004 * turn
    upper = np.arange(8) if first_above else np.arange(53, 61)
    points[upper, 2] += 0.9 * diameter
    rested = rest_on(points, diameter / 2)
    np.testing.assert_array_equal(rested[upper], points[upper])
    points[upper, 2] = diameter / 2 + 0.001  # noise, not another strand
    np.testing.assert_array_equal(rest_on(points, diameter / 2)[:, 2], diameter / 2)


def test_a_feature_is_divided_between_the_nodes_beside_it():
    points = np.stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)], axis=1)
    marked = Chain(points, features=np.isin(np.arange(11), (0, 3, 10)))
    shares = feature_shares(marked, np.linspace(0, 1, 5))
    assert shares == pytest.approx([1, 0.8, 0.2, 0, 1])
    assert shares @ np.linspace(0, 1, 5) == pytest.approx(0.3 + 1)  # the centre of mass is where it was
    assert not feature_shares(Chain(points), np.linspace(0, 1, 5)).any()


def test_nodes_have_the_rest_lengths_of_the_trial_and_start_on_the_observed_curve():
    stretched = np.linspace(0, 1, 21)**1.2
    gripped = replace(trial(arc(), ((0, 1),)), places=stretched)
    layout = NodeLayout.of(gripped, 41)
    assert layout.places[-1] == 1
    assert layout.point_places == pytest.approx(stretched)
    assert layout.places[list(layout.nodes(gripped.hands[0]))] == pytest.approx(stretched[:2])
    assert layout.points[[0, 1, -1]] == pytest.approx(arc()[[0, 1, -1]], abs=1e-9)
    radius = np.linalg.norm(layout.points - (0, 0.4, 0), axis=1)
    assert radius == pytest.approx(np.full(41, 0.4), abs=2e-5)
    assert layout.observe @ layout.points == pytest.approx(arc(), abs=1e-3)
    marked = replace(gripped, initial=replace(gripped.initial, features=np.arange(21) == 20))
    assert NodeLayout.of(marked, 41).features[-1] == 1


def clamped(noise, markers, seed=0):
    """Return a trial of a bent DLO whose ends are clamped, with a stream of 30 goals; noise in m."""
    random = np.random.default_rng(seed)
    along = np.linspace(0, 1, markers)
    swing = np.sin(np.arange(31) / 10)[:, None]
    rise = 0.1 * np.sin(5 * along) + 0 * swing
    points = np.stack([along + 0 * swing, rise, 0.1 * swing * along**2], axis=2)
    points += random.normal(0, noise, points.shape)
    hands = [Hand(name, grips, [0.0, 9.0], np.zeros((2, 3)))
             for name, grips in (('left', (0, 1)), ('right', (markers - 2, markers - 1)))]
    return Trial('clamped', Chain(points[0]), (Action(hands),),
                 [Goal(Chain(row), k / 30, False, ('left', 'right')) for k, row in enumerate(points[1:], 1)])


def test_clamps_that_a_stream_shows_are_held_where_they_were_measured():
    gripped = clamped(3e-5, 12)
    layout = NodeLayout.of(gripped, 41)
    for hand in gripped.hands:
        measured = gripped.initial.points[list(hand.grips)]
        assert layout.points[list(layout.nodes(hand))] == pytest.approx(measured, abs=2e-5)


def test_smoothing_makes_the_direction_of_a_noisy_clamp_truer():
    exact = clamped(0.0, 41).initial.points
    measured, used = [], []
    for seed in range(20):
        gripped = clamped(1e-3, 41, seed)
        layout = NodeLayout.of(gripped, 61)
        measured.append(gripped.initial.points[1] - gripped.initial.points[0] - exact[1] + exact[0])
        used.append(layout.points[layout.nodes(gripped.hands[0])[1]] - layout.points[0] - exact[1] + exact[0])
    assert np.linalg.norm(used) < 0.7 * np.linalg.norm(measured)
