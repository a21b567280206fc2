# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drawings of what a DLO remembers: its rest shape, and the moment that bends it to and fro."""

from __future__ import annotations

from typing import Sequence, TYPE_CHECKING

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import (
    bending_moments,
    BY_NAME,
    kept_curvature,
    LOCKING,
    measured,
    natural_curvature,
    number,
    rest_shape,
    STIFFNESS_KNOTS,
)
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.report.figure import BAND, BLUE, FAINT, OBSERVED, Panel, panel, SIMULATED
from dlo_calibration.report.sentences import keeps_bends

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRAWS, SHOWN = 60, 54  # of the posterior: nine of ten are shown
FINE, COARSE = 240, 60  # pieces of a curve that is alone, and of one among many
PREFIXES = ((1.0, ''), (1e-3, 'm'), (1e-6, 'µ'))  # of units


def rest_shape_panels(result: CalibrationResult) -> list[Panel]:
    """Draw the rest shape in its plane and across it; nothing if it is straight."""
    physical, length = result.physical(), result.length
    if not natural_curvature(physical, np.linspace(0, 1, FINE)).any():
        return []
    shape, = _shapes([physical], length, FINE)
    drawn = _shapes(Posterior.of(result).draws(DRAWS, seed=0), length, COARSE)
    shape = (shape - shape.mean(axis=0)) @ _best_axes(shape)
    places, fine = np.linspace(0, len(shape) - 1, drawn.shape[1]), np.arange(len(shape))
    same = np.stack([np.interp(places, fine, values) for values in shape.T], axis=1)
    moved = np.array([_moved_onto(curve, same) for curve in drawn])
    moved = moved[np.argsort(np.square(moved - same).sum(axis=(1, 2)), kind='stable')[:SHOWN]]
    words = (f'The rest shape, {measured(length, "m")} long: its ends are '
             f'{measured(float(np.linalg.norm(shape[-1] - shape[0])), "m")} apart, and it extends '
             f'{measured(float(np.ptp(shape[:, 2])), "m")} across the plane that fits it best')

    def view(columns: list[int], title: str, legend: bool) -> Panel:
        return panel(lambda axes: _draw_shape(axes, shape[:, columns], moved[..., columns], title),
                     f'{words}; {title}', legend)

    return [view([0, 1], 'rest shape, on the plane that fits it best', legend=True),
            view([0, 2], 'rest shape, from the side', legend=False)]


def moment_panels(result: CalibrationResult) -> list[Panel]:
    """Draw the moment while a piece of the DLO is bent to and fro; nothing if no friction is known."""
    if not keeps_bends(result):
        return []
    physical, space = result.physical(), result.space
    friction, slip, locking = (physical[name] for name in ('bending_friction', 'bending_slip', LOCKING))
    kept = kept_curvature(friction, locking)
    flexibility = result.values.get(
        'flexibility', space.fixed.get('flexibility', BY_NAME['flexibility'].default))
    stiffness, unit = space.reported('flexibility', flexibility)
    # As far as the trials bent it, but so that slip and what stays can be seen.
    reach = float(np.clip(_largest_curvature(result.chains), friction + 3 * slip, 4 * (friction + slip)))
    largest = float(bending_moments(np.array([0, reach]), stiffness, friction, slip, locking)[-1])
    scale, prefix = next((pair for pair in PREFIXES if largest >= pair[0]), PREFIXES[-1])
    stiffness, unit = stiffness / scale, prefix + unit.replace('N m^2', 'N m')
    first = np.linspace(0, reach, FINE + 1)
    path = np.concatenate([first, np.linspace(reach, -reach, 2 * FINE + 1)[1:],
                           np.linspace(-reach, reach, 2 * FINE + 1)[1:]])
    moments = bending_moments(path, stiffness, friction, slip, locking)

    def draw(axes: Axes) -> None:
        to, fro = slice(FINE, 3 * FINE + 1), slice(3 * FINE, None)
        axes.fill(path[FINE:], moments[FINE:], color=BAND, linewidth=0, label='work that friction takes')
        axes.plot(first, moments[:FINE + 1], '--', color=FAINT, linewidth=1.5, label='the first time')
        axes.plot(path[to], moments[to], color=BLUE, linewidth=2, label='while it is bent back')
        axes.plot(path[fro], moments[fro], color=SIMULATED, linewidth=2, label='while it is bent again')
        axes.axhline(0, color=FAINT, linewidth=0.6, zorder=0.5)
        axes.axvline(0, color=FAINT, linewidth=0.6, zorder=0.5)
        axes.plot([slip], [np.interp(slip, first, moments[:FINE + 1])], 's', color=OBSERVED, markersize=6,
                  label=f'bending_slip: from {measured(slip, "1/m")} on, the strands slip')
        axes.plot([kept], [0], 'o', color=OBSERVED, markersize=7,
                  label=f'bending_friction: {measured(kept, "1/m")} stay when it is released')
        one = 'part 1' if space.parts > 1 else 'its first end' if STIFFNESS_KNOTS[0] in space.free else 'it'
        axes.set(title=f'moment that bends {one} to and fro',
                 xlabel='curvature, from that of the rest shape [1/m]', ylabel=f'moment [{unit}]')
        axes.grid(alpha=0.3)

    return [panel(draw, (
        f'The moment, up to {number(moments.max())} {unit}, while a piece of the DLO is bent to and fro: '
        f'{measured(kept, "1/m")} of curvature stay when it is released; the strands slip after '
        f'{measured(slip, "1/m")}'))]


