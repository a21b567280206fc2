# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plan: the actions that bring a DLO from one configuration to another, and how near they get."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dlo_calibration.calibration.result import with_nulls
from dlo_calibration.model.action import Action, Hand, NO_ROTATION
from dlo_calibration.model.chain import Chain, Floats, grip_place
from dlo_calibration.model.pose import Pose
from dlo_calibration.planning.action_loads import ActionLoads, plain_loads


@dataclass(frozen=True)
class PlannedAction:
    """
    One action of a plan, and the DLO at rest after it.

    :param name: `grasp_and_place` or `drag`.
    :param action: the paths of the hands; they close at time 0 and open where they arrive.
    :param predicted: (n, 3) [m] with the best parameters.
    :param lower: (n, 3) [m] lower ends of the 90 % intervals of each coordinate; `upper` (n, 3) upper ends.
    :param loads: the largest ones of the DLO; None if the engine does not know them.
    """

    name: str
    action: Action
    predicted: Floats
    lower: Floats
    upper: Floats
    loads: ActionLoads | None = None

    def moved(self, pose: Pose) -> PlannedAction:
        """
        Return the action in another frame, in which its own has a pose.

        The errors of the coordinates count as independent: their intervals add up in squares.
        """
        predicted, squares = pose.points(self.predicted), pose.rotation.T**2
        lower, upper = (np.sqrt((end - self.predicted)**2 @ squares) for end in (self.lower, self.upper))
        return replace(self, action=pose.action(self.action), predicted=predicted, lower=predicted - lower,
                       upper=predicted + upper)


@dataclass(frozen=True)
class Plan:
    """
    Actions that bring a DLO from a start towards a goal.

    Errors are mean distances of the points from those of the goal, averaged over draws from the posterior.

    :param goal: its point i is the same material point as point i of the start.
    :param error_before: of the start [m].
    :param error_after: of the DLO at rest after all actions [m].
    :param score_after: the paper's difference score after all actions [cm], averaged likewise; its focal
        point is the first point, its features are the marked points, or both ends if there are none.
    :param reached: whether `error_after` is within the tolerance; if the score is minimised, together with
        the score for each of its terms; with a share of the length for each body passed at a wrong side.
    :param tolerance: [m].
    :param rollouts: number of simulated actions.
    :param seconds: that the plan took.
    :param seed: of the search and the draws.
    :param stop_reason: why the search ended, in words.
    :param warnings: sentences for the user: why the goal cannot be reached, what the limits prevented.
    """

    start: Chain
    goal: Chain
    actions: tuple[PlannedAction, ...]
    error_before: float
    error_after: float
    score_after: float
    reached: bool
    tolerance: float
    rollouts: int
    seconds: float
    seed: int
    stop_reason: str
    warnings: tuple[str, ...] = ()

    def moved(self, pose: Pose) -> Plan:
        """Return the plan in another frame, in which its own has a pose."""
        return replace(self, start=pose.chain(self.start), goal=pose.chain(self.goal),
                       actions=tuple(action.moved(pose) for action in self.actions))


def plain_plan(plan: Plan) -> dict[str, Any]:
    """
    Return a plan as plain values, under the keys that `plan --json` prints and `~/steps` carries.

    Lengths are in m, times in s, tensions in N, the score in cm.
    """
    return dict(with_nulls({
        'actions': [plain_action(plan.start, planned.name, planned.action, planned.predicted, planned.lower,
                                 planned.upper, planned.loads) for planned in plan.actions],
        'error_before_m': plan.error_before, 'error_after_m': plan.error_after,
        'error_after_percent_of_length': 100 * plan.error_after / plan.start.length,
        'score_after': plan.score_after, 'reached': plan.reached, 'tolerance_m': plan.tolerance,
        'rollouts': plan.rollouts, 'seconds': plan.seconds, 'seed': plan.seed,
        'stop_reason': plan.stop_reason, 'remarks': plan.warnings}))


def plain_action(start: Chain, name: str, action: Action, predicted: Floats, lower: Floats, upper: Floats,
                 loads: ActionLoads | None) -> dict[str, Any]:
    """
    Return an action, the DLO at rest after it, and its loads, as plain values.

    :param start: a chain with the same points as the DLO.
    :param predicted: (n, 3) [m]; `lower` (n, 3) and `upper` (n, 3) are ends of the 90 % intervals.
    """
    return {'name': name, 'hands': [_plain_hand(start, action, hand) for hand in action.hands],
            'predicted': predicted.tolist(), 'predicted_lower_upper_m': [lower.tolist(), upper.tolist()],
            **plain_loads(loads)}


def _plain_hand(start: Chain, action: Action, hand: Hand) -> dict[str, Any]:
    """
    Return a hand, with times from the start of its action.

    A clamp, which grips several points, also has `grips`.  A hand that turns also has `orientations`:
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
