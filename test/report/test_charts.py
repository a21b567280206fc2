# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Charts put what is drawn at its place on the axes, which have round numbers."""

import math
import re

import numpy as np
import pytest

from dlo_calibration.report.charts import (
    BOTTOM,
    cell_colour,
    Chart,
    CROSS,
    HEIGHT,
    LEFT,
    legend,
    RIGHT,
    TOP,
    WIDTH,
)

RED = '#f00'


def chart(**options):
    return Chart('Title <1>', 'x', 'y', 'what it shows', **options)


def places(svg):
    """Return the (n, 2) places of the red line, and how many pieces it has."""
    path, = re.findall(f'<path d="([^"]*)" fill="none" stroke="{RED}"', svg)
    return np.array(re.findall(r'[ML]([-\d.]+) ([-\d.]+)', path), dtype=float), path.count('M')


def ticks(svg, anchor):
    return [text for text in re.findall(f'text-anchor="{anchor}">([^<]*)</text>', svg)
            if re.fullmatch('[−0-9.e+-]+', text)]


def test_ends_of_the_axes_are_the_corners():
    drawn = chart(x_ends=(0.0, 2.0), y_ends=(-1.0, 1.0))
    drawn.line(np.array([0.0, 1.0, 2.0]), np.array([-1.0, 0.0, 1.0]), RED)
    (left, bottom), middle, (right, top) = places(drawn.svg())[0]
    assert (left, bottom, right, top) == (LEFT, HEIGHT - BOTTOM, WIDTH - RIGHT, TOP)
    assert middle == pytest.approx([(left + right) / 2, (bottom + top) / 2])


def test_logarithmic_axis_has_decades_equally_far_apart_and_nothing_below_zero():
    drawn = chart(logarithmic=True)
    drawn.line(np.arange(5.0), np.array([1.0, 10.0, 100.0, 0.0, 1000.0]), RED)
    found, pieces = places(drawn.svg())
    assert np.diff(found[:3, 1]) == pytest.approx([found[1, 1] - found[0, 1]] * 2, abs=0.11)
    assert (len(found), pieces) == (4, 2)
    assert ticks(drawn.svg(), 'end') == ['1', '10', '100', '1000']


def test_line_is_broken_where_a_value_is_not_known():
    drawn = chart()
    drawn.line(np.arange(5.0), np.array([1.0, 2.0, np.nan, 2.0, np.inf]), RED)
    found, pieces = places(drawn.svg())
    assert (len(found), pieces) == (3, 2)
    assert 'nan' not in drawn.svg() and 'inf' not in drawn.svg()


def test_equal_axes_keep_a_square_a_square():
    drawn = chart(equal=True)
    drawn.line(np.array([0.0, 1.0, 1.0]), np.array([5.0, 5.0, 6.0]), RED)
    (x0, y0), (x1, _), (_, y2) = places(drawn.svg())[0]
    assert x1 - x0 == pytest.approx(y0 - y2, abs=0.2)


@pytest.mark.parametrize('low, high, expected', [
    (0.0, 1.0, ['0', '0.2', '0.4', '0.6', '0.8', '1.0']), (-3.0, 3.0, ['−3', '−2', '−1', '0', '1', '2', '3']),
    (0.0, 100.0, ['0', '20', '40', '60', '80', '100'])])
def test_ticks_are_round_numbers(low, high, expected):
    drawn = chart(x_ends=(low, high))
    drawn.line(np.array([low, high]), np.ones(2), RED)
    assert ticks(drawn.svg(), 'middle') == expected


@pytest.mark.parametrize('values', [[], [3.0], [2.0, 2.0], [1e-12, 2e-12], [-1e9, 1e9], [math.nan]])
def test_whatever_is_drawn_is_finite(values):
    for logarithmic in (False, True):
        drawn = chart(logarithmic=logarithmic)
        drawn.marks(np.arange(len(values), dtype=float), np.array(values), RED, 'marks', shape=CROSS)
        svg = drawn.svg()
        assert not re.search(r'\b(nan|inf)\b', svg)
        assert len(ticks(svg, 'end')) < 20


def test_long_line_is_thinned_and_keeps_its_ends():
    drawn = chart(x_ends=(0.0, 1e5))
    drawn.line(np.arange(100001.0), np.ones(100001), RED)
    found, _ = places(drawn.svg())
    assert len(found) < 500
    assert (found[0, 0], found[-1, 0]) == (LEFT, WIDTH - RIGHT)


def test_cells_are_darker_for_more_and_missing_where_unknown():
    drawn = chart()
    drawn.cells(np.arange(3.0), np.arange(3.0), np.array([[0, 0.5, 1], [np.nan, 0.5, 1], [2, -1, np.nan]]))
    svg = drawn.svg()
    assert svg.count('crispEdges') == 7
    brightness = [sum(map(int, re.findall(r'\d+', cell_colour(share)))) for share in (0.0, 0.5, 1.0)]
    assert brightness[0] > brightness[1] > brightness[2]
    assert svg.count(cell_colour(1.0)) == 3


def test_legend_explains_everything_once_and_names_are_text():
    one, two = chart(), chart()
    for drawn in (one, two):
        drawn.line(np.arange(2.0), np.arange(2.0), RED, 'a <line>')
        drawn.marks(np.arange(2.0), np.arange(2.0), RED, 'marks')
        drawn.marks(np.arange(2.0), np.arange(2.0), RED)
    text = legend([one, two])
    assert text.count('<li>') == 2
    assert 'a &lt;line&gt;' in text
    assert 'Title &lt;1&gt;' in one.svg()
    assert legend([chart()]) == ''
