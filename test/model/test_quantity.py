# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers are short for people and exact for programs."""

import math

from hypothesis import given
from hypothesis import strategies as st
import pytest

from dlo_calibration.model.parameters import exact, interval, measured, number


@pytest.mark.parametrize('value, text', [
    (0.00109, '0.00109'), (9.68e-5, '9.68e-5'), (6200.4, '6200'), (22.0, '22'), (0.0, '0'), (-0.0, '0'),
    (-1.5, '-1.5'), (999.7, '1000'),
    (3.16e-9, '3.16e-9'), (1234567.0, '1.23e6'), (None, '-'), (math.nan, '-'), (math.inf, '-')])
def test_numbers_have_three_digits_that_count(value, text):
    assert number(value) == text


def test_values_have_the_units_that_people_use():
    assert measured(0.003936, 'm') == '3.94 mm'
    assert measured(0.4, '1') == '0.4'
    assert measured(None, 'm') == '- mm'
    assert interval(74.0, 6200.0, 'N') == '74 to 6200 N'
    assert interval(0.002, 0.03, 'm') == '2 to 30 mm'
    assert interval(None, 0.03, 'm') == '- to 30 mm'


@pytest.mark.parametrize('lower, value, upper, texts', [
    (9.23e-5, 1.02e-4, 1.12e-4, ('1.02e-4 N', '0.923e-4 to 1.12e-4 N')),
    (9.5e-4, 9.9e-4, 1.1e-3, ('0.00099 N', '0.00095 to 0.0011 N')),
    (5e5, 9e5, 2e6, ('0.9e6 N', '0.5e6 to 2e6 N')), (-2e-4, 1e-5, 1e-4, ('0.1e-4 N', '-2e-4 to 1e-4 N')),
    (0.0, 0.0, 0.0, ('0 N', '0 to 0 N'))])
def test_a_value_and_its_interval_have_one_power_of_ten(lower, value, upper, texts):
    assert (measured(value, 'N', max(lower, upper, key=abs)), interval(lower, upper, 'N')) == texts


@given(st.lists(st.floats(allow_nan=False)))
def test_text_for_programs_reads_back_exactly(values):
    assert [float(word) for word in exact(values).split()] == values
    assert (exact(True), exact(7), exact('word')) == ('true', '7', 'word')
