# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Limits: straight ways against boxes and annuli, compared with dense sampling; what is said about them."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration import Action, InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.planning.limits import Limits
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.regions import Annulus, Box, read_box, read_reach

SAMPLES = 4001  # of a way
#: On a grid of tenths, faces, edges and corners are met often, and nothing is decided by rounding alone.
COORDINATES = st.integers(-10, 10).map(lambda tenths: tenths / 10)
PLACES = st.tuples(COORDINATES, COORDINATES, COORDINATES).map(np.array)


def along(begin, end):
    """Return many places of a straight way, and how far apart they are."""
    places = begin + np.linspace(0, 1, SAMPLES)[:, None] * (end - begin)
    return places, float(np.linalg.norm(end - begin)) / (SAMPLES - 1)


def one(answer):
    """Return the answer about a single way."""
    assert answer.shape == (1,)
    return bool(answer[0])


@drawing(60)
@given(PLACES, PLACES, PLACES, PLACES)
def test_a_way_enters_a_box_if_one_of_its_places_does(corner, other, begin, end):
    box = Box.between(np.concatenate([corner, other]))
    places, apart = along(begin, end)
    outside = np.maximum(box.lower - places, places - box.upper).max(axis=1)  # 0 or less: inside
    entered = one(box.entered(begin[None], end[None]))
    if (outside <= 0).any():
        assert entered
    if entered:  # then a place between two samples does
        assert outside.min() <= apart + 2e-9
    assert one(box.contains(begin[None], end[None])) == (outside <= 1e-9).all()
    assert entered == one(box.entered(end[None], begin[None]))


@drawing(60)
@given(PLACES, PLACES, st.integers(0, 10), st.integers(1, 10))
def test_a_way_keeps_to_an_annulus_if_all_its_places_do(begin, end, inner, width):
    ring = Annulus(np.array([0.1, -0.2]), inner / 10, (inner + width) / 10)
    places, apart = along(begin, end)
    radii = np.linalg.norm(places[:, :2] - ring.centre, axis=1)
    contained = one(ring.contains(begin[None], end[None]))
    if contained:
        assert (radii >= ring.inner - 2e-9).all() and (radii <= ring.outer + 2e-9).all()
    else:
        assert radii.min() < ring.inner + apart or radii.max() > ring.outer


@drawing(30)
@given(st.lists(st.tuples(PLACES, PLACES), min_size=2, max_size=6), PLACES, PLACES)
def test_many_ways_are_judged_as_each_alone(ways, corner, other):
    begin, end = (np.array(places) for places in zip(*ways, strict=True))
    box, ring = Box.between(np.concatenate([corner, other])), Annulus(corner[:2], 0.3, 0.9)
    for judge in (box.entered, box.contains, ring.contains):
        assert judge(begin, end).tolist() == [one(judge(a[None], b[None])) for a, b in ways]


def action(*ways):
    """Return an action whose hands move along ways, (k, 3) each."""
    return Action(tuple(Hand(f'hand_{k}', (0,), np.arange(len(way)), np.array(way, dtype=float))
                        for k, way in enumerate(ways, start=1)))


LIFTED = [(0.5, 0, 0), (0.5, 0, 0.1), (-0.5, 0, 0.1), (-0.5, 0, 0)]  # over the origin, 0.1 m above the table


@pytest.mark.parametrize('options, told', [
    ({}, ''),
    ({'reach_1': 'annulus 0 0 0.2 0.8'}, 'hand_1 leaves its reach, annulus 0 0 0.2 0.8'),
    ({'reach_1': 'annulus 0 0 0 0.5'}, ''),
    ({'reach_1': 'annulus 0 0 0 0.4'}, 'hand_1 leaves its reach, annulus 0 0 0 0.4'),
    ({'reach_1': 'box -1 -1 0 1 1 0.1'}, ''),
    ({'reach_1': 'box -1 -1 0 1 1 0.09'}, 'hand_1 leaves its reach, box -1 -1 0 1 1 0.09'),
    ({'reach_2': 'box 5 5 5 6 6 6'}, ''),  # that of another hand
    ({'no_go': ['-0.1 -0.1 0 0.1 0.1 0.09']}, ''),  # the hand passes above
    ({'no_go': ['2 2 2 3 3 3', '0.1 -0.1 0.2 -0.1 0.1 0']},
     'hand_1 enters the no-go box 0.1 -0.1 0.2 -0.1 0.1 0')])
def test_an_action_is_refused_by_the_limit_that_it_breaks(options, told):
    assert Limits.of(PlanOptions.of(options)).refusal(action(LIFTED)) == told


def test_each_hand_has_its_own_reach_and_a_hand_that_stays_is_judged_too():
    limits = Limits.of(PlanOptions(hands=2, reach_1='box 0 -1 -1 1 1 1', reach_2='box -1 -1 -1 0 1 1'))
    right, left = [(0.5, 0, 0), (0.9, 0, 0)], [(-0.5, 0, 0)]
    assert limits.refusal(action(right, left)) == ''
    assert limits.refusal(action(left, right)) == 'hand_1 leaves its reach, box 0 -1 -1 1 1 1'
    assert limits.refusal(action(right, right)) == 'hand_2 leaves its reach, box -1 -1 -1 0 1 1'


def test_a_box_is_entered_by_the_dlo_between_its_points_at_any_instant():
    limits = Limits.of(PlanOptions(no_go=['0.04 -1 0 0.06 1 1']))
    away = np.array([[0, 0, 0], [0, 0.1, 0], [0, 0.2, 0.0]])
    across = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.0]])
    assert limits.entered(np.stack([away, away])) == ''
    assert limits.entered(np.stack([away, across])) == 'the DLO enters the no-go box 0.04 -1 0 0.06 1 1'
    assert Limits.of(PlanOptions()).entered(across[None]) == ''


@pytest.mark.parametrize('text', [
    'box', 'box 1 2 3', 'box 0 0 0 1 1 nan', 'box 0 0 0 1 1 inf', 'box 0 0 0 1 1 1e7', 'box 0,0,0 1,1,1',
    'annulus', 'annulus 0 0 1', 'annulus 0 0 0.2 0.8 1', 'annulus 0 0 a b', 'sphere 0 0 0 1', '0 0 0 1 1 1',
    'annulus 0 0 0.8 0.2', 'annulus 0 0 -1 1', 'annulus 0 0 1 1', 'box ' + 9000 * '1'],
    ids=lambda text: text[:20])
def test_a_reach_that_is_none_is_refused_in_one_sentence(text):
    for name in ('reach_1', 'reach_2'):
        with pytest.raises(InputError) as refusal:
            PlanOptions.of({name: text})
        assert refusal.value.thing == f'parameter {name}'
        assert len(str(refusal.value)) <= 300


@pytest.mark.parametrize('text', [
    '1', '0 0 0 1 1', '0 0 0 1 1 1 1', '0 0 0 1 1 x', '0 0 0 1 1 nan', '\x1b[2J'])
def test_a_box_that_is_none_is_refused_in_one_sentence(text):
    with pytest.raises(InputError) as refusal:
        PlanOptions.of({'no_go': ['0 0 0 1 1 1', text]})
    assert refusal.value.thing == 'parameter no_go'
    assert refusal.value.expected == 'x0 y0 z0 x1 y1 z1, two opposite corners in metres'
    assert '\x1b' not in str(refusal.value)


def test_any_two_opposite_corners_give_a_box():
    assert (read_box('', '1 -1 0 0 1 -2').lower == (0, -1, -2)).all()
    assert (read_reach('', ' box  1 -1 0 0 1 -2 ').upper == (1, 1, 0)).all()
