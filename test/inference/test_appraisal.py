# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What is known after each trial, against a simulator whose derivatives are known."""

from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from toy_simulator import REACH, toy_trial, ToySimulator

from dlo_calibration import Chain, Goal, Hand, SimulationError
from dlo_calibration.evaluation import Pool
from dlo_calibration.inference.trial_information import Appraisal, Appraiser, without_repeated_goals
from dlo_calibration.inference.uncertainty import UNKNOWN_STD
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.observation.noise import noise
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


def noisy_trial(name, seed):
    """Return a trial whose goal has 1 mm of white noise."""
    trial = toy_trial(TRUTH, name)
    points = trial.goals[0].chain.points + np.random.default_rng(seed).normal(0, 1e-3, (11, 3))
    return replace(trial, goals=(Goal(Chain(points), 2.0),))


def learned(trials, simulator=None, space=SPACE):
    """Return what is known before the first trial, and after each."""
    found = [Appraisal.before(space.free, space.default_point())]
    for count in range(1, len(trials) + 1):
        some = trials[:count]
        appraiser = Appraiser(space, Pool(simulator or ToySimulator()), 1.0, 0.0, noise(some))
        found.append(appraiser.after(found[-1], some))
    return found


def std(known):
    return known.uncertainty.std


def test_before_any_trial_nothing_is_known():
    known = Appraisal.before(SPACE.free, SPACE.default_point())
    assert std(known) == pytest.approx([UNKNOWN_STD] * 2)
    assert known.uncertainty.verdicts == ('not identifiable', 'not identifiable')


def test_the_values_follow_the_trials_and_the_standard_deviation_is_that_of_linear_regression():
    _, after = learned([noisy_trial('trial 1', 0)])
    assert after.point == pytest.approx([0.4, 0.7], abs=0.02)
    regression = (12 + SQUARES / after.uncertainty.scale**2)**-0.5
    assert (std(after) >= regression).all()  # with the noise of the initial chain, it is more
    assert (std(after) < 4 * regression).all()
    assert after.uncertainty.verdicts == ('identifiable', 'identifiable')


def test_the_appraised_standard_deviations_are_those_of_the_result():
    trials = [noisy_trial(f'trial {k}', k) for k in range(3)]
    *_, promised = learned(trials)
    result = fitted(trials, SPACE, ToySimulator(), SEARCHES['least_squares'](2, 1), budget=80)
    assert std(promised) / result.examination.uncertainty.std == pytest.approx([1, 1], rel=0.6)
    assert promised.uncertainty.verdicts == result.examination.uncertainty.verdicts


def test_rougher_chains_inform_less():
    smooth = toy_trial(TRUTH, n=41)
    rough = smooth.goals[0].chain.points + np.random.default_rng(1).normal(0, 5e-3, (41, 3))
    noisy = replace(smooth, goals=(Goal(Chain(rough), 2.0),))
    assert (std(learned([noisy])[1]) > 2 * std(learned([smooth])[1])).all()


def test_a_trial_informs_about_what_it_shows_and_an_exact_repeat_about_nothing():
    one, other = noisy_trial('trial 1', 0), noisy_trial('trial 2', 1)
    _, first, second, third = learned([one, other, other], Blind())
    assert std(first)[1] == pytest.approx(UNKNOWN_STD)
    assert std(first)[0] < 0.05
    assert std(second)[1] < 0.05
    assert std(third)[1] == pytest.approx(std(second)[1], rel=0.1)


class Fading(ToySimulator):
    """Friction below 50 of 100 has no effect, as stretching has none of a DLO that counts as stiff."""

    def simulate(self, trial, physical):
        least = SPACE.physical({'flexibility': 0, 'friction': 50}, 1.0)['friction']
        return super().simulate(trial, {**physical, 'friction': max(physical['friction'], least)})


