# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Figures: what a calibration found and how, as charts for a page."""

from __future__ import annotations

from itertools import cycle
from typing import Iterator

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.slices import Line, Plane, Slices
from dlo_calibration.inference.uncertainty import DEVIATIONS
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import SCALE
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.report.charts import cell_colour, Chart, CROSS, legend, RING, SQUARE, TRIANGLE
from dlo_calibration.report.drawing import horizontal_direction, INSTANT_COLOURS
from dlo_calibration.report.sentences import MEAN_DISTANCE

MILLIMETRES = 1e3
MEASURED, SIMULATED, BEFORE, BLUE, RED, GREY = '#111', '#e8710a', '#b4b4b4', '#2b6cb0', '#c62828', '#777'
HAND_COLOURS = ('#2e8b57', '#8e44ad', '#c2185b', '#795548', '#00838f', '#827717', '#5c6bc0', '#d84315')
COORDINATE_COLOURS = ('#c62828', '#2e7d32', '#1565c0')
PATH_SAMPLES = 40
SMALLEST_ERROR, SMALLEST_SCORE = 1e-6, 1e-2  # [m], [cm]; what an error is compared with is not smaller


def trial_figure(result: CalibrationResult, k: int) -> str:
    """Draw a trial: from above, from the side, the error of each point, and in which direction it errs."""
    trial, chains = result.trials[k], result.chains[k]
    above, side = (_view(trial, chains, above=above) for above in (True, False))
    return _group([above, side]) + _group([_errors(result, k), _directions(result, k)])


def convergence_figure(result: CalibrationResult) -> str:
    """Draw the score of every evaluation, and the best one so far."""
    counts = np.arange(1.0, len(result.evaluations) + 1)
    scores = np.array([one.score for one in result.evaluations])
    failed = np.array([bool(one.failure) for one in result.evaluations], dtype=bool)
    finished = ~failed
    best = np.minimum.accumulate(np.where(finished, scores, np.inf))
    chart = Chart(
        'Score of every parameter set that was tried', 'evaluation', 'difference score [cm]',
        f'the best score falls from {best[0]:.1f} to {best[-1]:.1f} in {len(best)} evaluations',
        logarithmic=True)
    chart.line(counts, best, BLUE, 'best so far')
    chart.marks(counts[finished], scores[finished], MEASURED, 'tried', size=2.5)
    if failed.any():
        top = float(scores[finished].max(initial=1.0))
        chart.marks(counts[failed], np.full(failed.sum(), 1.3 * top), RED, shape=CROSS,
                    label='could not be simulated', size=4)
    chart.marks(np.array([result.best.index + 1]), np.array([result.best.score]), RED, 'the result',
                shape=RING, size=6)
    return _group([chart])


def line_figure(result: CalibrationResult, slices: Slices) -> str:
    """Draw how the fit worsens along each parameter."""
    return _group([_line(result, line) for line in slices.lines])


def plane_figure(result: CalibrationResult, plane: Plane) -> str:
    """Draw how the fit worsens with two parameters: the error, and the score."""
    charts, scales = [], []
    for what, unit, values, factor in (('root mean square error', 'mm', plane.errors, MILLIMETRES),
                                       ('difference score', 'cm', plane.scores, 1.0)):
        known = values[np.isfinite(values)] * factor
        if not len(known) or not known.max() > 0:
            continue
        floor = max(float(known.min()), 1e-3 * float(known.max()))
        low, high = np.log([floor, max(float(known.max()), 1.01 * floor)])
        with np.errstate(divide='ignore'):
            shares = (np.log(np.maximum(values * factor, floor)) - low) / (high - low)
        one, two = plane.names
        chart = Chart(what, f'{one} (0 to 100)', f'{two} (0 to 100)',
                      f'from {np.exp(low):.3g} {unit} to {np.exp(high):.3g} {unit}')
        chart.cells(plane.values[0], plane.values[1], np.where(np.isfinite(values), shares, np.nan))
        found = [result.parameters[name] for name in plane.names]
        chart.marks(np.array([found[0].value]), np.array([found[1].value]), RED, 'the result', shape=RING,
                    size=6)
        _draw_region(chart, result, plane)
        charts.append(chart)
        scales.append(_scale(what, unit, float(np.exp(low)), float(np.exp(high))))
    return _group(charts, ''.join(scales))


def correlation_table(result: CalibrationResult) -> str:
    """Return a table of the correlations, as colours and numbers; empty where there are none."""
    found = result.examination
    if found is None or not found.regular or found.uncertainty.correlations is None \
            or result.space.dimension < 2:
        return ''
    names = result.space.free
    head = ''.join(f'<th scope="col">{name}</th>' for name in names)
    rows = ''.join(
        f'<tr><th scope="row">{name}</th>' + ''.join(_correlation(float(value)) for value in row) + '</tr>'
        for name, row in zip(names, found.uncertainty.correlations, strict=True))
    return f'<table class="cells"><tr><td></td>{head}</tr>{rows}</table>'


