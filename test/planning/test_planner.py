# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plans: known moves, limits, any number of workers, refusals, and warnings about a goal."""

from dataclasses import replace
import itertools

from made_up_dlo import arc, HOSE, LENGTH, LEVEL, MadeUpDlo, ROPE, straight
import numpy as np
import pytest
from soft_simulator import follow, new_soft, SoftSimulator
from toy_simulator import ToySimulator

from dlo_calibration import Chain, InputError, Options
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation import Pool
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.model.named_actions import GraspAndPlace
from dlo_calibration.planning.beam import Objective
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.limits import crossings
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import checked, goal_warnings, plan, sharpest_bend
from dlo_calibration.planning.prediction import simulate
from dlo_calibration.planning.rehearsal import ActionStep, in_turn, RehearsalJob, Rehearser
from dlo_calibration.simulation.compiled import CompiledSimulator

DLO = MadeUpDlo()
QUICK = Options(nodes=25, time_step=0.004)
ONE = PlanOptions(workers=1, draws=2)
TWO_MOVES = Chain(follow(follow(straight().points, 4, (0.004, 0.06)), 16, (-0.004, -0.05)))


def planned(goal, options=ONE, start=None, width=0.2, **keywords):
    """Return a plan with the soft simulator."""
    return plan(DLO, start or straight(), goal, options, make_simulator=lambda _: SoftSimulator(width),
                **keywords)


def gripped(result):
    """Return the gripped points of each action of a plan."""
    return [tuple(hand.grips[0] for hand in planned_action.action.hands) for planned_action in result.actions]


def test_a_goal_at_the_start_needs_no_action():
    result = planned(Chain(straight().points + [0.003, 0, 0]))
    assert result.reached
    assert result.actions == ()
    assert result.error_after == result.error_before == pytest.approx(0.003)
    assert result.rollouts == 0


def test_a_goal_at_one_move_is_reached():
    shift = np.array([0.004, 0.05])
    result = planned(Chain(follow(straight().points, 8, shift)))
    assert result.reached
    assert gripped(result) == [(8,)]
    path = result.actions[0].action.hands[0].positions
    np.testing.assert_allclose(path[0], straight().points[8])
    np.testing.assert_allclose(path[-1, :2] - path[0, :2], shift, atol=0.003)
    assert result.error_after < 0.002 < result.error_before


def test_a_move_of_a_simulated_rope_is_recovered_and_ends_as_predicted():
    placed = GraspAndPlace(point=16, to=(0.40, 0.12, straight().points[0, 2]))
    goal = Chain(simulate(DLO, straight(), [placed], options=QUICK, draws=0).steps[0].chain)
    result = plan(DLO, straight(), goal, ONE, simulation=QUICK)
    assert result.reached
    assert len(result.actions) == 1
    assert result.error_after < 0.1 * result.error_before
    seen = simulate(DLO, straight(), [each.action for each in result.actions], options=QUICK, draws=0)
    np.testing.assert_allclose(seen.steps[0].chain, result.actions[0].predicted, atol=1e-9)
    assert (result.actions[0].lower <= result.actions[0].predicted).all()
    assert (result.actions[0].upper >= result.actions[0].predicted).all()


def test_fewer_actions_win_within_the_tolerance():
    exact, rough = planned(TWO_MOVES), planned(TWO_MOVES, replace(ONE, tolerance=4.0))
    assert (exact.reached, len(exact.actions)) == (True, 2)
    assert (rough.reached, len(rough.actions)) == (True, 1)
    assert exact.error_after < rough.error_after <= rough.tolerance


def test_two_hands_do_in_one_action_what_one_hand_cannot():
    single, double = (planned(TWO_MOVES, replace(ONE, actions=1, hands=hands)) for hands in (1, 2))
    assert not single.reached
    assert double.reached
    first, second = double.actions[0].action.hands
    assert {first.name, second.name} == {'hand_1', 'hand_2'}
    np.testing.assert_array_equal(first.times, second.times)


def test_more_actions_than_permitted_are_not_planned():
    result = planned(TWO_MOVES, replace(ONE, actions=1))
    assert len(result.actions) == 1
    assert result.stop_reason == 'the largest number of actions, 1, is used up'
    assert result.error_after < result.error_before


class OneByOne(CompiledSimulator):
    """It simulates one trial after the other."""

    at_a_time = 1


