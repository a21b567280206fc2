# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations on an analytic simulator: their values, the order of evaluations, and how they end."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from toy_simulator import new_toy, toy_trial, ToySimulator

from dlo_calibration import calibrate, Goal, InputError, SimulationError, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.residuals import compared_goals
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.search import SEARCHES
from dlo_calibration.simulation.protocol import Rollout

TRUTH = {'flexibility': 40.0, 'elasticity': 65.0, 'friction': 25.0, 'self_collision': 55.0}
TRIALS = (toy_trial(TRUTH), toy_trial(TRUTH, 'trial 2', turn=1.0))
OPTIONS = Options(workers=1, engine='compiled')


def search(space=None, seed=1, name='random'):
    return SEARCHES[name]((space or ParameterSpace()).dimension, seed)


def calibrated(trials=TRIALS, space=None, simulator=None, seed=1, **rest):
    space = space or ParameterSpace()
    return fitted(trials, space, simulator or ToySimulator(), search(space, seed), seed=seed, **rest)


@pytest.mark.parametrize('name', TRUTH)
def test_a_single_parameter_is_recovered(name):
    space = ParameterSpace((name,), {other: value for other, value in TRUTH.items() if other != name})
    result = calibrated(space=space)
    estimate = result.parameters[name]
    # 150 random values lie less than 3 from anywhere, but for one seed in a hundred.
    assert estimate.value == pytest.approx(TRUTH[name], abs=3)
    assert estimate.identifiable
    assert estimate.lower <= estimate.value <= estimate.upper
    assert result.errors.max < 0.03 * 0.2
    assert result.best.score < 10


@pytest.mark.parametrize('seed', range(5))
def test_four_parameters_together_score_better_than_almost_any(seed):
    result = calibrated(seed=seed)
    scores = [evaluation.score for evaluation in result.evaluations]
    assert result.best.score == min(scores)
    assert result.best.score < 0.4 * np.median(scores)
    exact = ToySimulator().simulate(TRIALS[0], ParameterSpace().physical(TRUTH, result.length)).chains
    assert exact == pytest.approx(np.stack([goal.chain.points for goal in TRIALS[0].goals]), abs=1e-9)


def test_a_parameter_without_effect_is_not_identifiable():
    space = ParameterSpace(('flexibility', 'damping'), {k: v for k, v in TRUTH.items() if k != 'flexibility'})
    result = calibrated(space=space)
    assert result.parameters['flexibility'].identifiable
    assert not result.parameters['damping'].identifiable


def searched(space, truth=TRUTH):
    """Return what least squares finds on two trials."""
    trials = (toy_trial(truth), toy_trial(truth, 'trial 2', turn=1.0))
    return fitted(trials, space, ToySimulator(), search(space, name='least_squares'), budget=120)


def test_a_value_at_the_end_of_the_scale_is_noted_at_either_end():
    truth = {**TRUTH, 'flexibility': 0.0, 'friction': 100.0}
    result = searched(ParameterSpace(('flexibility', 'friction', 'elasticity'),
                                     {'self_collision': TRUTH['self_collision']}), truth)
    assert {name for name, estimate in result.parameters.items()
            if 'where the best value is' in estimate.note} == {'flexibility', 'friction'}
    assert result.parameters['friction'].upper == 100.0
    assert result.parameters['flexibility'].lower == 0.0


def test_physical_values_beside_the_scale():
    result = calibrated(space=ParameterSpace(mass=0.05), budget=30)
    for name, estimate in result.parameters.items():
        physical = result.space.physical(result.values, result.length)[name]
        assert estimate.physical_value == pytest.approx(physical)
        assert estimate.physical_lower <= estimate.physical_value <= estimate.physical_upper
    assert result.parameters['flexibility'].physical_unit == 'N m^2'
    assert result.physical()['mass'] == 0.05
    assert calibrated(budget=2).parameters['flexibility'].physical_unit == 'N m^2 per N/m'


