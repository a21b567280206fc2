# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Predictions of actions, and plans from one configuration to another.

`prediction` simulates given actions with a calibrated DLO; `planner` finds actions that bring it to a goal.
"""

from dlo_calibration.planning.dlo import CalibratedDlo, Posterior
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.planner import PlanProgress
from dlo_calibration.planning.rehearsal import ActionStep, Rehearsal, RehearsalJob, Rehearser

__all__ = ['ActionStep', 'CalibratedDlo', 'Plan', 'PlannedAction', 'PlanProgress', 'Posterior', 'Rehearsal',
           'RehearsalJob', 'Rehearser']
