# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Limits: straight ways against boxes and annuli, compared with dense sampling; crossings; the options."""

import argparse

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration import Action, InputError, Options
from dlo_calibration.calibration.options import MACHINE, SEARCH
from dlo_calibration.cli.arguments import add_options, given_options
from dlo_calibration.model.action import Hand
from dlo_calibration.planning.limits import Annulus, Box, crossings, read_box, read_reach
from dlo_calibration.planning.options import PlanOptions

SAMPLES = 4001  # of a way
#: On a grid of tenths, faces, edges and corners are met often, and nothing is decided by rounding alone.
COORDINATES = st.integers(-10, 10).map(lambda tenths: tenths / 10)
PLACES = st.tuples(COORDINATES, COORDINATES, COORDINATES).map(np.array)


def along(begin, end):
    """Return many places of a straight way, and the distance between neighbours [m]."""
    places = begin + np.linspace(0, 1, SAMPLES)[:, None] * (end - begin)
    return places, float(np.linalg.norm(end - begin)) / (SAMPLES - 1)


def single(answer):
    """Return the answer about a single way."""
    assert answer.shape == (1,)
    return bool(answer[0])


@drawing(60)
@given(PLACES, PLACES, PLACES, PLACES)
def test_a_way_enters_a_box_if_one_of_its_places_does(corner, other, begin, end):
    box = Box.between(np.concatenate([corner, other]))
    places, spacing = along(begin, end)
    outside = np.maximum(box.lower - places, places - box.upper).max(axis=1)  # 0 or less: inside
    entered = single(box.entered(begin[None], end[None]))
    if (outside <= 0).any():
        assert entered
    if entered:  # then a place between two samples is inside
        assert outside.min() <= spacing + 2e-9
    assert single(box.contains(begin[None], end[None])) == (outside <= 1e-9).all()
    assert entered == single(box.entered(end[None], begin[None]))


@drawing(60)
@given(PLACES, PLACES, st.integers(0, 10), st.integers(1, 10))
def test_a_way_keeps_to_an_annulus_if_all_its_places_do(begin, end, inner, width):
    ring = Annulus(np.array([0.1, -0.2]), inner / 10, (inner + width) / 10)
    places, spacing = along(begin, end)
    radii = np.linalg.norm(places[:, :2] - ring.centre, axis=1)
    contained = single(ring.contains(begin[None], end[None]))
    if contained:
        assert (radii >= ring.inner - 2e-9).all() and (radii <= ring.outer + 2e-9).all()
    else:
        assert radii.min() < ring.inner + spacing or radii.max() > ring.outer


@drawing(30)
@given(st.lists(st.tuples(PLACES, PLACES), min_size=2, max_size=6), PLACES, PLACES)
def test_many_ways_are_judged_as_each_by_itself(ways, corner, other):
    begin, end = (np.array(places) for places in zip(*ways, strict=True))
    box, ring = Box.between(np.concatenate([corner, other])), Annulus(corner[:2], 0.3, 0.9)
    for judge in (box.entered, box.contains, ring.contains):
        assert judge(begin, end).tolist() == [single(judge(a[None], b[None])) for a, b in ways]


def action(*ways):
    """Return an action whose hands move along ways, (k, 3) each."""
    return Action(tuple(Hand(f'hand_{k}', (0,), np.arange(len(way)), np.array(way, dtype=float))
                        for k, way in enumerate(ways, start=1)))


LIFTED = [(0.5, 0, 0), (0.5, 0, 0.1), (-0.5, 0, 0.1), (-0.5, 0, 0)]  # over the origin, 0.1 m above the table


@pytest.mark.parametrize('options, refusal', [
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
def test_an_action_is_refused_by_the_limit_that_it_breaks(options, refusal):
    assert PlanOptions.of(options).limits.refusal(action(LIFTED)) == refusal


def test_each_hand_has_its_own_reach_and_a_hand_that_stays_is_judged_too():
    limits = PlanOptions(hands=2, reach_1='box 0 -1 -1 1 1 1', reach_2='box -1 -1 -1 0 1 1').limits
    right, left = [(0.5, 0, 0), (0.9, 0, 0)], [(-0.5, 0, 0)]
    assert limits.refusal(action(right, left)) == ''
    assert limits.refusal(action(left, right)) == 'hand_1 leaves its reach, box 0 -1 -1 1 1 1'
    assert limits.refusal(action(right, right)) == 'hand_2 leaves its reach, box -1 -1 -1 0 1 1'


def test_a_box_is_entered_by_the_dlo_between_its_points_at_any_instant():
    limits = PlanOptions(no_go=['0.04 -1 0 0.06 1 1']).limits
    away = np.array([[0, 0, 0], [0, 0.1, 0], [0, 0.2, 0.0]])
    across = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.0]])
    assert limits.entered(np.stack([away, away])) == ''
    assert limits.entered(np.stack([away, across])) == 'the DLO enters the no-go box 0.04 -1 0 0.06 1 1'
    assert PlanOptions().limits.entered(across[None]) == ''


