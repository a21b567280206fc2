# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The 0..100 scale: the physical value of each value, and defaults."""

import math
import subprocess
import sys

from hypothesis import given
from hypothesis import strategies as st
import pytest
from random_examples import drawing

from dlo_calibration import InputError
from dlo_calibration.model.parameters import (
    BY_NAME,
    HANDS,
    PARAMETERS,
    ParameterSpace,
    PART_NAMES,
    REST_STATE,
    STIFFNESS_KNOTS,
)

PAPER = ('flexibility', 'elasticity', 'friction', 'self_collision')
WEIGHT = 0.05 * 9.81  # N/m, of a DLO whose mass is not known

MAPPING = {
    'flexibility': lambda u: 10 ** (1 - 6.5 * u / 100),
    'elasticity': lambda u: 10 ** (4 - 4 * u / 100),
    'friction': lambda u: 10 ** (-2 + 2.3 * u / 100),
    'self_collision': lambda u: 0.002 * 15 ** (u / 100),
}


@pytest.mark.parametrize('name', PAPER)
def test_the_papers_four_have_their_documented_quantities(name):
    for value in (0, 1, 25, 50, 87.5, 100):
        assert BY_NAME[name].physical(value) == pytest.approx(MAPPING[name](value), rel=1e-12)


@pytest.mark.parametrize(('name', 'at_zero', 'at_hundred', 'unit'), [
    ('flexibility', 10.0, 10**-5.5, 'N m^2'), ('elasticity', 1e4, 1.0, 'N'),
    ('friction', 0.01, 10**0.3, '1'), ('self_collision', 0.002, 0.03, 'm')])
def test_the_ends_of_the_scale(name, at_zero, at_hundred, unit):
    assert BY_NAME[name].physical(0) == pytest.approx(at_zero, rel=1e-12)
    assert BY_NAME[name].physical(100) == pytest.approx(at_hundred, rel=1e-12)
    assert BY_NAME[name].unit == unit


@pytest.mark.parametrize('parameter', PARAMETERS, ids=lambda parameter: parameter.name)
@drawing(20)
@given(u=st.floats(0, 100), v=st.floats(0, 100))
def test_every_scale_is_monotonic_and_can_be_inverted(parameter, u, v):
    assert parameter.value(parameter.physical(u)) == pytest.approx(u, abs=1e-9)
    if abs(u - v) > 1e-6:
        rises = parameter.at_hundred > parameter.at_zero
        assert (parameter.physical(u) < parameter.physical(v)) == ((u < v) == rises)


@pytest.mark.parametrize('parameter', PARAMETERS, ids=lambda parameter: parameter.name)
def test_every_parameter_says_what_it_is_and_has_a_default_on_the_scale(parameter):
    assert parameter.quantity and parameter.unit and parameter.description
    assert 0 <= parameter.default <= 100


def test_the_default_space_has_the_four_parameters_of_the_paper():
    space = ParameterSpace()
    assert space.free == PAPER
    assert space.dimension == 4


def test_a_point_of_the_box_and_the_values_of_its_parameters():
    space = ParameterSpace(('friction', 'flexibility'))
    assert space.upper == pytest.approx([1.0, 6.5 / 4.5])
    assert space.values([0.25, space.upper[1]]) == {'friction': 25.0, 'flexibility': 100.0}
    assert space.point({'flexibility': 100.0, 'friction': 25.0}).tolist() == [0.25, space.upper[1]]
    assert BY_NAME['flexibility'].coordinate(0.1) == pytest.approx(2 / 4.5)
    with pytest.raises(ValueError):
        space.values([0.5])  # a coordinate is missing


def test_physical_values_are_free_ones_then_fixed_ones_then_defaults():
    space = ParameterSpace(('flexibility',), {'friction': 10.0})
    physical = space.physical({'flexibility': 60.0}, length=1.0)
    assert set(physical) == BY_NAME.keys() - {*PART_NAMES, *STIFFNESS_KNOTS, *REST_STATE, *HANDS}
    assert physical['flexibility'] == pytest.approx(MAPPING['flexibility'](60), rel=1e-12)
    assert physical['friction'] == pytest.approx(MAPPING['friction'](10), rel=1e-12)
    assert physical['elasticity'] == pytest.approx(
        MAPPING['elasticity'](BY_NAME['elasticity'].default), rel=1e-12)


def test_parameters_that_are_freed_begin_where_they_were():
    space = ParameterSpace(('flexibility',), {'stiffness_knot_2': 60.0})
    wider, point = space.freed(STIFFNESS_KNOTS, space.point({'flexibility': 40.0}))
    assert wider.free == ('flexibility', *STIFFNESS_KNOTS) and not wider.fixed
    assert wider.values(point) == pytest.approx(
        {'flexibility': 40.0, **dict.fromkeys(STIFFNESS_KNOTS, 50.0), 'stiffness_knot_2': 60.0})
    assert wider.freed(STIFFNESS_KNOTS, point)[0] == wider


def test_more_of_the_object_is_off_by_default_exactly():
    physical = ParameterSpace().physical({}, length=1.0)
    names = ('length_scale', 'natural_curvature', 'marker_mass', 'torsion', 'bending_friction', 'locking')
    assert [physical[name] for name in names] == [1, 0, 0, 0, 0, 0]
    parts = ParameterSpace().divided(8).physical({}, length=1.0)
    assert [parts[f'stiffness_{part}'] for part in range(2, 9)] == [1] * 7
    assert BY_NAME['length_scale'].value(1.0) == 50
    assert BY_NAME['marker_mass'].value(0.0) == 0