def assert_same(first, second):
    """Assert that two plans are the same, bit for bit."""
    assert (first.rollouts, first.error_after, first.score_after) == (
        second.rollouts, second.error_after, second.score_after)
    for here, there in zip(first.actions, second.actions, strict=True):
        for name in ('predicted', 'lower', 'upper'):
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
        np.testing.assert_array_equal(here.action.hands[0].positions, there.action.hands[0].positions)


def test_any_number_of_threads_finds_the_same_plan():
    single, double, triple = (plan(DLO, straight(), TWO_MOVES, replace(ONE, workers=workers),
                            make_simulator=new_soft) for workers in (1, 2, 3))
    assert_same(single, double)
    assert_same(single, triple)


@pytest.mark.long
def test_sequences_simulated_together_give_the_plan_of_sequences_simulated_one_by_one():
    def planned_with(simulator, workers):
        return plan(DLO, straight(9), goal, replace(ONE, actions=2, kinds=('drag',), workers=workers),
                    make_simulator=lambda _: simulator)

    goal = Chain(follow(straight(9).points, 6, (0.0, 0.1)))
    alone = planned_with(OneByOne(nodes=15, time_step=0.006), 1)
    assert len(alone.actions) == 2
    assert_same(alone, planned_with(CompiledSimulator(nodes=15, time_step=0.006), 1))
    assert_same(alone, planned_with(CompiledSimulator(nodes=15, time_step=0.006), 2))


def test_a_stopped_plan_is_the_best_so_far():
    whole, asked = planned(TWO_MOVES), itertools.count()
    result = planned(TWO_MOVES, should_stop=lambda: next(asked) > 60)
    assert result.stop_reason == 'stopped'
    assert len(result.actions) == 1
    assert whole.error_after < result.error_after < result.error_before
    nothing = planned(TWO_MOVES, should_stop=lambda: True)
    assert (nothing.actions, nothing.reached, nothing.error_after) == ((), False, nothing.error_before)


def test_progress_is_reported():
    reports, times = [], itertools.count()
    result = planned(TWO_MOVES, on_progress=reports.append, clock=lambda: next(times))
    rollouts = [report.rollouts for report in reports]
    assert rollouts == sorted(rollouts)
    assert rollouts[-1] == result.rollouts
    assert {report.actions for report in reports} == {1, 2}
    errors = [report.best_error for report in reports]
    assert errors == sorted(errors, reverse=True)
    assert all(report.expected >= report.rollouts and report.seconds_left >= 0 for report in reports)
    assert result.seconds > 0


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
    beside = planned(goal, replace(ONE, actions=3), start, width=0.3)
    over = planned(goal, replace(ONE, actions=3, crossings=True), start, width=0.3)
    assert not any(crossings(each.predicted) for each in beside.actions)
    assert any(crossings(each.predicted) for each in over.actions)
    assert over.error_after < beside.error_after
    assert any('crosses itself' in warning for warning in beside.warnings)


def test_hands_stay_within_their_reach():
    left, right = 'box -1 -1 -1 0.3 1 1', 'box 0.3 -1 -1 1 1 1'
    result = planned(TWO_MOVES, replace(ONE, hands=2, reach_1=left, reach_2=right))
    assert result.reached
    for hand in [hand for each in result.actions for hand in each.action.hands]:
        x = hand.positions[:, 0]
        assert (x.max() if hand.name == 'hand_1' else -x.min()) <= (0.3 if hand.name == 'hand_1' else -0.3)
    alone = planned(TWO_MOVES, replace(ONE, reach_1=left))
    assert not alone.reached
    assert any('reach' in warning for warning in alone.warnings)
    assert alone.actions


@pytest.mark.long
def test_the_dlo_keeps_out_of_a_no_go_box_on_its_way():
    goal = Chain(straight().points + [0.0, 0.12, 0.0])
    box = '-0.05 0.04 -1 0.05 0.08 1'
    results = [planned(goal, replace(ONE, actions=3, no_go=no_go)) for no_go in ((), (box,))]
    sequences = [in_turn([ActionStep(each.action) for each in result.actions]) for result in results]
    jobs = [RehearsalJob(straight(), steps, {}, trajectories=True) for steps in sequences]
    entered = [any(((np.abs(chain[:, 0]) < 0.05) & (chain[:, 1] > 0.04) & (chain[:, 1] < 0.08)).any()
                   for course in rehearsal.trajectories for chain in course)
               for rehearsal in Rehearser(Pool(SoftSimulator()))(jobs)]
    assert entered == [True, False]


