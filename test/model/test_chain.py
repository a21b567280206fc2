# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The chain: a curve through all its points, lengths along it, and refusals."""

from dataclasses import FrozenInstanceError, replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration import Chain, Goal, Hand, InputError
from dlo_calibration.model.chain import bezier_curve, grip_place, interpolation_matrix, NEAR

LINE = np.array([[0, 0, 0], [0.1, 0, 0], [0.25, 0, 0], [0.3, 0, 0], [0.6, 0, 0]])


@st.composite
def chains(draw):
    """Walk 3 to 30 unequal steps, none of them back on the one before."""
    count = draw(st.integers(2, 29))
    seed = draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    steps = generator.uniform(-0.02, 0.02, (count, 3)) + (0.03, 0, 0)
    steps *= generator.uniform(0.3, 3, (count, 1))
    return Chain(np.concatenate([[[0.5, -2, 1]], [[0.5, -2, 1]] + np.cumsum(steps, axis=0)]))


@drawing(30, derandomize=True)
@given(chains())
def test_the_curve_passes_through_every_point_at_its_own_place(chain):
    places = chain.arc_lengths()
    assert places[0] == 0
    assert places[-1] == chain.length
    assert chain.resample(places) == pytest.approx(chain.points, abs=1e-12)
    # No point lies nearer along the curve than it does in space.
    assert (np.diff(places) >= np.linalg.norm(np.diff(chain.points, axis=0), axis=1) - 1e-12).all()


@drawing(30, derandomize=True)
@given(chains(), st.floats(0, 1))
def test_a_resampled_point_has_the_requested_arc_length(chain, share):
    at = share * chain.length
    fine = chain.resample(np.linspace(0, at, 2000))
    walked = np.linalg.norm(np.diff(fine, axis=0), axis=1).sum()
    assert walked == pytest.approx(at, abs=2e-3 * chain.length)


def circle(angles, radius=0.3, pitch=0.0):
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), pitch * angles], axis=1)


@pytest.mark.parametrize('pitch', [0.0, 0.1])
def test_length_of_a_circle_and_a_helix_from_few_points(pitch):
    exact = 1.5 * np.pi * np.hypot(0.3, pitch)
    errors = [abs(Chain(circle(np.linspace(0, 1.5 * np.pi, n), pitch=pitch)).length / exact - 1)
              for n in (9, 17, 33)]
    assert errors[0] < 2e-3  # the polygon through the same points: 1.4e-2
    assert errors[1] < errors[0] / 10
    assert errors[2] < errors[1] / 8


def test_places_on_an_arc_of_unequally_spaced_points():
    angles = np.cumsum(np.tile([0.05, 0.15, 0.1], 10))
    chain = Chain(circle(angles))
    assert chain.arc_lengths() == pytest.approx(0.3 * (angles - angles[0]), rel=1e-4)
    between = np.linspace(angles[0], angles[-1], 77)
    assert chain.resample(0.3 * (between - angles[0])) == pytest.approx(circle(between), abs=5e-5)


def test_a_straight_chain_is_reproduced_exactly_with_any_spacing():
    chain = Chain(LINE)
    assert chain.length == pytest.approx(0.6, rel=1e-12)
    assert chain.arc_lengths() == pytest.approx(LINE[:, 0], abs=1e-12)
    # The curve's own parameter is not its length between unequal points; the table's resolution remains.
    assert chain.resample([0.05, 0.2, 0.45])[:, 0] == pytest.approx([0.05, 0.2, 0.45], abs=3e-4)
    assert np.abs(chain.resample(np.linspace(0, 0.6, 50))[:, 1:]).max() < 1e-12


def test_beyond_its_ends_the_curve_stays_at_them():
    assert Chain(LINE).resample([-1.0, 7.0]) == pytest.approx(LINE[[0, -1]], abs=1e-12)


@drawing(30, derandomize=True)
@given(st.lists(st.floats(0.01, 2), min_size=2, max_size=12),
       st.lists(st.floats(0, 1), min_size=1, max_size=9), st.tuples(*[st.floats(-5, 5)] * 3))
