# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plans find known moves, keep to their limits, and do not depend on the number of workers."""

from dataclasses import replace
import itertools

from calibrated import MadeUpDlo, ROPE, straight
import numpy as np
import pytest
from soft_simulator import follow, new_soft, SoftSimulator

from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation import Pool
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import GraspAndPlace
from dlo_calibration.planning.crossings import crossings
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.objective import Objective
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import plan
from dlo_calibration.planning.prediction import simulate
from dlo_calibration.planning.rehearsal import in_turn, Job, Rehearser, Step
from dlo_calibration.simulation.compiled import CompiledSimulator

DLO = MadeUpDlo()
QUICK = Options(nodes=25, time_step=0.004)
ONE = PlanOptions(workers=1, draws=2)
TWO_MOVES = Chain(follow(follow(straight().points, 4, (0.004, 0.06)), 16, (-0.004, -0.05)))


def planned(goal, options=ONE, start=None, width=0.2, **keywords):
    """Return a plan with the soft simulator."""
    return plan(DLO, start or straight(), goal, options, make_simulator=lambda _: SoftSimulator(width),
                **keywords)


def gripped(found):
    """Return the gripped points of each action of a plan."""
    return [tuple(hand.grips[0] for hand in one.action.hands) for one in found.actions]


def test_nothing_is_done_for_a_goal_that_is_reached_already():
    found = planned(Chain(straight().points + [0.003, 0, 0]))
    assert found.reached
    assert found.actions == ()
    assert found.error_after == found.error_before == pytest.approx(0.003)
    assert found.rollouts == 0


def test_one_move_is_found():
    shift = np.array([0.004, 0.05])
    found = planned(Chain(follow(straight().points, 8, shift)))
    assert found.reached
    assert gripped(found) == [(8,)]
    path = found.actions[0].action.hands[0].positions
    np.testing.assert_allclose(path[0], straight().points[8])
    np.testing.assert_allclose(path[-1, :2] - path[0, :2], shift, atol=0.003)
    assert found.error_after < 0.002 < found.error_before


def test_a_move_of_a_simulated_rope_is_found_and_happens_as_predicted():
    placed = GraspAndPlace(point=16, to=(0.40, 0.12, straight().points[0, 2]))
    goal = Chain(simulate(DLO, straight(), [placed], options=QUICK, draws=0).steps[0].chain)
    found = plan(DLO, straight(), goal, ONE, simulation=QUICK)
    assert found.reached
    assert len(found.actions) == 1
    assert found.error_after < 0.1 * found.error_before
    seen = simulate(DLO, straight(), [one.action for one in found.actions], options=QUICK, draws=0)
    np.testing.assert_allclose(seen.steps[0].chain, found.actions[0].predicted, atol=1e-9)
    assert (found.actions[0].lower <= found.actions[0].predicted).all()
    assert (found.actions[0].upper >= found.actions[0].predicted).all()


def test_fewer_actions_win_within_the_tolerance():
    exact, rough = planned(TWO_MOVES), planned(TWO_MOVES, replace(ONE, tolerance=4.0))
    assert (exact.reached, len(exact.actions)) == (True, 2)
    assert (rough.reached, len(rough.actions)) == (True, 1)
    assert exact.error_after < rough.error_after <= rough.tolerance


def test_two_hands_do_in_one_action_what_one_hand_cannot():
    one, two = (planned(TWO_MOVES, replace(ONE, actions=1, hands=hands)) for hands in (1, 2))
    assert not one.reached
    assert two.reached
    first, second = two.actions[0].action.hands
    assert {first.name, second.name} == {'hand_1', 'hand_2'}
    np.testing.assert_array_equal(first.times, second.times)


def test_more_actions_than_permitted_are_not_planned():
    found = planned(TWO_MOVES, replace(ONE, actions=1))
    assert len(found.actions) == 1
    assert found.stop_reason == 'the largest number of actions, 1, is used up'
    assert found.error_after < found.error_before


class OneByOne(CompiledSimulator):
    """It simulates one trial after the other."""

    at_a_time = 1


def assert_same(one, other):
    """Assert that two plans are the same, bit for bit."""
    assert (one.rollouts, one.error_after, one.score_after) == (
        other.rollouts, other.error_after, other.score_after)
    for here, there in zip(one.actions, other.actions, strict=True):
        for name in ('predicted', 'lower', 'upper'):
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
        np.testing.assert_array_equal(here.action.hands[0].positions, there.action.hands[0].positions)


def test_any_number_of_threads_finds_the_same_plan():
    one, two, three = (plan(DLO, straight(), TWO_MOVES, replace(ONE, workers=workers),
                            make_simulator=new_soft) for workers in (1, 2, 3))
    assert_same(one, two)
    assert_same(one, three)


def test_sequences_simulated_together_give_the_plan_of_sequences_simulated_one_by_one():
    def found(simulator, workers):
        return plan(DLO, straight(9), goal, replace(ONE, actions=2, kinds=('drag',), workers=workers),
                    make_simulator=lambda _: simulator)

    goal = Chain(follow(straight(9).points, 6, (0.0, 0.1)))
    alone = found(OneByOne(nodes=15, time_step=0.006), 1)
    assert len(alone.actions) == 2
    assert_same(alone, found(CompiledSimulator(nodes=15, time_step=0.006), 1))
    assert_same(alone, found(CompiledSimulator(nodes=15, time_step=0.006), 2))


