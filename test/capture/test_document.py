# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The document of a project: missing values have defaults, and wrong ones are refused."""

import copy
import json

import pytest

from dlo_calibration.capture.document import Document, PhotographEntry
from dlo_calibration.capture.hands import described, KINDS
from dlo_calibration.errors import InputError

A, B, C = 'aaaaaaaa', 'bbbbbbb2', 'ccccccc3'
FULL = {
    'version': 1, 'dlo': {'diameter': 0.008, 'mass': 0.03, 'points': 31},
    'photographs': [
        {'id': A, 'name': 'start.jpg', 'scale': {'kind': 'board', 'ruler': 0.099},
         'clicks': [[10, 20.5], [300, 40]], 'crossings': [{'pixel': [5, 5], 'first_above': True}]},
        {'id': B, 'name': 'goal.jpg', 'scale': {'kind': 'same', 'photograph': A}, 'clicks': [],
         'crossings': []},
        {'id': C, 'name': '', 'scale': {'kind': 'points', 'points': [
            {'pixel': [1, 2], 'table': [0.1, -0.2]}]}, 'clicks': [], 'crossings': []}],
    'trials': [{'start': A, 'goal': B, 'start_side': None, 'goal_side': C, 'steps': [
        {'kind': 'grasp_and_place', 'hand': 'left_hand', 'fraction': 0.35, 'to': [0.1, 0.2], 'height': 0.05,
         'speed': 0.1, 'hold': False, 'with_previous': False},
        {'kind': 'path', 'hand': 'right_hand', 'fraction': 1.0, 'waypoints': [[0, 0.1, 0.05], [1, 1, 0.0]],
         'speed': 0.2, 'hold': True, 'with_previous': True},
        {'kind': 'two_hands', 'hands': ['a', 'b'], 'fractions': [0.0, 1.0], 'motion': 'apart',
         'distance': 0.02, 'moving': 'both', 'height': 0.0, 'speed': 0.1, 'hold': True,
         'with_previous': False},
        {'kind': 'release', 'hands': ['right_hand'], 'with_previous': False}]}],
    'obstacles': [{'photograph': A, 'kind': 'peg', 'first': [50, 60], 'second': [55, 60.5], 'height': 0.04,
                   'turn': 0.0},
                  {'photograph': B, 'kind': 'box', 'first': [100, 20], 'second': [150, 90], 'height': 0.1,
                   'turn': -0.5}],
    'films': [{'id': 'ddddddd4', 'name': 'rope.mp4', 'ruler': 0.1, 'trials': [
                   {'at': 3.5, 'start': 1.0, 'end': None, 'name': 'the end is lifted', 'used': False}],
               'marks': [{'time': 0.5, 'clicks': [[1, 2], [300.5, 4]]}],
               'held': [{'place': 0.2, 'height': 0.05}]}]}


def changed(path, value):
    """Return the full document with another value at a path of names and indices."""
    plain = copy.deepcopy(FULL)
    place = plain
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    return plain


def test_a_document_keeps_all_its_values():
    assert Document.of(FULL).plain() == json.loads(json.dumps(FULL))


def test_a_missing_value_has_its_default():
    plain = Document.of({'photographs': [{'id': A}], 'trials': [{'start': A, 'steps': [
        {'kind': kind} for kind in KINDS]}]}).plain()
    assert plain['dlo'] == {'diameter': None, 'mass': 0.0, 'points': 21}
    assert plain['photographs'][0] == {'id': A, 'name': '', 'scale': None, 'clicks': [], 'crossings': []}
    for step, kind in zip(plain['trials'][0]['steps'], described(), strict=True):
        defaults = {name: field['default'] for name, field in kind['fields'].items()}
        assert step == {'kind': kind['kind'], **defaults, 'with_previous': False}
    assert Document.of(plain).plain() == plain
    assert Document.of({}) == Document()


STEP = ('trials', 0, 'steps', 0)
NESTED = []
for _ in range(500):
    NESTED = [NESTED]