@pytest.mark.parametrize('text', [
    'box', 'box 1 2 3', 'box 0 0 0 1 1 nan', 'box 0 0 0 1 1 inf', 'box 0 0 0 1 1 1e7', 'box 0,0,0 1,1,1',
    'annulus', 'annulus 0 0 1', 'annulus 0 0 0.2 0.8 1', 'annulus 0 0 a b', 'sphere 0 0 0 1', '0 0 0 1 1 1',
    'annulus 0 0 0.8 0.2', 'annulus 0 0 -1 1', 'annulus 0 0 1 1', 'box ' + 9000 * '1'],
    ids=lambda text: text[:20])
def test_an_invalid_reach_is_refused(text):
    for name in ('reach_1', 'reach_2'):
        with pytest.raises(InputError) as refusal:
            PlanOptions.of({name: text})
        assert refusal.value.thing == f'parameter {name}'
        assert len(str(refusal.value)) <= 300


@pytest.mark.parametrize('text', [
    '1', '0 0 0 1 1', '0 0 0 1 1 1 1', '0 0 0 1 1 x', '0 0 0 1 1 nan', '\x1b[2J'])
def test_an_invalid_box_is_refused(text):
    with pytest.raises(InputError) as refusal:
        PlanOptions.of({'no_go': ['0 0 0 1 1 1', text]})
    assert refusal.value.thing == 'parameter no_go'
    assert refusal.value.expected == 'x0 y0 z0 x1 y1 z1, two opposite corners in metres'
    assert '\x1b' not in str(refusal.value)


def test_any_two_opposite_corners_give_a_box():
    assert (read_box('', '1 -1 0 0 1 -2').lower == (0, -1, -2)).all()
    assert (read_reach('', ' box  1 -1 0 0 1 -2 ').upper == (1, 1, 0)).all()

t = np.linspace(0, 1, 41)


def curve(x, y, z=0.0):
    return np.stack(np.broadcast_arrays(x, y, z), axis=1)


@pytest.mark.parametrize('points, count', [
    (curve(t, 0.0), 0),
    (curve(t, np.sin(9 * t)), 0),
    (curve(np.cos(5 * t), np.sin(5 * t)), 0),  # not yet a full circle
    (curve(t + 0.4 * np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)), 1),
    (curve(np.sin(2 * np.pi * t + 0.3), np.sin(4 * np.pi * t + 0.6 + 0.01)), 1),  # an eight
    (curve(t + 0.1 * np.sin(6 * np.pi * t), np.cos(6 * np.pi * t)), 3),  # three loops in a row
    (curve([0, 1, 0, 1], [0, 0, 1e-9, 1e-9]), 0),  # folded on itself
], ids=['straight', 'wave', 'arc', 'loop', 'eight', 'loops', 'folded'])
def test_crossings_are_counted_whatever_is_above_and_wherever_it_is_seen_from(points, count):
    turn = np.array([[np.cos(1), -np.sin(1), 0], [np.sin(1), np.cos(1), 0], [0, 0, 1]])
    assert crossings(points) == count
    assert crossings(points[::-1]) == count
    assert crossings(points @ turn.T + 3) == count
    assert crossings(points + curve(0 * points[:, 0], 0.0, np.cos(50 * points[:, 0]))) == count


@drawing(30)
@given(st.lists(st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=3, max_size=12, unique=True))
def test_crossings_are_those_of_the_signs_of_areas(points):
    """Two segments cross if the ends of each are on different sides of the other."""
    def side(a, b, c):
        return np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    count, sides = 0, []
    for i in range(len(points) - 1):
        for j in range(i + 2, len(points) - 1):
            a, b, c, d = points[i], points[i + 1], points[j], points[j + 1]
            sides += [side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)]
            count += sides[-4] * sides[-3] < 0 and sides[-2] * sides[-1] < 0
    if all(sides):  # no point lies on another segment
        assert crossings(np.array([(*point, 0.0) for point in points])) == count

DECLARED = {declaration.name: declaration for declaration in PlanOptions.declarations()}
DEFAULTS = {
    'actions': 4, 'hands': 1, 'kinds': ['grasp_and_place', 'drag'], 'objective': 'points', 'tolerance': 1.0,
    'crossings': False, 'draws': 8, 'seed': 1, 'height': 0.0, 'speed': 0.0, 'reach_1': '', 'reach_2': '',
    'no_go': [], 'clearance': 0.015, 'least_bend_radius': 0.0, 'most_tension': 0.0, 'workers': 0}