def test_a_stopped_plan_is_the_best_so_far():
    whole, asked = planned(TWO_MOVES), itertools.count()
    found = planned(TWO_MOVES, should_stop=lambda: next(asked) > 60)
    assert found.stop_reason == 'stopped'
    assert len(found.actions) == 1
    assert whole.error_after < found.error_after < found.error_before
    nothing = planned(TWO_MOVES, should_stop=lambda: True)
    assert (nothing.actions, nothing.reached, nothing.error_after) == ((), False, nothing.error_before)


def test_progress_is_told():
    told, times = [], itertools.count()
    found = planned(TWO_MOVES, on_progress=told.append, clock=lambda: next(times))
    rollouts = [one.rollouts for one in told]
    assert rollouts == sorted(rollouts)
    assert rollouts[-1] == found.rollouts
    assert {one.actions for one in told} == {1, 2}
    errors = [one.best_error for one in told]
    assert errors == sorted(errors, reverse=True)
    assert all(one.expected >= one.rollouts and one.seconds_left >= 0 for one in told)
    assert found.seconds > 0


def hairpin(side):
    """Return a DLO with two parallel arms, the first one at the given side (1 or -1) of the other."""
    along = np.linspace(-1, 1, 21) * 0.3
    turn = 0.06 / np.pi
    angle = np.clip(along / 0.03, -1, 1) * np.pi / 2
    x = np.where(np.abs(along) < 0.03, turn * np.cos(angle), -(np.abs(along) - 0.03))
    y = -side * turn * np.sin(angle)
    return Chain(np.stack([x, y, np.full(21, 0.004)], axis=1))


def test_the_dlo_is_put_over_itself_only_if_asked():
    start, goal = hairpin(1), hairpin(-1)
    apart = planned(goal, replace(ONE, actions=3), start, width=0.3)
    over = planned(goal, replace(ONE, actions=3, crossings=True), start, width=0.3)
    assert not any(crossings(one.predicted) for one in apart.actions)
    assert any(crossings(one.predicted) for one in over.actions)
    assert over.error_after < apart.error_after
    assert any('crosses itself' in remark for remark in apart.remarks)


def test_hands_stay_within_their_reach():
    left, right = 'box -1 -1 -1 0.3 1 1', 'box 0.3 -1 -1 1 1 1'
    found = planned(TWO_MOVES, replace(ONE, hands=2, reach_1=left, reach_2=right))
    assert found.reached
    for hand in [hand for one in found.actions for hand in one.action.hands]:
        x = hand.positions[:, 0]
        assert (x.max() if hand.name == 'hand_1' else -x.min()) <= (0.3 if hand.name == 'hand_1' else -0.3)
    alone = planned(TWO_MOVES, replace(ONE, reach_1=left))
    assert not alone.reached
    assert any('reach' in remark for remark in alone.remarks)
    assert alone.actions


def test_the_dlo_keeps_out_of_a_no_go_box_on_its_way():
    goal = Chain(straight().points + [0.0, 0.12, 0.0])
    box = '-0.05 0.04 -1 0.05 0.08 1'
    free, kept = planned(goal, replace(ONE, actions=3)), planned(goal, replace(ONE, actions=3, no_go=(box,)))
    jobs = [Job(straight(), in_turn([Step(one.action) for one in found.actions]), {}, courses=True)
            for found in (free, kept)]
    entered = [any(((np.abs(chain[:, 0]) < 0.05) & (chain[:, 1] > 0.04) & (chain[:, 1] < 0.08)).any()
                   for course in one.courses for chain in course)
               for one in Rehearser(Pool(SoftSimulator()))(jobs)]
    assert entered == [True, False]


def test_what_is_surer_is_preferred():
    unsure = MadeUpDlo({**ROPE, 'friction': (70.0, 55.0, 85.0)})
    goal = Chain(follow(straight().points, 10, (0.0, 0.08)))
    plans = [plan(unsure, straight(), goal, replace(ONE, draws=draws, actions=1),
                  make_simulator=lambda _: SoftSimulator(unsure=True)) for draws in (0, 6)]
    assert [found.actions[0].name for found in plans] == ['drag', 'grasp_and_place']
    others = Posterior.of(unsure).draws(30, seed=77)
    objective, errors = Objective(straight(), goal, 'points'), []
    for found in plans:
        jobs = [Job(straight(), (Step(found.actions[0].action),), one) for one in others]
        ends = [one.chains[-1] for one in Rehearser(Pool(SoftSimulator(unsure=True)))(jobs)]
        errors.append(np.mean([objective.error(end) for end in ends]))
    assert errors[1] < 0.5 * errors[0]


def test_the_score_may_be_minimised():
    found = planned(TWO_MOVES, replace(ONE, objective='score'))
    assert found.reached
    assert found.score_after < 100 * 23 * found.tolerance
    assert len(found.actions) == 2


def test_a_chain_of_few_points_is_enough():
    start = straight(5)
    found = planned(Chain(follow(start.points, 2, (0.0, 0.06))), start=start)
    assert found.reached
    assert gripped(found) == [(2,)]
