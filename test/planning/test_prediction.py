# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""simulate() predicts the chain after each action, with its intervals."""

from concurrent.futures import CancelledError, ThreadPoolExecutor

from made_up_dlo import HOSE, MadeUpDlo, ROPE, straight
import numpy as np
import pytest
from toy_simulator import ToySimulator

from dlo_calibration import calibrate, Chain, InputError, Options, read_session
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation import Pool
from dlo_calibration.files.session import samples, session_trials
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, Release
from dlo_calibration.planning import ActionStep, Posterior, RehearsalJob, Rehearser
from dlo_calibration.planning.prediction import intervals, simulate


def test_each_named_action_begins_at_the_end_of_the_previous_action():
    prediction = simulate(MadeUpDlo(), straight(), [
        GraspAndPlace(point=0, to=(0.1, 0.2, 0.004)), Drag(point=10, to=(0.3, -0.1, 0.004))], draws=0)
    first, second = prediction.steps
    assert (first.name, second.name) == ('grasp_and_place', 'drag')
    np.testing.assert_allclose(first.chain[0, :2], (0.1, 0.2), atol=0.01)  # the end springs back a little
    np.testing.assert_allclose(second.step.action.hands[0].positions[0], first.chain[10], atol=1e-12)
    np.testing.assert_allclose(second.chain[10, :2], (0.3, -0.1), atol=0.01)
    assert second.step.action.start > first.step.action.end
    assert first.settled and second.settled


def test_a_hand_holds_on_until_it_is_released():
    prediction = simulate(MadeUpDlo(HOSE), straight(), [
        LiftAndHold(point=20, height=0.1), Drag(point=0, to=(0.0, 0.1, 0.004), hand='right_hand'),
        Release()], draws=0)
    held, still_held, released = (step.chain[20, 2] for step in prediction.steps)
    assert held == pytest.approx(0.104, abs=1e-3) == still_held
    assert released < 0.02
    assert [step.step.held_by for step in prediction.steps] == [('left_hand',), ('left_hand',), ()]


def test_paths_and_steps_are_simulated_unchanged():
    lift = LiftAndHold(point=20, height=0.1).action(straight())
    opened, = simulate(MadeUpDlo(), straight(), [lift], draws=0).steps
    held, = simulate(MadeUpDlo(), straight(), [ActionStep(lift, ('left_hand',))], draws=0).steps
    assert opened.name == held.name == 'hand_paths'
    assert opened.chain[20, 2] < 0.02 < 0.09 < held.chain[20, 2]


def test_uncertain_parameters_make_the_interval_wide():
    unsure = {**ROPE, 'friction': (70.0, 40.0, 100.0)}
    action = GraspAndPlace(point=10, to=(0.3, 0.25, 0.004))

    def width(dlo):
        step, = simulate(dlo, straight(), [action]).steps
        assert (step.lower <= step.chain).all() and (step.chain <= step.upper).all()
        return float((step.upper - step.lower)[:, :2].mean())

    certain, uncertain, noisy = map(width, (MadeUpDlo(), MadeUpDlo(unsure), MadeUpDlo(error=0.01)))
    assert uncertain > 3 * certain
    # 90 % of a normal error of 1 cm over three coordinates
    assert noisy == pytest.approx(2 * 1.645 * 0.01 / 3**0.5, rel=0.05)


def test_intervals_hold_90_percent_of_normal_errors():
    generator = np.random.default_rng(1)
    best = np.zeros((50, 21, 3))
    drawn = [np.broadcast_to(generator.normal(0, 2e-3, (50, 1, 1)), best.shape) for _ in range(100)]
    lower, upper = intervals(best, drawn, 1e-3)
    seen = generator.normal(0, 2e-3, (50, 1, 1)) + generator.normal(0, 1e-3, best.shape)
    assert np.mean((lower < seen) & (seen < upper)) == pytest.approx(0.9, abs=0.05)


def test_the_noise_of_the_start_makes_the_interval_wide():
    lift, exact = LiftAndHold(point=20), straight()
    noisy = Chain(exact.points + np.random.default_rng(1).normal(0, 1e-3, exact.points.shape))
    widths = [float((step.upper - step.lower)[:10, 1].mean()) for start in (exact, noisy)
              for step in simulate(MadeUpDlo(), start, [lift]).steps]
    assert 3e-4 < widths[1] and widths[0] < widths[1] / 10


def test_the_difference_to_a_finer_simulation_widens_the_interval():
    place = GraspAndPlace(point=0, to=(0.1, 0.2, 0.004))
    coarse, usual = (simulate(MadeUpDlo(), straight(), [place], draws=0,
                              options=Options(nodes=nodes)).steps[0] for nodes in (15, 41))
    for step in (coarse, usual):
        assert (step.lower <= usual.chain + 1e-3).all() and (usual.chain - 1e-3 <= step.upper).all()
    assert (coarse.upper - coarse.lower).mean() > 2 * (usual.upper - usual.lower).mean()


