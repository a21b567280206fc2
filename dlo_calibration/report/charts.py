# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Charts: axes with lines, marks, bands and coloured cells as SVG, which stands in a page as it is."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
import math
from typing import Iterable

import numpy as np

from dlo_calibration.model.chain import Floats

WIDTH, HEIGHT = 460, 320  # of a chart, in the units of its text: 13 to a line
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 30, 48  # margins around the axes
TICKS = 5
MOST_POINTS = 400  # of a line; more are not to be told apart
MARGIN = 0.06  # of the range, left free around what is drawn
INK, GRID = '#222', '#ddd'
LOW_COLOUR, HIGH_COLOUR = (255, 247, 224), (22, 60, 110)  # of cells

CIRCLE, RING, SQUARE, TRIANGLE, CROSS = 'circle', 'ring', 'square', 'triangle', 'cross'
LINE, BAND, CELL = 'line', 'band', 'cell'


@dataclass(frozen=True)
class Entry:
    """A line of a legend: what is drawn in a colour, as a line, a band or a shape."""

    label: str
    colour: str
    kind: str
    dashes: str = ''


@dataclass(frozen=True)
class _Drawn:
    """What is drawn through, around or at (n, 2) points."""

    kind: str
    points: Floats
    colour: str
    size: float = 0.0
    dashes: str = ''


