# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A line is put together from the parts of a DLO that a picture shows."""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dlo_calibration.vision.joined_line import joined
from dlo_calibration.vision.middle_line import arc_lengths

ARC = np.linspace(0.0, 2.2, 221)
BENT = np.column_stack([0.2 * np.sin(ARC), 0.2 * np.cos(ARC) + 0.02 * np.sin(3 * ARC)])  # m
LENGTH = float(arc_lengths(BENT)[-1])


@pytest.mark.parametrize('order', list(permutations(range(3))))
def test_parts_in_any_order_become_the_line_from_which_they_were_cut(order):
    parts = [BENT[:70], BENT[95:150][::-1], BENT[175:]]
    line = joined([parts[k] for k in order], LENGTH, whole=True)[0].line
    assert cKDTree(line).query(BENT)[0].max() < 0.02 * LENGTH
    assert arc_lengths(line)[-1] == pytest.approx(LENGTH, rel=0.02)


def test_where_an_end_is_hidden_too_the_curve_between_two_parts_is_plain():
    one, = joined([BENT[:70], BENT[100:150]], LENGTH, whole=False)[:1]
    assert cKDTree(BENT).query(one.line)[0].max() < 0.01 * LENGTH
    assert arc_lengths(one.line)[-1] < 0.75 * LENGTH


def test_parts_that_are_too_far_apart_for_the_length_are_not_joined():
    assert not joined([BENT[:70], BENT[150:] + (0.3, 0.0)], LENGTH, whole=True)
