# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Markers of a plan: start, goal, what the hands do, and the DLO that is predicted after each action."""

from __future__ import annotations

from typing import Any, Iterator

import numpy as np

from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.quantity import measured
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.ros.markers import (
    Brush,
    cleared,
    Colour,
    GOAL_COLOUR,
    hand_markers,
    INITIAL_COLOUR,
    LINE_LIST,
    SIMULATED_COLOUR,
)

MARKERS_TYPE = 'visualization_msgs/msg/MarkerArray'


def plan_markers(types: MessageTypes, plan: Plan, *, stamp: int, frame_id: str,
                 pose: Pose | None = None) -> Any:
    """
    Build the message that shows a plan; it replaces everything that earlier messages show.

    Namespaces are ``plan/start``, ``/goal``, ``/label``, and for each action ``action_1/predicted``,
    ``/interval``, ``/hands``, ``/label``.  The colour of a prediction goes from that of the start to
    orange.  An interval is a cross at each point: the 90 % intervals of its coordinates.

    :param pose: of the plan's frame in that of `frame_id`; None: they are the same.
    """
    header = types.header(stamp, frame_id)
    thickness = 0.01 * plan.start.length
    brush = Brush(types, header, 'plan', thickness, pose)
    built = [cleared(types, header), brush.line('start', 0, plan.start.points, INITIAL_COLOUR),
             brush.spheres('goal', 0, plan.goal.points, [GOAL_COLOUR], 1.2),
             brush.line('goal', 1, plan.goal.points, GOAL_COLOUR, 0.5),
             brush.label('label', 0, plan.goal.points[0] + [0.0, 0.0, 6 * thickness], _title(plan))]
    before = plan.start.points
    for k, action in enumerate(plan.actions):
        red, green, blue = np.add(np.multiply((k + 1) / len(plan.actions), SIMULATED_COLOUR),
                                  np.multiply(1 - (k + 1) / len(plan.actions), INITIAL_COLOUR)).tolist()
        brush = Brush(types, header, f'action_{k + 1}', thickness, pose)
        built += _action_markers(brush, action, before, k, (red, green, blue))
        before = action.predicted
    return types.build(MARKERS_TYPE, markers=built)


def _action_markers(brush: Brush, action: PlannedAction, before: Floats, k: int,
                    colour: Colour) -> Iterator[Any]:
    """
    Show the k-th action.

    :param before: (n, 3) [m] the DLO when the hands close.
    """
    yield brush.line('predicted', 0, action.predicted, colour)
    yield brush.marker('interval', 0, LINE_LIST, points=_crosses(action), colours=[colour], scale=0.3,
                       group=6)
    for place, hand in enumerate(action.action.hands):
        yield from hand_markers(brush, 3 * place, hand, Chain(before))
    place = action.action.hands[0].positions[0]
    yield brush.label('label', 0, place + [0.0, 0.0, 6 * brush.thickness], f'{k + 1}. {action.name}')


def _crosses(action: PlannedAction) -> Floats:
    """Return the (6 n, 3) ends [m] of the three intervals of each point, axis by axis."""
    ends = np.repeat(action.predicted[:, None, None, :], 3, axis=1).repeat(2, axis=2)  # point, axis, end
    axes = np.arange(3)
    ends[:, axes, 0, axes], ends[:, axes, 1, axes] = action.lower, action.upper
    crosses: Floats = ends.reshape(-1, 3)
    return crosses


def _title(plan: Plan) -> str:
    return (f'{len(plan.actions)} action(s): mean error {measured(plan.error_before, "m")} before, '
            f'{measured(plan.error_after, "m")} after')
