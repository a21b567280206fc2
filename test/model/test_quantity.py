# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers are short for people and exact for programs."""

import math

from hypothesis import given
from hypothesis import strategies as st
import pytest

from dlo_calibration.model.parameters import exact, interval, measured, number


@pytest.mark.parametrize('value, text', [
    (0.000109, '0.000109'), (9.68e-5, '0.0000968'), (6200.4, '6200'), (22.0, '22'), (0.0, '0'), (-0.0, '0'),
    (-1.5, '-1.5'), (999.7, '1000'),
    (3.16e-9, '3.16e-09'), (1234567.0, '1.23e+06'), (None, '-'), (math.nan, '-'), (math.inf, '-')])
def test_numbers_have_three_digits_that_count(value, text):
    assert number(value) == text


def test_values_have_the_units_that_people_use():
    assert measured(0.003936, 'm') == '3.94 mm'
    assert measured(0.4, '1') == '0.4'
    assert measured(None, 'm') == '- mm'
    assert interval(74.0, 6200.0, 'N') == '74 to 6200 N'
    assert interval(0.002, 0.03, 'm') == '2 to 30 mm'


@given(st.lists(st.floats(allow_nan=False)))
def test_text_for_programs_reads_back_exactly(values):
    assert [float(word) for word in exact(values).split()] == values
    assert (exact(True), exact(7), exact('word')) == ('true', '7', 'word')