def test_every_evaluation_is_reported_and_in_the_result_in_order():
    seen = []
    result = calibrated(budget=120, on_evaluation=seen.append)
    assert [evaluation.index for evaluation in seen] == list(range(120))
    assert [evaluation.index for evaluation in result.evaluations] == list(range(120))
    assert [e.scores for e in result.evaluations] == [e.scores for e in seen]
    assert all(len(e.scores) == 2 for e in seen)
    assert result.simulations == 240 - sum(e.skipped for e in seen) + 2 * result.examination.evaluations


def test_only_the_best_evaluation_has_residuals():
    result = calibrated(budget=20)
    assert all(evaluation.residuals is None for evaluation in result.evaluations)
    assert result.best.residuals.shape == (2 * 11 * 3,)
    assert result.evaluations[result.best.index].point.tolist() == result.best.point.tolist()


def test_the_chains_are_those_that_the_simulator_gives_for_the_best():
    result = calibrated(budget=20)
    assert result.values == result.best.values
    for trial, chains in zip(TRIALS, result.chains, strict=True):
        assert chains == pytest.approx(ToySimulator().simulate(trial, result.physical()).chains, abs=1e-12)


@pytest.mark.parametrize('budget', [1, 2, 77])
def test_exactly_the_budget_is_spent(budget):
    result = calibrated(budget=budget)
    assert len(result.evaluations) == budget
    assert result.stop_reason == f'budget of {budget} evaluations spent'


def test_a_search_that_may_not_spend_the_whole_budget_names_both_numbers():
    with closing(ToySimulator()) as simulator:
        options = Options(evaluations=550, calibrate=('friction',), parts=1)
        setting = Setting(tuple(TRIALS), options, simulator)
        part = fit(setting, setting.options.space, SEARCHES['random'](1, 1), 5)
    assert part.stop_reason == '5 of at most 550 evaluations made, as many as this search may take'


def test_the_result_names_search_engine_seed_and_stop_reason():
    ticks = iter([10.0, 17.5])
    options = Options(search='random', evaluations=3, seed=7, workers=1, engine='compiled')
    result = calibrate(TRIALS, options, make_simulator=new_toy, clock=lambda: next(ticks))
    assert (result.seed, result.engine, result.search, result.seconds) == (7, 'toy', 'random', 7.5)
    assert result.trials == TRIALS
    assert all('a noise of' in text for text in result.warnings)  # the kinks of the toy look like it


def test_a_search_that_ends_early_says_why():
    class Finished:
        name = 'finished'
        limit = float('inf')
        best = model = None
        rivals = ()
        stop_reason = 'it cannot get better'

        def __init__(self):
            self.observations = []

        def ask(self, limit):
            return np.full((2 if not self.observations else 0, 4), 0.5)

        def tell(self, observations):
            self.observations += observations

    finished = Finished()
    result = fitted(TRIALS, ParameterSpace(), ToySimulator(), finished)
    assert len(result.evaluations) == 2
    assert result.stop_reason == 'it cannot get better'
    assert [observation.score for observation in finished.observations] == [
        evaluation.score for evaluation in result.evaluations]
    assert all(observation.residuals.shape == (66,) for observation in finished.observations)


def test_a_stop_gives_the_best_so_far():
    seen = []
    result = calibrated(should_stop=lambda: len(seen) >= 5, on_evaluation=seen.append)
    assert len(result.evaluations) == len(seen) == 5
    assert result.best.score == min(evaluation.score for evaluation in seen)
    assert result.stop_reason == 'stopped on request'
    assert result.evaluations[-1].scores == calibrated(budget=5).evaluations[-1].scores


def test_a_stop_before_the_first_evaluation_gives_no_result():
    with pytest.raises(SimulationError, match='stopped before the first evaluation had finished'):
        calibrated(should_stop=lambda: True)
    with ThreadPoolExecutor(2) as executor, pytest.raises(SimulationError, match='stopped before the first'):
        calibrated(should_stop=lambda: True, executor=executor)


