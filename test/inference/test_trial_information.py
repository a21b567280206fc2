# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What one trial tells, in words, and what each trial of a result told."""

from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Chain, Goal
from dlo_calibration.inference.trial_information import std_of_each_alone, TrialInformation, uninformative
from dlo_calibration.inference.uncertainty import UNKNOWN_STD
from dlo_calibration.model.parameters import knot_names, ParameterSpace
from dlo_calibration.search import SEARCHES

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SPACE = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})


class Blind(ToySimulator):
    """It shows friction in trials of one name only."""

    def __init__(self, showing='trial 2'):
        super().__init__()
        self.showing = showing

    def simulate(self, trial, physical):
        shown = physical if trial.name == self.showing else {
            **physical, 'friction': SPACE.physical({'flexibility': 0, 'friction': 70}, 1.0)['friction']}
        return super().simulate(trial, shown)


def test_components_of_a_rest_shape_are_counted():
    names = ('flexibility', *knot_names(3), 'damping')
    before = np.full(8, 0.2)

    def words(*shares):
        return TrialInformation('trial 1', names, before, before * shares).words

    assert words(0.5, 0.5, 0.5, 0.9, 0.5, 0.5, 0.5, 0.9) == (
        'trial 1 makes flexibility more certain (± 20.0 -> ± 10.0 of 100), 5 of 6 components of the rest '
        'shape; it adds nothing about damping')
    assert words(1, *[0.5] * 6, 1) == (
        'trial 1 makes 6 of 6 components of the rest shape more certain; it adds nothing about flexibility, '
        'damping')
    assert words(0.5, *[1] * 7).endswith('it adds nothing about damping, the rest shape')


def test_verdicts_so_far_end_the_sentence():
    told = TrialInformation('trial 2', ('flexibility', 'elasticity', 'friction'), [0.2, 0.2, 0.2],
                            [0.01, 0.2, 0.08], ('identifiable', 'not identifiable', 'weak'))
    assert told.words.endswith(
        '; so far identifiable: flexibility; weak: friction; not identifiable: elasticity')
    assert told.values['verdict_friction'] == 'weak'


def test_a_trial_that_cannot_be_simulated_says_so():
    told = TrialInformation.unknown('trial 3', SPACE.free, 'it diverged')
    assert told.words == 'the information of trial 3 is unknown: it diverged'
    assert told.values == {}
    assert told.improved == ()


def noisy_trial(name, seed):
    """Return a trial whose goal has 1 mm of white noise."""
    trial = toy_trial(TRUTH, name)
    points = trial.goals[0].chain.points + np.random.default_rng(seed).normal(0, 1e-3, (11, 3))
    return replace(trial, goals=(Goal(Chain(points), 2.0),))


def calibrated(simulator, *names):
    trials = [noisy_trial(name, seed) for seed, name in enumerate(names)]
    return fitted(trials, SPACE, simulator, SEARCHES['least_squares'](2, 1), budget=80)


def test_a_result_knows_the_standard_deviations_of_each_trial_alone():
    result = calibrated(Blind(), 'trial 1', 'trial 2')
    alone = std_of_each_alone(result.trials, result.examination)
    assert alone.shape == (2, 2)
    assert alone[0, 1] == pytest.approx(UNKNOWN_STD)
    assert (alone[[0, 1, 1], [0, 0, 1]] < 0.1).all()
    assert uninformative(result.trials, result.examination) == ()


def test_an_uninformative_trial_is_named():
    class Deaf(ToySimulator):
        def simulate(self, trial, physical):
            if trial.name == 'idle':
                physical = SPACE.physical(TRUTH, 1.0)
            return super().simulate(trial, physical)

    result = calibrated(Deaf(), 'trial 1', 'idle', 'trial 3')
    assert uninformative(result.trials, result.examination) == ('idle',)
    assert uninformative(result.trials, None) == ()
