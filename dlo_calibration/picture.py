# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""Pictures: measured and simulated chains of a trial, from above and from the side."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.chain import Floats
from dlo_calibration.score import PointErrors, residuals
from dlo_calibration.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INSTANTS = 5  # goals shown at most where a trial has many
PATH_SAMPLES = 60
HAND_COLOURS = ('tab:green', 'tab:purple', 'tab:brown', 'tab:pink')
OBSERVED, SIMULATED, BEFORE = 'black', 'tab:orange', '0.72'


def trial_picture(trial: Trial, chains: Floats | None, path: str | Path) -> None:
    """
    Write a PNG of one trial: from above on the left, from the side on the right.

    :param chains: (g, n, 3) [m] simulated at the goals; None: observed only.
    """
    session_picture([trial], None if chains is None else [chains], path)


def session_picture(trials: Sequence[Trial], chains: Sequence[Floats] | None, path: str | Path) -> None:
    """
    Write a PNG with a row per trial.

    :param chains: of each trial, (g, n, 3) [m] simulated at its goals; None: observed only.
    """
    figure = _figure(trials, chains)
    figure.savefig(path, format='png', dpi=110)


def trial_png(trial: Trial, chains: Floats | None) -> bytes:
    """Return the picture of one trial as the bytes of a PNG."""
    buffer = io.BytesIO()
    _figure([trial], None if chains is None else [chains]).savefig(buffer, format='png', dpi=90)
    return buffer.getvalue()


def horizontal_direction(trial: Trial) -> Floats:
    """Return the horizontal unit vector, (3,), along which a trial extends most."""
    points = np.concatenate([trial.initial.points, *(goal.chain.points for goal in trial.goals)])[:, :2]
    direction = np.linalg.eigh(np.cov(points.T))[1][:, -1]
    # The sign of an eigenvector is arbitrary; a picture of the same trial must not flip.
    direction = direction * (1.0 if direction[np.argmax(np.abs(direction))] > 0 else -1.0)
    return np.array([direction[0], direction[1], 0.0])


def shown_goals(count: int) -> list[int]:
    """Return the indices of the goals to show of `count`: evenly spread, the last one always."""
    return sorted({int(k) for k in np.linspace(count - 1, 0, min(count, INSTANTS)).round()})


def _figure(trials: Sequence[Trial], chains: Sequence[Floats] | None) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2 * len(trials)), layout='constrained')
    FigureCanvasAgg(figure)  # no pyplot: a picture never opens a window or keeps a figure alive
    rows: Any = figure.subplots(len(trials), 2, squeeze=False)
    for k, (trial, (top, side)) in enumerate(zip(trials, rows, strict=True)):
        simulated = None if chains is None else chains[k]
        across = horizontal_direction(trial)
        _draw(top, trial, simulated, np.array([[1.0, 0, 0], [0, 1.0, 0]]))
        _draw(side, trial, simulated, np.array([across, [0, 0, 1.0]]))
        top.set(xlabel='x [m]', ylabel='y [m]', title=_title(trial, simulated))
        angle = np.degrees(np.arctan2(across[1], across[0]))
        side.set(xlabel=f'along the horizontal direction at {angle:.0f} deg from x [m]', ylabel='z [m]',
                 title='from the side')
        side.legend(loc='best', fontsize='small', framealpha=0.7)
    return figure


def _title(trial: Trial, chains: Floats | None) -> str:
    if chains is None:
        return f'{trial.name}, from above'
    errors = PointErrors.of(residuals(trial, chains))
    return f'{trial.name}, from above: mean error {errors.mean * 1e3:.1f} mm, max {errors.max * 1e3:.1f} mm'


def _draw(axes: Axes, trial: Trial, chains: Floats | None, view: Floats) -> None:
    """Draw a trial through a (2, 3) projection."""
    def flat(points: Floats) -> Floats:
        return view @ np.asarray(points).T

    axes.plot(*flat(trial.initial.points), '-', color=BEFORE, linewidth=3, label='before', zorder=1)
    goals = shown_goals(len(trial.goals))
    for order, k in enumerate(goals):
        last = order == len(goals) - 1
        strength = 0.35 + 0.65 * (order + 1) / len(goals)
        axes.plot(*flat(trial.goals[k].chain.points), 'o', color=OBSERVED, markersize=4, alpha=strength,
                  label='measured' if last else None, zorder=3)
        if chains is not None:
            axes.plot(*flat(chains[k]), '-', color=SIMULATED, linewidth=2, alpha=strength,
                      label='simulated' if last else None, zorder=2)
    for number, hand in enumerate(trial.hands):
        colour = HAND_COLOURS[number % len(HAND_COLOURS)]
        path = hand.poses(np.linspace(hand.start, hand.end, PATH_SAMPLES))[0]
        axes.plot(*flat(path), '--', color=colour, linewidth=1, label=hand.name, zorder=4)
        axes.plot(*flat(path[:1]), 's', color=colour, markersize=5, zorder=4)
        axes.plot(*flat(path[-1:]), '^', color=colour, markersize=6, zorder=4)
    axes.set_aspect('equal', adjustable='datalim')
    axes.grid(alpha=0.3)
