# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of a prediction: a picture with a row an action, and an animation of all actions."""

from __future__ import annotations

from pathlib import Path
from typing import Mapping

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.planning.course import simulated_course
from dlo_calibration.planning.prediction import PredictedStep, Prediction
from dlo_calibration.report.animation import Captions, write_animation
from dlo_calibration.report.drawing import hand_colours, View
from dlo_calibration.report.figure import (
    add_legend,
    as_text,
    blank_figure,
    settings,
    SIMULATED,
    write_figure,
)
from dlo_calibration.report.plan_drawing import draw_ways
from dlo_calibration.report.prediction_sentences import width
from dlo_calibration.simulation.motion import MOST_FRAMES
from dlo_calibration.simulation.protocol import Simulator


def write_prediction_picture(prediction: Prediction, name: str, path: str | Path) -> None:
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
    everything = _extent(prediction)
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
                _draw_step(view, step, colours)
                axes.update_datalim(view.flat(everything).T)  # the same section in all rows
                axes.autoscale_view()
                panels.append(axes)
        add_legend(figure, panels, columns=3)
        write_figure(figure, path)


def write_prediction_animation(prediction: Prediction, name: str, simulator: Simulator,
                               path: str | Path) -> None:
    """
    Simulate the actions of a prediction again, and write their motion as a GIF.

    :raises InputError: if the file cannot be written.
    :raises SimulationError: if the simulation diverges.
    """
    trial, motion = simulated_course(prediction.start, [one.step for one in prediction.steps], simulator,
                                     prediction.physical, most=MOST_FRAMES)
    write_animation(trial, motion, path, Captions(f'{name}, simulated', 'start', ''))


def _extent(prediction: Prediction) -> Floats:
    """Return points, (m, 3) [m], among which all that a prediction contains lies."""
    return np.concatenate([prediction.start.points,
                           *(part for one in prediction.steps for part in (one.lower, one.upper)),
                           *(hand.positions for one in prediction.steps for hand in one.step.action.hands)])


def _draw_step(view: View, step: PredictedStep, colours: Mapping[str, str]) -> None:
    """Draw the DLO before and after an action, and the ways of the hands."""
    view.draw_start('before the action')
    view.draw_band(step.lower, step.upper, '90 % interval of its points')
    view.axes.plot(*view.flat(step.chain), '-', color=SIMULATED, linewidth=2.2, zorder=3,
                   label='after the action, predicted')
    draw_ways(view, step.step.action.hands, colours, step.step.held_by)
    view.draw_first_point()