def test_draws_prefer_the_action_with_the_more_certain_outcome():
    unsure = MadeUpDlo({**ROPE, 'friction': (70.0, 55.0, 85.0)})
    goal = Chain(follow(straight().points, 10, (0.0, 0.08)))
    plans = [plan(unsure, straight(), goal, replace(ONE, draws=draws, actions=1),
                  make_simulator=lambda _: SoftSimulator(unsure=True)) for draws in (0, 6)]
    assert [result.actions[0].name for result in plans] == ['drag', 'grasp_and_place']
    others = Posterior.of(unsure).draws(30, seed=77)
    objective, errors = Objective(straight(), goal, 'points'), []
    for result in plans:
        step = ActionStep(result.actions[0].action)
        jobs = [RehearsalJob(straight(), (step,), physical) for physical in others]
        ends = [rehearsal.chains[-1] for rehearsal in Rehearser(Pool(SoftSimulator(unsure=True)))(jobs)]
        errors.append(np.mean([objective.error(end) for end in ends]))
    assert errors[1] < 0.5 * errors[0]


def test_the_score_may_be_minimised():
    result = planned(TWO_MOVES, replace(ONE, objective='score'))
    assert result.reached
    assert result.score_after < 100 * 23 * result.tolerance
    assert len(result.actions) == 2


def test_a_chain_of_few_points_is_enough():
    start = straight(5)
    result = planned(Chain(follow(start.points, 2, (0.0, 0.06))), start=start)
    assert result.reached
    assert gripped(result) == [(2,)]

FRACTIONS = np.linspace(0, 1, 21)


def laid(x, y, z=LEVEL):
    """Return a chain from coordinates, in lengths of the DLO; z [m]."""
    x, y, z = np.broadcast_arrays(LENGTH * x, LENGTH * y, z)
    return Chain(np.stack([x, y, z], axis=1))


def loop():
    """Return a DLO that lies across itself once."""
    at = np.linspace(0, 1, 1000)
    curve = laid(at + 0.4 * np.sin(2 * np.pi * at), np.cos(2 * np.pi * at), 0.0)
    return Chain(curve.resample(FRACTIONS * curve.length) * LENGTH / curve.length + [0, 0, LEVEL])


def check(goal, start=None, dlo=None, simulation=None, **options):
    return checked(dlo or MadeUpDlo(), start or straight(), goal, simulation or Options(),
                   PlanOptions.of(options))


def lifted(chain, by):
    """Return a chain whose last quarter rises, at its end by a height [m]."""
    return Chain(chain.points + by * np.maximum(4 * FRACTIONS - 3, 0)[:, None] * [0, 0, 1])


def test_start_and_goal_of_the_same_dlo_stay_as_they_are():
    start, goal = straight(), arc(1.5)
    pair = check(goal, start)
    assert pair[0] is start and pair[1] is goal


def test_another_number_of_points_or_spacing_is_resampled_at_the_fractions_of_the_start():
    uneven = arc(1.5).resample(FRACTIONS**2 * LENGTH)
    for other in (arc(1.5, 50), Chain(uneven)):
        _, goal = check(other)
        np.testing.assert_allclose(goal.points, arc(1.5).points, atol=1e-3)
        np.testing.assert_allclose(goal.arc_lengths() / goal.length, FRACTIONS, atol=1e-3)


def test_a_drawn_goal_gets_the_height_at_which_the_dlo_lies():
    flat = laid(FRACTIONS, 0.1, 0.0)
    _, goal = check(replace(flat, features=FRACTIONS == 0.5))
    np.testing.assert_allclose(goal.points - flat.points, np.tile([0, 0, LEVEL], (21, 1)), atol=1e-12)
    assert goal.features.sum() == 1
    among_bodies = check(flat, simulation=Options(scene='scene.urdf'))[1].points
    np.testing.assert_allclose(among_bodies[:, 2], LEVEL, atol=1e-12)
    on_a_body = lifted(straight(), 0.03)
    assert check(on_a_body, simulation=Options(scene='scene.urdf'))[1] is on_a_body


def test_noise_of_a_camera_changes_nothing():
    noise = np.random.default_rng(1).normal(0, 0.002, (2, 21, 3))
    start, goal = Chain(straight().points + noise[0]), Chain(arc(1.5).points + noise[1])
    pair = check(goal, start)
    assert pair[0] is start
    np.testing.assert_allclose(pair[1].points, goal.points, atol=2e-3)


def without(name):
    """Return a DLO with an unknown interval."""
    return MadeUpDlo({**ROPE, name: (50.0, float('nan'), 60.0)})