def _correlation(value: float) -> str:
    """Return a cell: white for 0, blue for positive, orange for negative correlations."""
    strength = min(abs(value), 1.0)
    red, green, blue = (43, 108, 176) if value > 0 else (232, 113, 10)
    colour = ','.join(f'{255 - (255 - one) * strength:.0f}' for one in (red, green, blue))
    ink = '#fff' if strength > 0.75 and value > 0 else '#222'
    return f'<td style="background:rgb({colour});color:{ink}">{value:+.2f}</td>'.replace('>-', '>−')


def _group(charts: list[Chart], below: str = '') -> str:
    return (f'<div class="charts">{"".join(chart.svg() for chart in charts)}</div>{legend(charts)}{below}')


def _coloured_goals(trial: Trial) -> list[tuple[int, str | None]]:
    """Return the goals to show; where there are several, each with a colour of its own."""
    goals = shown_goals(len(trial.goals))
    return [(goal, INSTANT_COLOURS[order] if len(goals) > 1 else None) for order, goal in enumerate(goals)]


def _view(trial: Trial, chains: Floats, *, above: bool) -> Chart:
    across = horizontal_direction(trial)
    projection = np.array([[1.0, 0, 0], [0, 1.0, 0]] if above else [across, [0, 0, 1.0]])
    angle = float(np.degrees(np.arctan2(across[1], across[0])))
    where = 'x [m]'
    if abs(angle) >= 0.5:
        where = f'along a horizontal line {angle:.0f}° from x [m]'.replace('-', '−')
    chart = Chart('Seen from above' if above else 'Seen from the side', 'x [m]' if above else where,
                  'y [m]' if above else 'z, up [m]', f'trial {trial.name}: the measured and the simulated '
                                                     'chain',
                  equal=True)

    def flat(points: Floats) -> tuple[Floats, Floats]:
        xs, ys = projection @ points.T
        return xs, ys

    xs, ys = flat(trial.initial.points)
    chart.line(xs, ys, BEFORE, 'before the action, measured', width=4)
    for goal, colour in _coloured_goals(trial):
        measured, simulated = 'after the action, measured', 'after the action, simulated'
        if colour is not None:
            measured, simulated = '', f'after {trial.goals[goal].time:.2f} s: line simulated, dots measured'
        xs, ys = flat(trial.goals[goal].chain.points)
        chart.marks(xs, ys, colour or MEASURED, measured)
        xs, ys = flat(chains[goal])
        chart.line(xs, ys, colour or SIMULATED, simulated)
    colours = _hand_colours(trial)
    for hand in trial.hands:
        colour = colours[hand.name]
        xs, ys = flat(hand.positions_at(
            np.union1d(hand.times, np.linspace(hand.start, hand.end, PATH_SAMPLES))))
        chart.line(xs, ys, colour, width=1.5, dashes='5 3')
        chart.marks(xs[:1], ys[:1], colour, f'{hand.name} closes', shape=SQUARE, size=4)
        chart.marks(xs[-1:], ys[-1:], colour, f'{hand.name} at its last waypoint', shape=TRIANGLE, size=5)
    xs, ys = flat(trial.initial.points[:1])
    chart.marks(xs, ys, MEASURED, 'first point of the DLO', shape=RING, size=6)
    return chart


def _hand_colours(trial: Trial) -> dict[str, str]:
    names = dict.fromkeys(hand.name for hand in trial.hands)
    return dict(zip(names, cycle(HAND_COLOURS)))


def _errors(result: CalibrationResult, k: int) -> Chart:
    """Draw how far each simulated point is from the measured one, and how far it should be."""
    trial, places = result.trials[k], result.trials[k].initial.arc_lengths()
    distances = np.linalg.norm(_residuals(result, k), axis=2) * MILLIMETRES
    chart = Chart(
        'Error of each point', 'place along the DLO, from its first point [m]', 'distance [mm]',
        f'the mean is {distances.mean():.1f} mm, the largest {distances.max():.1f} mm',
        y_ends=(0.0, 1.05 * max(float(distances.max()), *_levels(result, k), 1e-3)))
    found = result.examination
    if found is not None and found.regular:
        chart.band(places, np.zeros(len(places)), _band(result, k), BLUE,
                   'how far a simulated point may lie elsewhere, given how well the parameters are known '
                   '(one standard deviation)')
    if found is not None and np.isfinite(found.noise):
        level = found.noise * MEAN_DISTANCE * MILLIMETRES
        chart.line(places[[0, -1]], np.array([level, level]), GREY,
                   'error that the noise of the measured points alone would give', dashes='6 4')
    for goal, colour in _coloured_goals(trial):
        chart.line(places, distances[goal], colour or SIMULATED, width=1.5)
        chart.marks(places, distances[goal], colour or SIMULATED,
                    'error' if colour is None else f'error after {trial.goals[goal].time:.2f} s', size=2.5)
    colours = _hand_colours(trial)
    for hand in trial.hands:
        chart.marks(places[list(hand.grips)], np.zeros(len(hand.grips)), colours[hand.name],
                     f'point that {hand.name} grips', shape=TRIANGLE, size=6)
    return chart


