# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The information of trials, in words and against a simulator with known derivatives."""

from dataclasses import replace

from felt_trials import felt_trials, LIFTS, ROPE
from fitted import fitted
import numpy as np
import pytest
from toy_simulator import REACH, toy_trial, ToySimulator

from dlo_calibration import Chain, Goal, Hand, SimulationError
from dlo_calibration.evaluation import Pool
from dlo_calibration.inference.trial_information import (
    Appraisal,
    Appraiser,
    std_of_each_alone,
    TrialInformation,
    uninformative,
    without_repeated_goals,
)
from dlo_calibration.inference.uncertainty import UNKNOWN_STD
from dlo_calibration.model.parameters import BY_NAME, knot_names, ParameterSpace
from dlo_calibration.observation.noise import noise
from dlo_calibration.search import Hints, SEARCHES
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.protocol import Rollout

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SPACE = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})
FIRST = toy_trial(TRUTH, 'trial 1')
BEST = SPACE.point({'flexibility': 40.0, 'friction': 70.0})
SQUARES = (REACH / SPACE.upper)**2 * np.sum(np.sin(np.linspace(0, np.pi, 11))**2)  # of the derivatives, (2,)


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


def calibrated(trials, simulator=None):
    search = SEARCHES['least_squares'](2, 1, Hints.none(2, SPACE.upper))
    return fitted(trials, SPACE, simulator or ToySimulator(), search, budget=80)


def appraised(trials, simulator=None, space=SPACE):
    """Return the appraisal before the first trial, and after each."""
    appraisals = [Appraisal.before(space.free, space.default_point())]
    for count in range(1, len(trials) + 1):
        some = trials[:count]
        appraiser = Appraiser(space, Pool(simulator or ToySimulator()), 1.0, 0.0, noise(some))
        appraisals.append(appraiser.after(appraisals[-1], some))
    return appraisals


def std(appraisal):
    return appraisal.uncertainty.std


def test_components_of_a_rest_shape_are_counted():
    names = ('flexibility', *knot_names(3), 'damping')
    before = np.full(8, 0.2)

    def words(*shares):
        return TrialInformation('trial 1', names, before, before * shares).words

    assert words(0.5, 0.5, 0.5, 0.9, 0.5, 0.5, 0.5, 0.9) == (
        'trial 1 makes flexibility more certain (± 13.8 -> ± 6.9 of 100), 5 of 6 components of the rest '
        'shape; it adds nothing about damping')
    assert words(1, *[0.5] * 6, 1) == (
        'trial 1 makes 6 of 6 components of the rest shape more certain; it adds nothing about flexibility, '
        'damping')
    assert words(0.5, *[1] * 7).endswith('it adds nothing about damping, the rest shape')


def test_verdicts_so_far_end_the_sentence():
    information = TrialInformation('trial 2', ('flexibility', 'elasticity', 'friction'), [0.2, 0.2, 0.2],
                            [0.01, 0.2, 0.08], ('identifiable', 'not identifiable', 'weak'))
    assert information.words.endswith(
        '; so far identifiable: flexibility; weak: friction; not identifiable: elasticity')
    assert information.values['verdict_friction'] == 'weak'


def test_a_trial_that_cannot_be_simulated_says_so():
    information = TrialInformation.unknown('trial 3', SPACE.free, 'it diverged')
    assert information.words == 'the information of trial 3 is unknown: it diverged'
    assert information.values == {}
    assert information.improved == ()


def test_before_any_trial_all_parameters_are_unknown():
    appraisal = Appraisal.before(SPACE.free, SPACE.default_point())
    assert std(appraisal) == pytest.approx([UNKNOWN_STD] * 2)
    assert appraisal.uncertainty.verdicts == ('not identifiable', 'not identifiable')


