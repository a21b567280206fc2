# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures: measured and simulated chains of a trial from above and from the side, and the errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Mapping, Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import PointErrors, residuals
from dlo_calibration.model.trial import shown_goals, Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

PATH_SAMPLES = 60
HAND_COLOURS = ('tab:green', 'tab:purple', 'tab:red', 'tab:pink', 'tab:brown', 'tab:olive', 'tab:cyan',
                'tab:blue')
INSTANT_COLOURS = ('#440154', '#3b6bb5', '#21918c', '#5ec962', '#e0b400')  # early to late
OBSERVED, SIMULATED, BEFORE = 'black', 'tab:orange', '0.72'
MILLIMETRES = 1e3
DOTS_PER_INCH = 110
LABEL_SIZE = (0.08, 0.06)  # from a label's point to its middle, relative to the size of what is drawn
LINE_HEIGHT = 0.25  # in, of the legend


def trial_picture(trial: Trial, chains: Floats | None, path: str | Path) -> None:
    """
    Write a PNG of one trial: from above, from the side, and the error of each point.

    :param chains: (g, n, 3) [m] simulated at the goals; None: observed only, with
        how far each point moved in place of the error.
    :raises InputError: where the file cannot be written.
    """
    session_picture([trial], None if chains is None else [chains], path)


def session_picture(trials: Sequence[Trial], chains: Sequence[Floats] | None, path: str | Path) -> None:
    """
    Write a PNG with a row per trial, each as `trial_picture` draws it.

    :param chains: of each trial, (g, n, 3) [m] simulated at its goals; None: observed only.
    :raises InputError: where the file cannot be written.
    """
    figure = _figure(trials, chains)
    try:
        figure.savefig(path, format='png', dpi=DOTS_PER_INCH)
    except OSError as error:
        raise unwritable(path, error) from error


def unwritable(path: str | Path, error: OSError) -> InputError:
    """Return the error for a picture that cannot be written."""
    return InputError(f'file {path}', str(error), 'a place that can be written to',
                      'choose another one with --output')


def horizontal_direction(trial: Trial) -> Floats:
    """Return the horizontal unit vector, (3,), along which a trial extends most."""
    points = np.concatenate([trial.initial.points, *(goal.chain.points for goal in trial.goals)])[:, :2]
    direction = np.linalg.eigh(np.cov(points.T))[1][:, -1]
    # The sign of an eigenvector is arbitrary; a picture of the same trial must not flip.
    direction = direction * (1.0 if direction[np.argmax(np.abs(direction))] > 0 else -1.0)
    return np.array([direction[0], direction[1], 0.0])


def blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure [in] that never opens a window or is kept alive: there is no pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def hand_colours(trials: Sequence[Trial]) -> Mapping[str, str]:
    """Return a colour for every hand of some trials, by name."""
    names = sorted({hand.name for trial in trials for hand in trial.hands})
    return {name: HAND_COLOURS[k % len(HAND_COLOURS)] for k, name in enumerate(names)}


def add_legend(figure: FigureBase, axes: Sequence[Axes], columns: int = 4) -> None:
    """Explain below the figure what is drawn in `axes`, everything once."""
    shown: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    figure.legend(list(shown.values()), list(shown), loc='outside lower center', frameon=False,
                  ncols=min(columns, len(shown)))


def as_text(name: str) -> str:
    """Return a name so that it is written as it is: neither a formula nor a hidden label."""
    shown = name.replace('$', r'\$')
    return f' {shown}' if shown.startswith('_') else shown


