# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A plan that a test makes up, without a search."""

from calibrated import straight
import numpy as np

from dlo_calibration import Chain
from dlo_calibration.model.named_actions import Drag, GraspAndPlace
from dlo_calibration.planning.plan import Plan, PlannedAction

AWAY = ((0.0, 0.05, 0.0), (0.0, 0.1, 0.0))  # m, from the start to the DLO after each action
MOVES = (GraspAndPlace(start=0.0, point=7, to=(0.31, 0.12, 0.004), hand='hand_1'),
         Drag(start=0.0, point=0, to=(0.0, 0.1, 0.004), hand='hand_2'))


def made_up_plan(start: Chain | None = None, actions: int = 2, **changes) -> Plan:
    """Return a plan of at most two actions, the last of which ends 6 mm from its goal."""
    start = start or straight()
    after = [start.points + np.array(away) for away in AWAY]
    done = tuple(PlannedAction(move.name, move.action(Chain(before)), points, points - 0.01, points + 0.01)
                 for move, before, points in zip(MOVES, [start.points, *after], after, strict=False))
    return Plan(**{**{
        'start': start, 'goal': Chain(after[-1] + (0.0, 0.006, 0.0)), 'actions': done[:actions],
        'error_before': 0.106, 'error_after': 0.007, 'score_after': 31.0, 'reached': False,
        'tolerance': 0.006, 'rollouts': 100, 'seconds': 1.0, 'seed': 1, 'stop_reason': 'made up'},
        **changes})
