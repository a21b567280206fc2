# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The picture and the film of `letters.py`: ropes on a table, seen from above, to scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence, TYPE_CHECKING

from matplotlib.animation import PillowWriter
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
import numpy as np

from dlo_calibration import Chain
from dlo_calibration.model.chain import Floats
from dlo_calibration.report.figure import blank_figure, BLUE, GREEN, settings, SIMULATED
from dlo_calibration.writing import whole

if TYPE_CHECKING:
    from letters import Laid

COLOURS = (SIMULATED, BLUE, GREEN)  # of the ropes
TABLE, INK, PALE, HAND = '#f5f1e8', '#3a3630', '#cfc8ba', '#1d1b18'
LIGHT = np.array([-0.45, 0.9])  # where it comes from
BETWEEN = 0.11  # m between two letters
PRINTED, SHOWN = 160, 100  # dots per inch of the picture and of the film
EVERY, RATE, STILL = 3, 10, 12  # of the film: a hand moves 3 cm a frame; frames a second; frames at rest


def mixed(colour: str, other: str, share: float) -> Any:
    """Return a colour with a share of another one."""
    return tuple((1 - share) * np.array(to_rgb(colour)) + share * np.array(to_rgb(other)))


class Rope:
    """
    A rope on a table, seen from above; its width is to scale.

    :param radius: [m]; `length` [m] of the DLO.
    """

    def __init__(self, axes: Any, colour: str, radius: float, length: float, twisted: bool = True) -> None:
        self._radius, self._count = radius, max(200, round(length / radius * 1.5))
        layers = [(2.0, 0.7, 'black', 0.05), (1.4, 0.6, 'black', 0.12)]  # width, shift from the light, ...
        layers += [(share, -0.45 * (1 - share), mixed(colour, other, much), 1.0) for share, other, much in (
            (1.0, 'black', 0.45), (0.86, 'black', 0.2), (0.66, 'black', 0.0), (0.42, 'white', 0.18),
            (0.2, 'white', 0.36))]
        self._layers = [(share, shift, axes.add_collection(PolyCollection([], color=shade, alpha=alpha,
                                                                          linewidth=0)))
                        for share, shift, shade, alpha in layers]
        self._strands = axes.add_collection(LineCollection(
            [], color=mixed(colour, 'black', 0.62), alpha=0.55, linewidth=0.55)) if twisted else None

    def show(self, points: Floats) -> None:
        """Lay it at (n, 2) points [m]."""
        chain = Chain(np.column_stack([points, np.zeros(len(points))]))
        curve = chain.resample(np.linspace(0, chain.length, self._count))[:, :2]
        along = np.gradient(curve, axis=0)
        along /= np.linalg.norm(along, axis=1)[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        for share, shift, layer in self._layers:
            middle, half = curve - shift * self._radius * LIGHT, share * self._radius
            begin = self._cap(middle[0], -along[0], -across[0], half)
            end = self._cap(middle[-1], along[-1], across[-1], half)
            left, right = middle + half * across, middle - half * across
            layer.set_verts([np.concatenate([left, end, right[::-1], begin])])
        if self._strands is not None:
            step = max(1, round(0.95 * self._radius / (chain.length / self._count)))
            places = np.linspace(-1, 1, 7)
            skew = np.rint((places + np.sin(np.pi * places) / 4) * step * 0.9).astype(int)
            sides = 0.97 * self._radius * places[:, None]
            self._strands.set_segments([curve[k + skew] + sides * across[k + skew] for k in
                                        range(step - skew.min(), self._count - skew.max(), step)])

    def _cap(self, end: Floats, along: Floats, across: Floats, half: float) -> Floats:
        angles = np.linspace(0, np.pi, 9)[:, None]
        return end + half * (np.cos(angles) * across + np.sin(angles) * along)


def draw_letters(letters: Sequence[Laid], path: Path) -> None:
    """Write the PNG: the letters, and below each the steps that led to it."""
    with settings():
        figure = blank_figure(11, 7.3, layout=None)
        figure.set_facecolor(TABLE)
        axes = figure.add_axes((0.01, 0.385, 0.98, 0.605))
        lefts, width, height = _places([laid.chains[-1] for laid in letters])
        for laid, colour, left in zip(letters, COLOURS, lefts, strict=True):
            shape = laid.chains[-1][:, :2]
            rope = Rope(axes, colour, laid.dlo.radius, laid.dlo.length)
            rope.show(shape + [left - shape[:, 0].min(), -shape[:, 1].min()])
            axes.text(left + np.ptp(shape[:, 0]) / 2, -0.022, _caption(laid), color=INK, fontsize=10,
                      ha='center', va='top', linespacing=1.5)
        _bare(axes, (-0.05, width + 0.05), (-0.062, height + 0.012))
        _draw_steps(figure, letters)
        figure.text(0.5, 0.022, 'Each step: the rope before (grey), the way of the hand, the rope after, and '
                    'its mean distance from the goal (dotted) in percent of the length.', color=INK,
                    fontsize=8.5, ha='center')
        with whole(path) as new:
            figure.savefig(new, format='png', dpi=PRINTED)
    _fewer_colours(path)


def _draw_steps(figure: Any, letters: Sequence[Laid]) -> None:
    """Draw the steps of all letters in one row, to the same scale."""
    count = sum(len(laid.chains) for laid in letters)
    gap, left = 0.03, 0.02
    each = (1 - 2 * left - gap * (len(letters) - 1)) / count
    extents = [_extent(laid) for laid in letters]
    half = np.max([(high - low) / 2 for low, high in extents], axis=0)
    for laid, colour, (low, high) in zip(letters, COLOURS, extents, strict=True):
        middle = (low + high) / 2
        for k, chain in enumerate(laid.chains):
            axes = figure.add_axes((left, 0.13, each, 0.235))
            axes.plot(*laid.goal[:, :2].T, linestyle=(0, (1, 1.6)), color=INK, linewidth=0.8, alpha=0.6)
            if k:
                axes.plot(*laid.chains[k - 1][:, :2].T, color=PALE, linewidth=2.2, solid_capstyle='round')
            axes.plot(*chain[:, :2].T, color=colour, linewidth=2.4, solid_capstyle='round')
            if k:
                _draw_way(axes, laid.actions[k - 1])
            _bare(axes, *np.transpose([middle - half, middle + half]))
            figure.text(left + each / 2, 0.112, f'{k or "start"}\n{laid.errors[k]:.2g} %', color=INK,
                        fontsize=8.5, ha='center', va='top', linespacing=1.35)
            left += each
        left += gap


def _draw_way(axes: Any, action: Any) -> None:
    for hand in action.hands:
        (x, y), (u, v) = hand.positions[[0, -1], :2]
        axes.plot([x], [y], 'o', color=HAND, markersize=2.6, zorder=5)
        axes.annotate('', (u, v), (x, y), zorder=5, arrowprops={
            'arrowstyle': '-|>,head_length=0.25,head_width=0.12', 'color': HAND, 'linewidth': 0.9,
            'shrinkA': 0, 'shrinkB': 0})


def draw_film(letters: Sequence[Laid], path: Path) -> None:
    """Write the GIF: all ropes at the same time, about three times as fast as in reality."""
    with settings():
        figure = blank_figure(7.6, 5.4, layout=None)
        figure.set_facecolor(TABLE)
        axes = figure.add_axes((0.01, 0.01, 0.98, 0.93))
        lefts, width, _ = _places([np.concatenate([laid.chains[0], laid.chains[-1]]) for laid in letters])
        ropes, offsets, hands = [], [], []
        for laid, colour, left in zip(letters, COLOURS, lefts, strict=True):
            both = np.concatenate([laid.chains[0], laid.chains[-1]])
            offsets.append(np.array([left - both[:, 0].min(), -laid.chains[-1][:, 1].min()]))
            ropes.append(Rope(axes, colour, 1.3 * laid.dlo.radius, laid.dlo.length, twisted=False))
            hands += axes.plot([], [], 'o', color=HAND, markersize=7, zorder=9)
        everything = np.concatenate([
            chains.reshape(-1, 3)[:, :2] + offset for laid, offset in zip(letters, offsets, strict=True)
            for chains in (laid.chains, *laid.courses)])
        _bare(axes, *np.transpose([everything.min(axis=0) - 0.03, everything.max(axis=0) + 0.03]))
        title = figure.text(0.5, 0.955, '', color=INK, ha='center', fontsize=12)
        writer = PillowWriter(fps=RATE)
        with whole(path) as new, writer.saving(figure, str(new), dpi=SHOWN):
            for text, chains, places in _frames(letters):
                title.set_text(text)
                for k, offset in enumerate(offsets):
                    ropes[k].show(chains[k][:, :2] + offset)
                    hands[k].set_data(*(places[k][:2] + offset)[:, None])
                writer.grab_frame()


def _frames(letters: Sequence[Laid]) -> Any:
    """Yield a title, the chains of all ropes, and where the hands are; nan: the hand is open."""
    nowhere = [np.full(3, np.nan)] * len(letters)
    for _ in range(STILL):
        yield 'three calibrated ropes', [laid.chains[0] for laid in letters], nowhere
    most = max(len(laid.actions) for laid in letters)
    for k in range(most):
        acting = [k < len(laid.actions) for laid in letters]
        last = max(len(laid.courses[k]) for laid, acts in zip(letters, acting, strict=True) if acts)
        for m in range(0, last, EVERY):
            chains, places = [], []
            for laid, acts in zip(letters, acting, strict=True):
                moving = acts and m < len(laid.courses[k])
                chains.append(laid.courses[k][m] if moving else laid.chains[min(k + acts, len(laid.actions))])
                hand = laid.actions[k].hands[0] if moving else None
                places.append(np.full(3, np.nan) if hand is None else hand.positions_at(
                    hand.start + (m + 1) / (len(laid.courses[k]) + 1) * (hand.end - hand.start))[0])
            yield f'action {k + 1}', chains, places
        for _ in range(STILL // 2 if k < most - 1 else 3 * STILL):
            yield f'action {k + 1}' if k < most - 1 else 'D L O', [
                laid.chains[min(k + 1, len(laid.actions))] for laid in letters], nowhere


def _places(shapes: Sequence[Floats]) -> tuple[list[float], float, float]:
    """Return where each shape begins when they stand side by side, and the width and height of all [m]."""
    widths = [float(np.ptp(points[:, 0])) for points in shapes]
    lefts = [sum(widths[:k]) + BETWEEN * k for k in range(len(widths))]
    return lefts, lefts[-1] + widths[-1], max(float(np.ptp(points[:, 1])) for points in shapes)


def _extent(laid: Laid) -> tuple[Floats, Floats]:
    everything = np.concatenate([laid.chains.reshape(-1, 3), *(hand.positions for action in laid.actions
                                                              for hand in action.hands)])[:, :2]
    return everything.min(axis=0) - 0.015, everything.max(axis=0) + 0.015


def _bare(axes: Any, x: Sequence[float], y: Sequence[float]) -> None:
    """Show nothing but what is drawn, with equal scales."""
    axes.set(xlim=x, ylim=y, aspect='equal')
    axes.axis('off')


def _caption(laid: Laid) -> str:
    dlo = laid.dlo
    return (f'{100 * dlo.length:.0f} cm, {1e3 * dlo.mass:.0f} g, {2e3 * dlo.radius:.0f} mm thick\n'
            f'after {len(laid.actions)} actions {10 * laid.errors[-1] * dlo.length:.1f} mm from the goal')


def _fewer_colours(path: Path) -> None:
    """Make a PNG smaller."""
    from PIL import Image

    picture = Image.open(path).convert('RGB')
    picture = picture.quantize(192, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    with whole(path) as new:
        picture.save(new, format='png', optimize=True)
