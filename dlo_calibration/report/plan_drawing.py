# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of a plan: a picture with a panel an action, and an animation of all actions."""

from __future__ import annotations

from dataclasses import replace
import math
from pathlib import Path
import textwrap
from typing import Collection, Mapping, Sequence

import numpy as np

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.quantity import measured, number
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.rehearsal import rehearsed_trial, Step
from dlo_calibration.report.animation import Captions, write_animation
from dlo_calibration.report.drawing import hand_colours, View
from dlo_calibration.report.figure import (
    add_legend,
    as_text,
    blank_figure,
    OBSERVED,
    settings,
    SIMULATED,
    write_figure,
)
from dlo_calibration.report.plan_sentences import distance
from dlo_calibration.simulation.motion import simulated_motion
from dlo_calibration.simulation.protocol import Simulator

COLUMNS = 3  # of panels, at most


def write_plan_picture(plan: Plan, path: str | Path) -> None:
    """
    Write a PNG with a panel an action: the DLO before it and as predicted after it, the goal, and the hands.

    A plan without an action has one panel.

    :raises InputError: if the file cannot be written.
    """
    trials = _trials(plan)
    colours = hand_colours(trials)
    rows = math.ceil(len(trials) / COLUMNS)
    columns = math.ceil(len(trials) / rows)
    width = max(5.0 * columns, 6.5)
    with settings():
        figure = blank_figure(width, 4.6 * rows + 1.0)
        figure.suptitle(textwrap.fill(_title(plan), round(9 * width)), fontweight='bold')
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for one in panels[len(trials):]:
            one.remove()
        everything = _extent(plan)
        for k, (axes, trial) in enumerate(zip(panels, trials, strict=False)):
            view = View(axes, trial, above=True)
            view.draw_start('before the action' if plan.actions else 'the DLO')
            if plan.actions:
                _draw_action(view, plan.actions[k], colours)
                axes.set_title(as_text(f'{k + 1}. {plan.actions[k].name}: then '
                                       f'{distance(plan, plan.actions[k].predicted)} from the goal'),
                               fontsize=10)
            _draw_goal(view)
            view.draw_first_point()
            axes.update_datalim(view.flat(everything).T)  # the same section of the table in all panels
            axes.autoscale_view()
        add_legend(figure, panels[:len(trials)], columns=columns + 1)
        write_figure(figure, path)


def write_plan_animation(plan: Plan, simulator: Simulator, physical: Mapping[str, float],
                         path: str | Path) -> None:
    """
    Simulate the actions of a plan, at least one, and write their motion as a GIF.

    :param physical: parameters by name (SI units).
    :raises InputError: if the file cannot be written.
    :raises SimulationError: if the simulation diverges.
    """
    trial = plan_trial(plan)
    write_animation(trial, simulated_motion(trial, simulator, physical), path,
                    Captions('plan, simulated', 'start', 'goal'))


def plan_trial(plan: Plan) -> Trial:
    """Return a trial with the actions of a plan, at least one, in turn; each goal is that of the plan."""
    trial = rehearsed_trial(plan.start, [Step(one.action) for one in plan.actions])
    goal = Chain(plan.goal.points)  # an object of its own, also where the start is the goal
    return replace(trial, name='plan', goals=tuple(replace(one, chain=goal) for one in trial.goals))


def _trials(plan: Plan) -> list[Trial]:
    """Return a trial for each panel: the DLO before an action, the action, and the goal of the plan."""
    after = [one.predicted for one in plan.actions[:-1]]
    # A trial has an action, so that where there is none to draw, its hand does nothing.
    nothing = Action((Hand('', (0,), np.zeros(1), plan.start.points[:1]),))
    return [Trial(str(k), chain, (action,), (Goal(plan.goal, action.end + 1.0),)) for k, (chain, action) in
            enumerate(zip([plan.start, *map(Chain, after)],
                          [one.action for one in plan.actions] or [nothing], strict=True))]


def _extent(plan: Plan) -> Floats:
    """Return points, (m, 3) [m], among which all that a plan contains lies."""
    return np.concatenate([plan.start.points, plan.goal.points,
                           *(part for one in plan.actions for part in (one.lower, one.upper)),
                           *(hand.positions for one in plan.actions for hand in one.action.hands)])


def _draw_action(view: View, planned: PlannedAction, colours: Mapping[str, str]) -> None:
    """Draw the DLO as predicted after an action, and the ways of the hands."""
    view.draw_band(planned.lower, planned.upper, '90 % interval of its points')
    view.axes.plot(*view.flat(planned.predicted), '-', color=SIMULATED, linewidth=2.2, zorder=3,
                   label='after the action, predicted')
    draw_ways(view, planned.action.hands, colours)


def draw_ways(view: View, hands: Sequence[Hand], colours: Mapping[str, str],
              holding: Collection[str] = ()) -> None:
    """
    Draw the ways of hands, with arrows, and where they close and open.

    :param holding: names of those that do not open at the end.
    """
    for hand in hands:
        colour, way = colours[hand.name], view.flat(hand.positions)
        moves = np.linalg.norm(np.diff(way, axis=1), axis=0) > 1e-6
        view.axes.plot(*way, '-', color=colour, linewidth=1.4, zorder=5)
        for k in np.flatnonzero(moves)[-1:]:
            head, tail = ((float(x), float(y)) for x, y in way.T[[k + 1, k]])
            view.axes.annotate('', head, tail, zorder=5, arrowprops={
                'arrowstyle': '-|>', 'color': colour, 'linewidth': 1.4, 'shrinkA': 0, 'shrinkB': 4})
        opens = hand.name not in holding
        if moves.any() or not opens:
            view.axes.plot(*way[:, :1], 's', color=colour, markersize=7, linestyle='none', zorder=5,
                           label=as_text(f'{hand.name} closes'))
        view.axes.plot(*way[:, -1:], 's', color=colour, markerfacecolor='none' if opens else colour,
                       markersize=8, zorder=5, linestyle='none',
                       label=as_text(f'{hand.name} opens') if opens else None)


def _draw_goal(view: View) -> None:
    view.axes.plot(*view.flat(view.trial.goals[-1].chain.points), linestyle=(0, (2, 1.5)), color=OBSERVED,
                   linewidth=1.5, zorder=4, label='goal')


def _title(plan: Plan) -> str:
    length = plan.start.length
    before = f'{measured(plan.error_before, "m")} ({number(100 * plan.error_before / length)} %)'
    if not plan.actions:
        return f'no action: the DLO is {before} from the goal'
    after = f'{measured(plan.error_after, "m")} ({number(100 * plan.error_after / length)} % of the length)'
    count = f'{len(plan.actions)} action{"s" if len(plan.actions) > 1 else ""}'
    return f'{count}: from {before} to {after} from the goal'