def test_a_linear_scale_reaches_zero():
    curvature = BY_NAME['natural_curvature']
    assert [curvature.physical(u) for u in (0, 25, 100)] == [0, 2.5, 10]
    assert curvature.value(5.0) == 50


def test_the_highest_stiffness_named_gives_the_number_of_parts():
    assert ParameterSpace().parts == 1
    space = ParameterSpace(('flexibility', 'stiffness_3'))
    assert space.parts == 3
    assert [name for name in space.physical({}, 1.0) if name.startswith('stiffness_')] == [
        'stiffness_2', 'stiffness_3']
    assert ParameterSpace(('friction',), {'stiffness_2': 40.0}).parts == 2


def test_a_divided_space_finds_the_stiffness_of_every_part():
    space = ParameterSpace(('flexibility', 'friction'), {'damping': 40.0}, 0.3)
    three = space.divided(3)
    assert three == ParameterSpace(
        ('flexibility', 'friction', 'stiffness_2', 'stiffness_3'), {'damping': 40.0}, 0.3)
    assert three.divided(1) == space
    assert three.divided(2).free == ('flexibility', 'friction', 'stiffness_2')
    # Where flexibility is not to be found, neither is that of a part.
    rest = ParameterSpace(('friction',), {'flexibility': 20.0, 'stiffness_2': 60.0}).divided(3)
    assert rest.free == ('friction',)
    assert rest.parts == 3
    assert rest.fixed == {'flexibility': 20.0, 'stiffness_2': 60.0, 'stiffness_3': 50.0}


@pytest.mark.parametrize(('arguments', 'text'), [
    ({'free': ('bendiness',)}, "parameter: 'bendiness'; expected one of flexibility, elasticity"),
    ({'fixed': {'bendiness': 1}}, "parameter: 'bendiness'; expected one of flexibility, elasticity"),
    ({'free': ()}, 'expected one or more different names'),
    ({'free': ('friction', 'friction')}, 'expected one or more different names'),
    ({'fixed': {'friction': 100.1}}, 'parameter friction: 100.1; expected a value from 0 to 100'),
    ({'fixed': {'friction': -1}}, 'parameter friction: -1; expected a value from 0 to 100'),
    ({'fixed': {'friction': math.nan}}, 'parameter friction: nan; expected a value from 0 to 100'),
])
def test_refused_spaces(arguments, text):
    with pytest.raises(InputError) as refusal:
        ParameterSpace(**arguments)
    assert text in str(refusal.value)
    assert refusal.value.remedy


def test_an_unknown_mass_is_that_of_the_assumed_density():
    assert ParameterSpace().physical(dict.fromkeys(PAPER, 50), length=0.8)['mass'] == pytest.approx(0.04)
    assert ParameterSpace(mass=0.3).physical(dict.fromkeys(PAPER, 50), length=0.8)['mass'] == 0.3


def test_stiffness_is_reported_per_weight_if_the_mass_is_unknown():
    space = ParameterSpace()
    bending, unit = space.reported('flexibility', 40.0)
    assert bending == pytest.approx(MAPPING['flexibility'](40) / WEIGHT)
    assert unit == 'N m^2 per N/m'
    stretching, unit = space.reported('elasticity', 40.0)
    assert stretching == pytest.approx(MAPPING['elasticity'](40) / WEIGHT)
    assert unit == 'N per N/m'
    # Quantities that do not depend on the weight do not change.
    assert space.reported('friction', 40.0) == (pytest.approx(MAPPING['friction'](40)), '1')
    assert space.reported('self_collision', 40.0) == (pytest.approx(MAPPING['self_collision'](40)), 'm')


@pytest.mark.parametrize(
    'arguments', [{'mass': 0.03}, {'free': ('flexibility', 'mass')}, {'fixed': {'mass': 50.0}}],
    ids=['given', 'calibrated', 'fixed'])
def test_stiffness_is_absolute_where_the_mass_is_given_calibrated_or_fixed(arguments):
    space = ParameterSpace(**arguments)
    assert space.mass_known
    assert space.reported('flexibility', 40.0) == (pytest.approx(MAPPING['flexibility'](40)), 'N m^2')


def test_the_mass_that_is_simulated_is_the_calibrated_or_fixed_one():
    mass = BY_NAME['mass'].physical
    fixed = ParameterSpace(('flexibility',), {'mass': 60.0})
    assert fixed.physical({'flexibility': 1.0}, 1.0)['mass'] == pytest.approx(mass(60))
    free = ParameterSpace(('mass',), mass=0.5)
    assert free.physical({'mass': 70.0}, 1.0)['mass'] == pytest.approx(mass(70))


def test_adding_a_parameter_is_one_entry():
    """A new line of the table is an option, can be calibrated, and reaches the engines."""
    program = """
from dlo_calibration.model import parameters
new = parameters.Parameter('stickiness', 'glue', 'N', 1.0, 100.0, 50.0, 'how it sticks')
parameters.PARAMETERS += (new,)
parameters.BY_NAME = {parameter.name: parameter for parameter in parameters.PARAMETERS}
from dlo_calibration.calibration.options import Options
assert 'stickiness' in Options().flat()
space = Options.of({'calibrate': ['stickiness']}).space
assert space.physical(space.values([1.0]), 1.0)['stickiness'] == 100.0
assert Options.of({'stickiness': 0.0}).space.physical({}, 1.0)['stickiness'] == 1.0
"""
    subprocess.run([sys.executable, '-c', program], check=True)
