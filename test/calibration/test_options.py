# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Every option: its default, its type, its range, and what is refused."""

import math

from hypothesis import given
from hypothesis import strategies as st
import pytest
from random_examples import drawing

from dlo_calibration import InputError
from dlo_calibration.calibration.options import FIXED_VALUES, Options
from dlo_calibration.model.parameters import (
    BY_NAME,
    CLAMP_BENDS,
    HANDS,
    PARAMETERS,
    REST_SHAPE,
    STIFFNESS_KNOTS,
)
from dlo_calibration.search import SEARCHES

DECLARED = {declaration.name: declaration for declaration in Options.declarations()}

#: The defaults that are part of the message contract.
CONTRACT = {
    'mass': 0.0, 'table': True, 'table_height': 0.0,
    'calibrate': ['auto'], 'search': 'least_squares', 'evaluations': 0,
    'grip_tolerance': 0.02, 'length_tolerance': 50.0,
    'start_after_trials': 0, 'output_directory': '.', 'record': True, 'release': True,
    'engine': 'auto', 'workers': 0,
}
MORE = {'seed', 'stable_distance', 'stable_time', 'settle_limit'}


def test_defaults_are_those_of_the_contract():
    flat = Options().flat()
    assert {name: flat[name] for name in CONTRACT} == CONTRACT
    assert MORE <= set(flat)


def test_there_is_an_option_for_every_value_that_is_not_calibrated():
    assert set(FIXED_VALUES) == {parameter.name for parameter in PARAMETERS} - {'mass', *HANDS}
    assert set(FIXED_VALUES) <= set(DECLARED)


@pytest.mark.parametrize('declaration', DECLARED.values(), ids=DECLARED)
def test_every_option_is_declared_completely(declaration):
    assert declaration.description
    assert type(declaration.default) in (bool, int, float, str, tuple)
    if type(declaration.default) in (int, float):
        assert declaration.minimum <= declaration.default <= declaration.maximum
    if declaration.choices:
        chosen = declaration.default if isinstance(declaration.default, tuple) else (declaration.default,)
        assert set(chosen) <= set(declaration.choices)
    assert Options.of({declaration.name: declaration.default}) == Options()


WRONG = {bool: (1, 'true', None), int: (1.0, '1', True, None), float: ('1', True, None, [1.0]),
         str: (1, None, ['a']), tuple: (1, [1], None)}
EXPECTED = {bool: 'true or false', int: 'an integer', float: 'a number', str: 'a text',
            tuple: 'a list of names'}


@pytest.mark.parametrize('name', DECLARED)
def test_another_type_is_refused(name):
    kind = type(DECLARED[name].default)
    for value in WRONG[kind]:
        with pytest.raises(InputError) as refusal:
            Options.of({name: value})
        assert refusal.value.thing == f'parameter {name}'
        assert refusal.value.expected == EXPECTED[kind]


@pytest.mark.parametrize('name', [name for name in DECLARED if type(DECLARED[name].default) in (int, float)])
def test_numbers_out_of_range_are_refused_and_the_ends_are_not(name):
    declaration = DECLARED[name]
    kind = type(declaration.default)
    low, high = kind(declaration.minimum), kind(declaration.maximum)
    for end in (low, high):
        assert Options.of({name: end}).flat()[name] == end
    step = 1 if kind is int else 1e-3 * (high - low)
    beyond = [low - step, high + step] + ([math.nan, math.inf, -math.inf] if kind is float else [])
    for value in beyond:
        with pytest.raises(InputError) as refusal:
            Options.of({name: value})
        assert f'parameter {name}: {value:g}' in str(refusal.value)
        assert f'expected {low:g} to {high:g}' in str(refusal.value)


@pytest.mark.parametrize('name', [name for name in DECLARED if DECLARED[name].choices])
def test_only_choices_can_be_chosen(name):
    declaration = DECLARED[name]
    several = isinstance(declaration.default, tuple)
    for choice in declaration.choices:
        value = [choice] if several else choice
        assert Options.of({name: value}).flat()[name] == value
    with pytest.raises(InputError) as refusal:
        Options.of({name: [declaration.choices[0], 'nonsense'] if several else 'nonsense'})
    text = str(refusal.value)
    assert f"parameter {name}: 'nonsense'; expected one of " in text
    if len(declaration.choices) < 8:
        assert ', '.join(declaration.choices) in text
    assert len(text) < 300


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="parameter: 'evalutions'; expected one of evaluations, "):
        Options.of({'evalutions': 10})
    with pytest.raises(InputError, match="parameter: 'values'"):
        Options.of({'values': {}})
    with pytest.raises(InputError, match="parameter: 'mass'"):
        Options(values={'mass': 42.0})


