# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Predictions and plans as plain values for JSON."""

import json

from made_up_dlo import MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Action, Chain, Hand
from dlo_calibration.model.named_actions import Drag, TwoHands
from dlo_calibration.planning import Plan, PlannedAction
from dlo_calibration.planning.plan import plain_plan
from dlo_calibration.planning.prediction import plain_prediction, simulate

PLAN_KEYS = {'actions', 'error_before_m', 'error_after_m', 'error_after_percent_of_length', 'score_after',
             'reached', 'tolerance_m', 'rollouts', 'seconds', 'seed', 'stop_reason', 'remarks'}


def test_a_prediction_becomes_json():
    prediction = simulate(MadeUpDlo(), straight(), [
        TwoHands(points=(0, 20), distance=0.05), Drag(point=10, to=(0.3, 0.1, 0.004))], draws=2)
    plain = plain_prediction(prediction)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    first, second = plain['actions']
    assert (first['name'], second['name'], plain['draws'], plain['remarks']) == ('two_hands', 'drag', 2, [])
    assert (first['held_by'], second['held_by']) == (['left_hand', 'right_hand'], ['right_hand'])
    assert first['settled'] is True
    assert [hand['grip'] for hand in first['hands']] == [0, 20]
    assert [hand['grip_fraction'] for hand in first['hands']] == [0.0, 1.0]
    np.testing.assert_array_equal(second['predicted'], prediction.steps[1].chain)
    lower, upper = np.array(second['predicted_lower_upper_m'])
    assert (lower <= second['predicted']).all() and (second['predicted'] <= upper).all()


def test_waypoints_begin_at_time_0_of_each_action():
    plain = plain_prediction(simulate(MadeUpDlo(), straight(), [
        Drag(point=0, to=(0.0, 0.05, 0.004)), Drag(point=10, to=(0.3, 0.05, 0.004))], draws=0))
    for action, reached in zip(plain['actions'], [(0.0, 0.05), (0.3, 0.05)], strict=True):
        hand, = action['hands']
        assert hand['waypoints'][0][0] == 0
        assert hand['waypoints'][-1][:3] == pytest.approx((0.5, *reached), abs=0.02)
        assert 'grips' not in hand and 'orientations' not in hand


def test_a_clamp_that_turns_has_grips_and_orientations():
    half = 0.5**0.5
    clamp = Action((Hand('gripper', (3, 4), [1.0, 2.0], [[0, 0, 0], [0, 0, 0.1]],
                         [[0, 0, 0, 1], [0, 0, half, half]]),))
    (action,) = plain_prediction(simulate(MadeUpDlo(), straight(), [clamp], draws=0))['actions']
    hand, = action['hands']
    assert (hand['grip'], hand['grips']) == (3, [3, 4])
    np.testing.assert_allclose(hand['orientations'][1], (0, 0, half, half))


def test_a_plan_has_the_documented_keys():
    start, goal = straight(), Chain(straight().points + (0.0, 0.06, 0.0))
    action = Drag(point=10, direction=(0, 1, 0), distance=0.06).action(start)
    planned = PlannedAction('drag', action, goal.points, goal.points - 0.001, goal.points + 0.001)
    plain = plain_plan(Plan(start, goal, (planned,), 0.06, 0.003, float('nan'), True, 0.006, 12, 0.5, 1,
                           'the goal is reached', ('a remark',)))
    assert set(plain) == PLAN_KEYS
    assert plain['error_after_percent_of_length'] == pytest.approx(0.5)
    assert plain['score_after'] is None
    assert plain['actions'][0]['name'] == 'drag'
    assert plain['actions'][0]['hands'][0]['waypoints'][-1] == pytest.approx([0.6, 0.3, 0.06, 0.004])
    np.testing.assert_array_equal(plain['actions'][0]['predicted'], goal.points)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
