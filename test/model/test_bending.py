# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The rest shape has the given curvature, and a cycle of bending dissipates the energy of friction."""

import numpy as np
import pytest
from stepping import SteppedRope

from dlo_calibration.model.parameters import (
    bending_moments,
    kept_curvature,
    natural_curvature,
    ParameterSpace,
    rest_shape,
)

STIFFNESS, FRICTION, SLIP = 2e-3, 1.5, 0.4


def cycle(reach, count=400):
    """Return curvatures from 0 to `reach`, to the other side and back."""
    branch = np.linspace(reach, -reach, 2 * count + 1)
    return np.concatenate([np.linspace(0, reach, count, endpoint=False), branch, branch[::-1][1:]])


def test_constant_curvature_is_a_circle_in_any_direction():
    curvatures = np.tile([3.0, 4.0], (199, 1))
    points = rest_shape(curvatures, 0.9)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(0.9)
    chord = 2 / 5 * np.sin(0.9 * 5 / 2)
    assert np.linalg.norm(points[-1]) == pytest.approx(chord, abs=1e-3)
    assert np.linalg.svd(points - points.mean(axis=0))[1][2] < 1e-9


def test_curvature_that_turns_evenly_is_a_helix():
    """The radius of a helix is k / (k^2 + w^2), and its rise for each metre is w / sqrt(k^2 + w^2)."""
    k, w, length = 5.0, 4.0, 4.0
    angles = w * np.linspace(0, length, 801)[1:-1]
    points = rest_shape(k * np.stack([np.cos(angles), np.sin(angles)], axis=1), length)
    period = round(2 * np.pi / np.hypot(k, w) / length * 800)
    rise = np.linalg.norm(points[200 + period] - points[200]) / (length * period / 800)
    assert rise == pytest.approx(w / np.hypot(k, w), rel=1e-3)


def test_many_shapes_at_once_are_those_of_each():
    curvatures = np.random.default_rng(0).normal(size=(4, 30, 2)) * 8
    for curvature, points in zip(curvatures, rest_shape(curvatures, 0.7), strict=True):
        np.testing.assert_allclose(points, rest_shape(curvature, 0.7))


def test_knots_are_joined_by_lines_and_added_to_the_constant_curvature():
    space = ParameterSpace(fixed={'natural_curvature': 20.0}).shaped(3)
    physical = space.physical({'rest_curvature_x2': 60.0, 'rest_curvature_y3': 30.0}, 1.0)
    curvatures = natural_curvature(physical, np.array([0.0, 0.25, 0.5, 1.0]))
    np.testing.assert_allclose(curvatures, [[2, 0], [4.5, 0], [7, 0], [2, -10]], atol=1e-9)
    straight = ParameterSpace().physical({}, 1.0)
    assert not natural_curvature(straight, np.linspace(0, 1, 5)).any()


def test_a_free_dlo_takes_this_rest_shape():
    """Simulate it without weight, from a nearly straight line."""
    places, length = np.linspace(0, 0.6, 31), 0.6
    points = np.stack([places, 0.05 * places**2, np.zeros(31)], axis=1)
    knots = {'rest_curvature_x1': 52.0, 'rest_curvature_y1': 54.0, 'rest_curvature_x2': 58.0,
             'rest_curvature_y2': 44.0, 'rest_curvature_x3': 46.0, 'rest_curvature_y3': 56.0}
    space = ParameterSpace(fixed={**knots, 'flexibility': 58.5, 'damping': 60.0}, mass=0.02).shaped(3)
    physical = space.physical({}, length)
    rope = SteppedRope(places, points, np.zeros_like(points), physical, 0.004, gravity=np.zeros(3))
    rope.advance(np.zeros((3000, 0, 3)))
    expected = rest_shape(natural_curvature(physical, places[1:-1] / length), length)
    for far in (10, 20, 30):  # distances within the shape do not depend on where it lies
        seen, drawn = (np.linalg.norm(shape[far:] - shape[:len(shape) - far], axis=1)
                       for shape in (rope.points, expected))
        np.testing.assert_allclose(seen, drawn, rtol=0.01)


@pytest.mark.parametrize('locking', [0.0, 0.3])
@pytest.mark.parametrize('reach', [0.1, 0.4, 0.5, 3.0])
def test_a_cycle_takes_the_energy_of_friction(reach, locking):
    curvatures = cycle(reach)
    moments = bending_moments(curvatures, STIFFNESS, FRICTION, SLIP, locking)
    area = ((moments[400:-1] + moments[401:]) / 2 * np.diff(curvatures[400:])).sum()
    expected = 4 * STIFFNESS * FRICTION * max(reach - SLIP, 0.0)
    assert area == pytest.approx(expected, rel=0.01, abs=1e-9)
    assert moments[400] == pytest.approx(moments[-1])  # it is closed


def test_a_branch_of_hysteresis_is_the_first_loading_twice_as_large():
    first = bending_moments(np.linspace(0, 2, 101), STIFFNESS, FRICTION, SLIP)
    moments = bending_moments(cycle(2, 100), STIFFNESS, FRICTION, SLIP)
    np.testing.assert_allclose(moments[100] - moments[100:301:2], 2 * first, atol=1e-12)


@pytest.mark.parametrize('locking', [0.0, 1.0, 10.0])
def test_a_dlo_that_was_bent_far_keeps_the_curvature_of_friction(locking):
    curvatures = cycle(5.0, 1000)
    unloading = slice(1000, 3001)
    moments = bending_moments(curvatures, STIFFNESS, FRICTION, SLIP, locking)[unloading]
    kept = np.interp(0.0, -moments, -curvatures[unloading])
    assert kept == pytest.approx(-kept_curvature(FRICTION, locking), abs=5e-3)
    assert kept_curvature(FRICTION) == pytest.approx(FRICTION)