def _levels(result: CalibrationResult, k: int) -> Iterator[float]:
    """Give the largest of what else is drawn with the errors [mm]."""
    yield 0.0
    found = result.examination
    if found is not None and np.isfinite(found.noise):
        yield found.noise * MEAN_DISTANCE * MILLIMETRES
    if found is not None and found.regular:
        yield float(_band(result, k).max())


def _directions(result: CalibrationResult, k: int) -> Chart:
    """Draw the residuals of the last goal: along which axis the simulated points are off."""
    trial, places = result.trials[k], result.trials[k].initial.arc_lengths()
    residuals = _residuals(result, k)[-1] * MILLIMETRES
    last = '' if len(trial.goals) == 1 else f', after {trial.goals[-1].time:.2f} s'
    chart = Chart(
        f'Simulated minus measured{last}', 'place along the DLO, from its first point [m]', 'difference [mm]',
        ', '.join(f'{axis}: {values.min():.1f} to {values.max():.1f} mm'
                  for axis, values in zip('xyz', residuals.T, strict=True)))
    found = result.examination
    if found is not None and np.isfinite(found.noise):
        noise = np.full(len(places), DEVIATIONS * found.noise * MILLIMETRES)
        chart.band(places, -noise, noise, GREY, 'noise of the measured points (90 % of it)')
    for axis, values, colour in zip('xyz', residuals.T, COORDINATE_COLOURS, strict=True):
        chart.line(places, values, colour, f'in {axis}{", up" if axis == "z" else ""}', width=1.8)
    return chart


def _residuals(result: CalibrationResult, k: int) -> Floats:
    """Return (g, n, 3) [m] simulated minus measured."""
    return np.asarray(result.chains[k] - np.stack([goal.chain.points for goal in result.trials[k].goals]))


def _band(result: CalibrationResult, k: int) -> Floats:
    """Return (n,) [mm] how far each point of a trial may lie elsewhere, the most of the goals shown."""
    assert result.examination is not None
    band = ResidualLayout.of(result.trials).by_point(result.examination.band)[k]
    return np.asarray(band[shown_goals(len(result.trials[k].goals))].max(axis=0) * MILLIMETRES)


def _line(result: CalibrationResult, line: Line) -> Chart:
    found = result.parameters[line.name]
    errors = line.errors / max(result.errors.rms, SMALLEST_ERROR)
    scores = line.scores / max(result.best.score, SMALLEST_SCORE)
    shown = np.concatenate([errors, scores])
    shown = shown[np.isfinite(shown) & (shown > 0)]
    low, high = (min(shown.min(initial=1.0), 0.8), max(shown.max(initial=1.0), 1.25))
    chart = Chart(
        f'Along {line.name}', f'{line.name} (0 to 100)', 'times that of the result',
        f'from {line.values[0]:.0f} to {line.values[-1]:.0f} the error is up to {errors.max():.3g} times, '
        f'the score up to {scores.max():.3g} times that of the result', logarithmic=True)
    inside = np.clip([found.lower, found.upper], line.values[0], line.values[-1])
    chart.band(inside, np.full(2, low), np.full(2, high), BLUE, '90 % interval')
    chart.line(line.values, scores, GREY, 'difference score', width=1.5, dashes='5 3')
    chart.line(line.values, errors, SIMULATED, 'root mean square error of the points')
    chart.marks(line.values, errors, SIMULATED, size=2.5)
    chart.marks(np.array([found.value]), np.ones(1), RED, 'the result', shape=RING, size=6)
    return chart


def _draw_region(chart: Chart, result: CalibrationResult, plane: Plane) -> None:
    """Draw where both parameters are with 90 % probability, as far as it lies in the plane."""
    found = result.examination
    if found is None or not found.regular or found.uncertainty.covariance is None:
        return
    chosen = [result.space.free.index(name) for name in plane.names]
    values, vectors = np.linalg.eigh(found.uncertainty.covariance[np.ix_(chosen, chosen)])
    radius = np.sqrt(-2 * np.log(0.1))  # of 90 % of a normal distribution in two dimensions
    angles = np.linspace(0, 2 * np.pi, 120)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    middle = result.best.point[chosen]
    region = (middle[:, None] + vectors @ (np.sqrt(values)[:, None] * radius * circle)) * SCALE
    ends = np.array([plane.values[:, 0], plane.values[:, -1]]).T
    outside = ((region < ends[:, :1]) | (region > ends[:, 1:])).any(axis=0)
    region[:, outside] = np.nan
    chart.line(region[0], region[1], RED, 'both are in there with 90 % probability', dashes='4 3')


def _scale(what: str, unit: str, low: float, high: float) -> str:
    colours = ', '.join(cell_colour(share) for share in np.linspace(0, 1, 5).tolist())
    return (f'<p class="scale">{what}: {low:.3g} {unit} <span style="background:linear-gradient(90deg, '
            f'{colours})">'
            f'</span> {high:.3g} {unit}</p>')