@pytest.mark.parametrize('wrong, thing, came', [
    ({'goal': arc(1.5), 'dlo': without('friction')}, 'result', 'no number for friction'),
    ({'goal': arc(1.5), 'dlo': MadeUpDlo(length=float('nan'))}, 'result', 'no number for length or errors'),
    ({'goal': Chain(1e3 * straight().points)}, 'goal chain', 'a length of 600000 mm'),
    ({'goal': Chain(0.85 * arc(1.5).points)}, 'goal chain', 'a length of 510 mm'),
    ({'goal': arc(1.5), 'start': Chain(1.2 * straight().points)}, 'start chain', 'a length of 720 mm'),
    ({'goal': arc(1.5), 'dlo': MadeUpDlo(length=0.5)}, 'start chain', 'a length of 600 mm'),
    ({'goal': lifted(straight(), 0.1)}, 'goal chain', 'points 4 to 104 mm above the table'),
    ({'goal': laid(FRACTIONS, 0.0, 0.3)}, 'goal chain', 'points 300 to 300 mm above the table'),
    ({'goal': arc(1.5), 'start': lifted(straight(), 0.1)}, 'start chain',
     'points 4 to 104 mm above the table'),
    ({'goal': straight(), 'simulation': Options(table=False)}, 'parameter table', 'false, and no scene'),
    ({'goal': arc(1.5), 'no_go': ['-1 -1 -1 0 0 1', '0.1 0.1 0 1 1 1']}, 'goal chain',
     'a part in the no-go box -1 -1 -1 0 0 1'),
    ({'goal': loop()}, 'goal chain', '1 crossing(s) of the DLO with itself more than in the start'),
], ids=lambda value: value if isinstance(value, str) else '-')
def test_a_wrong_start_or_goal_or_dlo_is_refused(wrong, thing, came):
    with pytest.raises(InputError) as refusal:
        check(**wrong)
    assert (refusal.value.thing, refusal.value.came) == (thing, came)
    assert refusal.value.expected and refusal.value.remedy and len(str(refusal.value)) <= 300


def test_options_allow_the_goals_that_are_refused_by_default():
    across = loop()
    assert check(across, crossings=True)[1] is check(across, start=loop())[1] is across
    high = [Chain(chain.points + [0, 0, 0.7]) for chain in (arc(1.5), straight())]
    assert check(*high, simulation=Options(table_height=0.7))[0] is high[1]
    on_a_scene = check(lifted(straight(), 0.1), simulation=Options(table=False, scene='scene.urdf'))
    assert on_a_scene[1].points[-1, 2] == pytest.approx(LEVEL + 0.1)


@pytest.mark.parametrize('text, reason', [
    ('0,0,0\n1,0,0\n', '2 point(s)'), ('0,0,0\n0.1,nan,0\n0.2,0,0\n', 'NaN in point(s) 1'),
    ('', '0 point(s)'), ('0,0\n', "'0,0'"), ('0,0,0\n0,0,0\n1,0,0\n', 'coincident neighbours'),
    ('x,y,z\n', "'x,y,z'")])
def test_a_file_without_a_chain_is_refused(text, reason, tmp_path):
    path = tmp_path / 'goal.csv'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match='^chain .*goal.csv') as refusal:
        read_chain_file(path)
    assert reason in refusal.value.came


# ---- warnings

def warnings_about(goal, dlo=None, start=None, **options):
    """Return the warnings about a goal."""
    chosen = PlanOptions.of({'tolerance': 1.0, **options})
    dlo = dlo or MadeUpDlo()
    start, goal = checked(dlo, start or straight(), goal, Options(), chosen)
    simulator = make_simulator(Options())
    rehearse = Rehearser(Pool(simulator))
    try:
        return goal_warnings(rehearse, Posterior.of(dlo), start, goal, chosen)
    finally:
        simulator.close()
        assert rehearse.count <= 4


def test_a_goal_in_which_the_dlo_stays_causes_no_warning():
    assert warnings_about(arc(1.5)) == ()


def test_a_stiff_dlo_springs_back_and_a_large_tolerance_makes_that_unimportant():
    sentence, = warnings_about(arc(4.0), MadeUpDlo(HOSE))
    assert sentence.startswith('laid exactly on the goal and let go, the DLO springs back by ')
    assert ('at 0.00 of the length' in sentence) or ('at 1.00 of the length' in sentence)
    back = float(sentence.split('springs back by ')[1].split(' mm')[0])
    end = float(sentence.split('and by ')[1].split(' mm')[0])
    assert 10 < back < end < 300
    assert warnings_about(arc(4.0), MadeUpDlo(HOSE), tolerance=90.0) == ()
    assert warnings_about(arc(4.0)) == ()  # the rope stays


