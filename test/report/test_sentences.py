# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Findings are sentences that a person understands without knowing the method."""

from dataclasses import replace

import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.inference.examination import Confirmation
from dlo_calibration.inference.uncertainty import NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.score import PointErrors
from dlo_calibration.report.sentences import sentences, verdict


@pytest.fixture(scope='module')
def result():
    """Return what the toy finds; the mass is known."""
    return calibrate(toy_trials(2), Options.of({'workers': 1, 'mass': 0.05}), make_simulator=new_toy)


def test_each_parameter_has_a_sentence_with_its_quantity(result):
    told = sentences(result)
    for name in TRUTH:
        assert len([text for text in told if text.startswith(f'{name} is known well: ')]) == 1
    assert any('friction coefficient 0.4' in text for text in told)
    assert all(text.endswith('.') for text in told)
    assert not any('mass' in text for text in told)


def test_well_known_parameters_come_first_and_unknown_ones_get_no_value(result):
    changed = dict(result.parameters)
    changed['flexibility'] = replace(changed['flexibility'], verdict=NOT_IDENTIFIABLE, identifiable=False,
                                     physical_lower=0.001, physical_upper=0.01)
    changed['elasticity'] = replace(changed['elasticity'], verdict=WEAK, identifiable=False)
    told = sentences(replace(result, parameters=changed))
    order = ['friction', 'self_collision', 'elasticity', 'flexibility']
    assert [text.split()[0] for text in told[:4]] == order
    assert 'only roughly' in told[2]
    assert told[3] == ('flexibility could not be determined: with these trials, bending stiffness EI may be '
                       'anything from 0.001 to 0.01 N m^2.')


def with_error(found, metres):
    """Return a result whose points are so far from the measured ones."""
    return replace(found, best=replace(found.best, errors=PointErrors(metres, metres, metres, metres)))


def test_good_result_is_usable(result):
    assert result.unusable == ''
    assert verdict(result) == 'This result is usable.'
    stopped = 'budget of 20 evaluations spent'
    assert replace(result, stop_reason=stopped).unusable == ''


def test_result_that_should_not_be_used_says_why(result):
    found = result.examination
    implausible = replace(result, implausible=('trial 1: a DLO in the air',))
    assert verdict(implausible) == 'Do not use this result: trial 1: a DLO in the air.'
    assert '51.7 % of the length: check frames' in with_error(result, 0.517 * result.length).unusable
    apart = Confirmation('bullet', 1.0, (1.0, 1.0), result.errors, 0.02, 0.1)
    assert 'engine bullet differs from toy by 20 mm' in replace(result, confirmation=apart).unusable
    near = replace(apart, mean_distance=0.0003)
    assert replace(result, confirmation=near).unusable == ''
    early = replace(result, examination=None, stop_reason='stopped on request')
    assert 'not reached a minimum (stopped on request)' in early.unusable
    assert 'not reached a minimum' in replace(result, examination=replace(found, regular=False)).unusable
    spread = replace(found.uncertainty, residual=0.01)
    poor = replace(found, default_error=0.01, uncertainty=spread, noise=1e-4)
    no_better = with_error(replace(result, examination=poor), 0.02)
    assert 'the default parameters fit as well' in no_better.unusable
    assert with_error(replace(result, examination=replace(poor, noise=0.01)), 0.02).unusable == ''
    blind = {name: replace(one, verdict=NOT_IDENTIFIABLE) for name, one in result.parameters.items()}
    assert 'determine none of the parameters' in replace(result, parameters=blind).unusable
    one = {**blind, 'friction': result.parameters['friction']}
    assert replace(result, parameters=one).unusable == ''


def test_stiffness_per_weight_is_explained():
    options = Options.of({'workers': 1, 'evaluations': 20})
    found = calibrate(toy_trials(1), options, make_simulator=new_toy)
    assert any('mass was not given' in text for text in sentences(found))


def test_fit_is_compared_with_noise(result):
    def last(noise):
        return sentences(replace(result, examination=replace(result.examination, noise=noise)))[-1]

    assert 'about as good as the measurement' in last(1.0)
    assert 'errors of the model' in last(1e-12)
    assert 'noise' not in last(float('nan'))


def test_a_lower_score_elsewhere_is_explained_in_one_sentence(result):
    def told(score):
        other = replace(result.evaluations[0], index=6, scores=(score,))
        return [text for text in sentences(replace(result, evaluations=(other, result.best)))
                if 'lower difference score' in text]

    best = replace(result.best, scores=(4.83,))
    result = replace(result, best=best)
    assert told(5.0) == told(4.829) == []  # people do not see a difference
    text, = told(4.5)
    assert text.startswith('Evaluation 7 has a lower difference score')
    assert '4.5 instead of 4.83 cm' in text


def test_a_search_that_did_not_converge_is_mentioned(result):
    told = sentences(replace(result, examination=replace(result.examination, regular=False)))
    assert any('has not reached a minimum' in text for text in told)


def test_an_interval_that_reaches_an_end_of_the_scale_is_a_bound(result):
    def told(name, **ends):
        changed = {**result.parameters, name: replace(result.parameters[name], **ends)}
        return next(text for text in sentences(replace(result, parameters=changed)) if text.startswith(name))

    assert told('elasticity', verdict=WEAK, lower=0.0, upper=15.0, physical_lower=2500.0) == (
        'elasticity is known on one side only: stretching stiffness EA is at least 2500 N, with 90 % '
        'probability.')
    assert told('friction', verdict=WEAK, lower=0.0, upper=15.0, physical_upper=0.02).endswith(
        'is at most 0.02, with 90 % probability.')
    assert told('friction', verdict=NOT_IDENTIFIABLE, lower=40.0, upper=100.0, physical_lower=0.08) == (
        'friction could not be determined: with these trials, Coulomb friction coefficient is only known to '
        'be at least 0.08.')
    assert 'anything from' in told('friction', verdict=NOT_IDENTIFIABLE, lower=0.0, upper=100.0)
