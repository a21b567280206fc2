# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of a trial: measured and simulated chains and their errors, for a PNG, a GIF and the page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
import math
from pathlib import Path
from typing import Callable, Iterable, Mapping, Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.uncertainty import DEVIATIONS
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats, grip_place
from dlo_calibration.model.parameters import interval, measured, number
from dlo_calibration.model.score import differences, MEAN_DISTANCE, PointErrors, residuals
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.report import figure
from dlo_calibration.report.obstacles import ABOVE, draw_obstacles
from dlo_calibration.simulation.scene import Obstacle
from dlo_calibration.writing import Attempts, make_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HAND_COLOURS = (figure.GREEN, figure.PURPLE, figure.SKY, figure.YELLOW, figure.BLUE,
                '#882255', '#999933', '#44aa99')
CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])  # of a square, in turn
SAME_PLACE = 0.005  # of the length: mean distance up to which two goals show the same rest
INSTANT_COLOURS = ('#440154', '#3b6bb5', '#21918c', '#5ec962', '#e0b400')  # of goals in motion, early to late


@dataclass(frozen=True)
class Drawn:
    """
    A trial to draw, and the errors to expect.

    :param chains: (g, n, 3) simulated chains at the goals [m]; None: nothing was simulated.
    :param colours: of the hands, by name.
    :param noise: noise level: standard deviation of a measured coordinate [m]; nan if unknown.
    :param band: (n,) standard deviation of the simulated points, the largest of all shown goals [m]; None if
        unknown.
    :param obstacles: of the scene.
    """

    trial: Trial
    chains: Floats | None
    colours: Mapping[str, str]
    noise: float = math.nan
    band: Floats | None = None
    obstacles: Sequence[Obstacle] = ()

    @classmethod
    def of(cls, result: CalibrationResult, k: int, obstacles: Sequence[Obstacle] = ()) -> Drawn:
        """Return the k-th trial of a result."""
        trial, examination = result.trials[k], result.examination
        drawn = cls(trial, result.chains[k], hand_colours([trial]),
                    math.nan if examination is None else examination.noise, obstacles=obstacles)
        if result.band is None:
            return drawn
        by_goal = ResidualLayout.of(result.trials).by_point(result.band)[k]
        return replace(drawn, band=np.fmax.reduce(by_goal[drawn._shown()], axis=0))

    def goals(self) -> list[tuple[int, str | None]]:
        """Return the indices of the goals to show, with a colour for each if there are several."""
        goals = self._shown()
        return [(goal, INSTANT_COLOURS[order] if len(goals) > 1 else None)
                for order, goal in enumerate(goals)]

    def _shown(self) -> list[int]:
        """
        Choose at most five goals: the last, and those with the largest errors.

        Only one is chosen of goals that show the same rest, or that a stream has at about the same time.
        Where nothing was simulated, they are spread over the trial.
        """
        goals = self.trial.goals
        points, times = np.stack([goal.chain.points for goal in goals]), [goal.time for goal in goals]
        most = len(INSTANT_COLOURS)
        spacing = (times[-1] - times[0]) / (2 * most) if len(goals) > most else 0.0
        order = np.array(shown_goals(len(goals)))
        if self.chains is not None:
            seen = np.stack([goal.chain.observed for goal in goals])
            order = np.argsort(-np.nanmean(np.linalg.norm(seen - self.chains, axis=2), axis=1), kind='stable')
        chosen = [len(goals) - 1]
        for k in map(int, order):
            away = np.linalg.norm(points[chosen] - points[k], axis=2).mean(axis=1)
            if len(chosen) < most and away.min() > SAME_PLACE * self.trial.initial.length \
                    and min(abs(times[k] - times[goal]) for goal in chosen) >= spacing:
                chosen.append(k)
        return sorted(chosen)


