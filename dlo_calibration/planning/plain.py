# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plain values of predictions and plans: numbers, texts, lists and dicts, from which JSON is made."""

from __future__ import annotations

from typing import Any

import numpy as np

from dlo_calibration.calibration.plain import known
from dlo_calibration.model.action import Action, Hand, NO_ROTATION
from dlo_calibration.model.chain import Chain, grip_place
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.prediction import PredictedStep, Prediction


def plain_prediction(prediction: Prediction) -> dict[str, Any]:
    """
    Return a prediction as plain values, under the keys that `simulate --json` prints.

    Lengths are in m, times in s.
    """
    values: dict[str, Any] = known({
        'actions': [{**_action(prediction.start, step), 'held_by': step.step.held_by, 'settled': step.settled}
                    for step in prediction.steps],
        'draws': prediction.draws, 'remarks': prediction.remarks})
    return values


def plain_plan(plan: Plan) -> dict[str, Any]:
    """
    Return a plan as plain values, under the keys that `plan --json` prints and `~/steps` carries.

    Lengths are in m, times in s, the score in cm.
    """
    values: dict[str, Any] = known({
        'actions': [_action(plan.start, action) for action in plan.actions],
        'error_before_m': plan.error_before, 'error_after_m': plan.error_after,
        'error_after_percent_of_length': 100 * plan.error_after / plan.start.length,
        'score_after': plan.score_after, 'reached': plan.reached, 'tolerance_m': plan.tolerance,
        'rollouts': plan.rollouts, 'seconds': plan.seconds, 'seed': plan.seed,
        'stop_reason': plan.stop_reason, 'remarks': plan.remarks})
    return values


def _action(start: Chain, one: PlannedAction | PredictedStep) -> dict[str, Any]:
    """Return an action of a DLO whose points are those of `start`, and the chain at rest after it."""
    if isinstance(one, PredictedStep):
        action, predicted = one.step.action, one.chain
    else:
        action, predicted = one.action, one.predicted
    return {'name': one.name, 'hands': [_hand(start, action, hand) for hand in action.hands],
            'predicted': predicted.tolist(),
            'predicted_lower_upper_m': [one.lower.tolist(), one.upper.tolist()]}


def _hand(start: Chain, action: Action, hand: Hand) -> dict[str, Any]:
    """
    Return a hand, with times from the start of its action.

    A clamp grips more than one point: it has `grips`, too.  A hand that turns has `orientations`, too:
    quaternions x y z w.
    """
    along = start.arc_lengths()
    values = {'name': hand.name, 'grip': hand.grips[0],
              'grip_fraction': grip_place(along, hand.grips[0], hand.offset) / float(along[-1]),
              'waypoints': np.column_stack([hand.times - action.start, hand.positions]).tolist()}
    if len(hand.grips) > 1:
        values['grips'] = list(hand.grips)
    if (hand.orientations != NO_ROTATION).any():
        values['orientations'] = hand.orientations.tolist()
    return values