def test_an_integer_is_a_number_too():
    assert Options.of({'mass': 1, 'friction': 30}).flat()['mass'] == 1.0


def test_auto_stands_alone():
    with pytest.raises(InputError, match='calibrate: friction, auto; expected auto alone, or only names; '
                                         'leave auto out'):
        Options.of({'calibrate': ['friction', 'auto']})
    assert Options(calibrate='auto') == Options.of({'calibrate': 'auto'}) == Options()


@pytest.mark.parametrize('names', [[], ['friction', 'friction']])
def test_a_calibration_of_no_name_or_of_a_name_twice_is_refused(names):
    with pytest.raises(InputError, match='calibrate: .* expected one or more different names'):
        Options.of({'calibrate': names})


def values(declaration):
    """Return a strategy for the values that an option may have."""
    kind = type(declaration.default)
    if kind is bool:
        return st.booleans()
    if kind is int:
        return st.integers(declaration.minimum, declaration.maximum)
    if kind is float:
        return st.floats(declaration.minimum, declaration.maximum)
    if kind is tuple:
        names = [choice for choice in declaration.choices if choice != 'auto']
        some = st.lists(st.sampled_from(names), min_size=1, unique=True)
        return some | st.just(['auto']) if 'auto' in declaration.choices else some
    if declaration.name == 'sessions':
        return st.sampled_from(['', '4', '4 3'])
    if declaration.name == 'frame_pose':
        return st.sampled_from(['', '0 0 -0.75 0 0 0 1', '0.1 0.2 1.5 1.0 0 0 0'])
    return st.sampled_from(declaration.choices) if declaration.choices else st.text()


@drawing(25)
@given(st.fixed_dictionaries({}, optional={name: values(d) for name, d in DECLARED.items()}))
def test_flat_and_of_are_inverse(given_options):
    options = Options.of(given_options)
    flat = options.flat()
    assert set(flat) == set(DECLARED)
    assert {name: flat[name] for name in given_options} == given_options
    assert Options.of(flat) == options
    assert {name: value for name, value in flat.items() if name not in given_options} \
        == {name: value for name, value in Options().flat().items() if name not in given_options}


def test_the_space_follows_from_the_options():
    space = Options.of({'calibrate': ['friction', 'mass'], 'flexibility': 10.0, 'mass': 0.2}).space
    assert space.free == ('friction', 'mass')
    assert space.mass == 0.2
    assert space.fixed['flexibility'] == 10.0


def test_every_search_can_be_chosen():
    assert DECLARED['search'].choices == tuple(SEARCHES)


def test_parts_are_calibrated_if_flexibility_is():
    assert Options().space.parts == 1
    space = Options.of({'calibrate': ['flexibility', 'friction'], 'parts': 3, 'stiffness_5': 70.0}).space
    assert space.free == ('flexibility', 'friction', 'stiffness_2', 'stiffness_3')
    assert space.parts == 3
    fixed = Options.of({'calibrate': ['friction'], 'parts': 2, 'stiffness_2': 70.0}).space
    assert (fixed.free, fixed.parts, fixed.fixed['stiffness_2']) == (('friction',), 2, 70.0)


def test_there_are_as_many_parts_as_calibrate_names():
    space = Options.of({'calibrate': ['flexibility', 'stiffness_3'], 'parts': 2}).space
    assert space.free == ('flexibility', 'stiffness_3', 'stiffness_2')
    assert Options.of({'calibrate': ['stiffness_3']}).space.parts == 3


def test_a_rest_shape_that_is_given_is_simulated_though_it_is_not_calibrated():
    space = Options(values={'rest_curvature_y4': 70.0}).space
    assert space.knots == 5
    assert not set(space.free) & set(REST_SHAPE)
    assert space.physical({}, 1.0)['rest_curvature_y4'] == BY_NAME['rest_curvature_y4'].physical(70.0)
    assert 'rest_curvature_y4' not in Options().space.physical({}, 1.0)


@pytest.mark.parametrize(('names', 'knots'), [(CLAMP_BENDS, 3), (STIFFNESS_KNOTS, 0)])
def test_what_a_dlo_rarely_has_is_there_when_it_is_named(names, knots):
    # Bends at clamps need a rest shape, in whose frame they are.
    assert not Options().space.physical({}, 1.0).keys() & {*names}
    found = Options(calibrate=('flexibility', names[0])).space
    assert names[0] in found.free and found.knots == knots
    fixed = Options(values={names[1]: 70.0}).space
    assert fixed.knots == knots and names[0] not in fixed.free
    physical = fixed.physical({}, 1.0)
    assert physical[names[0]] == BY_NAME[names[0]].neutral
    assert physical[names[1]] == BY_NAME[names[1]].physical(70.0)