#: Texts that are options, where not every text is.
TEXTS = {'reach_1': ['', 'box 0 0 0 1 1 1', 'annulus 0.1 -2 0 1e3'],
         'no_go': ['0 0 0 1 1 1', '-1 -1 0 1 1 .5']}


def values(declaration):
    """Return a strategy for the values that an option may have."""
    kind = type(declaration.default)
    if declaration.name == 'speed':
        return st.just(0.0) | st.floats(1e-4, declaration.maximum)
    if kind in (int, float):
        return (st.integers if kind is int else st.floats)(declaration.minimum, declaration.maximum)
    if kind is bool:
        return st.booleans()
    texts = TEXTS['reach_1' if declaration.name == 'reach_2' else declaration.name] \
        if not declaration.choices else declaration.choices
    if kind is str:
        return st.sampled_from(texts)
    return st.lists(st.sampled_from(texts), min_size=1 if declaration.choices else 0, unique=True)


@pytest.mark.parametrize('length, height, speed', [
    (0.3, 0.05, 0.1), (15.0, 0.05, 0.1), (0.03, 0.005, 0.01)])
def test_a_dlo_that_is_shorter_than_a_forearm_is_lifted_less_and_moved_more_slowly(length, height, speed):
    options = PlanOptions().of_length(length)
    assert (options.height, options.speed) == pytest.approx((height, speed))
    assert PlanOptions(height=0.2, speed=0.3).of_length(length) == PlanOptions(height=0.2, speed=0.3)


def test_hands_that_hardly_move_are_refused():
    with pytest.raises(InputError, match='parameter speed.*1e-05 m/s.*at least 0.0001 m/s'):
        PlanOptions(speed=1e-5)


def test_the_defaults_of_a_plan_and_the_options_that_no_file_may_set():
    assert PlanOptions().flat() == DEFAULTS
    assert {declaration.of for declaration in DECLARED.values()} == {MACHINE, SEARCH}
    robot = {'height', 'speed', 'reach_1', 'reach_2', 'no_go', 'clearance', 'least_bend_radius',
             'most_tension'}
    assert {name for name in DECLARED if DECLARED[name].of == MACHINE} == {'workers', *robot}


@pytest.mark.parametrize('declaration', DECLARED.values(), ids=DECLARED)
def test_every_option_is_declared_completely(declaration):
    assert declaration.description
    if type(declaration.default) in (int, float):
        assert declaration.minimum <= declaration.default <= declaration.maximum
        for beyond in (2 * declaration.maximum + 1, declaration.minimum - 1, float('nan')):
            with pytest.raises(InputError, match=f'^parameter {declaration.name}: '):
                PlanOptions.of({declaration.name: beyond})
    for wrong in (None, {}, [1], b'x'):
        with pytest.raises(InputError, match=f'^parameter {declaration.name}: '):
            PlanOptions.of({declaration.name: wrong})


@drawing(25)
@given(st.fixed_dictionaries({}, optional={name: values(DECLARED[name]) for name in DECLARED}))
def test_flat_and_of_are_inverse(chosen):
    options = PlanOptions.of(chosen)
    assert options.flat() == {**DEFAULTS, **chosen}
    assert PlanOptions.of(options.flat()) == options


def test_names_of_other_options_are_refused():
    with pytest.raises(InputError, match="^parameter: 'evaluations'; expected one of "):
        PlanOptions.of({'evaluations': 3})


@pytest.mark.parametrize('names', [[], ['drag', 'drag']])
def test_a_plan_needs_one_or_more_different_kinds_of_actions(names):
    with pytest.raises(InputError, match='^parameter kinds: '):
        PlanOptions.of({'kinds': names})


def test_a_command_line_can_have_options_of_two_classes():
    parser = argparse.ArgumentParser()
    add_options(parser, kind=PlanOptions, title='options of the plan')
    add_options(parser, set(Options().flat()) - set(DECLARED))
    words = ['--no-go', '-0.1 0 0 1 1 1', '5 5 5 6 6 6', '--reach-1', 'annulus 0 0 0.2 0.8', '--kinds',
             'drag', '--crossings', '--speed', '0.2', '--table-height', '0.7']
    chosen = parser.parse_args(words)
    assert given_options(chosen, PlanOptions) == {
        'no_go': ['-0.1 0 0 1 1 1', '5 5 5 6 6 6'], 'reach_1': 'annulus 0 0 0.2 0.8', 'kinds': ['drag'],
        'crossings': True, 'speed': 0.2}
    assert given_options(chosen) == {'table_height': 0.7}
    assert PlanOptions.of(given_options(chosen, PlanOptions)).no_go == ('-0.1 0 0 1 1 1', '5 5 5 6 6 6')
    assert Options.of(given_options(chosen)).table_height == 0.7