class Chart:
    """
    A chart; what is drawn later lies above.

    :param description: what it shows, in words, for those who cannot see it.
    :param logarithmic: whether the vertical axis is; values <= 0 are not drawn then.
    :param equal: both axes have the same scale.
    :param x_ends: of the horizontal axis; None: as what is drawn needs, as with `y_ends`.
    """

    def __init__(self, title: str, x_label: str, y_label: str, description: str, *, logarithmic: bool = False,
                 equal: bool = False, x_ends: tuple[float, float] | None = None,
                 y_ends: tuple[float, float] | None = None) -> None:
        self._words = title, x_label, y_label, description
        self._logarithmic, self._equal = logarithmic, equal
        self._ends = x_ends, y_ends
        self._drawn: list[_Drawn] = []
        self.entries: list[Entry] = []

    def line(self, xs: Floats, ys: Floats, colour: str, label: str = '', *, width: float = 2.0,
             dashes: str = '') -> None:
        """Draw a line through (n,) points; it is broken where one is not finite."""
        step = max(1, math.ceil(len(xs) / MOST_POINTS))
        chosen = np.unique([*range(0, len(xs), step), len(xs) - 1])
        self._add(LINE, np.asarray(xs)[chosen], np.asarray(ys)[chosen], colour, width, dashes)
        self._explain(label, colour, LINE, dashes)

    def marks(self, xs: Floats, ys: Floats, colour: str, label: str = '', *, shape: str = CIRCLE,
              size: float = 3.0) -> None:
        """Draw a mark at each of (n,) points."""
        self._add(shape, xs, ys, colour, size)
        self._explain(label, colour, shape)

    def band(self, xs: Floats, lows: Floats, highs: Floats, colour: str, label: str = '') -> None:
        """Fill what is between (n,) lower and (n,) upper values."""
        self._add(BAND, np.concatenate([xs, np.asarray(xs)[::-1]]),
                  np.concatenate([lows, np.asarray(highs)[::-1]]), colour)
        self._explain(label, colour, BAND)

    def cells(self, xs: Floats, ys: Floats, shares: Floats) -> None:
        """Fill cells around (k,) times (m,) places, coloured by (k, m) shares of 0..1; not if not finite."""
        x_edges, y_edges = _edges(xs), _edges(ys)
        for i in range(len(xs)):
            for j in range(len(ys)):
                self._add(CELL, x_edges[[i, i + 1, i + 1, i]], y_edges[[j, j, j + 1, j + 1]],
                          cell_colour(float(shares[i, j])))

    def svg(self) -> str:
        """Return the element."""
        title, x_label, y_label, description = self._words
        frame = self._frame()
        parts = [f'<text x="{WIDTH // 2}" y="18" text-anchor="middle" font-weight="bold">{escape(title)}'
                 '</text>']
        for value, text in frame.x_ticks():
            at = _short(frame.x(value))
            parts.append(f'<path d="M{at} {TOP}V{HEIGHT - BOTTOM}" stroke="{GRID}"/>'
                         f'<text x="{at}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{text}</text>')
        for value, text in frame.y_ticks():
            at = _short(frame.y(value))
            parts.append(f'<path d="M{LEFT} {at}H{WIDTH - RIGHT}" stroke="{GRID}"/>'
                         f'<text x="{LEFT - 6}" y="{at}" dy="4" text-anchor="end">{text}</text>')
        parts += [self._element(frame, one) for one in self._drawn]
        parts.append(
            f'<path d="M{LEFT} {TOP}V{HEIGHT - BOTTOM}H{WIDTH - RIGHT}" fill="none" stroke="{INK}"/>'
            f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 10}" text-anchor="middle">'
            f'{escape(x_label)}</text><text transform="translate(15 {(TOP + HEIGHT - BOTTOM) / 2}) '
            f'rotate(-90)" text-anchor="middle">{escape(y_label)}</text>')
        return (f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
                f'aria-label="{escape(f"{title}: {description}")}" font-size="13" fill="{INK}">'
                f'{"".join(parts)}</svg>')

    def _add(self, kind: str, xs: Floats, ys: Floats, colour: str, size: float = 0.0,
             dashes: str = '') -> None:
        self._drawn.append(_Drawn(kind, np.stack([xs, ys], axis=1).astype(float), colour, size, dashes))

    def _explain(self, label: str, colour: str, kind: str, dashes: str = '') -> None:
        if label:
            self.entries.append(Entry(label, colour, kind, dashes))

    def _visible(self, points: Floats) -> Floats:
        """Return whether each of (n, 2) points can be drawn."""
        seen = np.isfinite(points).all(axis=1)
        return np.asarray(seen & (points[:, 1] > 0) if self._logarithmic else seen)

    def _frame(self) -> _Frame:
        shown = [one.points[self._visible(one.points)] for one in self._drawn]
        points = np.concatenate([*shown, np.zeros((0, 2))])
        if not len(points):
            points = np.ones((1, 2))
        x_low, x_high = self._ends[0] or _around(points[:, 0])
        heights = np.log10(points[:, 1]) if self._logarithmic else points[:, 1]
        y_low, y_high = self._ends[1] or _around(heights)
        if self._equal:
            scale = max((x_high - x_low) / (WIDTH - LEFT - RIGHT), (y_high - y_low) / (HEIGHT - TOP - BOTTOM))
            x_low, x_high = _widened(x_low, x_high, scale * (WIDTH - LEFT - RIGHT))
            y_low, y_high = _widened(y_low, y_high, scale * (HEIGHT - TOP - BOTTOM))
        return _Frame(x_low, x_high, y_low, y_high, self._logarithmic)

    def _element(self, frame: _Frame, one: _Drawn) -> str:
        seen = self._visible(one.points)
        if one.kind == LINE:
            dashes = f' stroke-dasharray="{one.dashes}"' if one.dashes else ''
            path = ''.join(('L' if k and seen[k - 1] else 'M') + frame.place(point)
                           for k, point in enumerate(one.points) if seen[k])
            return (f'<path d="{path}" fill="none" stroke="{one.colour}" stroke-width="{one.size:g}" '
                    f'stroke-linejoin="round"{dashes}/>')
        if one.kind in (BAND, CELL):
            path = 'L'.join(frame.place(point) for point in one.points[seen])
            how = 'fill-opacity="0.25"' if one.kind == BAND else 'shape-rendering="crispEdges"'
            return f'<path d="M{path}Z" fill="{one.colour}" {how}/>' if path and one.colour else ''
        path = ''.join(f'M{frame.place(point)}{_outline(one.kind, one.size)}' for point in one.points[seen])
        return f'<path d="{path}" {_ink(one.kind, one.colour)}/>'


