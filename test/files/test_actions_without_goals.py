# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What hands shall do is read from requests and sessions, with or without goal chains."""

from dataclasses import replace

from made_up_dlo import MadeUpDlo, straight
import numpy as np
import pytest
from toy_messages import SECOND, toy_trials, trial_messages, write_session

from dlo_calibration import Action, Chain, Hand, InputError, Options, read_session
from dlo_calibration.files.request import (
    GoalRequest,
    read_request,
    Request,
    request_manipulations,
    request_trials,
    TrialRequest,
    write_request,
)
from dlo_calibration.files.session import session_manipulations, session_trials
from dlo_calibration.messages.codec import (
    ACTION,
    action_trajectory,
    ActionMessage,
    bag_types,
    chain_cloud,
    GOAL,
    INITIAL,
)
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, Release
from dlo_calibration.planning.prediction import simulate


def manipulation(*actions, goals=(), release=True):
    return TrialRequest('one', straight(), actions, goals).manipulation(release)


def path(name, begin, end, grip=0, to=(0.0, 0.1, 0.004)):
    return Action((Hand(name, (grip,), [begin, end], [straight().points[grip], to]),))


def test_a_request_without_goals_is_written_and_read_but_not_fitted(tmp_path):
    actions = (GraspAndPlace(point=0, to=(0.1, 0.2, 0.004)), Drag(point=10, to=(0.3, -0.1, 0.004)))
    request = Request((TrialRequest('one', straight(), actions, ()),))
    write_request(tmp_path / 'request.xml', request)
    read = read_request(tmp_path / 'request.xml')
    assert read.document == request.document
    done, = request_manipulations(read, Options())
    assert [step.actions for step in done.steps] == [(actions[0],), (actions[1],)]
    trials, (refusal,) = request_trials(read, Options())
    assert trials == () and "trial 'one': no goal chain; expected at least one" in refusal


def test_only_the_trials_with_a_goal_are_fitted():
    goal = GoalRequest(straight(), 5.0)
    drag = Drag(point=10, to=(0.3, -0.1, 0.004))
    request = Request((TrialRequest('to simulate', straight(), (drag,), ()),
                       TrialRequest('observed', straight(), (drag,), (goal,))))
    (trial,), (refusal,) = request_trials(request, Options())
    assert trial.name == 'observed' and "'to simulate'" in refusal
    names = [manipulation.name for manipulation in request_manipulations(request, Options())]
    assert names == ['to simulate', 'observed']


def test_actions_of_different_hands_that_overlap_are_one_step():
    whole = manipulation(path('left', 0.0, 2.0), path('right', 1.0, 3.0, 20), path('left', 3.0, 4.0))
    assert [[action.hands[0].name for action in step.actions] for step in whole.steps] == [
        ['left', 'right'], ['left']]
    assert whole.steps[0].name == 'hand_paths' and not whole.warnings
    together = simulate(MadeUpDlo(), straight(), whole.steps[:1], draws=0).steps[0].step.action
    assert {hand.name: (hand.start, hand.end) for hand in together.hands} == {
        'left': (0, 2), 'right': (1, 3)}


def test_one_hand_never_acts_twice_at_once():
    whole = manipulation(path('left', 0.0, 2.0), path('right', 0.0, 5.0, 20), path('left', 3.0, 4.0))
    assert [len(step.actions) for step in whole.steps] == [2, 1]
    assert 'left acts again at 3 s' in whole.warnings[0]
    drags = [Drag(point=k, direction=(0, 1, 0), distance=0.1) for k in range(3)]
    whole = manipulation(*drags)  # nobody said when they begin
    assert [step.actions for step in whole.steps] == [(drag,) for drag in drags] and not whole.warnings


def test_overlapping_named_actions_have_both_names():
    step, = manipulation(LiftAndHold(point=0, hand='a'), GraspAndPlace(
        point=20, to=(0.6, 0.1, 0.0), hand='b', start=0.5)).steps
    assert (step.name, step.held_by) == ('lift_and_hold and grasp_and_place', ('a',))
    done = simulate(MadeUpDlo(), straight(), [step], draws=0).steps[0]
    assert done.name == step.name
    assert [hand.start for hand in done.step.action.hands] == [0.0, 0.5]
    assert done.chain[0, 2] > 0.09 and done.chain[20, 1] > 0.05


@pytest.mark.parametrize(('release', 'held_by'), [(True, ()), (False, ('left',))])
def test_whether_explicit_paths_hold_is_an_option(release, held_by):
    step, = manipulation(path('left', 0.0, 2.0), release=release).steps
    assert step.held_by == held_by


def test_a_goal_names_the_holding_hands():
    goals = (GoalRequest(straight(), 3.0, held_by=('left',)), GoalRequest(straight(), 9.0))
    first, second = manipulation(path('left', 0.0, 2.0), path('right', 5.0, 6.0, 20), goals=goals).steps
    assert (first.held_by, second.held_by) == (('left',), ('left',))


def test_a_hand_holds_until_it_is_released():
    held = [step.held_by for step in manipulation(
        LiftAndHold(point=0, hand='a'), path('b', 2.0, 3.0, 20), Release(hands=('a',), start=4.0)).steps]
    assert held == [('a',), ('a',), ()]


