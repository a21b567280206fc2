# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Options of a plan: defaults, ranges, flags; what belongs to the user's computer and robot."""

import argparse

from hypothesis import given
from hypothesis import strategies as st
import pytest
from random_examples import drawing

from dlo_calibration import InputError, Options
from dlo_calibration.calibration.declaration import MACHINE, SEARCH
from dlo_calibration.cli.options import add_options, given_options
from dlo_calibration.planning.options import PlanOptions

DECLARED = {declaration.name: declaration for declaration in PlanOptions.declarations()}
DEFAULTS = {
    'actions': 4, 'hands': 1, 'kinds': ['grasp_and_place', 'drag'], 'objective': 'points', 'tolerance': 1.0,
    'crossings': False, 'draws': 8, 'seed': 1, 'height': 0.05, 'speed': 0.1, 'reach_1': '', 'reach_2': '',
    'no_go': [], 'workers': 0}
#: Texts that are options, where not every text is.
TEXTS = {'reach_1': ['', 'box 0 0 0 1 1 1', 'annulus 0.1 -2 0 1e3'],
         'no_go': ['0 0 0 1 1 1', '-1 -1 0 1 1 .5']}


def values(declaration):
    """Return a strategy for the values that an option may have."""
    kind = type(declaration.default)
    if kind in (int, float):
        return (st.integers if kind is int else st.floats)(declaration.minimum, declaration.maximum)
    if kind is bool:
        return st.booleans()
    texts = TEXTS['reach_1' if declaration.name == 'reach_2' else declaration.name] \
        if not declaration.choices else declaration.choices
    if kind is str:
        return st.sampled_from(texts)
    return st.lists(st.sampled_from(texts), min_size=1 if declaration.choices else 0, unique=True)


def test_defaults_and_what_no_file_may_set():
    assert PlanOptions().flat() == DEFAULTS
    assert {declaration.of for declaration in DECLARED.values()} == {MACHINE, SEARCH}
    robot = {'height', 'speed', 'reach_1', 'reach_2', 'no_go'}
    assert {name for name, one in DECLARED.items() if one.of == MACHINE} == {'workers', *robot}


@pytest.mark.parametrize('declaration', DECLARED.values(), ids=DECLARED)
def test_every_option_is_declared_completely(declaration):
    assert declaration.description
    if type(declaration.default) in (int, float):
        assert declaration.minimum <= declaration.default <= declaration.maximum
        for beyond in (2 * declaration.maximum + 1, declaration.minimum - 1, float('nan')):
            with pytest.raises(InputError, match=f'^parameter {declaration.name}: got '):
                PlanOptions.of({declaration.name: beyond})
    for wrong in (None, {}, [1], b'x'):
        with pytest.raises(InputError, match=f'^parameter {declaration.name}: got '):
            PlanOptions.of({declaration.name: wrong})


@drawing(25)
@given(st.fixed_dictionaries({}, optional={name: values(one) for name, one in DECLARED.items()}))
def test_flat_and_of_are_inverse(chosen):
    options = PlanOptions.of(chosen)
    assert options.flat() == {**DEFAULTS, **chosen}
    assert PlanOptions.of(options.flat()) == options


def test_names_of_other_options_are_refused():
    with pytest.raises(InputError, match="^parameter: got 'evaluations', expected one of "):
        PlanOptions.of({'evaluations': 3})


@pytest.mark.parametrize('names', [[], ['drag', 'drag']])
def test_a_plan_needs_one_or_more_different_kinds_of_actions(names):
    with pytest.raises(InputError, match='^parameter kinds: got '):
        PlanOptions.of({'kinds': names})


def test_a_command_line_can_have_options_of_two_classes():
    parser = argparse.ArgumentParser()
    add_options(parser, kind=PlanOptions, title='options of the plan')
    add_options(parser, without=tuple(DECLARED))
    words = ['--no-go', '-0.1 0 0 1 1 1', '5 5 5 6 6 6', '--reach-1', 'annulus 0 0 0.2 0.8', '--kinds',
             'drag', '--crossings', '--speed', '0.2', '--table-height', '0.7']
    chosen = parser.parse_args(words)
    assert given_options(chosen, PlanOptions) == {
        'no_go': ['-0.1 0 0 1 1 1', '5 5 5 6 6 6'], 'reach_1': 'annulus 0 0 0.2 0.8', 'kinds': ['drag'],
        'crossings': True, 'speed': 0.2}
    assert given_options(chosen) == {'table_height': 0.7}
    assert PlanOptions.of(given_options(chosen, PlanOptions)).no_go == ('-0.1 0 0 1 1 1', '5 5 5 6 6 6')
    assert Options.of(given_options(chosen)).table_height == 0.7
