# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Two photographs and the steps of the hands become a trial, or warnings say what is missing or wrong."""

from dataclasses import replace

from curve_views import curve, DIAMETER, loop, SIZE, traced, view
import numpy as np
import pytest

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.document import PhotographEntry, SameScale, TrialEntry
from dlo_calibration.capture.hands import held_after, StepEntry
from dlo_calibration.capture.json_values import JsonValue
from dlo_calibration.capture.measurement import Measurement
from dlo_calibration.capture.trials import draft_trial, Drafts, write_request, write_session
from dlo_calibration.files.request import read_request, request_trials
from dlo_calibration.files.session import read_session
from dlo_calibration.vision.axis import axis_of

START, GOAL = curve(), curve(1.1, 0.3)
COUNT = 21
SCALE = view(0.5)


def measurement(points, scale=SCALE, crossings=(), above=None, sure=None, **entry):
    trace = traced(points, scale, crossings)
    if sure is not None:
        trace = replace(trace, sure=sure(len(trace.pixels)))
    axis = axis_of(trace, scale, DIAMETER, COUNT, above)
    return Measurement(PhotographEntry('aaaaaaaa', **entry), SIZE, scale=scale, trace=trace, axis=axis,
                       above=above or {}, answered=frozenset(above or {}), thickness=DIAMETER, count=COUNT)


def step(kind, **values):
    return StepEntry.of(JsonValue('step', {'kind': kind, **values}))


def drafted(*steps, start=START, goal=GOAL, **entry):
    """Return the trial of two curves [m], or of two measurements."""
    start, goal = (shape if isinstance(shape, Measurement) else measurement(shape) for shape in (start, goal))
    return draft_trial(1, TrialEntry('start', 'goal', steps=steps, **entry), {'start': start, 'goal': goal})


def remedies(draft):
    return {warning.remedy for warning in draft.warnings
            if warning.remedy not in (None, 'mark_place')}


def on_curve(points, fraction):
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.array([np.interp(fraction * along[-1], along, axis) for axis in points.T])


def test_a_dragged_point_goes_from_its_place_in_the_start_to_that_in_the_goal():
    draft = drafted(step('drag', fraction=0.33, speed=0.2))
    trial, (hand,) = draft.trial, draft.trial.hands
    assert [len(trial.initial), len(trial.goals[0].chain)] == [COUNT, COUNT]
    np.testing.assert_allclose(hand.positions, [on_curve(START, 0.33), on_curve(GOAL, 0.33)], atol=2e-4)
    np.testing.assert_array_equal(trial.initial.points[hand.grips[0]], hand.positions[0])
    assert hand.end == pytest.approx(np.linalg.norm(hand.positions[1] - hand.positions[0]) / 0.2)
    assert trial.goals[0].stable
    assert trial.goals[0].held_by == ()
    gaps = np.diff(trial.initial.arc_lengths())
    assert gaps.max() / gaps.min() < 1.2  # a point at the grip, and evenly spaced all the same


def test_the_page_draws_the_hand_where_the_photographs_show_it():
    draft = drafted(step('drag', fraction=0.0, to=[0.1, 0.2]))
    drawn, = draft.plain['hands']
    np.testing.assert_allclose(drawn['start_pixels'][0], SCALE.to_pixels(START[:1])[0], atol=0.5)
    opened = SCALE.to_pixels([[0.1, 0.2, DIAMETER / 2]])[0]
    np.testing.assert_allclose(drawn['goal_pixels'][-1], opened, atol=0.1)
    assert len(drawn['times']) == len(drawn['start_pixels']) == len(drawn['goal_pixels']) == 2


