# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The examination around a fit, on an analytic simulator: intervals, and defaults that stay."""

from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.search import SEARCHES

TRUTH = {'flexibility': 40.0, 'elasticity': 65.0, 'friction': 25.0, 'self_collision': 55.0}
TRIALS = (toy_trial(TRUTH), toy_trial(TRUTH, 'trial 2', turn=1.0))


def search(space, seed=1, name='random'):
    return SEARCHES[name](space.dimension, seed)


def calibrated(trials=TRIALS, space=None, simulator=None, seed=1, **rest):
    space = space or ParameterSpace()
    return fitted(trials, space, simulator or ToySimulator(), search(space, seed), seed=seed, **rest)


def searched(space):
    """Return what least squares finds on two trials."""
    return fitted(TRIALS, space, ToySimulator(), search(space, name='least_squares'), budget=120)


def test_a_parameter_that_no_trial_excites_keeps_its_default_with_a_note():
    space = ParameterSpace(('flexibility', 'damping'), {k: v for k, v in TRUTH.items() if k != 'flexibility'})
    result = searched(space)
    assert result.parameters['flexibility'].value == pytest.approx(TRUTH['flexibility'], abs=0.01)
    damping = result.parameters['damping']
    assert (damping.value, damping.lower, damping.upper) == (50.0, 0.0, 100.0)
    assert damping.verdict == 'not identifiable'
    assert damping.note == 'no trial shows it; it keeps its default'
    assert result.best.values == result.values


class Numb(ToySimulator):
    """Elasticity shows only where it is more than 35 of 100 from the truth."""

    def simulate(self, trial, physical):
        elasticity = BY_NAME['elasticity']
        if abs(elasticity.value(physical['elasticity']) - TRUTH['elasticity']) < 35:
            physical = {**physical, 'elasticity': elasticity.physical(TRUTH['elasticity'])}
        return super().simulate(trial, physical)


@pytest.mark.parametrize('default, stays', [(25.0, False), (80.0, True)])
def test_a_default_that_the_trials_refute_does_not_stay(default, stays):
    space = ParameterSpace(('flexibility', 'elasticity'), {**TRUTH, 'elasticity': default})
    rough = np.random.default_rng(2)
    trials = [replace(trial, goals=(replace(trial.goals[0], chain=replace(
        trial.goals[0].chain, points=trial.goals[0].chain.points + rough.normal(0, 1e-3, (11, 3)))),))
        for trial in TRIALS]
    result = fitted(trials, space, Numb(), search(space, name='least_squares'), budget=120)
    elasticity = result.parameters['elasticity']
    assert elasticity.verdict == 'not identifiable'
    assert (elasticity.value == default) is stays
    assert ('keeps its default' in elasticity.note) is stays
    assert abs(elasticity.value - TRUTH['elasticity']) < 35
    assert result.best.values == result.values


@pytest.mark.long
@pytest.mark.parametrize('free', [('flexibility', 'friction'), ('flexibility', 'friction', 'damping')])
def test_intervals_of_a_search_that_ends_beside_the_minimum_are_around_its_values(free):
    others = {name: value for name, value in TRUTH.items() if name not in free}
    regular, inside = 0, []
    for seed in range(25):
        rough = np.random.default_rng(seed)
        trials = [replace(trial, goals=(replace(trial.goals[0], chain=replace(
            trial.goals[0].chain, points=trial.goals[0].chain.points + rough.normal(0, 5e-3, (91, 3)))),))
            for trial in (toy_trial(TRUTH, n=91), toy_trial(TRUTH, 'trial 2', n=91, turn=1.0))]
        result = calibrated(trials, ParameterSpace(free, others), seed=seed)
        regular += result.examination.regular
        for estimate in result.parameters.values():
            assert estimate.lower <= estimate.value <= estimate.upper
        inside += [result.parameters[name].lower <= TRUTH[name] <= result.parameters[name].upper
                   for name in ('flexibility', 'friction')]
    assert regular > 12  # enough results with the intervals of a linear model
    assert np.mean(inside) >= 0.85


def test_the_band_is_the_standard_deviation_of_simulated_points():
    result = calibrated()
    model = result.examination
    assert result.band.shape == (22,)
    # The variances of the points add up to the trace of their covariance.
    assert np.sum(result.band**2) == pytest.approx(
        np.trace(model.jacobian @ model.uncertainty.covariance @ model.jacobian.T))
    assert replace(result, examination=None).band is None
    assert replace(result, examination=replace(model, regular=False)).band is None


class Seeing(ToySimulator):
    """A toy that records the initial chains of its rollouts."""

    def __init__(self):
        super().__init__()
        self.starts = {}

    def simulate(self, trial, physical):
        self.starts[trial.initial.points.tobytes()] = trial
        return super().simulate(trial, physical)


@pytest.mark.long
@pytest.mark.parametrize(('count', 'more'), [(1, 32), (2, 32), (5, 35), (17, 34)])
def test_initial_chains_with_other_noise_are_simulated_where_there_is_noise(count, more):
    generator = np.random.default_rng(1)

    def noisy(chain):
        return replace(chain, points=chain.points + generator.normal(0, 1e-3, chain.points.shape))

    exact = [toy_trial(TRUTH, f'trial {k}', n=41) for k in range(count)]
    trials = [replace(trial, initial=noisy(trial.initial),
                      goals=(replace(trial.goals[0], chain=noisy(trial.goals[0].chain)),)) for trial in exact]
    seen = []
    for _ in range(2):
        simulator = Seeing()
        calibrated(trials=trials, simulator=simulator, budget=20)
        seen.append(simulator.starts)
    assert len(seen[0]) == count + more
    assert list(seen[0]) == list(seen[1])  # the same each time
    others = list(seen[0].values())[count:]
    away = [trial.initial.points - exact[0].initial.points for trial in others]
    assert np.std(away) == pytest.approx(1e-3, rel=0.15)
    assert {trial.name for trial in others} == {trial.name for trial in trials}
    assert all(trial.goals == trials[0].goals for trial in others if trial.name == trials[0].name)
    smooth = Seeing()
    still = [toy_trial(dict.fromkeys(TRUTH, 0.0), trial.name, n=41) for trial in exact]
    calibrated(trials=still, simulator=smooth, budget=20)
    assert len(smooth.starts) == 1