def session_picture(trials: Sequence[Trial], chains: Sequence[Floats] | None, path: str | Path,
                    obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Write a PNG with a row per trial: from above, from the side, and the error of each point.

    :param chains: of each trial, (g, n, 3) simulated at its goals [m]; None: nothing was simulated, and
        the distance that each point moved is drawn instead of the error.
    :param obstacles: of the scene.
    :raises InputError: if the file cannot be written.
    """
    colours = hand_colours(trials)
    # The colours of several goals belong to one trial, so that each row needs its own legend.
    several = any(len(trial.goals) > 1 for trial in trials)
    lines = (2 + len(colours) + 2 * several) * (len(trials) if several else 1)
    with figure.settings():
        whole = figure.blank_figure(14, 4.3 * len(trials) + 0.25 * lines)
        rows = whole.subfigures(len(trials), 1, squeeze=False)[:, 0]
        explained: list[Axes] = []
        for k, (trial, row) in enumerate(zip(trials, rows, strict=True)):
            drawn = Drawn(trial, None if chains is None else chains[k], colours, obstacles=obstacles)
            row.suptitle(figure.as_text(_title(drawn)), fontweight='bold')
            above, side, error = row.subplots(1, 3)
            draw_view(above, drawn, above=True)
            draw_view(side, drawn, above=False)
            draw_errors(error, drawn)
            explained += [above, error]
            if several:
                figure.add_legend(row, [above, error])
        if not several:
            figure.add_legend(whole, explained)
        figure.write_figure(whole, path)


def write_pictures(trials: Sequence[Trial], chains: Sequence[Floats] | None, folder: Path,
                   note: Callable[[str], None], numbers: Sequence[int],
                   obstacles: Sequence[Obstacle] = ()) -> list[Path]:
    """
    Write ``trial_1.png``, ``trial_2.png``, ... into a folder, which is created; see `session_picture`.

    :param note: called with the path of each written file.
    :param numbers: of the trials.
    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    return write_numbered(
        (partial(session_picture, [trial], None if chains is None else [chains[k]], obstacles=obstacles)
         for k, trial in enumerate(trials)), folder, '.png', note, numbers)


def write_numbered(writers: Iterable[Callable[[Path], None]], folder: Path, suffix: str,
                   note: Callable[[str], None], numbers: Sequence[int]) -> list[Path]:
    """
    Write a file for each trial, numbered because names may contain anything; create the folder.

    :param writers: of the files; an error from the iterable itself is raised.
    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    make_folder(folder)
    paths, attempts = [folder / f'trial_{number}{suffix}' for number in numbers], Attempts(folder)
    for write, path in zip(writers, paths, strict=True):
        with attempts.attempt(path.name):
            write(path)
            note(str(path))
    attempts.require()
    return paths


def trial_panels(drawn: Drawn) -> list[figure.Panel]:
    """Draw a trial for the page: from above, from the side, point errors, and residuals by coordinate."""
    name, chains = drawn.trial.name, drawn.chains
    assert chains is not None
    off, errors = differences(drawn.trial, chains), PointErrors.of(residuals(drawn.trial, chains))
    by_axis = (f'{axis}: {interval(np.nanmin(values), np.nanmax(values), "m")}'
               for axis, values in zip('xyz', off[-1].T, strict=True))
    return [
        figure.panel(lambda axes: draw_view(axes, drawn, above=True),
                     f'{name} seen from above: the measured and the simulated chain'),
        figure.panel(lambda axes: draw_view(axes, drawn, above=False),
                     f'{name} seen from the side: the measured and the simulated chain', legend=False),
        figure.panel(lambda axes: draw_errors(axes, drawn),
                     f'{name}, error of each point: the mean is {measured(errors.mean, "m")}, '
                     f'the largest {measured(errors.max, "m")}'),
        figure.panel(lambda axes: _draw_differences(axes, drawn),
                     f'{name}, residuals by coordinate: {", ".join(by_axis)}')]


def hand_colours(trials: Sequence[Trial]) -> Mapping[str, str]:
    """Return a colour for each hand of the trials, by name."""
    names = sorted({hand.name for trial in trials for hand in trial.hands})
    return {name: HAND_COLOURS[k % len(HAND_COLOURS)] for k, name in enumerate(names)}


def hand_path(hand: Hand) -> Floats:
    """Return the path of a hand, (k, 3) [m], from where it closes to its last waypoint."""
    return hand.positions_at(np.union1d(hand.times, np.linspace(hand.start, hand.end, 60)))


class View:
    """
    Axes that show a trial from one side.

    :param above: whether to look from above; else from the side, along the horizontal direction in which the
        trial extends least.
    :param extent: (m, 3) [m] points that determine this direction; None: those of the trial's chains.
    """

    def __init__(self, axes: Axes, trial: Trial, *, above: bool, extent: Floats | None = None) -> None:
        self.axes = axes
        self.trial = trial
        if extent is None:
            extent = np.concatenate([trial.initial.points, *(goal.chain.points for goal in trial.goals)])
        across = _horizontal_direction(extent)
        self._projection = ABOVE if above else np.array([across, [0, 0, 1.0]])
        if above:
            axes.set(title='seen from above', xlabel='x [m]', ylabel='y [m]')
        else:
            angle = np.degrees(np.arctan2(across[1], across[0]))
            where = 'x' if abs(angle) < 0.5 else f'distance along the horizontal line {angle:.0f}° from x'
            axes.set(title='seen from the side', xlabel=f'{where} [m]', ylabel='z (up) [m]')
        axes.set_aspect('equal', adjustable='datalim')
        axes.margins(0.12)
        axes.locator_params(axis='x', nbins=figure.MOST_TICKS)
        axes.grid(alpha=0.3)

    def flat(self, points: Floats) -> Floats:
        """Project (n, 3) points [m] to (2, n) [m]."""
        flat: Floats = self._projection @ np.asarray(points).T
        return flat

    def draw_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Draw the obstacles of a scene, as far as the axes show them."""
        draw_obstacles(self.axes, obstacles, self._projection)

    def draw_start(self, label: str = 'before the action, measured') -> None:
        """Draw the DLO before the action."""
        self.axes.plot(*self.flat(self.trial.initial.points), '-', color=figure.BEFORE, linewidth=3,
                       label=label, zorder=1)

    def draw_band(self, lower: Floats, upper: Floats, label: str) -> None:
        """
        Shade where the DLO may be.

        :param lower: (n, 3) [m] lower ends of the intervals of the coordinates; `upper` (n, 3) upper ends.
        """
        from matplotlib.collections import PolyCollection

        middle, half = self.flat((lower + upper) / 2), np.abs(self._projection) @ (upper - lower).T / 2
        corners = (middle[None] + half[None] * CORNERS[:, :, None]).transpose(2, 0, 1)  # (n, 4, 2) [m]
        after = np.roll(corners, -1, axis=1)
        # An interval that moves from one point to the next sweeps what its four edges sweep.
        swept = np.stack([corners[:-1], after[:-1], after[1:], corners[1:]], axis=2).reshape(-1, 4, 2)
        # One colour without transparency, as the pieces overlap; edges close the gaps between them.
        self.axes.add_collection(PolyCollection(
            [*corners, *swept], facecolor=figure.BAND, edgecolor=figure.BAND, linewidth=0.3, zorder=0.5,
            label=label))

    def draw_goal(self, index: int, simulated: Floats | None, colour: str | None) -> None:
        """
        Draw a goal.

        :param simulated: (n, 3) simulated chain [m]; None: nothing was simulated.
        :param colour: of this goal among several; None: it is the only one.
        """
        goal = self.trial.goals[index]
        seen = self.flat(goal.chain.observed)
        when = 'after the action' if colour is None else f'after {number(goal.time)} s'
        self.axes.plot(*seen, 'o', color=colour or figure.OBSERVED, markersize=4.5, linestyle='none',
                       label=f'{when}, measured', zorder=3)
        if simulated is None:
            return
        shown = self.flat(simulated)
        self.axes.plot(*shown, '-', color=colour or figure.SIMULATED, linewidth=2, zorder=2,
                       label=f'{when}, simulated')
        pairs = np.stack([seen, shown, np.full(seen.shape, np.nan)], axis=2).reshape(2, -1)
        self.axes.plot(*pairs, '-', zorder=2, linewidth=0.7, color=colour or figure.SIMULATED, alpha=0.6,
                       label=None if colour else 'one point, measured and simulated')

    def draw_first_point(self) -> None:
        """Mark the first point of the DLO."""
        self.axes.plot(*self.flat(self.trial.initial.points[:1]), 'o', markersize=11, markerfacecolor='none',
                       markeredgecolor=figure.OBSERVED, linestyle='none', zorder=6,
                       label='first point of the DLO')

    def draw_hands(self, colours: Mapping[str, str]) -> None:
        """Draw the paths of the hands, with their first and last points."""
        for hand in self.trial.hands:
            colour, path = colours[hand.name], hand_path(hand)
            self.axes.plot(*self.flat(path), '--', color=colour, linewidth=1, zorder=4)
            self.axes.plot(*self.flat(path[:1]), 's', color=colour, markersize=6, zorder=4, linestyle='none',
                           label=figure.as_text(f'{hand.name} closes'))
            self.axes.plot(*self.flat(path[-1:]), '^', color=colour, markersize=8, zorder=5, linestyle='none',
                           label=figure.as_text(f'{hand.name} at its last waypoint'))


def draw_view(axes: Axes, drawn: Drawn, *, above: bool) -> None:
    """Draw a trial from one side."""
    view = View(axes, drawn.trial, above=above)
    view.draw_obstacles(drawn.obstacles)
    view.draw_start()
    for goal, colour in drawn.goals():
        view.draw_goal(goal, None if drawn.chains is None else drawn.chains[goal], colour)
    view.draw_hands(drawn.colours)
    view.draw_first_point()


def draw_errors(axes: Axes, drawn: Drawn) -> None:
    """Draw the error of each point and the errors to expect; without a simulation, how far each moved."""
    trial, chains = drawn.trial, drawn.chains
    places = trial.initial.arc_lengths()
    for goal, colour in drawn.goals():
        seen = trial.goals[goal].chain.observed
        other = trial.initial.points if chains is None else chains[goal]
        axes.plot(places, np.linalg.norm(seen - other, axis=1) * 1e3, 'o-', markersize=4, linewidth=1,
                  color=colour or (figure.OBSERVED if chains is None else figure.SIMULATED),
                  label=None if colour is None else f'after {number(trial.goals[goal].time)} s')
    if chains is not None:
        mean = PointErrors.of(residuals(trial, chains)).mean * 1e3
        axes.axhline(mean, color=figure.SIMULATED, linestyle=':', linewidth=1.2, label='mean error')
    if math.isfinite(drawn.noise):
        axes.axhline(drawn.noise * MEAN_DISTANCE * 1e3, color=figure.FAINT, linestyle=(0, (6, 3)),
                     linewidth=1.2, label='error from the noise of the measured points alone')
    if drawn.band is not None:
        axes.fill_between(places, 0.0, drawn.band * 1e3, color=figure.BLUE, alpha=0.25, linewidth=0, label=(
            'error of a simulated point from the uncertainty of the parameters (one standard deviation)'))
    for hand in trial.hands:
        for k, grip in enumerate(hand.grips):
            axes.axvline(grip_place(places, grip, hand.offset), color=drawn.colours[hand.name],
                         linestyle='--', linewidth=1,
                         label=None if k else figure.as_text(f'place that {hand.name} grips'))
    axes.set(xlabel='arc length from the first point [m]',
             ylabel='distance [mm]',
             title='how far each point moved' if chains is None else 'distance from measured to simulated')
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)


