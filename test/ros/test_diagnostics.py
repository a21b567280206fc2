# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the node tells reads back exactly, under the names of the contract."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from wire import result_values, wire

from dlo_calibration.calibration.result import CalibrationResult, ParameterEstimate
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.together import Together
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.score import PointErrors
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.ros import diagnostics

STAMP = 12_500_000_000


def sample_result(**changes):
    estimates = {
        'flexibility': ParameterEstimate('flexibility', 100 / 3, 0.1 + 0.2, 30.0, 36.5, 1e-3 / 7, 1e-5, 2e-3,
                                         'N m^2 per N/m', True),
        'friction': ParameterEstimate('friction', 50.0, 28.9, 0.0, 100.0, 0.14, 0.01, 2.0, '1', False)}
    best = Evaluation(1, np.array([1 / 3, 0.5]), {'flexibility': 100 / 3, 'friction': 50.0}, (40.5, 20.25),
                      PointErrors(0.002, 0.003, 0.01, 0.001), np.zeros(3))
    chain = Chain([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    trial = Trial('trial 1', chain, (Action((Hand('left_hand', (0,), [0.0], [[0, 0, 0]]),)),),
                  (Goal(chain, 1.0),))
    return replace(CalibrationResult(
        ParameterSpace(('flexibility', 'friction')), estimates, best, (trial, trial), (), (best, best, best),
        9.1, 'random', 'bullet', 'budget of 3 evaluations spent', 7, ('one', 'two')), **changes)


def by_name(message):
    return {part.name: (part, {pair.key: pair.value for pair in part.values}) for part in message.status}


def test_result_has_every_parameter_exactly(types):
    result = sample_result()
    message = diagnostics.result(types, result, STAMP)
    values = result_values(message)
    assert list(values) == ['flexibility', 'friction']
    for name, estimate in result.parameters.items():
        assert list(values[name]) == [
            'value', 'std', 'lower', 'upper', 'unit', 'physical_value', 'physical_lower', 'physical_upper',
            'physical_unit', 'identifiable', 'verdict', 'note']
        for key, value in values[name].items():
            assert value == ('0..100' if key == 'unit' else getattr(estimate, key))
    levels = {name: status.level for name, (status, _) in by_name(message).items()}
    assert levels['flexibility'] == types.level(0)
    assert levels['friction'] == types.level(1)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 500_000_000)


def test_result_has_the_values_of_the_whole_calibration(types):
    status, values = by_name(diagnostics.result(types, sample_result(), STAMP))['calibration']
    assert values.pop('seconds') == '9.1'
    assert [float(score) for score in values.pop('scores').split()] == [40.5, 20.25]
    assert float(values.pop('error_percent_of_length')) == pytest.approx(0.1)
    assert 'friction could not be determined' in values.pop('findings')
    for key, millimetres in (('mean', 2), ('rms', 3), ('max', 10), ('mean_abs', 1)):
        assert float(values.pop(f'{key}_error_mm')) == pytest.approx(millimetres)
    assert values == {
        'score': '30.375', 'trials': '2', 'evaluations': '3', 'simulations': '6', 'engine': 'bullet',
        'search': 'random', 'seed': '7', 'stop_reason': 'budget of 3 evaluations spent', 'choice': '',
        'headline': sample_result().headline, 'unusable': '', 'warnings': 'one; two', 'undetermined': '',
        'together': '',
        'cross_validated_error_mm': '', 'default_error_mm': '',
        'noise_mm': '', 'residual_std_mm': '', 'force_error_n': ''}
    assert status.level == types.level(1)
    clean = sample_result(warnings=(), seed=None)
    status, values = by_name(diagnostics.result(types, clean, STAMP))['calibration']
    assert status.level == types.level(0)
    assert status.message.startswith('Usable: the simulated points are 2 mm from the measured ones')
    assert (values['seed'], values['warnings']) == ('', '')
    poor = sample_result(warnings=(), implausible=('trial 1: a DLO in the air',))
    status, values = by_name(diagnostics.result(types, poor, STAMP))['calibration']
    assert status.level == types.level(1)
    assert status.message.startswith('Not usable: trial 1: a DLO in the air. The simulated')
    assert values['unusable'] == 'trial 1: a DLO in the air'


def test_what_only_two_parameters_together_tell_is_one_text(types, monkeypatch):
    pair = Together('flexibility', 'mass', -1.0, 0.04, (0.3, 0.3))
    monkeypatch.setattr(CalibrationResult, 'together', (pair,))
    _, values = by_name(diagnostics.result(types, sample_result(), STAMP))['calibration']
    assert values['together'] == pair.words == (
        'flexibility / mass, in physical values, is known to 4 %, each alone only to 30 %.')
    assert pair.words in values['findings']


def test_progress_has_the_best_so_far_and_the_time_left(types):
    best = Evaluation(0, np.array([0.25]), {'friction': 25.0}, (12.0,))
    failed = Evaluation(4, np.array([0.5]), {'friction': 50.0}, failure='diverged')
    progress = SimpleNamespace(newest=failed, best=best, evaluations=150, simulations_per_second=31.5,
                               seconds_left=4.6, spread={})
    status, values = by_name(diagnostics.progress(types, progress, STAMP))['progress']
    assert values == {'evaluation': '5', 'evaluations': '150', 'score': 'inf', 'best_score': '12.0',
                      'best_friction': '25.0', 'simulations_per_second': '31.5', 'seconds_left': '4.6',
                      'failure': 'diverged'}
    assert status.message == 'evaluation 5 of 150, best score 12, 4.6 s left'
    assert status.level == types.level(1)


@pytest.mark.parametrize(('state', 'level'), [
    ('collecting', 0), ('calibrating', 0), ('done', 0), ('failed', 2)])
def test_status_has_state_trials_and_refusal(types, state, level):
    content = {'state': state, 'trials': 3, 'last_refusal': 'too few', 'detail': 'why'}
    status, values = by_name(diagnostics.status(types, STAMP, content, None))['status']
    assert values == {**content, 'trials': '3', 'last_trial': ''}
    assert status.message == f'{state}: why'
    assert status.level == types.level(level)


def test_status_says_what_the_newest_trial_adds(types):
    information = TrialInformation('trial 2', ('elasticity', 'friction'), [0.0625, 0.25], [0.015625, 0.25])
    status, values = by_name(diagnostics.status(
        types, STAMP, {'state': 'collecting', 'detail': ''}, information))['status']
    assert values['last_trial'] == information.words
    assert {key: float(value) for key, value in values.items() if key.startswith('std_')} == {
        'std_before_elasticity': 6.25, 'std_before_friction': 25.0,
        'std_after_elasticity': 1.5625, 'std_after_friction': 25.0}
    assert status.message == f'collecting; {information.words}'
    failed, values = by_name(diagnostics.status(
        types, STAMP, {'state': 'failed', 'detail': 'why'},
        TrialInformation.unknown('trial 2', ('friction',), 'it diverged')))['status']
    assert values['last_trial'] == 'the information of trial 2 is unknown: it diverged'
    assert not any(key.startswith('std_') for key in values)
    assert failed.message == 'failed: why'


def test_diagnostics_cross_the_wire(types):
    travel = wire(types)
    values = result_values(travel(diagnostics.result(types, sample_result(), STAMP)))
    assert values['flexibility']['value'] == 100 / 3
    report = travel(diagnostics.status(types, STAMP, {'state': 'failed', 'detail': 'why'}, None))
    assert report.status[0].level == types.level(2)
