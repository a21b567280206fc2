# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of the planner: the messages about its progress and status."""

from __future__ import annotations

from typing import Any, Sequence

from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.model.quantity import measured, number
from dlo_calibration.planning.plan import Plan
from dlo_calibration.planning.planner import PlanProgress
from dlo_calibration.ros.diagnostics import diagnostic_array, diagnostic_status, ERROR, OK, WARN

WAITING, PLANNING, DONE, FAILED = STATES = ('waiting', 'planning', 'done', 'failed')


def plan_progress(types: MessageTypes, progress: PlanProgress, stamp: int) -> Any:
    """Build the message about the progress of a plan."""
    message = (f'{progress.rollouts} of about {progress.expected} simulated actions, sequences of '
               f'{progress.actions}, best mean error {measured(progress.best_error, "m")}, '
               f'{number(progress.seconds_left)} s left')
    return diagnostic_array(types, stamp, [diagnostic_status(types, OK, 'progress', message, {
        'actions': progress.actions, 'rollouts': progress.rollouts, 'expected': progress.expected,
        'best_error_mm': 1e3 * progress.best_error, 'seconds_left': progress.seconds_left})])


def planner_status(types: MessageTypes, *, stamp: int, state: str, detail: str, missing: Sequence[str],
                   last_refusal: str, description: str, plans: int, plan: Plan | None) -> Any:
    """
    Build the message about what the planner is doing.

    :param state: one of STATES.
    :param detail: about the state, e.g. why no plan could be made.
    :param missing: names of the inputs that have not come.
    :param last_refusal: text of the last refusal; empty if there was none.
    :param description: where the description in use came from; empty if there is none.
    :param plans: number of plans that were begun.
    :param plan: the newest one; None while there is none.
    """
    level = ERROR if state == FAILED else WARN if state == DONE and plan and not plan.reached else OK
    values: dict[str, Any] = {'state': state, 'detail': detail, 'missing': ' '.join(missing),
                              'last_refusal': last_refusal, 'description': description, 'plans': plans}
    if plan is not None:
        values.update({
            'actions': len(plan.actions), 'reached': plan.reached, 'error_before_mm': 1e3 * plan.error_before,
            'error_after_mm': 1e3 * plan.error_after,
            'error_after_percent_of_length': 100 * plan.error_after / plan.start.length,
            'score_after': plan.score_after, 'tolerance_mm': 1e3 * plan.tolerance, 'rollouts': plan.rollouts,
            'seconds': plan.seconds, 'seed': plan.seed, 'stop_reason': plan.stop_reason,
            'remarks': ' '.join(plan.remarks)})
    message = f'{state}: {detail}' if detail else state
    return diagnostic_array(types, stamp, [diagnostic_status(types, level, 'status', message, values)])
