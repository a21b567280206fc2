# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences: a plan in plain English."""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats, grip_place
from dlo_calibration.model.quantity import measured, number
from dlo_calibration.model.score import SIMILAR
from dlo_calibration.planning.plan import Plan

FLAT = 1e-3  # m; a hand that rises by less stays on the table


def plan_sentences(plan: Plan) -> list[str]:
    """Return sentences on the actions, whether they reach the goal or why the search ended, and remarks."""
    steps = [f'{k}. {one.name}: {"; ".join(_hand(plan, hand) for hand in one.action.hands)}; then the points '
             f'are {distance(plan, one.predicted)} from the goal on average.'
             for k, one in enumerate(plan.actions, start=1)]
    ended = [] if plan.reached else [f'The search ended: {plan.stop_reason}.']
    return [*steps, outcome(plan), *ended, *map(_sentence, plan.remarks)]


def _sentence(words: str) -> str:
    """Return words that begin with a capital letter and end with a full stop."""
    return f'{words[:1].upper()}{words[1:].removesuffix(".")}.'


def distance(plan: Plan, points: Floats) -> str:
    """Say how far points, (n, 3) [m], are from the goal on average, in mm and in percent of the length."""
    return _of_length(plan, float(np.linalg.norm(points - plan.goal.points, axis=1).mean()))


def _of_length(plan: Plan, error: float) -> str:
    return f'{measured(error, "m")} ({number(100 * error / plan.start.length)} %)'


def _hand(plan: Plan, hand: Hand) -> str:
    """Say what a hand does."""
    places, begin = plan.start.arc_lengths(), hand.positions[0]
    rise = hand.positions[:, 2].max() - begin[2]
    way = f'lifts {number(100 * rise)} cm, carries' if rise > FLAT else 'drags'
    x, y = hand.positions[-1, :2]
    grip = grip_place(places, hand.grips[0], hand.offset) / places[-1]
    return (f'{hand.name} grips at {grip:.2f} of the length, {way} it to '
            f'({x:.3f}, {y:.3f}) m and opens')


def outcome(plan: Plan) -> str:
    """Say whether the goal is reached, with how many actions, and how near it gets."""
    tolerance = f'the tolerance of {_of_length(plan, plan.tolerance)}'
    if not plan.actions and plan.reached:
        return f'The DLO is at the goal already: {_of_length(plan, plan.error_before)}, within {tolerance}.'
    if not plan.actions:
        return (f'The goal is not reached, and no action is planned: the DLO stays '
                f'{_of_length(plan, plan.error_before)} away, beyond {tolerance}.')
    count = f'{len(plan.actions)} action{"" if len(plan.actions) == 1 else "s"}'
    change = (f'the mean error goes from {_of_length(plan, plan.error_before)} to '
              f'{_of_length(plan, plan.error_after)}')
    score = f'the difference score is {number(plan.score_after)} cm (below {SIMILAR:g}: similar)'
    if plan.reached:
        return f'The goal is reached with {count}: {change}, within {tolerance}; {score}.'
    return f'The goal is not reached: with {count}, {change}, beyond {tolerance}; {score}.'