@dataclass(frozen=True)
class _Frame:
    """Places on the paper; on a logarithmic axis, `y_low` and `y_high` are exponents of 10."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    logarithmic: bool

    def x(self, value: float) -> float:
        return LEFT + (value - self.x_low) / (self.x_high - self.x_low) * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        height = math.log10(value) if self.logarithmic else value
        return HEIGHT - BOTTOM - (height - self.y_low) / (self.y_high - self.y_low) * (HEIGHT - TOP - BOTTOM)

    def place(self, point: Floats) -> str:
        return f'{_short(self.x(float(point[0])))} {_short(self.y(float(point[1])))}'

    def x_ticks(self) -> list[tuple[float, str]]:
        return _ticks(self.x_low, self.x_high)

    def y_ticks(self) -> list[tuple[float, str]]:
        if not self.logarithmic:
            return _ticks(self.y_low, self.y_high)
        for steps in ((1,), (1, 3), (1, 2, 5)):
            decades = range(math.floor(self.y_low), math.ceil(self.y_high) + 1)
            found = [(10.0**decade * step, f'{10.0**decade * step:g}') for decade in decades for step in steps
                     if self.y_low <= math.log10(10.0**decade * step) <= self.y_high]
            if len(found) >= TICKS - 2:
                return found
        return _ticks(10**self.y_low, 10**self.y_high)


def legend(charts: Iterable[Chart]) -> str:
    """Return a list that explains what is drawn in some charts, everything once."""
    entries = dict.fromkeys(entry for chart in charts for entry in chart.entries)
    return '<ul class="legend">' + ''.join(
        f'<li><svg width="28" height="14" aria-hidden="true">{_sample(entry)}</svg> '
        f'{escape(entry.label)}</li>'
        for entry in entries) + '</ul>' if entries else ''


def cell_colour(share: float) -> str:
    """Return the colour of a share of 0..1, from light to dark; none where it is not finite."""
    if not math.isfinite(share):
        return ''
    share = min(max(share, 0.0), 1.0)
    return 'rgb({},{},{})'.format(*(round(low + (high - low) * share)
                                    for low, high in zip(LOW_COLOUR, HIGH_COLOUR, strict=True)))


def _sample(entry: Entry) -> str:
    if entry.kind == BAND:
        return f'<path d="M2 2H26V12H2Z" fill="{entry.colour}" fill-opacity="0.25"/>'
    if entry.kind == LINE:
        dashes = f' stroke-dasharray="{entry.dashes}"' if entry.dashes else ''
        return f'<path d="M1 7H27" stroke="{entry.colour}" stroke-width="2.5"{dashes}/>'
    return f'<path d="M14 7{_outline(entry.kind, 4.0)}" {_ink(entry.kind, entry.colour)}/>'


def _outline(shape: str, r: float) -> str:
    """Return the path of a shape around the place where the pen is."""
    if shape in (CIRCLE, RING):
        return f'm-{r:g} 0a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 -{2 * r:g} 0z'
    if shape == SQUARE:
        return f'm-{r:g} -{r:g}h{2 * r:g}v{2 * r:g}h-{2 * r:g}z'
    if shape == TRIANGLE:
        return f'm0 -{1.2 * r:g}l{r:g} {2 * r:g}h-{2 * r:g}z'
    return f'm-{r:g} -{r:g}l{2 * r:g} {2 * r:g}m-{2 * r:g} 0l{2 * r:g} -{2 * r:g}'


def _ink(shape: str, colour: str) -> str:
    return f'fill="none" stroke="{colour}" stroke-width="2"' if shape in (RING, CROSS) else f'fill="{colour}"'


def _short(value: float) -> str:
    return f'{value:.1f}'.removesuffix('.0')


def _around(values: Floats) -> tuple[float, float]:
    """Return the ends of an axis that shows all values."""
    low, high = float(values.min()), float(values.max())
    room = MARGIN * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _widened(low: float, high: float, width: float) -> tuple[float, float]:
    middle = (low + high) / 2
    return middle - width / 2, middle + width / 2


def _edges(places: Floats) -> Floats:
    """Return (k + 1,) the edges of cells around (k,) places; the first and the last are those places."""
    return np.concatenate([places[:1], (places[1:] + places[:-1]) / 2, places[-1:]])


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Return round values between two ends, with their texts."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(one * power for one in (1, 2, 5, 10) if one * power >= 0.7 * rough)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    texts = {k: f'{k * step:.{digits}f}'.replace('-', '−') if k else '0' for k in range(first, last + 1)}
    return [(k * step, text) for k, text in texts.items()]