def _largest_curvature(chains: Sequence[Floats]) -> float:
    """Return the largest curvature [1/m] of the chains (g, n, 3) [m] of each trial."""
    largest = 0.0
    for chain in chains:
        segments = np.diff(chain, axis=1)
        lengths = np.linalg.norm(segments, axis=2)
        bends = np.linalg.norm(np.diff(segments / lengths[..., None], axis=1), axis=2)
        largest = max(largest, float((2 * bends / (lengths[:, 1:] + lengths[:, :-1])).max()))
    return largest


def _shapes(drawn: Sequence[dict[str, float]], length: float, pieces: int) -> Floats:
    """Return the rest shapes (k, pieces + 1, 3) [m] for k sets of physical values, of their own lengths."""
    places = np.linspace(0, 1, pieces + 1)[1:-1]
    curvatures = np.array([natural_curvature(values, places) * values['length_scale'] for values in drawn])
    lengths = np.array([values['length_scale'] for values in drawn])
    return np.asarray(rest_shape(curvatures, length) * lengths[:, None, None])


def _best_axes(shape: Floats) -> Floats:
    """Return right-handed axes, the columns of (3, 3): a shape extends most along the first of them."""
    first, second, _ = np.linalg.svd(shape - shape.mean(axis=0), full_matrices=False)[2]
    first = first * (1.0 if first @ (shape[-1] - shape[0]) >= 0 else -1.0)  # the first point is on the left
    second = second * (1.0 if second[np.argmax(np.abs(second))] > 0 else -1.0)  # as a sign is arbitrary
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _moved_onto(points: Floats, target: Floats) -> Floats:
    """Turn and shift (n, 3) points onto others (Kabsch, Acta Crystallographica A32, 1976)."""
    middle = points.mean(axis=0)
    left, _, right = np.linalg.svd((points - middle).T @ (target - target.mean(axis=0)))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return np.asarray((points - middle) @ (left * mirror) @ right + target.mean(axis=0))


def _draw_shape(axes: Axes, shape: Floats, drawn: Floats, title: str) -> None:
    """Draw (n, 2) points of the rest shape, (k, m, 2) draws of it, and a bar for the scale."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(drawn), colors=BAND, linewidths=2.5, zorder=1,
                                       label='nine of ten draws from the posterior'), autolim=False)
    axes.plot(*shape.T, color=SIMULATED, linewidth=2, label='rest shape', zorder=2)
    axes.plot(*shape[0], 'o', markersize=11, markerfacecolor='none', markeredgecolor=OBSERVED,
              linestyle='none', zorder=3, label='first point of the DLO')
    extent = float(np.ptp(shape, axis=0).max())
    step = 10.0 ** np.floor(np.log10(extent / 2))
    bar = float(max(size * step for size in (1, 2, 5) if size * step <= extent / 2))
    axes.set_aspect('equal', adjustable='datalim')
    axes.margins(0.2)
    for side in axes.spines.values():
        side.set_visible(False)
    axes.set(title=title, xticks=[], yticks=[])
    left = float(shape[:, 0].min())
    axes.annotate('', xy=(left, -0.06), xytext=(left + bar, -0.06), xycoords=('data', 'axes fraction'),
                  arrowprops={'arrowstyle': '|-|,widthA=0.3,widthB=0.3'})
    axes.annotate(f'{number(bar)} m', (left + bar / 2, -0.09), xycoords=('data', 'axes fraction'),
                  ha='center', va='top')
