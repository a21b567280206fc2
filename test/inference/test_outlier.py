# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A trial that does not fit the others is named; one that only shows more of the DLO is not."""

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path

import numpy as np
import pytest

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.files.session import read_session
from dlo_calibration.inference.outlier import candidate, is_outlier, Outlier, spread_without
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.simulation.compiled import CompiledSimulator

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / 'msg_samples/object1'
DATA = Path(os.environ.get('DLO_DATA', ROOT / '../shared/data'))


@pytest.mark.parametrize(('errors', 'expected'), [
    ([1.8, 2.0, 2.1, 1.8], None),  # samples
    ([1.6, 2.2, 1.9, 8.9], 3),
    ([50.0, 1.9, 2.2, 2.0], 0),
    ([1.6, 3.0], None)])  # of two, nothing says which is right
def test_a_trial_with_larger_errors_may_be_an_outlier(errors, expected):
    assert candidate(np.array(errors) * 1e-3) == expected


@pytest.mark.parametrize(('errors', 'expected'), [
    ([1.6, 2.2, 1.9, 8.9], True),
    ([1.6, 2.2, 1.9, 3.0], False),
    # Recordings of a real cable: the seventh is the fastest.
    ([7.9, 8.8, 11.9, 10.8, 7.3, 7.9, 30.6, 18.9], False)])
def test_an_outlier_differs_by_more_than_the_others_among_themselves(errors, expected):
    assert is_outlier(int(np.argmax(errors)), np.array(errors) * 1e-3) == expected


@pytest.fixture(scope='module')
def session():
    return read_session(SAMPLE)


def calibrated(session, trials):
    return calibrate(trials, replace(session.options, engine='compiled', workers=1))


@pytest.mark.long
def test_no_trial_of_a_sample_is_an_outlier(session):
    assert calibrated(session, session.trials).outlier is None


@pytest.mark.long
def test_an_outlier_is_named_with_the_values_without_it(session):
    trials = list(session.trials)
    goal = trials[1].goals[-1]
    chain = replace(goal.chain, points=goal.chain.points + np.linspace(0, 0.1, 21)[:, None] * (0.0, 1.0, 0.0))
    trials[1] = replace(trials[1], goals=(*trials[1].goals[:-1], replace(goal, chain=chain)))
    result, without = calibrated(session, trials), calibrated(session, [trials[0], *trials[2:]])
    assert (result.outlier.trial, result.outlier.number) == (trials[1].name, 2)
    assert result.outlier.error > 10 * result.outlier.usual
    for name in ('flexibility', 'friction'):
        assert result.outlier.values[name] == pytest.approx(without.values[name], abs=1.0)
    words, = (text for text in result.warnings if 'does not fit the others' in text)
    assert words.startswith(trials[1].name)
    assert words.endswith('(--without 2)')
    assert bool(result.unusable) == bool(result.outlier.decided)


@pytest.mark.long
def test_a_result_that_an_outlier_decides_is_not_usable(session):
    result = calibrated(session, session.trials)
    estimate = result.parameters['flexibility']
    outlier = Outlier('trial 2', 2, error=0.03, usual=0.002, values={'flexibility': 50.0}, turned=False,
                      decided=('flexibility',))
    words = replace(result, outlier=outlier).unusable
    assert estimate.identifiable
    assert 'flexibility 50 instead of' in words
    assert '--without 2' in words


@pytest.mark.long
def test_goals_from_the_other_end_are_named_as_such(session):
    trials = list(session.trials)
    goal = trials[1].goals[-1]
    chain = replace(goal.chain, points=goal.chain.points[::-1])
    trials[1] = replace(trials[1], goals=(*trials[1].goals[:-1], replace(goal, chain=chain)))
    result = calibrated(session, trials)
    assert result.outlier.turned
    assert 'run from the other end' in result.outlier_words


@pytest.mark.parametrize(('error', 'usual', 'spread', 'turned', 'expected'), [
    (0.0300, 0.0067, 0.0267, False, True),  # a recording of a real cable, whose hands hold it to the end
    (0.0300, 0.0067, 0.0040, False, False),
    (0.0300, 0.0067, 0.0267, True, False)])  # from the other end of the DLO
def test_a_trial_is_sensitive_if_the_uncertainty_of_the_parameters_explains_its_error(
        error, usual, spread, turned, expected):
    assert Outlier('trial 2', 2, error, usual, {}, turned, (), spread).sensitive == expected


def test_the_spread_without_a_trial_is_that_of_a_linear_model():
    layout, generator = ResidualLayout(((1, 20), (1, 20), (2, 20))), np.random.default_rng(0)
    jacobian = 0.1 * generator.normal(size=(layout.rows[-1].stop, 2))
    own, sigma = layout.rows[1], 1e-3
    others = np.delete(jacobian, own, axis=0)
    residuals = sigma * generator.normal(size=len(others))
    covariance = np.linalg.inv(others.T @ others) * sigma**2
    expected = np.mean([np.sqrt(np.trace(block @ covariance @ block.T))
                        for block in jacobian[own].reshape(-1, 3, 2)])
    spread = spread_without(1, layout, np.full(2, 0.5), residuals, jacobian, sigma)
    assert spread == pytest.approx(expected, rel=0.2)
    jacobian[own] *= 100
    assert spread_without(1, layout, np.full(2, 0.5), residuals, jacobian, sigma) == pytest.approx(
        100 * spread)