def test_a_parabola_is_reproduced_exactly(steps, shares, factors):
    knots = np.concatenate([[0.0], np.cumsum(steps)])

    def parabola(t):
        return np.stack([factors[0] + factors[1] * t + factors[2] * t**2, t, t * 0], axis=1)

    at = np.array(shares) * knots[-1]
    size = 1 + np.abs(parabola(knots)).max()
    assert np.abs(bezier_curve(knots, parabola(knots), at) - parabola(at)).max() < 1e-9 * size


@drawing(30, derandomize=True)
@given(chains(), st.integers(1, 40))
def test_interpolation_matrix_gives_the_curve(chain, count):
    knots = chain.arc_lengths()
    at = np.random.default_rng(count).uniform(-0.1, 1.1, count) * knots[-1]
    weights = interpolation_matrix(knots, at)
    assert weights.shape == (count, len(chain))
    assert weights.sum(axis=1) == pytest.approx(np.ones(count))
    assert weights @ chain.points == pytest.approx(bezier_curve(knots, chain.points, at), abs=1e-12)


def test_a_chain_is_a_read_only_copy():
    points = LINE.copy()
    hands, features = np.array([1, 0, 0, 0, 2]), np.array([False, True, False, False, False])
    chain = Chain(points, hands, features)
    points[0] = hands[0] = features[1] = 9
    assert chain.points.tolist() == LINE.tolist()
    assert chain.hands.tolist() == [1, 0, 0, 0, 2]
    assert chain.features.tolist() == [False, True, False, False, False]
    for array in (chain.points, chain.hands, chain.features):
        with pytest.raises(ValueError):
            array[0] = 1
    with pytest.raises(FrozenInstanceError):
        chain.points = LINE


def test_annotations_that_are_not_given():
    chain = Chain(LINE.tolist())
    assert chain.hands is None  # the source does not tell, which is not the same as no hand
    assert chain.features.tolist() == [False] * 5
    assert len(chain) == 5


REFUSED = {
    'shape': ({'points': np.zeros((5, 2))}, '(5, 2)', '(n, 3)', 'x y z'),
    'flat': ({'points': np.arange(9.0)}, '(9,)', '(n, 3)', 'x y z'),
    'few': ({'points': LINE[:2]}, '2 point', 'at least 3', 'whole DLO'),
    'nan': ({'points': np.where(LINE > 0.1, np.nan, LINE)}, 'NaN in point(s)', 'at least 3 that were seen',
            'less of it is hidden'),
    'infinite': ({'points': np.where(LINE == 0.6, -np.inf, LINE)}, 'infinity in point(s) 4', 'metres',
                 'leave such frames out'),
    'coincident': ({'points': LINE[[0, 1, 1, 2, 3]]}, 'coincident neighbours after point(s) 1', 'apart',
                   'remove the repeated points'),
    'hands': ({'points': LINE, 'hands': [1, 0, 0]}, "'hands': shape (3,)", 'each of the 5 points',
              'one value per point'),
    'features': ({'points': LINE, 'features': [[1], [0], [0], [0], [1]]}, "'features': shape (5, 1)",
                 'each of the 5 points', 'one value per point'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_refusals_say_what_came_what_was_expected_and_what_to_do(name):
    arguments, came, expected, remedy = REFUSED[name]
    with pytest.raises(InputError) as refusal:
        Chain(**arguments)
    text = str(refusal.value)
    assert text.startswith('chain')
    assert text.index(came) < text.index(expected) < text.index(remedy)


def test_many_bad_points_are_counted_not_listed():
    with pytest.raises(InputError, match=r'0 of 100 points .*NaN in point\(s\) 0, 1, 2, 3, 4 and 95 more'):
        Chain(np.full((100, 3), np.nan))


@pytest.mark.parametrize('far', [1.1e8, -1e300])
def test_coordinates_that_cannot_be_metres_are_refused(far):
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    assert len(Chain(points + 0.9e8)) == 3
    points[1, 2] = far
    with pytest.raises(InputError, match='a coordinate of .* m in point 1; expected at most 1e.08 m'):
        Chain(points)
    with pytest.raises(InputError, match='a coordinate of .* m in waypoint 1; expected at most 1e.08 m'):
        Hand('left', (0,), np.arange(3.0), points)


@pytest.mark.parametrize('time', [1e300, -1e13, float('nan')])
def test_times_that_no_clock_gives_are_refused(time):
    chain = Chain(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]))
    with pytest.raises(InputError):
        Goal(chain, time)
    with pytest.raises(InputError):
        Hand('left', (0,), np.array([time]), np.zeros((1, 3)))