@pytest.mark.long
def test_90_percent_of_the_points_of_a_left_out_trial_are_in_their_intervals():
    options = Options.of({'mass': 0.03, 'calibrate': ['flexibility', 'friction'], 'workers': 1})
    trials, _ = session_trials(read_session(samples() / 'object1'), options)
    inside, widths = [], []
    for k in (1, 2):
        result = calibrate([trial for trial in trials if trial is not trials[k]], options)
        goal, = trials[k].goals
        step, = simulate(result, trials[k].initial, [ActionStep(trials[k].actions[0], goal.held_by)]).steps
        inside.append((step.lower <= goal.chain.points) & (goal.chain.points <= step.upper))
        widths.append((step.upper - step.lower).mean())
    assert np.mean(widths) < 0.008  # of a rope of 60 cm, seen with a noise of 1 mm
    assert 0.84 < np.mean(inside) < 0.97


def test_the_same_seed_gives_the_same_prediction():
    action = GraspAndPlace(point=5, direction=(0, 1, 0), distance=0.1)
    first, same, other = (simulate(MadeUpDlo(), straight(), [action], draws=3, seed=seed).steps[0]
                        for seed in (1, 1, 2))
    assert np.array_equal(first.lower, same.lower) and np.array_equal(first.chain, other.chain)
    assert not np.array_equal(first.lower, other.lower)


def test_rehearsals_do_not_depend_on_the_executor():
    simulator = make_simulator(Options())
    step = ActionStep(GraspAndPlace(point=5, direction=(0, 1, 0), distance=0.1).action(straight()))
    jobs = [RehearsalJob(straight(), (step, step), physical, trajectories=True)
            for physical in Posterior.of(MadeUpDlo()).draws(4, 1)]
    alone = Rehearser(Pool(simulator))
    with ThreadPoolExecutor(2) as executor:
        together = Rehearser(Pool(simulator, executor))
        for rehearsal, other in zip(alone(jobs), together(jobs), strict=True):
            assert np.array_equal(rehearsal.chains, other.chains)
            assert all(map(np.array_equal, rehearsal.trajectories, other.trajectories))
            assert len(rehearsal.trajectories) == 2 and len(rehearsal.trajectories[0]) > 10
    assert alone.count == together.count == 8


@pytest.mark.parametrize('speed', [0.1, 1.0])
def test_a_trajectory_has_no_gaps_however_fast_the_hand_is(speed):
    lift = GraspAndPlace(point=0, direction=(0, 1, 0), distance=0.1, speed=speed)
    step = ActionStep(lift.action(straight()))
    rehearsal, = Rehearser(Pool(make_simulator(Options())))(
        [RehearsalJob(straight(), (step,), Posterior.of(MadeUpDlo()).best, trajectories=True)])
    course, = rehearsal.trajectories
    assert np.linalg.norm(np.diff(course[:, 0], axis=0), axis=1).max() < 0.0101
    assert course[:, 0, 2].max() > 0.05
    np.testing.assert_allclose(course[-1, 0], step.action.hands[0].positions[-1], atol=0.0101)


def test_a_hand_holds_on_while_another_moves():
    lift = LiftAndHold(point=20, height=0.1, hand='a').action(straight())
    drag = Drag(point=0, to=(0.0, 0.1, 0.004), hand='b').action(straight())
    steps, physical = (ActionStep(lift, ('a',)), ActionStep(drag, ('a',))), Posterior.of(MadeUpDlo()).best
    without, with_courses = Rehearser(Pool(make_simulator(Options())))(
        [RehearsalJob(straight(), steps, physical, courses) for courses in (False, True)])
    assert with_courses.trajectories[1][:, 20, 2].min() > 0.1
    np.testing.assert_allclose(with_courses.chains, without.chains, atol=1e-3)


def test_draws_of_the_same_actions_are_rehearsed_as_each_alone():
    step = ActionStep(GraspAndPlace(point=5, direction=(0, 1, 0), distance=0.1).action(straight()))
    rehearse, start, steps = Rehearser(Pool(make_simulator(Options()))), straight(), (step,)
    draws = Posterior.of(MadeUpDlo()).draws(3, 1)
    together = rehearse([RehearsalJob(start, steps, physical) for physical in draws])
    for rehearsal, physical in zip(together, draws, strict=True):
        alone, = rehearse([RehearsalJob(straight(), (step,), physical)])
        assert np.array_equal(rehearsal.chains, alone.chains)
    assert not np.array_equal(together[0].chains, together[1].chains)


def test_a_rehearsal_that_diverges_says_so():
    step = ActionStep(Drag(point=5, direction=(0, 1, 0), distance=0.1).action(straight()))
    physical = Posterior.of(MadeUpDlo()).best
    rehearsal, = Rehearser(Pool(ToySimulator(fail_below=101)))([RehearsalJob(straight(), (step,), physical)])
    assert 'diverged' in rehearsal.failure
    assert np.isnan(rehearsal.chains).all()


def test_a_prediction_can_be_stopped():
    with pytest.raises(CancelledError):
        simulate(MadeUpDlo(), straight(), [Drag(point=0, to=(0.1, 0.1, 0.004))], should_stop=lambda: True)


@pytest.mark.parametrize(('actions', 'what'), [
    ([], 'no action'),
    ([Drag(point=30, to=(0.1, 0.1, 0.004))], 'point 30'),
    ([Release()], 'holds nothing'),
])
def test_impossible_actions_are_refused(actions, what):
    with pytest.raises(InputError, match=what):
        simulate(MadeUpDlo(), straight(), actions)
