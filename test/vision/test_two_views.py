# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The curve in space of a lifted DLO from two photographs; views that do not determine it are refused."""

import math

from curve_views import curve, DIAMETER, traced, view
import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.vision.two_views import axis_of_two_views

ABOVE = view(0.1)
SIDES = {'from the side': view(math.radians(60), 0.3), 'from the other side': view(math.radians(50), 2.5),
         'along it': view(math.radians(65), math.radians(100))}


def lifted(at=0.0, height=0.12, reach=0.25, **shape):
    """Return a curve (n, 3) [m] that is lifted at a share of its length."""
    points = curve(**shape)
    shares = np.linspace(0.0, 1.0, len(points))
    t = np.clip(1.0 - np.abs(shares - at) / reach, 0.0, 1.0)
    points[:, 2] += height * (4 * t**3 - 3 * t**4)
    return points


SAG = np.zeros((400, 3))
SAG[:, 2] = 0.1 * np.sin(np.pi * np.linspace(0.0, 1.0, 400))**2


def distance(points, truth):
    return np.linalg.norm(points[:, None] - truth[None], axis=2).min(axis=1)


@pytest.mark.parametrize('truth', [
    pytest.param(lifted(), id='an end', marks=pytest.mark.long), pytest.param(lifted(0.5), id='the middle'),
    pytest.param(lifted(0.3, bend=1.3), id='strongly bent', marks=pytest.mark.long),
    pytest.param(curve(), id='it lies', marks=pytest.mark.long)])
@pytest.mark.parametrize('side', SIDES.values(), ids=SIDES)
def test_the_curve_in_space_is_found(truth, side):
    axis = axis_of_two_views(traced(truth, ABOVE), ABOVE, traced(truth, side), side, DIAMETER)
    assert distance(axis.points, truth).mean() < 7e-4
    assert distance(axis.points, truth).max() < 4e-3
    true_length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert axis.length == pytest.approx(true_length, rel=0.01)
    np.testing.assert_allclose(axis.points[0], truth[0], atol=1e-3)


def test_the_second_line_may_be_clicked_the_other_way_round():
    truth, side = lifted(), SIDES['from the side']
    axis = axis_of_two_views(traced(truth, ABOVE), ABOVE, traced(truth[::-1], side), side, DIAMETER)
    np.testing.assert_allclose(axis.points[0], truth[0], atol=1e-3)
    assert distance(axis.points, truth).max() < 2e-3


@pytest.mark.parametrize('second, scale, text', [
    (lifted(), view(0.2), 'degrees'),
    (lifted()[:-60], SIDES['from the side'], 'last end'),
    (lifted() + (0.04, 0, 0), SIDES['from the side'], 'first end'),
    (lifted() - SAG, SIDES['from the side'], 'below the table'),
    pytest.param(lifted() + SAG[:, [2, 0, 1]], SIDES['from the other side'], 'second photograph',
                 marks=pytest.mark.long),
], ids=['the same view', 'a part', 'it moved', 'another height', 'another shape'])
def test_views_that_do_not_determine_the_curve_are_refused(second, scale, text):
    with pytest.raises(InputError, match=text):
        axis_of_two_views(traced(lifted(), ABOVE), ABOVE, traced(second, scale), scale, DIAMETER)
