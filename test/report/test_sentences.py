# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Findings are sentences that a person understands without knowing the method."""

from dataclasses import replace

import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import plain
from dlo_calibration.inference.advice import Advice
from dlo_calibration.inference.examination import Confirmation
from dlo_calibration.inference.missing_parameters import MissingParameter
from dlo_calibration.inference.uncertainty import NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.score import PointErrors
from dlo_calibration.report.sentences import lower_score, sentences


@pytest.fixture(scope='module')
def result():
    """Return a result of the toy; the mass is known."""
    return calibrate(toy_trials(2), Options.of({'workers': 1, 'mass': 0.05}), make_simulator=new_toy)


def test_each_parameter_has_a_sentence_with_its_quantity(result):
    texts = sentences(result)
    for name in TRUTH:
        assert len([text for text in texts if text.startswith(f'{name} is known well: ')]) == 1
    assert any('friction coefficient 0.4' in text for text in texts)
    assert all(text.endswith('.') for text in texts)
    assert not any('mass' in text for text in texts)


def test_well_known_parameters_come_first_and_unknown_ones_get_no_value(result):
    changed = dict(result.parameters)
    changed['flexibility'] = replace(changed['flexibility'], verdict=NOT_IDENTIFIABLE, identifiable=False,
                                     physical_lower=0.001, physical_upper=0.01)
    changed['elasticity'] = replace(changed['elasticity'], verdict=WEAK, identifiable=False)
    texts = sentences(replace(result, estimates=changed))
    order = ['friction', 'self_collision', 'elasticity', 'flexibility']
    assert [text.split()[0] for text in texts[:4]] == order
    assert 'only roughly' in texts[2]
    assert texts[3] == ('flexibility could not be determined: with these trials, bending stiffness EI may be '
                       'anything from 0.001 to 0.01 N m^2.')


def with_error(result, metres):
    """Return a result whose points are `metres` from the measured ones."""
    return replace(result, best=replace(result.best, errors=PointErrors(metres, metres, metres, metres)))


def test_good_result_is_usable(result):
    assert result.unusable == ''
    assert result.headline.startswith('Usable: the simulated points are ')
    stopped = 'budget of 20 evaluations spent'
    assert replace(result, stop_reason=stopped).unusable == ''


def test_result_that_should_not_be_used_says_why(result):
    examination = result.examination
    implausible = replace(result, implausible=('trial 1: a DLO in the air',))
    assert implausible.headline.startswith('Not usable: trial 1: a DLO in the air. The simulated points are ')
    assert '51.7 % of the length; check frames' in with_error(result, 0.517 * result.length).unusable
    distant = Confirmation('bullet', 1.0, (1.0, 1.0), result.errors, 0.02, 0.1)
    assert 'engine bullet differs from toy by 20 mm' in replace(result, confirmation=distant).unusable
    near = replace(distant, mean_distance=0.0003)
    assert replace(result, confirmation=near).unusable == ''
    early = replace(result, examination=None, stop_reason='stopped on request')
    assert 'not reached a minimum (stopped on request)' in early.unusable
    irregular = replace(result, examination=replace(examination, regular=False))
    assert 'not reached a minimum' in irregular.unusable
    spread = replace(examination.uncertainty, residual=0.01)
    poor = replace(examination, default_error=0.01, uncertainty=spread, noise=1e-4)
    no_better = with_error(replace(result, examination=poor), 0.02)
    assert 'the default parameters fit as well' in no_better.unusable
    assert with_error(replace(result, examination=replace(poor, noise=0.01)), 0.02).unusable == ''
    blind = {name: replace(estimate, verdict=NOT_IDENTIFIABLE)
             for name, estimate in result.parameters.items()}
    assert 'determine none of the parameters' in replace(result, estimates=blind).unusable
    friction = {**blind, 'friction': result.parameters['friction']}
    assert replace(result, estimates=friction).unusable == ''


def test_first_line_has_the_error_in_terms_of_the_noise_and_the_next_action(result):
    def headline(**changed):
        examination = replace(result.examination, noise=0.001)  # MEAN_DISTANCE * 1 mm is 1.6 mm
        return replace(with_error(result, 0.0024), **{'examination': examination, 'advice': None, **changed}
                       ).headline

    usable = 'Usable: the simulated points are 2.4 mm from the measured ones, 1.5 times the noise.'
    assert headline() == f'{usable} Nothing more is needed.'
    assert 'times the noise' not in headline(examination=replace(result.examination, noise=float('nan')))
    advice = Advice('drag', 'drag the first end by 20 cm', 'friction', 0.1, 0.05, 0.0, 1.0)
    assert headline(advice=advice) == f'{usable} Next: drag the first end by 20 cm, to know friction better.'
    friction = replace(result.estimates['friction'], verdict=NOT_IDENTIFIABLE)
    assert headline(estimates={**result.estimates, 'friction': friction}) == (
        f'{usable} Next: do not rely on friction, which these trials do not determine.')
    missing = headline(missing_parameters=(MissingParameter('torsion', 0.3),))
    assert missing == f'{usable} Next: calibrate torsion, too.'
    assert headline(hand_error='the stamps are 80 ms late; set hand_delay') == (
        'Not usable: the stamps are 80 ms late; set hand_delay. The simulated points are 2.4 mm from the '
        'measured ones, 1.5 times the noise.')


