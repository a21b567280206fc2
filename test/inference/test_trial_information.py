# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What one trial tells, against a simulator whose derivatives are known."""

from dataclasses import replace

from fitting import fitted
import numpy as np
import pytest
from toy_simulator import REACH, toy_trial, ToySimulator

from dlo_calibration import Chain, Goal, Hand, SimulationError
from dlo_calibration.inference.trial_information import (
    posterior,
    simulated_information,
    std_of_each_alone,
    TrialInformation,
    uninformative,
    without_repeated_goals,
)
from dlo_calibration.inference.uncertainty import UNKNOWN_STD
from dlo_calibration.model.parameters import knot_names, ParameterSpace
from dlo_calibration.search import SEARCHES
from dlo_calibration.simulation.protocol import Rollout

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SPACE = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})
FIRST = toy_trial(TRUTH, 'trial 1')
SQUARES = REACH**2 * np.sum(np.sin(np.linspace(0, np.pi, 11))**2)  # of the derivatives, for either parameter


class Blind(ToySimulator):
    """It shows friction in trials of one name only."""

    def __init__(self, showing='trial 2'):
        super().__init__()
        self.showing = showing

    def simulate(self, trial, physical):
        shown = physical if trial.name == self.showing else {
            **physical, 'friction': SPACE.physical({'flexibility': 0, 'friction': 70}, 1.0)['friction']}
        return super().simulate(trial, shown)


def told(trials, simulator):
    """Return what each trial adds to those before."""
    known, found = posterior(trials, SPACE, 0.0), []
    for trial in trials:
        after = known.after(simulated_information(trial, known, SPACE, simulator, 1.0, 0.0))
        found.append(TrialInformation(trial.name, known.names, known.std, after.std))
        known = after
    return found


def test_before_any_trial_nothing_is_known():
    known = posterior([FIRST], SPACE, 0.0)
    assert known.std == pytest.approx([UNKNOWN_STD] * 2)
    assert ((known.point >= 0) & (known.point <= 1)).all()


def test_the_standard_deviation_after_a_trial_is_that_of_linear_regression():
    known = posterior([FIRST], SPACE, 0.0)
    after = known.after(simulated_information(FIRST, known, SPACE, ToySimulator(), 1.0, 0.0))
    assert after.std == pytest.approx((12 + SQUARES / known.scale**2)**-0.5, rel=1e-6)


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


def test_rougher_chains_tell_less():
    smooth = toy_trial(TRUTH, n=41)
    rough = smooth.goals[0].chain.points + np.random.default_rng(1).normal(0, 5e-3, (41, 3))
    noisy = replace(smooth, goals=(Goal(Chain(rough), 2.0),))
    assert posterior([noisy], SPACE, 0.0).scale > 2 * posterior([smooth], SPACE, 0.0).scale


def test_a_trial_tells_what_it_shows_and_a_repeat_nothing_new():
    trials = [FIRST, replace(FIRST, name='trial 2'), replace(FIRST, name='trial 2')]
    first, second, third = told(trials, Blind())
    assert first.improved == ('flexibility',)
    assert second.improved == ('friction',)
    assert third.improved == ()
    assert first.after[1] == pytest.approx(UNKNOWN_STD)
    assert first.words.startswith('trial 1 makes flexibility more certain (± 28.9 -> ± ')
    assert first.words.endswith(' of 100); it adds nothing about friction')
    assert third.words == 'trial 2 adds nothing new: repeat it only to average noise'
    assert second.values['std_before_friction'] == pytest.approx(100 * UNKNOWN_STD)
    assert second.values['std_after_friction'] < 5
    # a repeat of the same measurement leaves one over the square root of two
    assert third.after[1] / third.before[1] == pytest.approx(0.5**0.5, rel=0.02)


def test_what_a_trial_surely_does_not_show_is_not_simulated():
    space, simulated = ParameterSpace(('flexibility', 'damping')), []
    simulator = ToySimulator()
    simulate = simulator.simulate
    simulator.simulate = lambda trial, physical: simulated.append(physical) or simulate(trial, physical)
    known = posterior([FIRST], space, 0.0)
    after = known.after(simulated_information(FIRST, known, space, simulator, 1.0, 0.0))
    assert len(simulated) == 2  # either side in flexibility; damping does not show at rest
    assert after.std[1] == pytest.approx(UNKNOWN_STD)


class Restless(ToySimulator):
    """It never comes to rest."""

    def simulate(self, trial, physical):
        rollout = super().simulate(trial, physical)
        return Rollout(rollout.chains, (False,) * len(rollout.settled), rollout.duration, rollout.steps)


