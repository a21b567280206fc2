# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of the search: the scores of its evaluations, and how the fit worsens around the result."""

from __future__ import annotations

from typing import Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.inference.slices import Line, Plane
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import number, SCALE
from dlo_calibration.report.figure import BEFORE, BLUE, FAINT, OBSERVED, Panel, panel, PURPLE, SIMULATED

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def convergence_panel(result: CalibrationResult) -> Panel:
    """Draw the score of every evaluation, and the best one so far."""
    counts = np.arange(1, len(result.evaluations) + 1)
    scores = np.array([evaluation.score for evaluation in result.evaluations])
    finished = np.array([not evaluation.failure for evaluation in result.evaluations])
    best = np.minimum.accumulate(np.where(finished, scores, np.inf))

    def draw(axes: Axes) -> None:
        axes.step(counts, best, color=BLUE, where='post', label='best so far')
        axes.plot(counts[finished], scores[finished], '.', color=OBSERVED, markersize=5, label='tried')
        if not finished.all():
            top = 1.3 * scores[finished].max(initial=1.0)
            axes.plot(counts[~finished], np.full((~finished).sum(), top), 'x', color=PURPLE,
                      label='could not be simulated')
        _mark(axes, result.best.index + 1, result.best.score)
        axes.set(title='score of every parameter set that was tried', xlabel='evaluation',
                 ylabel='difference score [cm]')
        _logarithmic(axes)

    failed = int((~finished).sum())
    return panel(draw, f'the best score falls from {number(best[0])} to {number(best[-1])} cm in {len(best)} '
                       f'evaluations' + (f', of which {failed} could not be simulated' if failed else ''))


def line_panels(result: CalibrationResult, lines: Sequence[Line]) -> list[Panel]:
    """Draw how the fit worsens along each parameter."""
    return [_line(result, line, legend=line is lines[0]) for line in lines]


def plane_panels(result: CalibrationResult, plane: Plane) -> list[Panel]:
    """Draw how the fit worsens while two parameters vary: the error, and the score."""
    drawn = (('root mean square error', 'mm', 1e3 * plane.errors), ('difference score', 'cm', plane.scores))
    return [_plane(result, plane, what, unit, values) for what, unit, values in drawn
            if values[np.isfinite(values)].max(initial=0.0) > 0]


def _line(result: CalibrationResult, line: Line, legend: bool) -> Panel:
    estimate = result.parameters[line.name]
    # A result that fits exactly would make the ratios infinite.
    errors = line.errors / max(result.errors.rms, 1e-6)
    scores = line.scores / max(result.best.score, 1e-2)

    def draw(axes: Axes) -> None:
        axes.axvspan(*np.clip([estimate.lower, estimate.upper], line.values[0], line.values[-1]),
                     color=BEFORE, alpha=0.4, linewidth=0, label='90 % interval')
        axes.plot(line.values, _visible(scores), '--', color=FAINT, label='difference score')
        axes.plot(line.values, _visible(errors), '.-', color=BLUE, linewidth=1.8,
                  label='root mean square error of the points')
        _mark(axes, estimate.value, 1.0)
        axes.set(title=f'along {line.name}', xlabel=f'{line.name} [0 to 100]',
                 ylabel='multiple of the value at the result')
        _logarithmic(axes, 0.8, 1.25)

    return panel(draw, (
        f'Along {line.name}, from {number(line.values[0])} to {number(line.values[-1])}, the error is up to '
        f'{number(errors.max())} times, the score up to {number(scores.max())} times that of the result'),
        legend)


def _plane(result: CalibrationResult, plane: Plane, what: str, unit: str, values: Floats) -> Panel:
    first, second = plane.names
    finite = values[np.isfinite(values)]
    low = max(float(finite.min()), 1e-3 * float(finite.max()))
    high = max(float(finite.max()), 1.01 * low)

    def draw(axes: Axes) -> None:
        from matplotlib.colors import LogNorm

        cells = axes.pcolormesh(*plane.values, np.ma.masked_invalid(np.maximum(values, low)).T, cmap='Blues',
                                norm=LogNorm(low, high), shading='nearest')
        steps = np.geomspace(low, high, 5)
        bar = axes.figure.colorbar(cells, ax=axes, ticks=steps)
        bar.ax.minorticks_off()
        bar.ax.set_yticklabels([number(step) for step in steps])
        region = _region(result, plane)
        if region is not None:
            axes.plot(*region, '--', color=SIMULATED, label='90 % region of both parameters')
        _mark(axes, *(result.parameters[name].value for name in plane.names))
        axes.set(title=f'{what} [{unit}]', xlabel=f'{first} [0 to 100]', ylabel=f'{second} [0 to 100]',
                 xlim=plane.values[0, [0, -1]], ylim=plane.values[1, [0, -1]])

    return panel(draw, f'{what} over {first} and {second}: from {number(low)} {unit} to {number(high)} '
                       f'{unit}')


def _region(result: CalibrationResult, plane: Plane) -> Floats | None:
    """Return the border of the 90 % region of both parameters, (2, k) on the 0..100 scale; None: unknown."""
    examination = result.examination
    if examination is None or not examination.regular or examination.uncertainty.covariance is None:
        return None
    chosen = [result.space.free.index(name) for name in plane.names]
    values, vectors = np.linalg.eigh(examination.uncertainty.covariance[np.ix_(chosen, chosen)])
    radius = np.sqrt(-2 * np.log(0.1))  # holds 90 % of a normal distribution in two dimensions
    angles = np.linspace(0, 2 * np.pi, 120)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    border = vectors @ (np.sqrt(values)[:, None] * radius * circle)
    scale = SCALE / result.space.upper[chosen][:, None]
    return np.asarray((result.best.point[chosen][:, None] + border) * scale)


def _mark(axes: Axes, x: float, y: float) -> None:
    axes.plot([x], [y], 'o', markersize=11, markerfacecolor='none', markeredgecolor=SIMULATED,
              markeredgewidth=2, linestyle='none', label='the result')


def _visible(values: Floats) -> Floats:
    """Replace values that a logarithmic axis cannot show by nan."""
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)


def _logarithmic(axes: Axes, lowest: float = np.inf, highest: float = 0.0) -> None:
    """Make the vertical axis logarithmic with round ticks; it includes `lowest` and `highest`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    axes.set_yscale('log')
    low, high = axes.get_ylim()
    low, high = min(low, lowest), max(high, highest)
    axes.set_ylim(low, high)
    few = high < 8.0 * low  # 1, 2, 5, 10, ... would be too few ticks
    axes.yaxis.set_major_locator(MaxNLocator(5) if few else LogLocator(
        subs=(1, 2, 5) if high < 1e3 * low else (1,)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.grid(alpha=0.3)