def test_validation_of_an_unusable_result_is_unusable(result):
    validation = replace(result, choice=None, examination=None, unusable_fit='the hand slipped; repeat it')
    assert validation.headline.startswith('Not usable: the hand slipped; repeat it. ')
    assert replace(validation, unusable_fit='').headline.startswith('Usable: ')


def test_no_parameter_of_an_unusable_result_is_identifiable(result):
    unusable = replace(result, hand_error='the hands are 15 mm off in x')
    assert {(each.verdict, each.identifiable) for each in unusable.parameters.values()} == {
        (NOT_IDENTIFIABLE, False)}
    texts = sentences(unusable)
    assert not any('known well' in text or '90 % probability' in text for text in texts)
    assert any(text.startswith('friction is not known, as the result is not usable: Coulomb friction')
               for text in texts)
    assert {each['identifiable'] for each in plain(unusable)['parameters'].values()} == {False}
    assert unusable.values == result.values
    assert replace(unusable, hand_error='').parameters == result.parameters


def test_what_nobody_can_act_on_comes_last(result):
    covariance = np.eye(4) * 1e-4 + 0.1 * np.outer([1, -1, 0, 0], [1, -1, 0, 0])
    uncertainty = replace(result.examination.uncertainty, covariance=covariance)
    texts = sentences(replace(result, examination=replace(result.examination, uncertainty=uncertainty)))
    assert texts[-1].startswith('This combination of parameters can change')


def test_stiffness_per_weight_is_explained():
    options = Options.of({'workers': 1, 'evaluations': 20})
    result = calibrate(toy_trials(1), options, make_simulator=new_toy)
    assert any('mass was not given' in text for text in sentences(result))


def test_fit_is_compared_with_noise(result):
    def fit(noise):
        texts = sentences(replace(result, examination=replace(result.examination, noise=noise)))
        return next(text for text in texts if text.startswith('The simulated points are'))

    assert 'about as good as the measurement' in fit(1.0)
    assert 'errors of the model' in fit(1e-12)
    assert 'noise' not in fit(float('nan'))


def test_a_lower_score_elsewhere_is_explained_in_one_sentence(result):
    def explanation(score):
        other = replace(result.evaluations[0], index=6, scores=(score,))
        return lower_score(replace(result, evaluations=(other, result.best)))

    best = replace(result.best, scores=(4.83,))
    result = replace(result, best=best)
    assert explanation(5.0) == explanation(4.829) == ''  # people do not see a difference
    text = explanation(4.5)
    assert text.startswith('Evaluation 7 has a lower difference score')
    assert '4.5 instead of 4.83 cm' in text


def test_a_search_that_did_not_converge_is_mentioned(result):
    texts = sentences(replace(result, examination=replace(result.examination, regular=False)))
    assert any('has not reached a minimum' in text for text in texts)


def test_an_interval_that_reaches_an_end_of_the_scale_is_a_bound(result):
    def sentence(name, **ends):
        changed = {**result.parameters, name: replace(result.parameters[name], **ends)}
        return next(text for text in sentences(replace(result, estimates=changed)) if text.startswith(name))

    assert sentence('elasticity', verdict=WEAK, lower=0.0, upper=15.0, physical_lower=2500.0) == (
        'elasticity is known on one side only: stretching stiffness EA is at least 2500 N, with 90 % '
        'probability.')
    assert sentence('friction', verdict=WEAK, lower=0.0, upper=15.0, physical_upper=0.02).endswith(
        'is at most 0.02, with 90 % probability.')
    assert sentence('friction', verdict=NOT_IDENTIFIABLE, lower=40.0, upper=100.0, physical_lower=0.08) == (
        'friction could not be determined: with these trials, Coulomb friction coefficient is only known to '
        'be at least 0.08.')
    assert 'anything from' in sentence('friction', verdict=NOT_IDENTIFIABLE, lower=0.0, upper=100.0)