def test_each_kind_of_step_moves_its_hand():
    rest = DIAMETER / 2
    hand, = drafted(step('grasp_and_place', fraction=1.0, to=[0.2, 0.1], height=0.07)).trial.hands
    np.testing.assert_allclose(hand.positions[1:], [
        [*hand.positions[0][:2], rest + 0.07], [0.2, 0.1, rest + 0.07], [0.2, 0.1, rest]], atol=1e-9)
    hand, = drafted(step('path', fraction=1.0, waypoints=[[0, 0.1, 0.05], [0.1, 0.1, 0]])).trial.hands
    np.testing.assert_allclose(hand.positions[1:], [[0, 0.1, rest + 0.05], [0.1, 0.1, rest]], atol=1e-9)
    draft = drafted(step('two_hands', fractions=[0.2, 0.8], distance=0.06))
    left, right = draft.trial.hands
    np.testing.assert_allclose(np.linalg.norm(left.positions[0] - right.positions[0])
                               - np.linalg.norm(left.positions[-1] - right.positions[-1]), 0.06)
    assert draft.trial.goals[0].held_by == ('left_hand', 'right_hand')


LIFT = step('lift_and_hold', fraction=0.0, height=0.1)
RELEASE = step('release', hands=['left_hand'])
RIGHT = step('drag', hand='right_hand', fraction=1.0)


def test_a_hand_that_holds_stays_until_it_opens():
    draft = drafted(LIFT, RIGHT, RELEASE)
    left, right = draft.trial.hands
    assert left.end > right.end > right.start > 1.0
    np.testing.assert_array_equal(left.positions[-1], left.positions[-2])
    assert draft.trial.goals[0].held_by == ()


def test_steps_of_two_hands_can_begin_together():
    draft = drafted(step('drag', fraction=0.0), replace(RIGHT, with_previous=True))
    assert [hand.start for hand in draft.trial.hands] == [0.0, 0.0]
    assert [hand.grips for hand in draft.trial.hands] == [(0,), (COUNT - 1,)]
    in_turn = drafted(step('drag', fraction=0.0), RIGHT)
    left, right = in_turn.trial.hands
    assert right.start > left.end
    assert any('Step 2 grips a point' in warning.text for warning in in_turn.warnings)


def test_a_hand_that_held_in_the_goal_before_holds_at_the_start():
    held = held_after([step('drag', fraction=0.3, hold=True)])
    both = {'start': measurement(START), 'goal': measurement(GOAL)}

    def after(*steps):
        return draft_trial(2, TrialEntry('start', 'goal', steps=steps), both, held)

    trial = after(RIGHT).trial
    left = next(hand for hand in trial.hands if hand.name == 'left_hand')
    assert left.start == 0.0
    assert {hand.name for hand in trial.hands} == {'left_hand', 'right_hand'}
    np.testing.assert_allclose(left.positions[0], on_curve(START, 0.3), atol=2e-4)
    assert trial.goals[0].held_by == ('left_hand',)
    assert 'add_step' in remedies(after(RIGHT))
    assert not any('left_hand' in warning.text for warning in after(RELEASE).warnings)
    opened = after(RELEASE).trial
    assert ([hand.name for hand in opened.hands], opened.goals[0].held_by) == (['left_hand'], ())
    elsewhere, = after(step('drag', fraction=0.8)).trial.hands
    np.testing.assert_allclose(elsewhere.positions[0], on_curve(START, 0.8), atol=2e-4)


def test_a_hand_that_held_in_the_air_needs_a_start_from_the_side():
    both = {'start': measurement(START), 'goal': measurement(GOAL)}
    draft = draft_trial(2, TrialEntry('start', 'goal', steps=(RELEASE,)), both, held_after([LIFT]))
    assert draft.trial is None
    assert 'add_side' in remedies(draft)


def test_hands_that_move_for_hours_are_refused():
    draft = drafted(step('path', fraction=0.5, waypoints=[[0, 99, 0]], speed=0.001))
    assert draft.trial is None
    assert any('raise their speed' in warning.text for warning in draft.warnings)


def test_a_hand_that_continues_from_its_place_has_one_path():
    draft = drafted(step('path', fraction=0.5, waypoints=[[0, 0.1, 0.05]], hold=True),
                 step('path', fraction=0.5, waypoints=[[0.1, 0.1, 0]]))
    hand, = draft.trial.hands
    assert len(hand.times) == 4  # it waits between both