def test_failed_evaluations_are_in_the_result_with_their_reason():
    seen = []
    result = calibrated(simulator=ToySimulator(fail_below=30.0), budget=60, on_evaluation=seen.append)
    failed = [evaluation for evaluation in result.evaluations if evaluation.failure]
    assert 0 < len(failed) < 60
    assert len(seen) == 60
    for evaluation in failed:
        assert evaluation.values['flexibility'] < 30
        assert evaluation.failure == 'trial 1: diverged'
        assert evaluation.score == float('inf')
        assert evaluation.errors is None
    assert result.best.values['flexibility'] >= 30
    assert result.warnings == (
        f'{len(failed)} of 60 evaluations could not be simulated: trial 1: diverged',)


def test_no_result_but_a_reason_if_all_evaluations_fail():
    with pytest.raises(SimulationError, match='none of 12 evaluations could be simulated: trial 1: diverged'):
        calibrated(simulator=ToySimulator(fail_below=101.0), budget=12)


class Shaky(ToySimulator):
    """It never comes to rest in the second trial."""

    def simulate(self, trial, physical):
        rollout = super().simulate(trial, physical)
        settled = tuple(trial.name != 'trial 2' for _ in rollout.settled)
        return Rollout(rollout.chains, settled, rollout.duration, rollout.steps)


def test_a_trial_that_never_settles_is_named_in_a_warning():
    result = calibrated(simulator=Shaky(), budget=3)
    assert result.best.unsettled == ('trial 2',)
    assert len(result.warnings) == 1
    assert 'never came to rest: trial 2' in result.warnings[0]


class NotFinite(ToySimulator):
    """Its first rollouts diverge to NaN without an error."""

    def __init__(self):
        super().__init__()
        self.failures = 4

    def simulate(self, trial, physical):
        rollout = super().simulate(trial, physical)
        self.failures -= 1
        chains = rollout.chains * (np.nan if self.failures >= 0 else 1)
        return Rollout(chains, rollout.settled, rollout.duration, rollout.steps)


def test_a_rollout_that_is_not_finite_is_a_failure_and_never_wins():
    result = calibrated(simulator=NotFinite(), budget=10)
    assert np.isfinite(result.best.score)
    assert [bool(evaluation.failure) for evaluation in result.evaluations] == [True] * 2 + [False] * 8


def test_an_unexpected_error_is_raised():
    with pytest.raises(RuntimeError, match='the toy'):
        calibrated(simulator=ToySimulator(crash=True))
    with ThreadPoolExecutor(2) as executor, pytest.raises(RuntimeError, match='the toy'):
        calibrated(simulator=ToySimulator(crash=True), executor=executor)


def test_without_trials_there_is_nothing_to_calibrate():
    with pytest.raises(InputError, match='no trials; expected at least one complete trial; record'):
        calibrate(())


def scores(evaluation):
    """Return the scores as bytes, which compare bit for bit, NaN too."""
    return np.array(evaluation.scores).tobytes()


def same(first, second):
    """Compare two results bit for bit, except for their duration."""
    assert [e.point.tobytes() for e in first.evaluations] == [e.point.tobytes() for e in second.evaluations]
    assert [scores(e) for e in first.evaluations] == [scores(e) for e in second.evaluations]
    assert [e.skipped for e in first.evaluations] == [e.skipped for e in second.evaluations]
    assert [e.failure for e in first.evaluations] == [e.failure for e in second.evaluations]
    assert first.parameters == second.parameters
    assert first.best.residuals.tobytes() == second.best.residuals.tobytes()
    assert [chain.tobytes() for chain in first.chains] == [chain.tobytes() for chain in second.chains]
    assert (first.stop_reason, first.warnings) == (second.stop_reason, second.warnings)


@pytest.mark.parametrize('threads', [1, 2, 3])
def test_any_number_of_threads_gives_the_same_result_bit_for_bit(threads):
    simulator = ToySimulator(fail_below=10.0)
    seen = []
    with ThreadPoolExecutor(threads) as executor:
        elsewhere = calibrated(simulator=simulator, budget=80, executor=executor, on_evaluation=seen.append)
        again = calibrated(simulator=simulator, budget=80, executor=executor)
    here = calibrated(simulator=simulator, budget=80)
    same(here, elsewhere)
    same(here, again)
    assert [evaluation.index for evaluation in seen] == list(range(80))
    assert calibrated(seed=2, budget=80).best.scores != here.best.scores


