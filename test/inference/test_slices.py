# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Slices contain the best values, show how the fit worsens, and end in time."""

from dataclasses import replace
import math

import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.inference.slices import (
    LEVELS,
    MOST_LINES,
    NARROWEST,
    pairs,
    simulate_slices,
    varied_parameters,
)


@pytest.fixture(scope='module')
def result():
    """Return what the toy finds; its optimum is the truth."""
    result = calibrate(toy_trials(2), Options.of({'workers': 1}), make_simulator=new_toy)
    assert result.values == pytest.approx(TRUTH, abs=1.0)
    return result


def around(result, simulator=None, seconds=60.0, **rest):
    """Return slices around a result."""
    evaluator = Evaluator(result.trials, result.space, simulator or ToySimulator())
    return simulate_slices(evaluator, result.best, result.std, result.examination, seconds=seconds, **rest)


def test_a_line_per_parameter_whose_lowest_error_is_at_the_truth(result):
    slices = around(result)
    assert [line.name for line in slices.lines] == list(result.space.free)
    for line in slices.lines:
        assert len(line.values) in (LEVELS[-1] + 1, LEVELS[-1] + 2)
        assert (np.diff(line.values) > 0).all()
        assert line.values[line.errors.argmin()] == pytest.approx(TRUTH[line.name], abs=1.0)
        assert line.values[-1] - line.values[0] >= NARROWEST
        assert 0 <= line.values[0] and line.values[-1] <= 100
    assert slices.complete


def test_of_many_parameters_the_papers_and_the_least_certain_have_lines():
    names = ['damping', 'friction', 'torsion', 'mass', 'marker_mass', 'flexibility', 'elasticity',
             'self_collision']
    std = np.array([0.2, 0.01, 0.1, 0.01, 0.15, 0.01, 0.01, 0.01])
    assert varied_parameters(names, std) == [0, 1, 4, 5, 6, 7]
    assert varied_parameters(names[:MOST_LINES], std[:MOST_LINES]) == list(range(MOST_LINES))


def test_errors_are_those_of_the_simulator(result):
    line = around(result).lines[0]
    # The toy lifts the chain by a sine arch of 0.2 m for the whole scale.
    arch = 0.2 * np.sin(np.linspace(0, np.pi, len(result.trials[0].initial)))
    expected = abs(line.values - TRUTH['flexibility']) / 100 * np.sqrt(np.mean(arch**2))
    assert line.errors == pytest.approx(expected, abs=2e-3)


def test_plane_has_the_first_parameter_along_the_first_axis(result):
    slices = around(result)
    plane = slices.planes[0]
    lines = {line.name: line for line in slices.lines}
    k = int(np.abs(plane.values[1] - result.values[plane.names[1]]).argmin())
    line = lines[plane.names[0]]
    assert plane.errors[:, k] == pytest.approx(np.interp(plane.values[0], line.values, line.errors), abs=0.02)
    assert plane.errors.shape == (plane.values.shape[1],) * 2


def test_pair_that_depends_on_each_other_most_comes_first(result):
    names = list(result.space.free)
    covariance = np.eye(4) * 1e-4
    covariance[1, 2] = covariance[2, 1] = 0.9e-4
    covariance[0, 3] = covariance[3, 0] = 0.2e-4
    examination = replace(result.examination, uncertainty=replace(
        result.examination.uncertainty, covariance=covariance, excited=np.ones(4, dtype=bool)))
    expected = [(names.index('elasticity'), names.index('friction'))]
    assert pairs(4, examination) == expected


def test_slices_that_would_take_too_long_are_omitted(result):
    now = iter(np.arange(10000.0))
    slices = around(result, seconds=40, clock=lambda: next(now))
    assert not slices.complete
    assert slices.evaluations <= 40
    assert all(len(line.values) <= LEVELS[0] + 2 for line in slices.lines)
    nothing = around(result, should_stop=lambda: True)
    assert (nothing.lines, nothing.planes, nothing.evaluations, nothing.complete) == ((), (), 0, False)


def test_failed_points_of_a_slice_are_infinite(result):
    slices = around(result, ToySimulator(fail_below=result.values['flexibility'] - 1.0))
    line = slices.lines[0]
    assert math.isinf(line.errors[0]) and math.isinf(line.scores[0])
    assert np.isfinite(line.errors[-1])


def test_slices_are_the_same_each_time(result):
    first, second = (around(result) for _ in range(2))
    assert all(np.array_equal(a.errors, b.errors) for a, b in zip(first.lines, second.lines, strict=True))
    assert first.evaluations == second.evaluations
