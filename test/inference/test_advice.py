# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The advised action: the only or most informative one, none if none helps, always one that can be done."""

from concurrent.futures import CancelledError
from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from rest_shape_result import rest_shape_result
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Chain, Goal, SimulationError, Trial
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.stages import advised
from dlo_calibration.evaluation import Pool
from dlo_calibration.inference.advice import advise, candidates, MOST_SOUGHT
from dlo_calibration.model.named_actions import NAMED_ACTIONS
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.search import SEARCHES
from dlo_calibration.simulation.protocol import Rollout

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SPACE = ParameterSpace(('flexibility', 'friction'), {'elasticity': 30.0, 'self_collision': 20.0})


class Informing(ToySimulator):
    """
    It shows friction only in trials whose name contains a word.

    :param worth: share of its effect that shows.
    """

    def __init__(self, word, worth=1.0):
        super().__init__()
        self.word, self.worth = word, worth
        self.names = []

    def simulate(self, trial, physical):
        self.names.append(trial.name)
        blind = {**physical, 'friction': SPACE.physical({'friction': 70.0}, 1.0)['friction']}
        rollout = super().simulate(trial, blind)
        if self.word not in trial.name:
            return rollout
        seen = super().simulate(trial, physical).chains
        return replace(rollout, chains=rollout.chains + self.worth * (seen - rollout.chains))


def observed(name, simulator=None, seed=0, trial=None):
    """Return a trial with 1 mm of noise on what the simulator gives for the truth."""
    trial = trial or toy_trial(TRUTH, name)
    chains = (simulator or ToySimulator()).simulate(trial, SPACE.physical(TRUTH, 1.0)).chains
    noise = np.random.default_rng(seed).normal(0, 1e-3, chains.shape)
    return replace(trial, goals=tuple(replace(goal, chain=Chain(chain)) for goal, chain in zip(
        trial.goals, chains + noise, strict=True)))


def calibrated(simulator, *trials):
    return fitted(trials, SPACE, simulator, SEARCHES['least_squares'](2, 1), budget=80)


def advice_for(simulator, result, **rest):
    return advise(result.trials, SPACE, Pool(simulator, **rest), result.best.point,
                  result.examination.uncertainty, result.length)


def test_the_only_action_that_informs_about_a_parameter_is_advised():
    simulator = Informing('drag the middle')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    assert result.parameters['friction'].verdict == 'not identifiable'
    advice = advice_for(simulator, result)
    assert (advice.parameter, advice.action) == ('friction', 'drag')
    assert advice.words == 'drag the middle sideways by 30 cm'
    assert advice.std == pytest.approx(12**-0.5)
    assert advice.expected_std < 0.05
    assert advice.lower <= result.best.point[1] <= advice.upper


def test_the_expected_deviation_is_what_a_calibration_with_that_trial_gives():
    simulator = Informing('drag the middle')
    trials = [observed(f'trial {k}', seed=k) for k in (1, 2)]
    result = calibrated(simulator, *trials)
    advice = advice_for(simulator, result)
    tried = next(candidate for candidate in candidates(trials) if candidate.words == advice.words).trial
    again = calibrated(simulator, *trials, observed(tried.name, simulator, 3, tried))
    friction = again.parameters['friction']
    assert friction.verdict == 'identifiable'
    assert advice.expected_std == pytest.approx(friction.std / 100, rel=0.6)


def test_nothing_is_advised_if_no_action_helps():
    simulator = Informing('no such action')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    assert advice_for(simulator, result) is None


def test_nothing_is_simulated_and_advised_if_all_parameters_are_identifiable():
    simulator = Informing('')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    assert {estimate.verdict for estimate in result.parameters.values()} == {'identifiable'}
    simulator.names.clear()
    assert advice_for(simulator, result) is None
    assert simulator.names == []


def test_the_most_informative_action_is_advised():
    class Better(Informing):
        def simulate(self, trial, physical):
            self.worth = 0.3 if 'middle' in trial.name else 1.0
            return super().simulate(trial, physical)

    simulator = Better('drag')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    assert 'drag the first end' in advice_for(simulator, result).words


def test_few_rollouts_are_spent():
    simulator = Informing('drag')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    simulator.names.clear()
    assert advice_for(simulator, result) is not None
    count = len(list(candidates(result.trials)))
    # Each at the values, with three or four errors, and on both sides in friction.
    assert len(simulator.names) <= 7 * count


