# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A calibrated DLO, chains of it, and a plan for it, all made up: no calibration, no search."""

from dataclasses import dataclass, field
from typing import Mapping

import numpy as np

from dlo_calibration import Chain
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.model.named_actions import Drag, GraspAndPlace
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.score import PointErrors
from dlo_calibration.planning.action_loads import ActionLoads
from dlo_calibration.planning.plan import Plan, PlannedAction

LENGTH = 0.6  # m
LEVEL = 0.004  # m, at which its centre line rests on the table
#: Of a limp rope: name -> value, lower and upper end of its interval.
ROPE = {'flexibility': (66.0, 65.0, 67.0), 'elasticity': (50.0, 20.0, 80.0), 'friction': (70.0, 68.0, 72.0),
        'self_collision': (25.0, 20.0, 30.0)}
#: Of a stiff hose.
HOSE = {**ROPE, 'flexibility': (16.0, 15.0, 17.0)}


@dataclass(frozen=True)
class MadeUpDlo:
    """A DLO with given intervals; see `CalibratedDlo`."""

    intervals: Mapping[str, tuple[float, float, float]] = field(default_factory=lambda: ROPE)
    error: float = 0.0  # m, that the calibration left, root mean square
    correlations: Mapping[str, Mapping[str, float]] | None = None
    length: float = LENGTH
    space: ParameterSpace = field(default_factory=lambda: ParameterSpace(PAPER_PARAMETERS, mass=0.03))

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """The made-up estimates."""
        return {name: self._estimate(name, *interval) for name, interval in self.intervals.items()}

    def _estimate(self, name: str, value: float, lower: float, upper: float) -> ParameterEstimate:
        physical = [self.space.reported(name, end)[0] for end in (value, lower, upper)]
        unit = self.space.reported(name, value)[1]
        return ParameterEstimate(name, value, (upper - lower) / 3.29, lower, upper, *physical, unit, True)

    @property
    def errors(self) -> PointErrors:
        """Errors whose root mean square is `error`."""
        return PointErrors(self.error, self.error, self.error, self.error)


def straight(points: int = 21, length: float = LENGTH) -> Chain:
    """Return a DLO that lies straight along x, its first point in the origin."""
    x = np.linspace(0.0, length, points)
    return Chain(np.stack([x, np.zeros(points), np.full(points, LEVEL)], axis=1))


def arc(angle=1.0, points=21, length=LENGTH, height=LEVEL):
    """Return a DLO that lies on the table from the origin along x, and turns to the left by `angle` [rad]."""
    turned = angle * np.linspace(0, 1, points)
    across = np.column_stack([np.sin(turned), 1 - np.cos(turned)]) * length / angle
    return Chain(np.column_stack([across, np.full(points, height)]))


AWAY = ((0.0, 0.05, 0.0), (0.0, 0.1, 0.0))  # m, from the start to the DLO after each action
#: Sharpest curvature [1/m], largest tension [N], largest strain, and where [m].
LOADS = ActionLoads(np.array([20.0, 1.5, 0.01]), np.array([0.21, 0.6, 0.57]), np.array([18.0, 1.2, 0.008]),
                    np.array([25.0, 1.9, 0.02]))
MOVES = (GraspAndPlace(start=0.0, point=7, to=(0.31, 0.12, 0.004), hand='hand_1'),
         Drag(start=0.0, point=0, to=(0.0, 0.1, 0.004), hand='hand_2'))


def made_up_plan(start: Chain | None = None, actions: int = 2, **changes) -> Plan:
    """Return a plan of at most two actions, the last of which ends 6 mm from its goal."""
    start = start or straight()
    after = [start.points + np.array(away) for away in AWAY]
    done = tuple(PlannedAction(move.name, move.action(Chain(before)), points, points - 0.01, points + 0.01,
                               LOADS)
                 for move, before, points in zip(MOVES, [start.points, *after], after, strict=False))
    return Plan(**{**{
        'start': start, 'goal': Chain(after[-1] + (0.0, 0.006, 0.0)), 'actions': done[:actions],
        'error_before': 0.106, 'error_after': 0.007, 'score_after': 31.0, 'reached': False,
        'tolerance': 0.006, 'rollouts': 100, 'seconds': 1.0, 'seed': 1, 'stop_reason': 'made up'},
        **changes})
