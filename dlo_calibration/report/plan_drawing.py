# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of plans and predictions: a picture of each action, and an animation of all actions."""

from __future__ import annotations

from dataclasses import replace
import math
from pathlib import Path
import textwrap
from typing import Collection, Iterable, Mapping, Sequence

import numpy as np

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.planning.prediction import PredictedStep, Prediction
from dlo_calibration.planning.rehearsal import ActionStep, motion_of_actions, rehearsed_trial
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
from dlo_calibration.report.obstacles import ABOVE, draw_obstacles
from dlo_calibration.report.sentences import distance, of_length, width
from dlo_calibration.simulation.motion import MOST_FRAMES, simulated_motion
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.simulation.scene import Obstacle

COLUMNS = 3  # of panels, at most


def write_plan_picture(plan: Plan, path: str | Path, *, obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Write a PNG with a panel an action: the DLO before it and as predicted after it, the goal, and the hands.

    A plan without an action has one panel.

    :param obstacles: that stand around the DLO, seen from above.
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
        for axes in panels[len(trials):]:
            axes.remove()
        everything = _extent([plan.start.points, plan.goal.points], plan.actions,
                             (hand for step in plan.actions for hand in step.action.hands))
        for k, (axes, trial) in enumerate(zip(panels, trials, strict=False)):
            view = View(axes, trial, above=True)
            view.draw_start('before the action' if plan.actions else 'the DLO')
            draw_obstacles(view.axes, obstacles, ABOVE)
            if plan.actions:
                _draw_predicted(view, plan.actions[k], plan.actions[k].predicted)
                _draw_ways(view, plan.actions[k].action.hands, colours)
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
                         path: str | Path, *, obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Simulate the actions of a plan, at least one, and write their motion as a GIF.

    :param physical: parameters by name (SI units).
    :raises InputError: if the file cannot be written.
    :raises SimulationError: if the simulation diverges.
    """
    trial = plan_trial(plan)
    write_animation(trial, simulated_motion(trial, simulator, physical), path,
                    Captions('plan, simulated', 'start', 'goal'), obstacles)


def plan_trial(plan: Plan) -> Trial:
    """Return a trial with the actions of a plan, at least one, in turn; each goal is that of the plan."""
    trial = rehearsed_trial(plan.start, [ActionStep(step.action) for step in plan.actions])
    chain = Chain(plan.goal.points)  # an object of its own, also where the start is the goal
    return replace(trial, name='plan', goals=tuple(replace(goal, chain=chain) for goal in trial.goals))


def _trials(plan: Plan) -> list[Trial]:
    """Return a trial for each panel: the DLO before an action, the action, and the goal of the plan."""
    after = [step.predicted for step in plan.actions[:-1]]
    # A trial has an action, so that where there is none to draw, its hand does nothing.
    nothing = Action((Hand('', (0,), np.zeros(1), plan.start.points[:1]),))
    return [Trial(str(k), chain, (action,), (Goal(plan.goal, action.end + 1.0),)) for k, (chain, action) in
            enumerate(zip([plan.start, *map(Chain, after)],
                          [step.action for step in plan.actions] or [nothing], strict=True))]


def _extent(chains: Sequence[Floats], steps: Sequence[PlannedAction | PredictedStep],
            hands: Iterable[Hand]) -> Floats:
    """Return points, (m, 3) [m], among which all of these lie."""
    return np.concatenate([*chains, *(part for step in steps for part in (step.lower, step.upper)),
                           *(hand.positions for hand in hands)])


def _draw_predicted(view: View, step: PlannedAction | PredictedStep, predicted: Floats) -> None:
    """Draw the DLO as predicted after an action, (n, 3) [m], with its intervals."""
    view.draw_band(step.lower, step.upper, '90 % interval of its points')
    view.axes.plot(*view.flat(predicted), '-', color=SIMULATED, linewidth=2.2, zorder=3,
                   label='after the action, predicted')


def _draw_ways(view: View, hands: Sequence[Hand], colours: Mapping[str, str],
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
    before = of_length(plan, plan.error_before)
    if not plan.actions:
        return f'no action: the DLO is {before} from the goal'
    after = of_length(plan, plan.error_after).replace('%', '% of the length')
    count = f'{len(plan.actions)} action{"s" if len(plan.actions) > 1 else ""}'
    return f'{count}: from {before} to {after} from the goal'


def write_prediction_picture(prediction: Prediction, name: str, path: str | Path, *,
                             obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Write a PNG with a row an action, seen from above and from the side; of many actions, five are shown.

    :param name: of the trial.
    :raises InputError: if the file cannot be written.
    """
    before = [prediction.start.points, *(step.chain for step in prediction.steps)]
    trials = [Trial(name, Chain(chain), (step.step.action,),
                    (Goal(Chain(step.chain), step.step.action.end + 1.0),))
              for chain, step in zip(before, prediction.steps, strict=False)]
    colours, shown = hand_colours(trials), shown_goals(len(trials))
    everything = _extent([prediction.start.points], prediction.steps,
                         (hand for step in prediction.steps for hand in step.step.action.hands))
    with settings():
        figure = blank_figure(11, 3.9 * len(shown) + 1.0)
        figure.suptitle(as_text(f'{name}, predicted'), fontweight='bold')
        rows = figure.subfigures(len(shown), 1, squeeze=False)[:, 0]
        panels = []
        for k, row in zip(shown, rows, strict=True):
            step = prediction.steps[k]
            row.suptitle(as_text(f'{k + 1}. {step.name}: then the 90 % intervals are {width(step)} wide '
                                 'on average'), fontsize=11)
            for axes, above in zip(row.subplots(1, 2), (True, False), strict=True):
                view = View(axes, trials[k], above=above, extent=everything)
                view.draw_start('before the action')
                _draw_predicted(view, step, step.chain)
                view.draw_obstacles(obstacles)
                _draw_ways(view, step.step.action.hands, colours, step.step.held_by)
                view.draw_first_point()
                axes.update_datalim(view.flat(everything).T)  # the same section in all rows
                axes.autoscale_view()
                panels.append(axes)
        add_legend(figure, panels, columns=3)
        write_figure(figure, path)


def write_prediction_animation(prediction: Prediction, name: str, simulator: Simulator,
                               path: str | Path, *, obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Simulate the actions of a prediction again, and write their motion as a GIF.

    :raises InputError: if the file cannot be written.
    :raises SimulationError: if the simulation diverges.
    """
    trial, motion = motion_of_actions(prediction.start, [step.step for step in prediction.steps], simulator,
                                      prediction.physical, most=MOST_FRAMES)
    write_animation(trial, motion, path, Captions(f'{name}, simulated', 'start', ''), obstacles)


