# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Lines in photographs become chains in metres; where strands cross, one is above."""

import math

from curve_views import curve, DIAMETER, loop, traced, view
import numpy as np
import pytest

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.vision.axis import axis_of, measured_diameter

VIEWS = {'from above': view(), 'oblique': view(math.radians(40), 0.7), 'near': view(0.3, -2.0, 0.5)}
COUNT = 21
EVENLY = np.linspace(0, 1, COUNT)


@pytest.mark.parametrize('scale', VIEWS.values(), ids=VIEWS)
def test_the_points_are_evenly_spaced_on_the_axis_of_the_dlo(scale):
    points = curve()
    chain = axis_of(traced(points, scale), scale, DIAMETER, COUNT).chain(EVENLY)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0.0, along[-1], COUNT)
    expected = np.stack([np.interp(even, along, axis) for axis in points.T], axis=1)
    np.testing.assert_allclose(chain.points, expected, atol=1e-4)
    assert chain.length == pytest.approx(0.5, abs=5e-4)


@pytest.mark.parametrize('scale', VIEWS.values(), ids=VIEWS)
def test_the_diameter_is_measured(scale):
    assert measured_diameter(traced(curve(), scale), scale) == pytest.approx(DIAMETER, rel=0.02)


@pytest.mark.parametrize('count', [15, 21, 61])
@pytest.mark.parametrize('diameter', [0.003, 0.008, 0.02])
@pytest.mark.parametrize('first_above', [True, False])
def test_the_chain_clears_the_strand_below(diameter, first_above, count):
    points, pair = loop(height=diameter / 2)
    scale = VIEWS['oblique']
    axis = axis_of(traced(points, scale, [pair], diameter), scale, diameter, count, {0: first_above})
    shares = np.linspace(0.0, 1.0, count)
    chain = axis.chain(shares)
    first, second = np.interp(np.array(pair) * axis.length, shares * axis.length, chain.arc_lengths())
    heights = chain.resample([first, second])[:, 2]
    assert (heights[0] - heights[1]) * (1 if first_above else -1) == pytest.approx(diameter, rel=0.07)
    assert min(heights) == pytest.approx(diameter / 2, abs=0.1 * diameter)
    far = np.abs(shares - pair[0 if first_above else 1]) > 0.35
    np.testing.assert_allclose(chain.points[far, 2], diameter / 2)


def test_a_raised_strand_lies_where_it_is_seen():
    points, pair = loop()
    scale = view(math.radians(35))
    trace = traced(points, scale, [pair])
    axis = axis_of(trace, scale, DIAMETER, COUNT, {0: True})
    np.testing.assert_allclose(scale.to_pixels(axis.points), trace.pixels, atol=1e-6)


def on_top(points):
    """Return the height of the second strand above the first where (n, 3) points cross themselves [m]."""
    dense = Chain(points).resample(np.linspace(0.0, Chain(points).length, 200))
    gaps = np.linalg.norm(dense[:, None, :2] - dense[None, :, :2], axis=2)
    index = np.arange(len(dense))
    gaps[np.abs(index[:, None] - index) < 30] = np.inf
    first, second = sorted(np.unravel_index(gaps.argmin(), gaps.shape))
    assert gaps[first, second] < 0.004, 'no crossing'
    return dense[second, 2] - dense[first, 2]


@pytest.mark.parametrize('diameter', [0.003, 0.008])
@pytest.mark.parametrize('first_above', [True, False])
def test_the_simulation_begins_and_ends_with_the_same_strand_above(first_above, diameter):
    points, pair = loop(height=diameter / 2)
    scale = view(0.4)
    trace = traced(points, scale, [pair], diameter)
    chain = axis_of(trace, scale, diameter, COUNT, {0: first_above}).chain(EVENLY)
    hand = Hand('left_hand', (0,), [0.0, 0.4], [chain.points[0], chain.points[0] - (0.03, 0.02, 0)])
    trial = Trial('loop', chain, (Action((hand,)),), (
        Goal(chain, 0.1, stable=False), Goal(chain, 2.0)))
    physical = ParameterSpace().physical({'flexibility': 86.2}, chain.length)
    simulated = CompiledSimulator().simulate(trial, {**physical, 'self_collision': diameter / 2})
    sign = -1 if first_above else 1
    for points in (chain.points, *simulated.chains):
        assert sign * on_top(points) > 0.4 * diameter