def test_unseen_points_are_marked_and_lie_on_the_curve_through_the_others():
    turn = np.linspace(0, 1.5, 16)
    points = 0.3 * np.stack([np.sin(turn), 1 - np.cos(turn), np.zeros(16)], axis=1)
    hidden = points.copy()
    hidden[[4, 9], 0] = np.nan  # one coordinate is enough
    hidden[10] = np.nan
    chain = Chain(hidden, hands=np.arange(16) == 4)
    assert np.flatnonzero(~chain.seen).tolist() == [4, 9, 10]
    np.testing.assert_allclose(chain.points, points, atol=3e-4)  # neighbours are 30 mm apart
    np.testing.assert_array_equal(chain.points[chain.seen], points[chain.seen])
    assert np.flatnonzero(np.isnan(chain.observed).any(axis=1)).tolist() == [4, 9, 10]
    assert replace(chain, hands=None).seen.tolist() == chain.seen.tolist()
    assert not chain.seen.flags.writeable
    assert Chain(points).seen.all()


def test_an_unseen_end_continues_straight():
    even = Chain(np.stack([np.linspace(0, 1, 7), np.zeros(7), np.zeros(7)], axis=1))
    points = even.points.copy()
    points[[0, -1]] = np.nan
    np.testing.assert_allclose(Chain(points).points, even.points, atol=1e-9)


def test_half_of_the_points_are_enough():
    points = np.stack([np.linspace(0, 1, 8), np.zeros(8), np.zeros(8)], axis=1)
    points[[1, 3, 5, 6]] = np.nan
    assert Chain(points).length == pytest.approx(1.0)
    points[2] = np.nan
    with pytest.raises(InputError, match='3 of 8 points that were seen.*at least 4 that were seen.*hidden'):
        Chain(points)


@pytest.mark.parametrize('place', [0.0, 0.31, 0.487, 1.2, 1.5])
def test_the_place_nearest_to_a_position_lies_between_points(place):
    turn = np.linspace(0, 1.5, 13)
    chain = Chain(np.stack([np.sin(turn), 1 - np.cos(turn), np.zeros(13)], axis=1))
    at = np.array([np.sin(place), 1 - np.cos(place), 0.0])
    point, offset, distance = chain.nearest(at + [0, 0, 0.02])
    assert point == np.abs(turn - place).argmin()
    assert distance == pytest.approx(0.02, abs=1e-4)
    assert grip_place(chain.arc_lengths(), point, offset) == pytest.approx(place, abs=4e-3)
    np.testing.assert_allclose(chain.gripped((point,), offset)[0], at, atol=4e-3)
    assert chain.nearest(chain.points[4]) == (4, 0.0, pytest.approx(0.0, abs=1e-12))


@given(chains(), st.tuples(*[st.floats(-3, 3)] * 3), st.sampled_from([0.01, 1.0]), st.floats(0, 1))
def test_no_place_is_nearer_to_a_position_than_the_nearest_one(chain, away, scale, share):
    position = chain.resample([share * chain.length])[0] + scale * np.array(away)
    point, offset, distance = chain.nearest(position)
    curve = chain.resample(np.linspace(0, chain.length, 2000))
    assert distance == pytest.approx(np.linalg.norm(curve - position, axis=1).min(), abs=chain.length / 500)
    place = chain.gripped((point,), offset)[0]
    assert np.linalg.norm(place - position) < distance + 1.5 * NEAR * np.diff(chain.arc_lengths()).max()
