# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""How often a DLO crosses itself, seen from above."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration.planning.crossings import crossings

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
def test_each_pair_of_segments_counts_as_the_signs_of_areas_tell(points):
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