def test_the_values_follow_the_trials_and_the_standard_deviation_is_that_of_linear_regression():
    _, after = appraised([noisy_trial('trial 1', 0)])
    assert after.point == pytest.approx(BEST, abs=0.02)
    regression = (12 + SQUARES / after.uncertainty.scale**2)**-0.5
    assert (std(after) >= regression).all()  # with the noise of the initial chain, it is more
    assert (std(after) < 4 * regression).all()
    assert after.uncertainty.verdicts == ('identifiable', 'identifiable')


def test_the_appraised_standard_deviations_are_those_of_the_result():
    trials = [noisy_trial(f'trial {k}', k) for k in range(3)]
    *_, promised = appraised(trials)
    result = calibrated(trials)
    assert std(promised) / result.examination.uncertainty.std == pytest.approx([1, 1], rel=0.6)
    assert promised.uncertainty.verdicts == result.examination.uncertainty.verdicts


def test_the_appraised_values_are_those_that_fit_all_trials_best():
    trials = [noisy_trial(f'trial {k}', k) for k in range(6)]
    *_, last = appraised(trials)
    assert last.point == pytest.approx(calibrated(trials).best.point, abs=0.4 * std(last).min())


class Steep(ToySimulator):
    """Friction does ever less, the further it is from the truth: a wide step shows a third of its effect."""

    def simulate(self, trial, physical):
        friction = 70.0 + 10.0 * np.tanh((BY_NAME['friction'].value(physical['friction']) - 70.0) / 10.0)
        return super().simulate(trial, {**physical, 'friction': BY_NAME['friction'].physical(friction)})


def test_derivatives_are_measured_anew_once_a_value_is_known_well():
    trial = noisy_trial('trial 1', 0)

    def known(simulator):  # from a start at the truth, whose first derivatives are those of wide steps
        return std(Appraiser(SPACE, Pool(simulator), 1.0, 0.0, noise([trial])).after(
            Appraisal.before(SPACE.free, BEST), [trial]))
    assert known(Steep()) == pytest.approx(known(ToySimulator()), rel=0.25)


def test_rougher_chains_inform_less():
    smooth = toy_trial(TRUTH, n=41)
    rough = smooth.goals[0].chain.points + np.random.default_rng(1).normal(0, 5e-3, (41, 3))
    noisy = replace(smooth, goals=(Goal(Chain(rough), 2.0),))
    assert (std(appraised([noisy])[1]) > 2 * std(appraised([smooth])[1])).all()


def test_a_trial_informs_about_what_it_shows_and_an_exact_repeat_about_nothing():
    single, other = noisy_trial('trial 1', 0), noisy_trial('trial 2', 1)
    _, first, second, third = appraised([single, other, other], Blind())
    assert std(first)[1] == pytest.approx(UNKNOWN_STD)
    assert std(first)[0] < 0.05
    assert std(second)[1] < 0.05
    assert std(third)[1] == pytest.approx(std(second)[1], rel=0.15)  # as new trials: 0.82 of it


class Fading(ToySimulator):
    """Friction below 50 of 100 has no effect, like stretching of a very stiff DLO."""

    def simulate(self, trial, physical):
        least = SPACE.physical({'flexibility': 0, 'friction': 50}, 1.0)['friction']
        return super().simulate(trial, {**physical, 'friction': max(physical['friction'], least)})


def test_a_value_is_recovered_from_a_start_without_a_derivative():
    start = SPACE.point({'flexibility': 40.0, 'friction': 10.0})
    appraisal = Appraisal.before(SPACE.free, start)
    trial = noisy_trial('trial 1', 0)
    after = Appraiser(SPACE, Pool(Fading()), 1.0, 0.0, noise([trial]), guessed=('friction',)).after(
        appraisal, [trial])
    assert after.point == pytest.approx(BEST, abs=0.02)
    assert after.uncertainty.verdicts == ('identifiable', 'identifiable')


def test_unseen_points_do_not_count():
    trial = noisy_trial('trial 1', 0)
    points = np.array(trial.goals[0].chain.points)
    points[4] = np.nan
    hidden = replace(trial, goals=(Goal(Chain(points), 2.0),))
    assert std(appraised([hidden])[1]) == pytest.approx(std(appraised([trial])[1]), rel=0.5)