@pytest.mark.parametrize('steps, text', [
    ([RELEASE], 'step 1, hand left_hand'),
    ([step('two_hands', fractions=[0.5, 0.5])], 'step 1, two_hands'),
    ([step('drag', fraction=0.5, hold=True), step('drag', hand='right', fraction=0.5)], 'step 2, hand right'),
    ([step('drag', fraction=0.5, hold=True), replace(step('drag', fraction=0.2), with_previous=True)],
     'step 2, hand left'),
    ([step('two_hands', fractions=[0.4, 0.6], distance=0.5)], 'step 1, action two_hands'),
])
def test_steps_that_contradict_each_other_are_refused(steps, text):
    draft = drafted(*steps)
    assert draft.trial is None
    error, = (warning.text for warning in draft.warnings if warning.level == 'error')
    assert text in error


@pytest.mark.parametrize('steps', [
    [LIFT], [step('two_hands', height=0.05)], [step('path', waypoints=[[0, 0, 0.1]], hold=True)]])
def test_a_goal_in_the_air_needs_a_second_photograph(steps):
    draft = drafted(*steps)
    assert draft.trial is None
    assert 'add_side' in remedies(draft)


def test_a_lifted_goal_is_measured_in_two_photographs():
    hung = GOAL.copy()
    t = np.clip(1 - np.linspace(0, 1, len(hung)) / 0.3, 0, 1)
    hung[:, 2] += 0.1 * (4 * t**3 - 3 * t**4)
    side = view(1.0, 0.4)
    both = {'start': measurement(START)}
    for name, scale in (('goal', SCALE), ('side', side)):
        both[name] = replace(measurement(GOAL, scale), trace=traced(hung, scale))
    both['side'] = replace(both['side'], axis=None, axis_problem='above the horizon')
    draft = draft_trial(1, TrialEntry('start', 'goal', goal_side='side', steps=(LIFT,)), both)
    goal = draft.trial.goals[0]
    assert goal.held_by == ('left_hand',)
    np.testing.assert_allclose(goal.chain.points[0], hung[0], atol=2e-3)
    np.testing.assert_allclose(draft.trial.hands[0].positions[-1], goal.chain.points[0])
    assert 'add_side' not in remedies(draft)
    too_near = draft_trial(1, TrialEntry('start', 'goal', goal_side='goal', steps=(LIFT,)), both)
    assert too_near.trial is None
    assert any('degrees' in warning.text for warning in too_near.warnings if warning.level == 'error')


def test_a_goal_traced_from_the_other_end_causes_a_warning():
    moved = START.copy()
    moved[300:, 1] += np.linspace(0, 0.05, 100)
    assert remedies(drafted(RIGHT, goal=moved)) == set()
    assert remedies(drafted(RIGHT, goal=moved[::-1])) == {'reverse_goal'}


UNSURE_END = measurement(curve(1.1, 0.3, 0.48), sure=lambda count: np.arange(count) > 0.05 * count)
LENGTHS = {
    'the camera moved': (measurement(curve(1.1, 0.3, 0.52), scale=SCALE, name='b'), 'camera moved'),
    'another scale': (measurement(curve(1.1, 0.3, 0.52)), 'scale is wrong'),
    'the line ends too early': (measurement(START[:-20]), 'ends too early at its last end'),
    'it begins too late': (measurement(START[20:]), 'ends too early at its first end'),
    'an end is not sure': (UNSURE_END, 'an end of the DLO was not found in the goal'),
}


@pytest.mark.parametrize('goal, reason', LENGTHS.values(), ids=LENGTHS)
def test_a_different_length_has_a_likely_reason(goal, reason):
    if reason == 'camera moved':
        goal = replace(goal, entry=replace(goal.entry, scale=SameScale('aaaaaaaa')))
    draft = drafted(step('drag', fraction=0.5), goal=goal)
    text, = (warning.text for warning in draft.warnings if warning.remedy == 'check_length')
    assert reason in text
    assert draft.trial is not None


