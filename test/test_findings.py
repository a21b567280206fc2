# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a result says to a person, and what it says to a file."""

from dataclasses import replace
import json

import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import calibrate, Chain, cli, Goal, ParameterSpace
from dlo_calibration.advice import Advice
from dlo_calibration.findings import sentences, values
from dlo_calibration.search import SEARCHES
from dlo_calibration.uncertainty import from_jacobian

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SPACE = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})
ADVICE = Advice('drag', 'drag the middle sideways by 30 cm', 'friction', 0.25, 0.0125, 0.5, 0.75)


class Blind(ToySimulator):
    """Friction shows in no trial, and the trial `idle` shows nothing."""

    def simulate(self, trial, physical):
        fixed = SPACE.physical({'friction': 70.0} if trial.name != 'idle' else TRUTH, 1.0)
        names = ('friction',) if trial.name != 'idle' else tuple(TRUTH)
        return super().simulate(trial, {**physical, **{name: fixed[name] for name in names}})


def calibrated(simulator=None, names=('trial 1', 'trial 2'), truth=TRUTH, space=SPACE):
    """Return a result on trials with 1 mm of noise."""
    trials = []
    for k, name in enumerate(names):
        trial = toy_trial(truth, name, n=41)
        rough = np.random.default_rng(k).normal(0, 1e-3, (41, 3))
        trials.append(replace(trial, goals=(Goal(Chain(trial.goals[0].chain.points + rough), 2.0),)))
    return calibrate(trials, space, simulator or ToySimulator(),
                     SEARCHES['least_squares'](space.dimension, 1), budget=120)


def test_where_all_is_known_only_the_errors_are_compared():
    only, = sentences(calibrated())
    assert only.startswith('mean error 1.')
    for words in ('trials left out of the fit 1.', 'default parameters', 'noise of the points alone '):
        assert words in only


def test_what_no_trial_tells_is_said_and_a_trial_that_told_nothing_is_named():
    found = sentences(calibrated(Blind(), ('trial 1', 'idle')))
    assert found[0] == ('not identifiable from these trials: friction (no trial tells anything about it; '
                        'it keeps its default)')
    assert 'idle told nothing: all of it would have been known without' in found


def test_the_action_to_observe_is_said_with_what_it_would_give():
    found = sentences(replace(calibrated(), advice=ADVICE))
    assert ('to know friction better, drag the middle sideways by 30 cm (drag): that would give it to '
            '± 1.2 of 100, which is ± 25.0 now') in found


def test_a_value_at_the_end_of_its_scale_is_said():
    space = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})
    result = calibrated(truth={**TRUTH, 'friction': 100.0}, space=space)
    at_end = replace(result.parameters['friction'], note='at the end of its scale')
    found = sentences(replace(result, parameters={**result.parameters, 'friction': at_end}))
    assert 'at the end of the scale, so that the best value may lie beyond: friction' in found


def combined(result):
    """Return a result whose two parameters show only together."""
    examination = result.examination
    jacobian = examination.jacobian.copy()
    jacobian[:, 1] = jacobian[:, 0] * (1 + 1e-3 * np.linspace(-1, 1, len(jacobian)))
    uncertainty = from_jacobian(result.best.point, result.best.residuals, jacobian, [(1, 41)] * 2, noise=1e-3)
    return replace(result, examination=replace(examination, jacobian=jacobian, uncertainty=uncertainty))


def test_combinations_that_stay_open_are_said_and_correlations_kept():
    result = combined(calibrated())
    assert [one for one in sentences(result) if one.startswith('the trials leave open: ')] == [
        'the trials leave open: flexibility - friction']
    found = values(result)
    assert found['undetermined'] == ['flexibility - friction']
    assert found['correlations']['flexibility']['friction'] < -0.95
    assert found['correlations']['friction']['friction'] == pytest.approx(1)


def test_where_the_search_had_not_arrived_that_is_said_and_no_correlation_given():
    result = calibrated(Blind())
    away = replace(result, examination=replace(result.examination, regular=False))
    assert any(one.startswith('the search had not arrived at a minimum') for one in sentences(away))
    assert values(away)['correlations'] is None
    assert values(away)['undetermined'] == []


def test_values_are_lengths_in_metres_and_advice_on_the_scale():
    result = replace(calibrated(), advice=ADVICE)
    found = values(result)
    assert 3e-4 < found['noise_m'] < 1e-3  # the initial chains have none
    assert found['residual_std_m'] == pytest.approx(1e-3, rel=0.2)
    assert found['cross_validated_error_m'] == pytest.approx(result.errors.mean, rel=0.2)
    assert found['default_error_m'] > 5 * result.errors.mean
    assert found['advice'] == {
        'action': 'drag', 'words': ADVICE.words, 'parameter': 'friction', 'std': 25.0,
        'expected_std': 1.25, 'lower': 50.0, 'upper': 75.0}


def test_what_was_not_examined_is_null():
    found = values(replace(calibrated(), examination=None))
    assert {key for key, value in found.items() if value is None} == {
        'cross_validated_error_m', 'default_error_m', 'noise_m', 'residual_std_m', 'correlations', 'advice'}
    assert sentences(replace(calibrated(), examination=None)) == []


def test_numbers_that_are_not_known_are_null_in_json(capsys):
    result = calibrated(names=('trial 1',))  # nothing can be left out of one trial
    assert np.isnan(values(result)['cross_validated_error_m'])
    cli._print_result(result, as_json=True)
    document = json.loads(capsys.readouterr().out, parse_constant=lambda text: pytest.fail(text))
    assert document['cross_validated_error_m'] is None
    assert 'left out' not in sentences(result)[-1]