def test_parameters_that_a_trial_cannot_show_are_not_varied():
    space, simulated = ParameterSpace(('flexibility', 'damping')), []
    simulator = ToySimulator()
    simulate = simulator.simulate
    simulator.simulate = lambda trial, physical: simulated.append(physical) or simulate(trial, physical)
    _, after = appraised([FIRST], simulator, space)
    dampings = {physical['damping'] for physical in simulated}
    assert len(dampings) == 1  # it does not show at rest
    assert std(after)[1] == pytest.approx(UNKNOWN_STD)


class Restless(ToySimulator):
    """It never comes to rest."""

    def simulate(self, trial, physical):
        rollout = super().simulate(trial, physical)
        return Rollout(rollout.chains, (False,) * len(rollout.settled), rollout.duration, rollout.steps)


def test_a_trial_that_does_not_come_to_rest_still_informs():
    restless, usual = (std(appraised([FIRST], toy)[1]) for toy in (Restless(), ToySimulator()))
    assert restless.tolist() == usual.tolist()


def test_a_trial_that_cannot_be_simulated_is_an_error():
    with pytest.raises(SimulationError, match='diverged'):
        appraised([FIRST], ToySimulator(fail_below=101.0))


def stream(count):
    """Return a trial as a tracker shows it: while the hand moves, and `count` times at rest."""
    chain = FIRST.goals[0].chain
    return replace(FIRST, goals=(
        *(Goal(chain, time, stable=False) for time in np.linspace(0.5, 1.5, 21)),
        *(Goal(chain, 2.0 + 0.03 * k) for k in range(count))))


def test_a_tracker_that_goes_on_at_rest_changes_nothing():
    short, long = (std(appraised([stream(count)])[1]) for count in (1, 100))
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
    result = calibrated(trials)
    assert result.examination.regular
    appraisal = Appraisal(SPACE.free, result.best.point, result.examination.uncertainty)
    trials = [*result.trials, noisy_trial('trial 5', 9)]
    after = Appraiser(SPACE, Pool(ToySimulator()), 1.0, 0.0, noise(trials)).after(appraisal, trials)
    assert std(after) / std(appraisal) == pytest.approx([0.9, 0.9], rel=0.4)
    assert len(after.models) == 5


def test_a_result_gives_the_standard_deviations_of_each_trial_alone():
    result = calibrated([noisy_trial('trial 1', 0), noisy_trial('trial 2', 1)], Blind())
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

    trials = [noisy_trial(name, seed) for seed, name in enumerate(('trial 1', 'idle', 'trial 3'))]
    result = calibrated(trials, Deaf())
    assert uninformative(result.trials, result.examination) == ('idle',)
    assert uninformative(result.trials, None) == ()


@pytest.mark.long
def test_forces_make_the_mass_known_while_trials_come():
    """In the median of three draws of noise."""
    engine = CompiledSimulator(nodes=21)
    space = ParameterSpace(('flexibility', 'elasticity', 'mass'))

    def after(trials):
        appraiser = Appraiser(space, Pool(engine), 0.6, 0.0, noise(trials))
        appraisal = Appraisal.before(space.free, space.default_point())
        for count in (1, 2):
            appraisal = appraiser.after(appraisal, trials[:count])
        return appraisal

    known, unknown = [], []
    for seed in (1, 2, 3):
        trials = felt_trials(seed, lifts=LIFTS[:2])
        felt = after(trials)
        assert abs(BY_NAME['mass'].value(ROPE['mass']) / 100 - felt.point[2]) < 3 * std(felt)[2]
        assert felt.outlier(trials) == ''
        numb = after([replace(trial, goals=tuple(replace(goal, forces=()) for goal in trial.goals))
                      for trial in trials])
        known, unknown = [*known, std(felt)[2]], [*unknown, std(numb)[2]]
    assert np.median(known) < 0.05
    assert np.median(unknown) > 5 * np.median(known)