@pytest.mark.parametrize('path, value, place', [
    (('version',), 2, 'version'),
    (('colour',), 'red', 'document'),
    (('dlo', 'diameter'), float('nan'), 'dlo, diameter'),
    (('dlo', 'diameter'), -1, 'dlo, diameter'),
    (('dlo', 'mass'), True, 'dlo, mass'),
    (('dlo', 'mass'), '0.1', 'dlo, mass'),
    (('dlo', 'points'), 10**400, 'dlo, points'),
    (('dlo', 'points'), 20.5, 'dlo, points'),
    (('photographs',), {}, 'photographs'),
    (('obstacles',), [{}] * 21, 'obstacles'),
    (('obstacles', 0, 'kind'), 'cone', 'obstacle 1, kind'),
    (('obstacles', 1, 'photograph'), 'dddddddd', 'obstacle 2'),
    (('obstacles', 0, 'height'), 0.0, 'obstacle 1, height'),
    (('obstacles', 0, 'height'), float('inf'), 'obstacle 1, height'),
    (('obstacles', 1, 'first'), [1.0], 'obstacle 2, first'),
    (('obstacles', 1, 'second'), [1.0, None], 'obstacle 2, second 2'),
    (('obstacles', 1, 'turn'), 100, 'obstacle 2, turn'),
    (('obstacles', 1, 'colour'), 'red', 'obstacle 2'),
    (('photographs',), [{'id': A}] * 201, 'photographs'),
    (('photographs', 1, 'id'), A, 'photographs'),
    (('photographs', 0, 'id'), '../../..', 'photograph 1, id'),
    (('photographs', 0, 'id'), 'aaaaaaaa\n', 'photograph 1, id'),
    (('photographs', 0, 'name'), 'x' * 10**6, 'photograph 1, name'),
    (('photographs', 0, 'clicks'), [[1, 2]] * 51, 'photograph 1, clicks'),
    (('photographs', 0, 'clicks', 1), [1, 2, 3], 'photograph 1, click 2'),
    (('photographs', 0, 'clicks', 1), [1, float('inf')], 'photograph 1, click 2 2'),
    (('photographs', 0, 'clicks'), NESTED, 'photograph 1, click 1'),
    (('photographs', 0, 'scale'), {'kind': 'guess'}, 'photograph 1, scale, kind'),
    (('photographs', 0, 'scale'), {'kind': 'same', 'photograph': B}, 'photograph 1, scale'),
    (('photographs', 0, 'scale'), {'kind': 'same', 'photograph': 'zzzzzzzz'}, 'photograph 1, scale'),
    (('photographs', 2, 'scale', 'points', 0, 'table'), [0, 1e9], 'photograph 3, scale, point 1, table 2'),
    (('trials', 0, 'goal'), 'zzzzzzzz', 'trial 1'),
    (('trials', 0, 'start'), None, 'trial 1, start'),
    ((*STEP, 'kind'), 'throw', 'trial 1, step 1, kind'),
    ((*STEP, 'kind'), ['drag'], 'trial 1, step 1, kind'),
    ((*STEP, 'fraction'), 1.2, 'trial 1, step 1, fraction'),
    ((*STEP, 'speed'), 0, 'trial 1, step 1, speed'),
    ((*STEP, 'distance'), 0.1, 'trial 1, step 1'),
    ((*STEP, 'hand'), 'left hand', 'trial 1, step 1, hand'),
    ((*STEP, 'hand'), '\ud800', 'trial 1, step 1, hand'),
    ((*STEP, 'to'), [0.1], 'trial 1, step 1, to'),
    (('trials', 0, 'steps', 1, 'waypoints', 0), [0, 0, -0.1], 'trial 1, step 2, waypoints 1'),
    (('trials', 0, 'steps', 2, 'fractions'), [0.5], 'trial 1, step 3, fractions'),
    (('trials', 0, 'steps', 2, 'moving'), 'none', 'trial 1, step 3, moving'),
])
def test_a_wrong_value_is_refused_with_its_place(path, value, place):
    with pytest.raises(InputError) as caught:
        Document.of(changed(path, value))
    assert caught.value.thing == place
    assert len(str(caught.value)) <= 300


@pytest.mark.parametrize('plain', [None, [], 'text', 1])
def test_other_values_than_objects_are_no_document(plain):
    with pytest.raises(InputError, match='document'):
        Document.of(plain)


def test_each_new_photograph_gets_its_place_in_a_trial():
    document = Document()
    for identity in (A, B, C):
        document = document.with_photograph(PhotographEntry(identity))
    assert [(trial.start, trial.goal) for trial in document.trials] == [(A, B), (B, C)]
