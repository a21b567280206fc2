# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Markers of a plan show its start, goal, hands and predictions with their intervals, on both wires."""

from made_up_dlo import made_up_plan
import numpy as np
from wire import wire

from dlo_calibration.ros.markers import plan_markers

STAMP = 12_500_000_000
DELETE_ALL = 3


def shown(types, plan):
    """Return markers by namespace, after the wire."""
    first, *rest = wire(types)(plan_markers(types, plan, stamp=STAMP, frame_id='table')).markers
    assert (first.action, first.header.frame_id) == (DELETE_ALL, 'table')
    marks = {}
    for marker in rest:
        marks.setdefault(marker.ns, []).append(marker)
    return marks


def points(marker):
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_each_action_shows_what_is_predicted_and_its_intervals(types):
    plan = made_up_plan()
    marks = shown(types, plan)
    assert np.array_equal(points(marks['plan/start'][0]), plan.start.points)
    assert np.array_equal(points(marks['plan/goal'][0]), plan.goal.points)
    for k, action in enumerate(plan.actions, start=1):
        assert np.array_equal(points(marks[f'action_{k}/predicted'][0]), action.predicted)
        interval, = marks[f'action_{k}/interval']
        ends = points(interval).reshape(len(plan.start), 3, 2, 3)
        for axis in range(3):
            assert np.allclose(ends[:, axis, 0, axis], action.lower[:, axis])
            assert np.allclose(ends[:, axis, 1, axis], action.upper[:, axis])
            others = [other for other in range(3) if other != axis]
            assert np.allclose(ends[:, axis, :, others], action.predicted[:, others].T[:, :, None])


def test_a_hand_closes_where_the_dlo_is_after_the_action_before(types):
    plan = made_up_plan()
    marks = shown(types, plan)
    for k, before in ((1, plan.start.points), (2, plan.actions[0].predicted)):
        hand, = plan.actions[k - 1].action.hands
        path, grip, end = marks[f'action_{k}/hands']
        assert np.allclose(points(path)[[0, -1]], hand.positions[[0, -1]])
        assert np.array_equal(points(grip), before[list(hand.grips)])
        assert np.allclose([end.pose.position.x, end.pose.position.y], hand.positions[-1, :2])


def test_later_predictions_have_other_colours_and_no_two_markers_one_identity(types):
    marks = shown(types, made_up_plan())
    colours = {(marker.color.r, marker.color.g, marker.color.b)
               for name in ('plan/start', 'action_1/predicted', 'action_2/predicted')
               for marker in marks[name]}
    assert len(colours) == 3
    identities = [(marker.ns, marker.id) for markers in marks.values() for marker in markers]
    assert len(set(identities)) == len(identities)


def test_a_plan_without_actions_shows_start_and_goal(types):
    assert set(shown(types, made_up_plan(actions=0))) == {'plan/start', 'plan/goal', 'plan/label'}
