# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Missing parameters: fixed ones that would have explained the residuals."""

from dataclasses import replace

from carried_trials import EVEN, observed, STIFF_MIDDLE, TRUTH
from fitted import fitted
import numpy as np
import pytest

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import plain
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.stages import with_missing_parameters
from dlo_calibration.inference.missing_parameters import _candidates, PARTS
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.report.sentences import sentences
from dlo_calibration.search import Hints, LeastSquares
from dlo_calibration.simulation.compiled import CompiledSimulator


def search_of(space):
    unknown, all_shown = np.full(space.dimension, np.nan), np.ones(space.dimension, np.bool_)
    return LeastSquares(space.dimension, 1, Hints(
        unknown, all_shown, upper=space.upper, middle=space.default_point()))


def calibrated(trials, space=EVEN):
    simulator = CompiledSimulator(table=False, nodes=21)
    result = fitted(trials, space, simulator, search_of(space), budget=40)
    return with_missing_parameters(Setting(result.trials, Options(parts=1), simulator), result)


def candidates(space):
    return {name for name, *_ in _candidates(space)}


@pytest.mark.parametrize('name, value', [
    ('natural_curvature', 15.0), pytest.param('bending_friction', 60.0, marks=pytest.mark.long)])
def test_a_parameter_that_was_fixed_at_a_wrong_value_is_named(name, value):
    result = calibrated(observed(ParameterSpace((*EVEN.free, name)), {**TRUTH, name: value}))
    assert result.missing_parameters[0].name == name
    assert result.missing_parameters[0].share > 0.15
    assert f'name {name}' in sentences(result)[-1]
    assert f'in calibrate, beside {", ".join(EVEN.free)}' in sentences(result)[-1]
    assert plain(result)['explanations'][name] == result.missing_parameters[0].share


@pytest.mark.long
def test_parts_of_different_stiffness_are_named():
    result = calibrated(observed(EVEN.divided(4), STIFF_MIDDLE))
    assert result.missing_parameters[0].name == PARTS
    assert result.missing_parameters[0].share > 0.15
    assert 'set parts to 0' in sentences(result)[-1]


@pytest.mark.long
def test_residuals_that_are_noise_need_no_explanation():
    result = calibrated(observed(EVEN, TRUTH))
    assert result.missing_parameters == ()
    assert plain(result)['explanations'] == {}


def test_a_parameter_that_would_not_help_is_not_named():
    # Points that are all off by a centimetre, whatever the DLO is made of.
    trials = [replace(trial, goals=tuple(
        replace(goal, chain=replace(goal.chain, points=goal.chain.points + 0.01 * (-1)**k))
        for k, goal in enumerate(trial.goals))) for trial in observed(EVEN, TRUTH)]
    result = calibrated(trials)
    assert result.examination.uncertainty.residual > 5e-3
    assert result.missing_parameters == ()


def test_a_parameter_without_effect_of_its_own_is_not_simulated():
    space = ParameterSpace(('flexibility',), {'bending_friction': 0.0})
    assert 'bending_slip' not in candidates(space) and 'bending_friction' in candidates(space)
    assert 'bending_slip' in candidates(ParameterSpace(('flexibility', 'bending_friction')))
    assert 'natural_curvature' in candidates(space) - candidates(space.shaped(3))


def test_a_stop_leaves_the_result_as_it_is():
    trials = observed(ParameterSpace((*EVEN.free, 'length_scale')), {**TRUTH, 'length_scale': 40.0})
    simulator = CompiledSimulator(table=False, nodes=21)
    result = fitted(trials, EVEN, simulator, search_of(EVEN), budget=12)
    setting = Setting(result.trials, Options(), simulator, should_stop=lambda: True)
    assert with_missing_parameters(setting, result) is result
