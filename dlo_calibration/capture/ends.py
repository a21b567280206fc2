# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Where the line begins and ends, and how it goes on where the DLO is hidden.

The outline of the DLO closes at its end, so that its edges there say nothing about the middle: the last part
of the line goes on with the curvature before it, up to where the colours of the DLO end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from dlo_calibration.capture.middle import Middle
from dlo_calibration.capture.strip import evenly, lengths, odds, straighten, Strip
from dlo_calibration.model.chain import Floats

SURE = 0.35  # quality below which the line is not sure
SEEN = 1.0  # median logarithm of the odds from which on the DLO is not hidden
BRIDGED = 1.6  # widths: a shorter gap between sure parts is sure, too
HIDDEN = 1.2  # widths: over a longer gap the line is drawn anew
CAP = 1.6  # half widths at the end that say nothing about the middle
EDGE = 0.35  # half widths around an end, in which its edge is
END_STEP = 0.2  # half widths between places where an end is looked for
BEFORE = 4.5  # half widths before these, whose curvature goes on


def between_ends(pixels: NDArray[np.uint8], middle: Middle, clicks: Floats, near: float,
                 spacing: float) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """
    Return the line (n, 2) between its ends, where it is sure (n,), and the strength of its edges (n,).

    :param middle: of a line that goes on beyond the first and last click.
    :param clicks: (k, 2) [px].
    :param near: how far an end may be from its click [px], at least.
    :param spacing: of the points [px].
    """
    half = float(np.median(middle.half))
    near = max(near, 4 * half)
    line = middle.line
    sure = middle.quality > SURE
    for order in (1, -1):
        way = line[::order]
        arc = lengths(way)
        end = _end(arc, middle.inside[::order], _passed(way, arc, clicks[::order][0]), near)
        if end is not None:
            line = _extended(way, arc, end, half)[::order]
    line = _bridged(line, sure, middle.inside, clicks, 2 * half)
    ends = []
    for order in (1, -1):
        way = line[::order]
        arc = lengths(way)
        click = _passed(way, arc, clicks[::order][0])
        whole = float(arc[-1])
        way = evenly(way[:int(np.searchsorted(arc, click + near)) + 2], END_STEP * half)
        arc = lengths(way)
        part = straighten(pixels, way, np.full(len(way), half), np.linspace(-0.25, 0.25, 9))
        found = _end(arc, odds(middle.table, part.lab).mean(axis=1), click, near)
        found = click if found is None else _edge(arc, part, found, EDGE * half)
        ends.append(float(found if order == 1 else whole - found))
    arc = lengths(line)
    if ends[1] - ends[0] < 2 * spacing:
        return np.empty((0, 2)), np.empty(0, dtype=bool), np.empty(0)
    at = np.linspace(ends[0], ends[1], round((ends[1] - ends[0]) / spacing) + 1)
    even = np.column_stack([np.interp(at, arc, column) for column in line.T])
    # An end is as sure as what is before it.
    quality = np.interp(np.clip(at, ends[0] + 1.5 * half, ends[1] - 1.5 * half), arc, middle.quality)
    certain = quality > SURE
    for first, last in gaps(certain):
        if (last - first) * spacing <= BRIDGED * 2 * half and first > 0 and last < len(certain):
            certain[first:last] = True
    return even, certain, np.interp(at, arc, middle.edges.min(axis=1))


def _passed(line: Floats, arc: Floats, click: Floats) -> float:
    """Return the arc length at which the first half of a line (n, 2) passes a click (2,) [px]."""
    # The line may pass the click again, elsewhere.
    distance = np.where(arc < arc[-1] / 2, np.linalg.norm(line - click, axis=1), np.inf)
    return float(arc[np.argmin(distance)])