@pytest.mark.long
def test_a_sensitive_outlier_widens_intervals_but_decides_nothing(session):
    result = calibrated(session, session.trials)
    point = result.best.point.copy()
    point[0] += 0.05
    outlier = Outlier('trial 2', 2, error=0.03, usual=0.002, values=result.space.values(point), turned=False,
                      decided=('flexibility',), spread=0.03)
    wider = replace(result.including(point), outlier=outlier)
    assert not wider.unusable
    for text in ('trial 2 does not fit the others', 'moves its points by 30 mm', '--without 2'):
        assert text in wider.outlier_words
    before, after = result.parameters['flexibility'], wider.parameters['flexibility']
    assert before.upper < after.upper == pytest.approx(after.value + 5 / result.space.upper[0])
    assert after.lower == before.lower
    assert after.physical_lower < before.physical_lower or after.physical_upper > before.physical_upper
    assert wider.parameters['friction'] == result.parameters['friction']


MASS, LENGTH, RADIUS = 0.03, 0.6, 0.004  # kg, m, m
TRUE = {'flexibility': 72.3, 'elasticity': 40.0, 'friction': 65.0, 'self_collision': 25.6, 'damping': 50.0}
GENTLE = ((0, (0.10, 0.20), 0.0), (10, (0.15, -0.18), 1.3), (20, (-0.25, 0.12), 2.6), (16, (0.10, 0.10), 0.5))


def observed_trial(number, grip, way, times, heading, **true):
    """Return a trial of a known rope, observed ten times a second while a hand moves it and 1.5 s longer."""
    along = np.linspace(-0.5, 0.5, 21) * LENGTH
    c, s = np.cos(heading), np.sin(heading)
    points = np.stack([along, 0.04 * np.sin(10 * along), 0 * along + RADIUS], axis=1) @ np.array(
        [[c, s, 0], [-s, c, 0], [0, 0, 1]])
    hand = Hand('hand', (grip,), np.array(times), points[grip] + np.array(way))
    goals = tuple(Goal(Chain(points), t / 10, stable=False, held_by=('hand',) if t / 10 < hand.end else ())
                  for t in range(1, round(10 * hand.end + 15)))
    trial = Trial(f'trial {number}', Chain(points), (Action((hand,)),), goals)
    physical = ParameterSpace(fixed={**TRUE, **true}, mass=MASS).physical({}, trial.initial.length)
    chains = CompiledSimulator(nodes=41).refined().simulate(trial, physical).chains
    generator = np.random.default_rng(number)

    def seen(exactly):
        return Chain(exactly + generator.normal(0, 0.7e-3, exactly.shape))

    return replace(trial, initial=seen(points), goals=tuple(
        replace(goal, chain=seen(chain)) for goal, chain in zip(goals, chains, strict=True)))


def carried(number, grip, aside, heading, **true):
    way = [(0, 0, 0), (0, 0, 0.06), (*aside, 0.06), (*aside, 0)]
    return observed_trial(number, grip, way, [0, 0.4, 1.4, 1.8], heading, **true)


def known_rope(last):
    """Calibrate four trials of a known rope, and another one."""
    trials = [carried(k, *action) for k, action in enumerate(GENTLE, 1)]
    given = {name: value for name, value in TRUE.items() if name not in ('flexibility', 'friction')}
    return calibrate([*trials, last], Options(mass=MASS, engine='compiled', workers=1, parts=1, values=given,
                                              calibrate=('flexibility', 'friction')))


def coiled(number, **true):
    """Return a trial in which a rope is hung up by an end, and laid down in a heap."""
    return observed_trial(number, 0, [(0, 0, 0), (0.3, 0, 0.62), (0.3, 0, 0.62), (0.3, 0, 0.02)],
                          [0, 0.8, 1.5, 2.5], 1.0, **true)


def holds_truth(result):
    estimates = [(result.parameters[name], TRUE[name]) for name in ('flexibility', 'friction')]
    return all(not estimate.identifiable or estimate.lower <= true <= estimate.upper
               for estimate, true in estimates)


@pytest.mark.long
def test_a_chaotic_trial_of_a_known_rope_is_named_and_the_result_is_usable():
    result = known_rope(coiled(5))
    assert result.outlier.trial == 'trial 5'
    assert not result.unusable
    assert holds_truth(result)


@pytest.mark.parametrize('wrong', [
    pytest.param(lambda: coiled(5, damping=65.0), id='drag', marks=pytest.mark.long),
    pytest.param(lambda: carried(5, 0, (-0.25, 0.2), 2.0, flexibility=89.6), id='another rope',
                 marks=pytest.mark.long)])
def test_a_trial_that_went_wrong_is_not_sensitive_though_the_hand_holds_the_rope(wrong):
    result = known_rope(wrong())
    assert GripEvidence.of(result.trials).losses == ()
    assert result.outlier.trial == 'trial 5'
    assert not result.outlier.sensitive
    assert result.unusable or holds_truth(result)


@pytest.mark.long
def test_a_recording_that_the_others_do_not_predict_is_named_and_they_fit_better_without_it(tmp_path):
    if not DATA.is_dir():
        pytest.skip(f'{DATA} is not there; DLO_DATA names the folder of measured data')
    place = spec_from_file_location('convert', ROOT / 'benchmark' / 'convert.py')
    convert = module_from_spec(place)
    place.loader.exec_module(convert)
    assert convert.main(['--data', str(DATA), 'mocap', 'dlo3', str(tmp_path / 'out'), '--recordings',
                         '0,8,16,24,32,40,48,54']) == 0
    session = read_session(tmp_path / 'out')
    options = replace(session.options, engine='compiled', workers=2)
    result = calibrate(session.trials, options)
    assert result.outlier.trial == 'trial 8'
    # The uncertainty of so many parameters may explain it: then the result is still of use.
    assert 'trial 8 does not fit the others' in f'{result.unusable} {result.outlier_words}'
    assert bool(result.unusable) != result.outlier.sensitive
    without = calibrate(session.trials[:7], options)
    assert not without.unusable
    assert without.errors.mean < 0.9 * result.errors.mean