def test_a_stop_from_another_thread_gives_the_first_evaluations_in_order():
    seen = []
    with ThreadPoolExecutor(2) as executor:
        result = calibrated(executor=executor, on_evaluation=seen.append, should_stop=lambda: len(seen) >= 10)
    assert len(result.evaluations) == len(seen) == 10
    assert result.stop_reason == 'stopped on request'
    assert [e.scores for e in seen] == [e.scores for e in calibrated(budget=10).evaluations]


def test_trials_may_have_different_shapes():
    long = toy_trial(TRUTH, 'long', n=21)
    goal = long.goals[0]
    several = Trial('several', long.initial, long.actions, (goal, Goal(goal.chain, 4.0)))
    result = calibrated(trials=(TRIALS[0], several), budget=10)
    assert [chains.shape for chains in result.chains] == [(1, 11, 3), (2, 21, 3)]
    assert result.best.residuals.shape == (11 * 3 + 2 * 21 * 3,)
    for trial, chains in zip(result.trials, result.chains, strict=True):
        assert chains == pytest.approx(ToySimulator().simulate(trial, result.physical()).chains, abs=1e-12)


def test_a_failed_evaluation_counts_its_rollouts():
    result = calibrated(simulator=ToySimulator(fail_below=50.0), budget=8)
    failed = [e for e in result.evaluations if e.failure]
    assert all(e.skipped == 1 for e in failed)
    assert result.simulations == 16 - len(failed) + 2 * result.examination.evaluations


@pytest.mark.long
def test_threads_give_the_result_of_pybullet_bit_for_bit():
    pytest.importorskip('pybullet')
    trials = [replace(trial, goals=(Goal(trial.goals[0].chain, 1.6),)) for trial in TRIALS[:1]]
    options = Options(engine='bullet', nodes=8, time_step=0.01, settle_limit=0.5)
    results = []
    for threads in (1, 3):
        with closing(make_simulator(options)) as simulator, ThreadPoolExecutor(threads) as executor:
            results.append(calibrated(trials=trials, simulator=simulator, budget=3, executor=executor))
    same(*results)


def streamed(trial, frames=90):
    """Return the index of a goal that no search compares, and a stream in which it is 50 mm too high."""
    chain, goals = trial.goals[0].chain, [trial.hands[0].end + k / 30 for k in range(1, frames + 1)]
    stream = replace(trial, goals=tuple(Goal(chain, time, stable=False) for time in goals))
    wrong = min(set(range(frames)) - set(compared_goals(stream)))
    high = replace(chain, points=chain.points + (0, 0, 0.05))
    return wrong, replace(stream, goals=tuple(
        replace(goal, chain=high) if k == wrong else goal for k, goal in enumerate(stream.goals)))


@pytest.mark.long
def test_a_few_goals_of_a_stream_are_fitted_and_all_are_judged():
    wrong, first = streamed(TRIALS[0])
    trials = (first, TRIALS[1])
    seen, options = [], replace(OPTIONS, calibrate=tuple(TRUTH))  # the toy shows no damping
    result = calibrate(trials, options, make_simulator=new_toy, on_evaluation=seen.append)
    assert result.values == pytest.approx(TRUTH, abs=0.5)
    assert [chains.shape for chains in result.chains] == [(90, 11, 3), (1, 11, 3)]
    assert result.errors.max == pytest.approx(0.05, abs=1e-3)  # that of the goal that was not fitted
    distances = np.linalg.norm(result.chains[0] - [goal.chain.points for goal in first.goals], axis=2)
    assert distances.mean(axis=1).argmax() == wrong
    assert result.errors.mean == pytest.approx(np.mean([*distances.ravel(), *np.linalg.norm(
        result.chains[1][0] - trials[1].goals[0].chain.points, axis=1)]))
    assert min(evaluation.errors.max for evaluation in seen) > 0.04
    assert result.band.shape == (91 * 11,)
    # The same goals, without those that are not compared, give the same parameters.
    few = replace(first, goals=tuple(first.goals[k] for k in compared_goals(first)))
    assert calibrate((few, TRIALS[1]), options, make_simulator=new_toy).values == result.values