def test_a_value_is_found_from_where_no_derivative_points_to_it():
    start = np.array([0.4, 0.1])
    known = Appraisal.before(SPACE.free, start)
    one = noisy_trial('trial 1', 0)
    after = Appraiser(SPACE, Pool(Fading()), 1.0, 0.0, noise([one]), guessed=('friction',)).after(
        known, [one])
    assert after.point == pytest.approx([0.4, 0.7], abs=0.02)
    assert after.uncertainty.verdicts == ('identifiable', 'identifiable')


def test_points_that_were_not_seen_are_left_out():
    trial = noisy_trial('trial 1', 0)
    points = np.array(trial.goals[0].chain.points)
    points[4] = np.nan
    hidden = replace(trial, goals=(Goal(Chain(points), 2.0),))
    assert std(learned([hidden])[1]) == pytest.approx(std(learned([trial])[1]), rel=0.5)


def test_parameters_that_a_trial_cannot_show_are_not_varied():
    space, simulated = ParameterSpace(('flexibility', 'damping')), []
    simulator = ToySimulator()
    simulate = simulator.simulate
    simulator.simulate = lambda trial, physical: simulated.append(physical) or simulate(trial, physical)
    _, after = learned([FIRST], simulator, space)
    dampings = {one['damping'] for one in simulated}
    assert len(dampings) == 1  # it does not show at rest
    assert std(after)[1] == pytest.approx(UNKNOWN_STD)


class Restless(ToySimulator):
    """It never comes to rest."""

    def simulate(self, trial, physical):
        rollout = super().simulate(trial, physical)
        return Rollout(rollout.chains, (False,) * len(rollout.settled), rollout.duration, rollout.steps)


def test_a_trial_that_does_not_come_to_rest_still_informs():
    one, other = (std(learned([FIRST], toy)[1]) for toy in (Restless(), ToySimulator()))
    assert one.tolist() == other.tolist()


def test_a_trial_that_cannot_be_simulated_is_an_error():
    with pytest.raises(SimulationError, match='diverged'):
        learned([FIRST], ToySimulator(fail_below=101.0))


def stream(count):
    """Return a trial as a tracker shows it: while the hand moves, and `count` times at rest."""
    chain = FIRST.goals[0].chain
    return replace(FIRST, goals=(
        *(Goal(chain, time, stable=False) for time in np.linspace(0.5, 1.5, 21)),
        *(Goal(chain, 2.0 + 0.03 * k) for k in range(count))))


def test_a_tracker_that_goes_on_at_rest_changes_nothing():
    short, long = (std(learned([stream(count)])[1]) for count in (1, 100))
    assert short == pytest.approx(long, rel=0.2)  # but for the noise level
    assert [goal.stable for goal in without_repeated_goals(stream(100)).goals] == [False] * 5 + [True]


def test_each_rest_after_another_action_counts():
    hand = Hand('left_hand', (0,), np.array([4.0, 5.0]), FIRST.hands[0].positions[::-1])
    chain = FIRST.goals[0].chain
    twice = replace(FIRST, actions=(*FIRST.actions, type(FIRST.actions[0])((hand,))),
                    goals=(Goal(chain, 2.0), Goal(chain, 3.0), Goal(chain, 6.0), Goal(chain, 7.0)))
    assert [goal.time for goal in without_repeated_goals(twice).goals] == [2.0, 6.0]


def test_a_trial_after_a_result_adds_to_it():
    trials = [noisy_trial(f'trial {k}', k) for k in range(4)]
    result = fitted(trials, SPACE, ToySimulator(), SEARCHES['least_squares'](2, 1), budget=80)
    assert result.examination.regular
    known = Appraisal(SPACE.free, result.best.point, result.examination.uncertainty)
    trials = [*result.trials, noisy_trial('trial 5', 9)]
    after = Appraiser(SPACE, Pool(ToySimulator()), 1.0, 0.0, noise(trials)).after(known, trials)
    assert std(after) / std(known) == pytest.approx([0.9, 0.9], rel=0.4)
    assert len(after.models) == 5