def test_a_small_difference_of_lengths_causes_no_warning():
    assert remedies(drafted(step('drag', fraction=0.5), goal=curve(1.1, 0.3, 0.505))) == set()


@pytest.mark.parametrize('fraction, to, hold, level', [
    (0.0, None, False, 'warning'), (0.4, None, False, 'hint'), (0.0, [0.1, 0.2], False, None),
    (0.0, None, True, None)])
def test_the_place_where_a_hand_opened_near_an_end_should_be_marked(fraction, to, hold, level):
    draft = drafted(step('drag', fraction=fraction, to=to, hold=hold))
    levels = [warning.level for warning in draft.warnings if warning.remedy == 'mark_place']
    assert levels == ([] if level is None else [level])


def test_the_upper_strand_is_asked_for_until_it_is_answered():
    points, pair = loop()
    open_, answered = (measurement(points, crossings=[pair], above=above) for above in (None, {0: True}))
    assert remedies(drafted(RIGHT, start=open_, goal=answered)) == {'ask_crossings'}
    draft = drafted(RIGHT, start=answered, goal=answered)
    assert remedies(draft) == set()
    assert draft.trial.initial.points[:, 2].max() > 1.5 * DIAMETER


@pytest.mark.parametrize('change, remedy', [
    ({'scale': None, 'axis': None}, 'set_scale'), ({'scale_problem': 'no board', 'axis': None}, 'set_scale'),
    ({'trace': None, 'axis': None}, 'add_click'), ({'trace_problem': 'no DLO', 'axis': None}, 'add_click')])
def test_missing_measurements_are_asked_for(change, remedy):
    draft = drafted(RIGHT, goal=replace(measurement(GOAL), **change))
    assert draft.trial is None
    assert remedies(draft) == {remedy}
    assert draft.plain['complete'] is False


def test_a_trial_without_goal_or_steps_is_not_complete():
    draft = draft_trial(1, TrialEntry('start'), {'start': measurement(START)})
    assert remedies(draft) == {'add_goal', 'add_step'}
    assert draft.start.axis.length == pytest.approx(0.5, abs=1e-3)


def test_session_and_request_have_the_same_trials(tmp_path):
    points, pair = loop()
    start, goal = (measurement(points, view(tilt), [pair], {0: True}) for tilt in (0.0, 0.2))
    trials = (drafted(RIGHT), drafted(LIFT, RIGHT, RELEASE), drafted(step('two_hands', fractions=[0.2, 0.8])),
              drafted(), drafted(step('drag', fraction=0.4), start=start, goal=goal))
    drafts = Drafts({'a': measurement(START)}, trials, mass=0.03)
    assert len(drafts.complete) == 4
    write_session(tmp_path / 'session.mcap', drafts.complete, drafts.options)
    write_request(tmp_path / 'request.xml', drafts.complete, drafts.options)
    session, request = read_session(tmp_path / 'session.mcap'), read_request(tmp_path / 'request.xml')
    assert session.warnings == request.file_options.warnings == ()
    assert session.options == request.file_options.options() == Options.of(
        {**drafts.options, 'workers': 0})
    assert session.options.mass == 0.03
    assert session.options.space.physical({}, 0.5)['self_collision'] == pytest.approx(DIAMETER / 2)
    for trials in (session.trials, request_trials(request, session.options)[0]):
        for trial, expected in zip(trials, drafts.complete, strict=True):
            assert (trial.name, trial.goals[0].time, trial.goals[0].held_by) == (
                expected.name, expected.goals[0].time, expected.goals[0].held_by)
            pairs = [(trial.initial, expected.initial), (trial.goals[0].chain, expected.goals[0].chain)]
            assert all(np.array_equal(a.points, b.points) for a, b in pairs)
            for a, b in zip(trial.hands, expected.hands, strict=True):
                assert (a.name, a.grips) == (b.name, b.grips)
                np.testing.assert_array_equal(a.times, b.times)
                np.testing.assert_array_equal(a.positions, b.positions)