def test_advice_is_sought_for_the_least_certain_of_many_parameters():
    """The toy shows four of thirty parameters, which are the most certain ones."""
    result = rest_shape_result()
    unsure = replace(result.examination.uncertainty, std=np.where(np.arange(30) < 4, 0.15, 0.2))
    simulator = Informing('')
    assert advise(result.trials, result.space, Pool(simulator), result.best.point, unsure,
                  result.length) is None
    assert len(simulator.names) <= (5 + 2 * MOST_SOUGHT) * len(list(candidates(result.trials)))


class Failing(Informing):
    """The most informative action diverges, or never comes to rest."""

    def __init__(self, settles):
        super().__init__('drag')
        self.settles = settles

    def simulate(self, trial, physical):
        if 'drag the middle' in trial.name and not self.settles:
            raise SimulationError('diverged')
        rollout = super().simulate(trial, physical)
        settled = 'drag the middle' not in trial.name
        return Rollout(rollout.chains, (settled,) * len(rollout.settled), rollout.duration, rollout.steps)


@pytest.mark.parametrize('settles', [False, True])
def test_an_action_that_cannot_be_simulated_to_rest_is_not_advised(settles):
    simulator = Failing(settles)
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    advice = advice_for(simulator, result)
    assert 'drag' in advice.words
    assert 'the middle' not in advice.words


def test_a_stop_gives_no_advice():
    simulator = Informing('drag')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    with pytest.raises(CancelledError):
        advice_for(simulator, result, should_stop=lambda: True)


def test_a_result_that_is_no_minimum_gets_no_advice():
    simulator = Informing('drag')
    result = calibrated(simulator, observed('trial 1'), observed('trial 2', seed=1))
    setting = Setting(result.trials, Options(), simulator)
    assert advised(setting, result).advice is not None
    for examination in (None, replace(result.examination, regular=False)):
        assert advised(setting, replace(result, examination=examination)).advice is None


ALONG = np.linspace(0, 1, 11)
SHAPES = {
    'straight': np.stack([ALONG, 0 * ALONG, 0 * ALONG], axis=1),
    'bent': np.stack([np.cos(3 * ALONG) / 3, np.sin(3 * ALONG) / 3, 0 * ALONG], axis=1),
    'closed': np.stack([np.cos(2 * np.pi * ALONG), np.sin(2 * np.pi * ALONG), 0 * ALONG], axis=1) / 6,
    'short': 0.02 * np.stack([ALONG, 0.1 * ALONG**2, 0 * ALONG], axis=1),
    'vertical': np.stack([0 * ALONG, 0 * ALONG, 1 - ALONG], axis=1),
    'of three points': np.array([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0.1, 0]]),
}


@pytest.mark.parametrize('name', SHAPES)
def test_advised_actions_can_be_done_with_a_chain_of_any_shape(name):
    base = toy_trial(TRUTH, n=len(SHAPES[name]))
    chain = Chain(SHAPES[name])
    trial = Trial('trial 1', chain, base.actions, (Goal(chain, 2.0),))
    actions = list(candidates([trial]))
    assert {candidate.action for candidate in actions} >= {'lift_and_hold', 'drag', 'grasp_and_place'}
    assert len({candidate.words for candidate in actions}) == len(actions)
    for candidate in actions:
        assert candidate.action in NAMED_ACTIONS
        assert candidate.trial.initial is chain
        for hand in candidate.trial.hands:
            assert np.isfinite(hand.positions).all()
            assert hand.positions[0] == pytest.approx(chain.gripped(hand.grips, hand.offset)[0])
        for goal in candidate.trial.goals:
            assert goal.stable is ('while it moves' not in candidate.words)
            holds = candidate.action in ('lift_and_hold', 'two_hands')
            assert bool(candidate.trial.holding(goal)) is (holds or not goal.stable)


def test_actions_begin_where_a_trial_began_at_rest():
    moving = toy_trial(TRUTH)
    moving = Trial('moving', moving.initial, moving.actions, moving.goals, np.ones((11, 3)))
    resting = toy_trial(TRUTH, 'resting', turn=1.0)
    assert all(candidate.trial.initial is resting.initial for candidate in candidates([moving, resting]))