def test_a_trial_that_does_not_come_to_rest_tells_what_it_tells():
    known = posterior([FIRST], SPACE, 0.0)
    one, other = (simulated_information(FIRST, known, SPACE, toy, 1.0, 0.0)
                  for toy in (Restless(), ToySimulator()))
    assert one.tolist() == other.tolist()


def test_a_trial_that_cannot_be_simulated_says_so():
    known = posterior([FIRST], SPACE, 0.0)
    with pytest.raises(SimulationError, match='diverged'):
        simulated_information(FIRST, known, SPACE, ToySimulator(fail_below=101.0), 1.0, 0.0)
    told = TrialInformation.unknown('trial 3', SPACE.free, 'it diverged')
    assert told.words == 'the information of trial 3 is unknown: it diverged'
    assert told.values == {}
    assert told.improved == ()


def stream(count):
    """Return a trial as a tracker shows it: while the hand moves, and `count` times at rest."""
    chain = FIRST.goals[0].chain
    return replace(FIRST, goals=(
        *(Goal(chain, time, stable=False) for time in np.linspace(0.5, 1.5, 21)),
        *(Goal(chain, 2.0 + 0.03 * k) for k in range(count))))


def test_a_tracker_that_goes_on_at_rest_changes_nothing():
    known = posterior([FIRST], SPACE, 0.0)
    short, long = (simulated_information(stream(count), known, SPACE, ToySimulator(), 1.0, 0.0)
                   for count in (1, 100))
    assert short.tolist() == long.tolist()
    assert [goal.stable for goal in without_repeated_goals(stream(100)).goals] == [False] * 5 + [True]


def test_each_rest_counts():
    hand = Hand('left_hand', (0,), np.array([4.0, 5.0]), FIRST.hands[0].positions[::-1])
    chain = FIRST.goals[0].chain
    twice = replace(FIRST, actions=(*FIRST.actions, type(FIRST.actions[0])((hand,))),
                    goals=(Goal(chain, 2.0), Goal(chain, 3.0), Goal(chain, 6.0), Goal(chain, 7.0)))
    assert [goal.time for goal in without_repeated_goals(twice).goals] == [2.0, 6.0]


def noisy_trial(name, seed):
    """Return a trial whose goal has 1 mm of white noise."""
    trial = toy_trial(TRUTH, name)
    points = trial.goals[0].chain.points + np.random.default_rng(seed).normal(0, 1e-3, (11, 3))
    return replace(trial, goals=(Goal(Chain(points), 2.0),))


def calibrated(simulator, *names):
    trials = [noisy_trial(name, seed) for seed, name in enumerate(names)]
    return fitted(trials, SPACE, simulator, SEARCHES['least_squares'](2, 1), budget=80)


def test_after_a_result_the_next_trial_adds_to_what_it_found():
    # Four: what is known counts the noise of their initial chains, too, which the toy does not smooth.
    result = calibrated(ToySimulator(), 'trial 1', 'trial 2', 'trial 3', 'trial 4')
    assert result.examination.regular
    known = posterior(result.trials, SPACE, 0.0, result.best.point, result.examination)
    assert known.point.tolist() == result.best.point.tolist()
    assert known.std == pytest.approx(result.examination.uncertainty.std, rel=1e-6)
    again = TrialInformation('trial 5', known.names, known.std, known.after(simulated_information(
        FIRST, known, SPACE, ToySimulator(), 1.0, 0.0)).std)
    assert again.improved == ()


def test_a_result_says_what_each_trial_told_alone():
    result = calibrated(Blind(), 'trial 1', 'trial 2')
    alone = std_of_each_alone(result.trials, result.examination)
    assert alone.shape == (2, 2)
    assert alone[0, 1] == pytest.approx(UNKNOWN_STD)
    assert (alone[[0, 1, 1], [0, 0, 1]] < 0.1).all()
    assert uninformative(result.trials, result.examination) == ()


def test_a_trial_that_told_nothing_is_named():
    class Deaf(ToySimulator):
        def simulate(self, trial, physical):
            if trial.name == 'idle':
                physical = SPACE.physical(TRUTH, 1.0)
            return super().simulate(trial, physical)

    result = calibrated(Deaf(), 'trial 1', 'idle', 'trial 3')
    assert uninformative(result.trials, result.examination) == ('idle',)
    assert uninformative(result.trials, None) == ()