class View:
    """
    Axes that show a trial from one side.

    :param above: look from above; else from the side, along the horizontal
        direction in which the trial extends least.
    :param colours: of the hands, by name.
    """

    def __init__(self, axes: Axes, trial: Trial, colours: Mapping[str, str], *, above: bool) -> None:
        self.axes = axes
        self._trial = trial
        self._colours = colours
        across = horizontal_direction(trial)
        self._projection = np.array([[1.0, 0, 0], [0, 1.0, 0]] if above else [across, [0, 0, 1.0]])
        if above:
            axes.set(title='seen from above', xlabel='x [m]', ylabel='y [m]')
        else:
            angle = np.degrees(np.arctan2(across[1], across[0]))
            where = 'x' if abs(angle) < 0.5 else f'distance along the horizontal line {angle:.0f}° from x'
            axes.set(title='seen from the side', xlabel=f'{where} [m]', ylabel='z (up) [m]')
        axes.set_aspect('equal', adjustable='datalim')
        axes.margins(0.12)
        axes.grid(alpha=0.3)

    def flat(self, points: Floats) -> Floats:
        """Project (n, 3) points [m] to (2, n) [m]."""
        flat: Floats = self._projection @ np.asarray(points).T
        return flat

    def draw_start(self) -> None:
        """Draw the DLO before the action."""
        self.axes.plot(*self.flat(self._trial.initial.points), '-', color=BEFORE, linewidth=3,
                       label='before the action, measured', zorder=1)

    def draw_goal(self, index: int, simulated: Floats | None, colour: str | None = None) -> None:
        """
        Draw a goal.

        :param simulated: (n, 3) [m]; None where nothing was.
        :param colour: of this one among several goals; None: it is the only one.
        """
        goal = self._trial.goals[index]
        measured = self.flat(goal.chain.points)
        when = 'after the action' if colour is None else f'after {goal.time:.2f} s'
        self.axes.plot(*measured, 'o', color=colour or OBSERVED, markersize=4.5, linestyle='none',
                       label=f'{when}, measured', zorder=3)
        if simulated is None:
            return
        shown = self.flat(simulated)
        self.axes.plot(*shown, '-', color=colour or SIMULATED, linewidth=2, zorder=2,
                       label=f'{when}, simulated')
        for k in range(measured.shape[1]):
            self.axes.plot(*np.stack([measured[:, k], shown[:, k]], axis=1), '-', zorder=2, linewidth=0.7,
                           color=colour or SIMULATED, alpha=0.6,
                           label=None if colour else 'one point, measured and simulated')

    def draw_first_point(self) -> None:
        """Name the point at which the DLO begins."""
        chains = [self._trial.initial, *(goal.chain for goal in self._trial.goals)]
        shown = np.concatenate([self.flat(chain.points).T for chain in chains])
        first = shown[0]

        def room(side: tuple[int, int]) -> float:
            middle = first + LABEL_SIZE * np.array(side) * np.ptp(shown, axis=0).max()
            return float(np.linalg.norm(shown - middle, axis=1).min())

        right, up = max(((1, 1), (1, -1), (-1, 1), (-1, -1)), key=room)
        self.axes.annotate(
            'first point', (first[0], first[1]), textcoords='offset points', xytext=(0, 9 * up),
            fontsize='small', color='0.3', ha='left' if right > 0 else 'right',
            va='bottom' if up > 0 else 'top', zorder=1)

    def draw_hands(self) -> None:
        """Draw where hands close, move and open."""
        for hand in self._trial.hands:
            colour = self._colours[hand.name]
            path = hand.positions_at(np.union1d(hand.times, np.linspace(hand.start, hand.end, PATH_SAMPLES)))
            self.axes.plot(*self.flat(path), '--', color=colour, linewidth=1, zorder=4)
            self.axes.plot(*self.flat(path[:1]), 's', color=colour, markersize=6, zorder=4, linestyle='none',
                           label=as_text(f'{hand.name} closes'))
            self.axes.plot(*self.flat(path[-1:]), '^', color=colour, markersize=8, zorder=5, linestyle='none',
                           label=as_text(f'{hand.name} at its last waypoint'))


def _figure(trials: Sequence[Trial], chains: Sequence[Floats] | None) -> Figure:
    colours = hand_colours(trials)
    # Colours of instants are a trial's own, so each row explains them then.
    several = any(len(trial.goals) > 1 for trial in trials)
    lines = (1 + len(colours) + 2 * several) * (len(trials) if several else 1)
    figure = blank_figure(14, 4.3 * len(trials) + LINE_HEIGHT * lines)
    rows = figure.subfigures(len(trials), 1, squeeze=False)[:, 0]
    drawn: list[Axes] = []
    for k, (trial, row) in enumerate(zip(trials, rows, strict=True)):
        simulated = None if chains is None else chains[k]
        row.suptitle(as_text(_title(trial, simulated)), fontweight='bold')
        above, side, error = row.subplots(1, 3)
        for axes, from_above in ((above, True), (side, False)):
            _draw_view(View(axes, trial, colours, above=from_above), trial, simulated)
        _draw_errors(error, trial, simulated, colours)
        drawn += [above, error]
        if several:
            add_legend(row, [above, error])
    if not several:
        add_legend(figure, drawn)
    return figure


def _title(trial: Trial, chains: Floats | None) -> str:
    if chains is None:
        return f'{trial.name}, as it was measured'
    errors = PointErrors.of(residuals(trial, chains))
    share = 100 * errors.mean / trial.initial.length
    return (f'{trial.name}: simulated points are {errors.mean * MILLIMETRES:.1f} mm from the measured ones '
            f'on average ({share:.1f} % of the length), {errors.max * MILLIMETRES:.1f} mm at most')


def _coloured_goals(trial: Trial) -> list[tuple[int, str | None]]:
    """Return the goals to show; where there are several, each with a colour of its own."""
    goals = shown_goals(len(trial.goals))
    return [(goal, INSTANT_COLOURS[order] if len(goals) > 1 else None) for order, goal in enumerate(goals)]


def _draw_view(view: View, trial: Trial, chains: Floats | None) -> None:
    view.draw_start()
    for goal, colour in _coloured_goals(trial):
        view.draw_goal(goal, None if chains is None else chains[goal], colour)
    view.draw_hands()
    view.draw_first_point()


def _draw_errors(axes: Axes, trial: Trial, chains: Floats | None, colours: Mapping[str, str]) -> None:
    """Draw the error of each point; without simulation, how far each has moved."""
    places = trial.initial.arc_lengths()
    for goal, colour in _coloured_goals(trial):
        measured = trial.goals[goal].chain.points
        other = trial.initial.points if chains is None else chains[goal]
        distances = np.linalg.norm(measured - other, axis=1) * MILLIMETRES
        axes.plot(places, distances, 'o-', markersize=4, linewidth=1,
                  color=colour or (OBSERVED if chains is None else SIMULATED))
    if chains is not None:
        mean = PointErrors.of(residuals(trial, chains)).mean * MILLIMETRES
        axes.axhline(mean, color='0.4', linestyle=':', label='mean error')
    for hand in trial.hands:
        for grip in hand.grips:
            axes.axvline(places[grip], color=colours[hand.name], linestyle='--', linewidth=1,
                         label=as_text(f'point that {hand.name} grips'))
    axes.set(xlabel='place along the DLO, from its first point [m]',
             ylabel='distance [mm]' if chains is None else 'distance from measured to simulated [mm]',
             title='how far each point moved' if chains is None else 'error of each point')
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