def gaps(sure: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List where the line is not sure: first index, and the one after the last."""
    edges = np.nonzero(np.diff(np.concatenate([[True], sure, [True]]).astype(int)))[0]
    return [(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def _end(arc: Floats, inside: Floats, click: float, near: float) -> float | None:
    """
    Return the arc length [px] at which the DLO begins near a click; None if it begins elsewhere.

    :param arc: (n,) [px].
    :param inside: (n,) or fewer, logarithm of the odds that there is the DLO.
    """
    window = np.nonzero(np.abs(arc[:len(inside)] - click) <= near)[0]
    total = np.cumsum(inside[window][::-1])[::-1]
    first = int(np.argmax(total))
    if not 1 < first < len(window) - 1:
        return None
    # Between the last station that is not the DLO and the next.
    return float(arc[window[first]] + arc[window[first - 1]]) / 2


def _edge(arc: Floats, part: Strip, near: float, reach: float) -> float:
    """Return the arc length [px] of the strongest change of colour along a strip, within reach of one."""
    colour = gaussian_filter1d(part.lab.mean(axis=1), 1.0, axis=0)
    change = np.linalg.norm(np.diff(colour, axis=0), axis=1)
    between = (arc[:len(colour)][1:] + arc[:len(colour)][:-1]) / 2
    window = np.nonzero(np.abs(between - near) <= reach)[0]
    if not len(window):
        return near
    weight = change[window] ** 4
    return float(weight @ between[window] / max(float(weight.sum()), 1e-12))


def _extended(line: Floats, arc: Floats, end: float, half: float) -> Floats:
    """Return a line (n, 2) whose first part goes on with the curvature behind it."""
    low, high = end + CAP * half, end + (CAP + BEFORE) * half
    behind = (arc >= low) & (arc <= high)
    if behind.sum() < 5:
        return line
    at = (arc - low) / half
    found = line.copy()
    before = arc < low
    weights = np.exp(-at[behind] / BEFORE)
    for column in range(2):
        parabola = np.polyfit(at[behind], line[behind, column], 2, w=weights)
        step = line[np.argmax(~before), column] - np.polyval(parabola, at[np.argmax(~before)])
        found[before, column] = np.polyval(parabola, at[before]) + step
    return found


def _beside_itself(line: Floats, arc: Floats, part: slice, width: float) -> bool:
    """Tell whether a part of a line (n, 2) lies beside another part of it, or across it."""
    places = np.arange(len(line))[part]
    apart = np.abs(arc[places][:, None] - arc) > 3 * width
    near = np.linalg.norm(line[places][:, None] - line, axis=2) < 1.5 * width
    return bool((apart & near).any())


def _bridged(line: Floats, sure: NDArray[np.bool_], inside: Floats, clicks: Floats,
             width: float) -> Floats:
    """Return a line (n, 2) that is smooth where the DLO is hidden, and goes through clicks there."""
    found = line.copy()
    arc = lengths(line)
    clicked = np.array([int(np.argmin(np.linalg.norm(line - click, axis=1))) for click in clicks])
    drawn = sure.copy()
    for first, last in gaps(sure):
        # What has the DLO's colours is not hidden, however its edges look; but beside another strand the line
        # may have strayed onto that.
        drawn[first:last] = (arc[last - 1] - arc[first] <= HIDDEN * width or first == 0 or last == len(line)
                             or np.median(inside[first:last]) > SEEN
                             and not _beside_itself(line, arc, slice(first, last), width))
    for first, last in gaps(drawn):
        # The edges of what hides the DLO disturb the line next to them.
        low = int(np.searchsorted(arc, arc[first] - 0.7 * width))
        high = min(int(np.searchsorted(arc, arc[last - 1] + 0.7 * width)), len(line) - 1)
        step = max(1, round(0.7 * width / (arc[1] - arc[0])))
        before = np.arange(low, max(low - 5 * step, -1), -step)[::-1]
        after = np.arange(high, min(high + 5 * step, len(line)), step)
        through = clicks[(clicked >= first) & (clicked < last)]
        points = np.concatenate([line[before], through, line[after]])
        at = lengths(points)
        if (np.diff(at) <= 0).any():
            continue
        share = (arc[low:high + 1] - arc[low]) / (arc[high] - arc[low])
        begin, end = at[len(before) - 1], at[len(before) + len(through)]
        found[low:high + 1] = CubicSpline(at, points)(begin + share * (end - begin))
    return found