def bent(radius):
    """Return a DLO with a bend of 90 degrees in its middle, between straight parts; radius in lengths."""
    along = np.linspace(0, 1, 2001)
    heading = np.clip((along - 0.5) / radius + np.pi / 4, 0, np.pi / 2)
    x, y = (np.concatenate([[0], np.cumsum(f((heading[1:] + heading[:-1]) / 2) * along[1])])
            for f in (np.cos, np.sin))
    return laid(x[::100], y[::100])


def test_the_sharpest_bend_follows_from_stiffness_and_friction():
    """With stiffness EI = 2e-3 N m^2, friction 0.4 and a weight of 0.6 N/m it is (2e-3 / 0.24)^(1/3) m."""
    physical = {'flexibility': 2e-3, 'friction': 0.4, 'mass': 0.06 / 9.81}
    assert sharpest_bend(physical, 0.1) == pytest.approx(0.2027, rel=1e-3)
    stiff = MadeUpDlo({**HOSE, 'flexibility': (65.4, 64.7, 66.1)})
    radius = sharpest_bend(Posterior.of(stiff).best, LENGTH) / LENGTH
    assert 0.1 < radius < 0.3
    assert warnings_about(bent(1.2 * radius), stiff) == ()
    sentence, = warnings_about(bent(0.5 * radius), stiff)
    assert f'friction holds only bends with a radius above about {1e3 * LENGTH * radius:.0f} mm' in sentence


@pytest.mark.long
def test_a_plan_of_a_dlo_of_1_cm_ends_within_2_percent_of_the_goal():
    length, limp = 0.01, {**ROPE, 'flexibility': (99.0, 98.5, 99.5)}
    start, goal = straight(length=length), arc(0.15, length=length)
    turned = goal.points @ [[0.92, 0.39, 0.0], [-0.39, 0.92, 0.0], [0.0, 0.0, 1.0]]
    goal = Chain(turned + [0.3 * length, 0.25 * length, 0.0])
    made = plan(MadeUpDlo(limp, length=length), start, goal, replace(ONE, seed=3),
                simulation=Options(nodes=21, time_step=3e-4))
    assert made.error_before > 0.3 * length
    assert made.error_after < 0.02 * length


def test_a_goal_that_cannot_be_simulated_causes_a_warning():
    dlo = MadeUpDlo()
    rehearse = Rehearser(Pool(ToySimulator(fail_below=101)))
    sentence, = goal_warnings(rehearse, Posterior.of(dlo), straight(), arc(1.5), PlanOptions(draws=0))
    assert sentence.startswith('whether the DLO stays on the goal is unknown: ')


def test_a_goal_of_another_length_causes_a_warning():
    sentence, = warnings_about(Chain(1.05 * arc(1.5).points + [0, 0, -0.05 * LEVEL]))
    assert sentence == ('the goal is 5.0 % longer than the DLO, 630 mm instead of 600 mm, so its points stay '
                        'about 7.5 mm away from the goal on average')
    sentence, = warnings_about(Chain(0.95 * arc(1.5).points))
    assert '5.0 % shorter' in sentence


def test_two_hands_that_are_wider_than_the_dlo_cause_a_warning():
    rehearse, dlo = Rehearser(Pool(ToySimulator())), MadeUpDlo(length=0.03)
    start, goal = straight(length=0.03), arc(0.1, length=0.03)
    sentence, *_ = goal_warnings(rehearse, Posterior.of(dlo), start, goal, PlanOptions(draws=0, hands=2))
    assert 'so two of them cannot grip a DLO of 30 mm together' in sentence


@pytest.mark.parametrize('options, words', [
    ({'reach_1': 'box -1 -1 -1 0.31 1 1'}, '10 of the 21 points of the goal are outside the reach'),
    ({'reach_1': 'box -1 -1 -1 0.31 1 1', 'reach_2': 'box 0.32 -1 -1 1 1 1', 'hands': 2}, None),
    ({'reach_1': 'annulus 5 5 0 1'}, 'no point of the DLO is within the reach of hand_1, so nothing'),
    ({'no_go': ['0.1 -0.1 -1 0.2 0.05 1']}, 'the DLO is in the no-go box 0.1 -0.1 -1 0.2 0.05 1')])
def test_limits_that_prevent_a_plan_cause_a_warning(options, words):
    warnings = warnings_about(laid(FRACTIONS, 0.2), **options)
    assert [text for text in warnings if words and text.startswith(words)] == list(warnings[:1])
    assert bool(warnings) == (words is not None)