def test_a_request_with_a_grip_beyond_the_chain_is_refused():
    with pytest.raises(InputError, match=r"'one': hand 'left' gripping points \(21,\)"):
        manipulation(Action((Hand('left', (21,), [0.0], [[0, 0, 0]]),)))


def test_too_many_actions_are_refused():
    with pytest.raises(InputError, match='201 actions in turn; expected at most 200'):
        manipulation(*[path('left', k, k + 1) for k in range(201)])


def recorded(tmp_path, messages, options=None):
    """Return a session with (stamp [s], chain or hands) messages; a chain after an action is a goal."""
    types, pairs, kind = bag_types(), [], INITIAL
    for stamp, content in messages:
        nanoseconds = round(stamp * SECOND)
        if isinstance(content, Chain):
            pairs.append((kind, chain_cloud(types, content, nanoseconds, 'world')))
            continue
        names = tuple(hand.name for hand in content)
        pairs.append((ACTION, action_trajectory(types, ActionMessage(
            nanoseconds, 'world', names, content[0].times, np.stack([hand.positions for hand in content], 1),
            np.stack([hand.orientations for hand in content], 1)))))
        kind = GOAL
    return read_session(write_session(tmp_path / 'recorded.mcap', pairs, options))


def test_a_session_without_goals_has_manipulations_but_no_trials(tmp_path):
    hand = Hand('left', (3,), [0.0, 2.0], [straight().points[3], (0.1, 0.1, 0.004)])
    session = recorded(tmp_path, [(1, straight()), (2, [hand])])
    assert session_trials(session, Options())[0] == ()
    (done,), refusals = session_manipulations(session, Options())
    assert refusals == ()
    np.testing.assert_allclose(done.start.points, straight().points, atol=1e-6)  # float32
    (action,) = done.steps[0].actions
    assert action.hands[0].grips == (3,) and done.steps[0].held_by == ()
    np.testing.assert_allclose(action.hands[0].positions, hand.positions)


def test_later_hands_grip_the_predicted_chain(tmp_path):
    """Without a goal chain, a hand that closes where the DLO is then is far from where it was."""
    def drag(begin, to):
        return [Hand('left', (0,), [0.0, 2.0], [begin, to])]

    session = recorded(tmp_path, [(1, straight()), (2, drag((0.3, 0, 0.004), (0.3, 0.2, 0.004))),
                                  (9, drag((0.3, 0.2, 0.004), (0.35, 0.3, 0.004)))])
    (done,), refusals = session_manipulations(session, Options())
    assert refusals == ()
    first, second = simulate(MadeUpDlo(), done.start, done.steps, draws=0).steps
    assert [step.step.action.hands[0].grips for step in (first, second)] == [(10,), (10,)]
    assert second.chain[10, 1] == pytest.approx(0.3, abs=0.01)
    far = replace(done.steps[1].actions[0], positions=np.full((2, 1, 3), 0.5))
    with pytest.raises(InputError, match='m from any point of the predicted chain; expected at most 0.02'):
        simulate(MadeUpDlo(), done.start, [done.steps[0], replace(done.steps[1], actions=(far,))], draws=0)


def test_goals_of_a_session_change_nothing_but_who_holds(tmp_path):
    trial, = toy_trials(1)
    types = bag_types()
    with_goal = read_session(write_session(tmp_path / 'with.mcap', trial_messages(types, trial, SECOND)))
    without = read_session(write_session(tmp_path / 'without.mcap', trial_messages(
        types, replace(trial, goals=trial.goals), SECOND)[:2]))
    observed, unobserved = (session_manipulations(session, Options())[0][0]
                            for session in (with_goal, without))
    np.testing.assert_array_equal(observed.start.points, unobserved.start.points)
    for step, same in zip(observed.steps, unobserved.steps, strict=True):
        assert step.held_by == same.held_by
        for hand, again in zip(step.actions[0].hands, same.actions[0].hands, strict=True):
            assert hand.grips == again.grips
            np.testing.assert_array_equal(hand.positions, again.positions)


def test_an_action_far_from_the_first_chain_is_refused(tmp_path):
    far = Hand('left', (0,), [0.0, 1.0], [(2.0, 0, 0), (2.0, 1, 0)])
    near = Hand('left', (0,), [0.0, 1.0], [straight().points[0], (0.0, 0.1, 0.004)])
    manipulations, (refusal,) = session_manipulations(recorded(tmp_path, [
        (1, straight()), (2, [far]), (5, [near])]), Options())
    assert len(manipulations) == len(manipulations[0].steps) == 1
    assert 'closing 1.4 m from any point' in refusal


def test_an_action_before_any_chain_is_refused(tmp_path):
    hand = Hand('left', (0,), [0.0, 1.0], [straight().points[0], (0.0, 0.1, 0.004)])
    manipulations, (refusal,) = session_manipulations(recorded(tmp_path, [(1, [hand])]), Options())
    assert manipulations == () and 'no initial_chain before it' in refusal