def _draw_differences(axes: Axes, drawn: Drawn) -> None:
    """Draw the residuals of the last goal along each axis."""
    trial, goal = drawn.trial, drawn.trial.goals[-1]
    assert drawn.chains is not None
    places = trial.initial.arc_lengths()
    if math.isfinite(drawn.noise):
        reach = DEVIATIONS * drawn.noise * 1e3
        axes.axhspan(-reach, reach, color=figure.FAINT, alpha=0.25, linewidth=0,
                     label='noise of the measured points (90 % interval)')
    for axis, values, colour, dashes in zip(
            ('x', 'y', 'z, up'), (drawn.chains[-1] - goal.chain.observed).T,
            (figure.BLUE, figure.YELLOW, figure.GREEN), ('-', (0, (5, 1)), (0, (2, 1))), strict=True):
        axes.plot(places, values * 1e3, color=colour, linestyle=dashes, linewidth=1.8, label=f'in {axis}')
    last = '' if len(trial.goals) == 1 else f', after {number(goal.time)} s'
    axes.set(xlabel='arc length from the first point [m]', ylabel='simulated minus measured [mm]',
             title=f'residuals{last}')
    axes.grid(alpha=0.3)


def _title(drawn: Drawn) -> str:
    if drawn.chains is None:
        return f'{drawn.trial.name}, measured'
    errors = PointErrors.of(residuals(drawn.trial, drawn.chains))
    return (f'{drawn.trial.name}: simulated points are {measured(errors.mean, "m")} from the measured ones '
            f'on average ({number(100 * errors.mean / drawn.trial.initial.length)} % of the length), '
            f'{measured(errors.max, "m")} at most')


def _horizontal_direction(points: Floats) -> Floats:
    """Return the horizontal unit vector (3,) along which points (m, 3) [m] extend most."""
    direction = np.linalg.eigh(np.cov(points[:, :2].T))[1][:, -1]
    # The sign of an eigenvector is arbitrary; it is fixed so that pictures of the same trial agree.
    direction = direction * (1.0 if direction[np.argmax(np.abs(direction))] > 0 else -1.0)
    return np.array([direction[0], direction[1], 0.0])
