# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The middle line of a DLO in the full resolution: between both of its edges, from one end to the other.

The photograph is straightened along a rough line: stations lie evenly along it, and at each, colours are
read at offsets across.  Dynamic programming chooses the middle at each station: there are edges at half the
width on both sides, the colours between them are the DLO's, those beside them are not, and the offset
changes little from station to station.

The outline of the DLO closes at its end, so that its edges there say nothing about the middle: the line
continues with the curvature before, up to the end of the DLO's colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import find_objects, gaussian_filter, gaussian_filter1d, label

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.ridge import Singles

SPACING = 4.0  # px between stations, at least
STATIONS = 800  # along a line, at most: more take time and add nothing
HALVES = 0.5 * np.geomspace(0.3, 2.6, 26)  # of the rough width: half widths that are tried
FAR = 2.6  # half widths: how far the strip reaches beside the line
STEP = 0.04  # half widths between the offsets
COLOUR = 0.2  # weight of colours; that of each edge is 1
FIRST_COLOUR = 0.1  # weight in the first fit, which knows only the colours in the very middle of the DLO
FULL = 0.9  # share of the usual strength from which on an edge counts fully
ITERATIONS = 3  # of straightening the strip
LEAST = 0.4  # mean logarithm of the odds below which a colour says nothing
LOCAL = 3.0  # half widths, standard deviation of smoothing the local width along the line
UNSEEN = 0.05  # weight of the strip's own width; that of edges with the usual strength is 1
DRIFT = 0.15  # cost of a change of the middle by one offset; that by two is four times as much
BINS = (24, 40, 40)  # of L, a, b
LOW, SIZE = (0.0, -100.0, -100.0), (100.0, 200.0, 200.0)
DARKER = (0.9, 0.8, 0.65)  # L, a and b of the ground in shadows that take 25, 50 and 70 % of its light
UNKNOWN = 2e-3  # share of either class that may have any colour
MOST = 3.0  # limit of the logarithm of the odds
STRANGE = 0.3  # subtracted from the logarithm: a colour of neither class is not the DLO's
SURE = 0.35  # quality below which the line is not sure
SEEN = 1.0  # median logarithm of the odds from which on the DLO is not hidden
BRIDGED = 1.6  # widths: a shorter gap between sure parts is sure, too
HIDDEN = 1.2  # widths: over a longer gap the line is drawn anew
CAP = 1.6  # half widths at the end that say nothing about the middle
EDGE = 0.35  # half widths around an end, in which its edge is
END_STEP = 0.2  # half widths between places where an end is looked for
BEFORE = 4.5  # half widths before these, whose curvature goes on


@dataclass(frozen=True, eq=False)
class Middle:
    """
    The line in the middle.

    :param line: (n, 2) [px], evenly.
    :param half: (n,) half the width of the DLO [px].
    :param quality: (n,) 1 where both edges and the colours are as usual, 0 where nothing is.
    :param edges: (n, 2) strength of both edges, 1 is usual.
    :param inside: (n,) mean logarithm of the odds that the middle has a colour of the DLO.
    :param table: of these logarithms, as `odds` reads it.
    """

    line: Floats
    half: Floats
    quality: Floats
    edges: Floats
    inside: Floats
    table: Singles


def fit(pixels: NDArray[np.uint8], rough: Floats, width: float, beyond: float) -> Middle:
    """
    Fit the middle line.

    :param pixels: (height, width, 3) RGB.
    :param rough: (k, 2) [px], at most about half a width beside the middle.
    :param width: rough width of the DLO [px].
    :param beyond: least length by which the line is prolonged at both ends [px].
    """
    least = max(SPACING, float(arc_lengths(rough)[-1]) / STATIONS)
    spacing = max(least, width / 10)
    line = smoothed(evenly(rough, spacing), 0.5 * width / spacing)
    line = prolonged(line, max(beyond, 2.2 * width), width)
    line, half = _first_fit(pixels, evenly(line, 2.0 * spacing), width)
    spacing = max(least, half / 6)
    halves = np.full(len(line), half)
    for iteration in range(ITERATIONS):
        arc = arc_lengths(line)
        line = evenly(line, spacing)
        halves = np.interp(np.linspace(0, arc[-1], len(line)), arc, halves)
        strip = straighten(pixels, line, halves, np.arange(-FAR, FAR + STEP / 2, STEP))
        along = 1.0 * half / spacing
        strength = edges(strip, along * (0.6 if iteration == 0 else 1.0))
        table = learn_colours(strip, 0.75, (1.5, 2.4))
        colours = gaussian_filter1d(odds(table, strip.lab), along / 2, axis=0)
        index = best_columns(scores_of(strip, evidence_of(strip, strength, colours), 1.0)[None], DRIFT)[0][0]
        if iteration < ITERATIONS - 1:
            halves = halves * _width_ratios(strip, strength, index)
            line = smoothed(strip.at(strip.offsets[index]), along)
    return _last_fit(strip, strength, colours, index, along, table)


def best_columns(scores: Singles, drift: float) -> tuple[NDArray[np.int64], Floats]:
    """
    Return the columns with the largest sum of scores in each matrix, and the means of these sums.

    :param scores: (k, n, m): k matrices; each of their rows gets a column.
    :param drift: cost of a change by one column from row to row; a change by two, the largest possible,
        costs four times as much.
    :returns: (k, n) and (k,).
    """
    count, rows, columns = scores.shape
    changes = np.array([0, -1, 1, -2, 2])  # among columns with equal sums, the nearest counts
    costs = drift * changes ** 2
    every = np.arange(count)
    totals = np.full((rows, count, columns + 4), -np.inf)  # largest sum to each column; two more at each side
    totals[0, :, 2:-2] = scores[:, 0]
    for row in range(1, rows):
        best = totals[row - 1, :, 2:-2]
        for change, cost in zip(changes[1:].tolist(), costs[1:].tolist(), strict=True):
            best = np.maximum(best, totals[row - 1, :, 2 + change:2 + change + columns] - cost)
        totals[row, :, 2:-2] = best + scores[:, row]
    chosen = np.empty((count, rows), dtype=np.int64)
    chosen[:, -1] = totals[-1, :, 2:-2].argmax(axis=1)
    for row in range(rows - 1, 0, -1):
        sums = totals[row - 1, every, 2 + chosen[:, row] + changes[:, None]]
        chosen[:, row - 1] = chosen[:, row] + changes[(sums - costs[:, None]).argmax(axis=0)]
    return chosen, totals[-1].max(axis=1) / rows


def prolonged(line: Floats, by: float, width: float) -> Floats:
    """Return a line (n, 2) that goes straight on at both ends."""
    arc = arc_lengths(line)
    ends = []
    for order in (1, -1):
        part = line[::order]
        reach = int(np.searchsorted(np.abs(arc[::order] - arc[::order][0]), 1.2 * width))
        reach = min(max(reach, 1), len(line) - 1)
        towards = part[0] - part[reach]
        ends.append(part[0] + by * towards / max(float(np.linalg.norm(towards)), 1e-9))
    return np.concatenate([ends[:1], line, ends[1:]])


def _first_fit(pixels: NDArray[np.uint8], line: Floats, width: float) -> tuple[Floats, float]:
    """Return a better line, and half the width: the best of `HALVES`."""
    spacing = float(arc_lengths(line)[-1]) / (len(line) - 1)
    reach = 1.7 * HALVES[-1] + 0.6
    strip = straighten(pixels, line, np.full(len(line), width), np.arange(-reach, reach, 0.04))
    strength = edges(strip, 0.3 * width / spacing)
    table = learn_colours(strip, 0.2, (1.2, reach))
    colours = gaussian_filter1d(odds(table, strip.lab), 0.3 * width / spacing, axis=0)
    colours *= np.float32(FIRST_COLOUR / COLOUR)
    evidence = evidence_of(strip, strength, colours)
    indices, means = best_columns(np.stack([scores_of(strip, evidence, half) for half in HALVES]), DRIFT)
    best = int(np.argmax(means))
    index = indices[best]
    half = float(HALVES[best]) * width
    return smoothed(strip.at(strip.offsets[index]), half / spacing), half


def evidence_of(strip: Strip, strength: Singles, colours: Singles) -> tuple[Singles, Singles]:
    """Return the strength of edges (n, m), at most 1, and the sums of colours across (n, m + 1)."""
    # An edge counts fully from a share of the usual one on.
    saturated = np.minimum(strength / max(FULL * _usual(strip, strength), 1e-6), 1)
    return saturated, np.concatenate(
        [np.zeros((len(colours), 1), np.float32), np.cumsum(colours, axis=1)], axis=1)


def scores_of(strip: Strip, evidence: tuple[Singles, Singles], half: float) -> Singles:
    """Return how well each offset (n, m) fits as the middle of a DLO with a half width."""
    saturated, sums = evidence
    step = strip.offsets[1] - strip.offsets[0]
    count = len(strip.offsets)
    middle = np.arange(count)

    def at(by: float) -> Singles:
        return np.asarray(saturated[:, np.clip(middle + round(by / step), 0, count - 1)])

    def between(low: float, high: float) -> Singles:
        first = np.clip(middle + round(low / step), 0, count - 1)
        last = np.clip(middle + round(high / step), 0, count - 1) + 1
        return np.asarray((sums[:, last] - sums[:, first]) / (last - first))

    inside = between(-0.85 * half, 0.85 * half)
    left, right = between(-1.7 * half, -1.15 * half), between(1.15 * half, 1.7 * half)
    scores = at(-half) + at(half) + COLOUR * (inside - (left + right) / 2)
    outside = np.abs(strip.offsets) > np.abs(strip.offsets).max() - half
    scores[:, outside] = -4
    return np.ascontiguousarray(scores, dtype=np.float32)


def _usual(strip: Strip, strength: Singles) -> float:
    """Return the usual strength of the DLO's edges."""
    near = np.abs(strip.offsets) < 0.6 * np.abs(strip.offsets).max()
    return float(np.median(strength[:, near].max(axis=1)))


def sides_of(strip: Strip, strength: Singles, index: NDArray[np.int64],
           half: float | Floats = 1.0) -> tuple[Floats, Floats]:
    """Return the offsets (2, n) of both edges near the half widths, and their strength (2, n), 1 is usual."""
    usual = max(_usual(strip, strength), 1e-6)
    near = np.arange(-7, 8)
    offsets, strengths = np.empty((2, len(index))), np.empty((2, len(index)))
    for k, side in enumerate((-1, 1)):
        place = index + np.round(side * half / STEP).astype(int)
        around = np.clip(place[:, None] + near, 1, strength.shape[1] - 2)
        peak = np.take_along_axis(strength, around, axis=1) * np.exp(-0.5 * (near / 5) ** 2)
        best = np.take_along_axis(around, peak.argmax(axis=1)[:, None], axis=1)
        before, here, after = (np.take_along_axis(strength, best + by, axis=1)[:, 0] for by in (-1, 0, 1))
        bend = np.minimum(before - 2 * here + after, -1e-6)
        offsets[k] = strip.offsets[best[:, 0]] + np.clip(0.5 * (before - after) / bend, -0.6, 0.6) * STEP
        strengths[k] = np.minimum(here / usual, 1.0)
    return offsets, strengths


def _width_ratios(strip: Strip, strength: Singles, index: NDArray[np.int64]) -> Floats:
    """Return the ratio (n,) of the edges' distance to the strip's width; its logarithm is linear in place."""
    (left, right), strengths = sides_of(strip, strength, index)
    ratio = np.log(np.clip((right - left) / 2, 0.6, 1.6))
    place = strip.line - strip.line.mean(axis=0)
    terms = np.column_stack([np.ones(len(place)), place / max(float(np.abs(place).max()), 1.0)])
    weight = strengths.min(axis=0) ** 2
    coefficients = np.zeros(3)
    for scale in (0.3, 0.2, 0.1, 0.05, 0.05, 0.05):
        # Cauchy's weights, against shadows; without evidence the width stays.
        share = weight / (1 + ((ratio - terms @ coefficients) / scale) ** 2)
        normal = (terms * share[:, None]).T @ terms + np.diag([1e-6, 0.002, 0.002]) * len(place)
        coefficients = np.linalg.solve(normal, (terms * share[:, None]).T @ ratio)
    return np.exp(np.clip(terms @ coefficients, -0.3, 0.3))


def _last_fit(strip: Strip, strength: Singles, colours: Singles, index: NDArray[np.int64], along: float,
              table: Singles) -> Middle:
    """Locate both edges between the offsets, and smooth the middle where they are weak."""
    half = np.ones(len(index))
    for _ in range(2):
        (left, right), (left_strength, right_strength) = sides_of(strip, strength, index, half)
        # A rope's width varies; without evidence it is the strip's.
        trust = np.minimum(left_strength, right_strength) ** 2
        widths, trusts = (gaussian_filter1d(values, LOCAL * along, mode='nearest') + UNSEEN
                          for values in (trust * (right - left) / 2, trust))
        half = np.clip(widths / trusts, 0.75, 1.4)
    # Where the edges disagree, as with a shadow beside the DLO, the stronger one counts.
    shares = np.column_stack([left_strength, right_strength]) ** 4 + 1e-6
    middle = (np.column_stack([left + half, right - half]) * shares).sum(axis=1) / shares.sum(axis=1)
    agrees = np.exp(-0.5 * ((right - left - 2 * half) / 0.25) ** 2)
    around = np.clip(index[:, None] + np.arange(-10, 11), 0, colours.shape[1] - 1)
    inside = np.take_along_axis(colours, around, axis=1).mean(axis=1, dtype=float)
    # In a shadow, the edge of the colours is clearer than that of the brightness.
    smooth = gaussian_filter1d(gaussian_filter1d(odds(table, strip.lab), along, axis=0), 1.0, axis=1)
    changes = np.abs(np.gradient(smooth, axis=1)).astype(np.float32)
    (left_seen, right_seen) = sides_of(strip, changes, index, half)[1]
    both = np.minimum(np.maximum(left_strength, left_seen), np.maximum(right_strength, right_seen))
    quality = np.clip(1.4 * both, 0, 1) * agrees * np.clip((inside - LEAST) / 1.2, 0, 1)
    weight = 1e-4 + quality
    sigma = 0.8 * along
    weights = gaussian_filter1d(weight, sigma, mode='nearest')
    coarse = gaussian_filter1d(weight * middle, sigma, mode='nearest') / weights
    chosen = np.where(quality > 0.05, quality * middle + (1 - quality) * coarse, coarse)
    line = smoothed(strip.at(smoothed(chosen, 0.7 * along)), 0.2 * along)
    return Middle(line, strip.half.copy(), gaussian_filter1d(quality, along / 2, mode='nearest'),
                  np.column_stack([left_strength, right_strength]), inside, table)


@dataclass(frozen=True, eq=False)
class Strip:
    """
    A straightened part of a photograph.

    :param line: (n, 2) stations [px].
    :param normals: (n, 2) unit vectors across, to the right of the line in the picture.
    :param half: (n,) [px] that one unit of the offsets is.
    :param offsets: (m,) across the line, evenly.
    :param lab: (n, m, 3) colours L, a, b.
    """

    line: Floats
    normals: Floats
    half: Floats
    offsets: Floats
    lab: Singles

    def at(self, offsets: Floats) -> Floats:
        """Return the pixels (n, 2) at offsets (n,), one for each station."""
        return np.asarray(self.line + (offsets * self.half)[:, None] * self.normals)


def arc_lengths(line: Floats) -> Floats:
    """Return the length (n,) from the beginning of a line (n, k) to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def along_line(line: Floats, along: Floats, places: ArrayLike) -> Floats:
    """Return the points (m, k) of a line (n, k) with arc lengths (n,), at other arc lengths (m,)."""
    at = np.asarray(places, float)
    return np.stack([np.interp(at, along, axis) for axis in line.T], axis=1)


def evenly(line: Floats, spacing: float) -> Floats:
    """Return a line (n, 2) with points about `spacing` apart, evenly."""
    arc = arc_lengths(line)
    at = np.linspace(0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return along_line(line, arc, at)


def smoothed(values: Floats, sigma: float) -> Floats:
    """Return (n, ...) values smoothed along the first axis; the ends stay where they are."""
    reach = min(len(values) - 1, int(4 * sigma) + 1)
    padded = np.pad(values, [(reach, reach), (0, 0)][:values.ndim], 'reflect', reflect_type='odd')
    return np.asarray(gaussian_filter1d(padded, max(sigma, 1e-3), axis=0)[reach:reach + len(values)])


def straighten(pixels: NDArray[np.uint8], line: Floats, half: Floats, offsets: Floats) -> Strip:
    """
    Read the colours along a line.

    :param pixels: (height, width, 3) RGB.
    :param line: (n, 2) [px], evenly.
    :param half: (n,) [px] that one unit of the offsets is.
    """
    tangents = np.gradient(line, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    at = line[:, None] + (half[:, None] * offsets)[..., None] * normals[:, None]
    low = np.clip(np.floor(at.min(axis=(0, 1))).astype(int) - 2, 0, np.array(pixels.shape[1::-1]) - 1)
    high = np.ceil(at.max(axis=(0, 1))).astype(int) + 3
    part = pixels[low[1]:max(high[1], low[1] + 1), low[0]:max(high[0], low[0] + 1)]
    return Strip(line, normals, half, offsets, colours_at(part, at - low))


def colours_at(pixels: NDArray[np.uint8], places: Floats) -> Singles:
    """Return the colours L, a, b (n, m, 3) of an image at places (n, m, 2) [px]."""
    at = places.astype(np.float32)
    # OpenCV's remap takes at most 32767 rows, and reads whatever is aligned.
    colours = np.concatenate([
        cv2.remap(pixels, at[k:k + 16384, :, 0], at[k:k + 16384, :, 1], cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE) for k in range(0, len(at), 16384)])
    lab: Any = cv2.cvtColor(colours.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2Lab)
    return np.asarray(lab)


def learn_colours(strip: Strip, inner: float, outer: tuple[float, float], others: float = 0.0) -> Singles:
    """
    Return a table of the logarithm of the odds that a colour is the DLO's.

    :param inner: offsets below this count as the DLO.
    :param outer: offsets between these count as the ground, which may be in shadow, too.
    :param others: share of each colour in what may come into the picture later.
    """
    far = np.abs(strip.offsets)
    of_dlo = _share(strip.lab[:, far <= inner].reshape(-1, 3))
    outside = strip.lab[:, (far >= outer[0]) & (far <= outer[1])].reshape(-1, 3)
    shadows = sum((_share(outside * np.float32(k)) for k in DARKER), np.zeros(BINS))
    of_ground = 0.6 * _share(outside) + 0.4 / len(DARKER) * shadows
    least = UNKNOWN * of_dlo.mean() + 1e-7
    logarithms: Singles = np.log((of_dlo + least) / (of_ground + others + least)).astype(np.float32).ravel()
    return np.asarray(np.clip(logarithms - np.float32(STRANGE), -MOST, MOST))


def odds(table: Singles, lab: Singles) -> Singles:
    """Return the logarithm of the odds (...) that colours (..., 3) are the DLO's."""
    return np.asarray(table[_bin(lab)])


def _bin(lab: Singles) -> NDArray[np.int64]:
    index = np.zeros(lab.shape[:-1], dtype=np.int64)
    for k, bins in enumerate(BINS):
        scaled = (lab[..., k] - np.float32(LOW[k])) * np.float32(bins / SIZE[k])
        index = index * bins + np.clip(scaled, 0, bins - 1).astype(np.int64)
    return index


def _share(lab: Singles) -> Floats:
    counted = np.bincount(_bin(lab), minlength=BINS[0] * BINS[1] * BINS[2]).reshape(BINS).astype(float)
    return np.asarray(gaussian_filter(counted, 0.8) / max(len(lab), 1))


def edges(strip: Strip, along: float) -> Singles:
    """
    Return the strength (n, m) of edges along the line.

    :param along: stations, standard deviation over which changes of colour must agree.
    """
    smooth = cv2.GaussianBlur(strip.lab, (0, 0), sigmaX=1.0, sigmaY=max(along, 0.3),
                              borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.linalg.norm(np.gradient(smooth, axis=1), axis=2).astype(np.float32))


def between_ends(pixels: NDArray[np.uint8], middle: Middle, clicks: Floats, near: float,
                 spacing: float, clamped: bool = False) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """
    Return the line (n, 2) between its ends, where it is sure (n,), and the strength of its edges (n,).

    :param middle: of a line that goes on beyond the first and last click.
    :param clicks: (k, 2) [px].
    :param near: how far an end may be from its click [px], at least.
    :param spacing: of the points [px].
    :param clamped: whether the DLO goes on beyond the first and the last click, hidden in clamps.
    """
    half = float(np.median(middle.half))
    near = max(near, 4 * half)
    line = middle.line
    sure = middle.quality > SURE
    for order in (1, -1):
        way = line[::order]
        arc = arc_lengths(way)
        click = _arc_at(way, arc, clicks[::order][0])
        end = click if clamped else end_near(arc, middle.inside[::order], click, near)
        if end is not None:
            line = _extended(way, arc, end, half)[::order]
    line = _bridged(line, sure, middle.inside, clicks, 2 * half, near)
    ends = []
    for order in (1, -1):
        way = line[::order]
        arc = arc_lengths(way)
        click = _arc_at(way, arc, clicks[::order][0])
        whole = float(arc[-1])
        way = evenly(way[:int(np.searchsorted(arc, click + near)) + 2], END_STEP * half)
        arc = arc_lengths(way)
        part = straighten(pixels, way, np.full(len(way), half), np.linspace(-0.25, 0.25, 9))
        end = None if clamped else end_near(
            arc, odds(middle.table, part.lab).mean(axis=1), click, near)
        end = click if end is None else edge_near(arc, part, end, EDGE * half)
        ends.append(float(end if order == 1 else whole - end))
    arc = arc_lengths(line)
    if ends[1] - ends[0] < 2 * spacing:
        return np.empty((0, 2)), np.empty(0, dtype=bool), np.empty(0)
    at = np.linspace(ends[0], ends[1], round((ends[1] - ends[0]) / spacing) + 1)
    even = along_line(line, arc, at)
    # An end is as sure as the part before it.
    quality = np.interp(np.clip(at, ends[0] + 1.5 * half, ends[1] - 1.5 * half), arc, middle.quality)
    certain = quality > SURE
    for first, last in gaps(certain):
        if (last - first) * spacing <= BRIDGED * 2 * half and first > 0 and last < len(certain):
            certain[first:last] = True
    return even, certain, np.interp(at, arc, middle.edges.min(axis=1))


def _arc_at(line: Floats, arc: Floats, click: Floats) -> float:
    """Return the arc length at which the first half of a line (n, 2) passes a click (2,) [px]."""
    # The line may pass the click again, elsewhere.
    steps = np.diff(line, axis=0)
    share = ((click - line[:-1]) * steps).sum(axis=1) / np.maximum((steps * steps).sum(axis=1), 1e-9)
    share = np.clip(share, 0.0, 1.0)
    distance = np.linalg.norm(line[:-1] + share[:, None] * steps - click, axis=1)
    k = int(np.argmin(np.where(arc[:-1] < arc[-1] / 2, distance, np.inf)))
    return float(arc[k] + share[k] * (arc[k + 1] - arc[k]))


def gaps(sure: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List the parts where the line is not sure: first index, and the index after the last."""
    return [(part.start, part.stop) for part, in find_objects(label(~sure)[0])]


def end_near(arc: Floats, inside: Floats, click: float, near: float) -> float | None:
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
    # Half-way between the last station beside the DLO and the first one on it.
    return float(arc[window[first]] + arc[window[first - 1]]) / 2


def edge_near(arc: Floats, part: Strip, near: float, reach: float) -> float:
    """Return the arc length [px] of the strongest change of colour along a strip near `near`."""
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
    extended = line.copy()
    before = arc < low
    weights = np.exp(-at[behind] / BEFORE)
    for column in range(2):
        parabola = np.polyfit(at[behind], line[behind, column], 2, w=weights)
        step = line[np.argmax(~before), column] - np.polyval(parabola, at[np.argmax(~before)])
        extended[before, column] = np.polyval(parabola, at[before]) + step
    return extended


def _beside_itself(line: Floats, arc: Floats, part: slice, width: float) -> bool:
    """Tell whether a part of a line (n, 2) lies beside another part of it, or across it."""
    places = np.arange(len(line))[part]
    distant = np.abs(arc[places][:, None] - arc) > 3 * width
    near = np.linalg.norm(line[places][:, None] - line, axis=2) < 1.5 * width
    return bool((distant & near).any())


def _misses(points: Floats, clicks: Floats, near: float) -> NDArray[np.bool_]:
    """Tell which clicks (k, 2) a smooth curve through points (n, 2) misses by more than `near` [px]."""
    at = arc_lengths(points)
    if not len(clicks) or (np.diff(at) <= 0).any():
        return np.ones(len(clicks), dtype=bool)
    curve = CubicSpline(at, points)(np.linspace(0.0, at[-1], 200))
    return np.asarray(np.linalg.norm(clicks[:, None] - curve, axis=2).min(axis=1) > near)


def _bridged(line: Floats, sure: NDArray[np.bool_], inside: Floats, clicks: Floats,
             width: float, near: float) -> Floats:
    """
    Return a line (n, 2) that is smooth where the DLO is hidden, and there passes the clicks.

    :param near: how far beside the DLO a click may be [px]: one that is no farther off changes nothing.
    """
    bridged = line.copy()
    arc = arc_lengths(line)
    clicked = np.array([int(np.argmin(np.linalg.norm(line - click, axis=1))) for click in clicks])
    drawn = sure.copy()
    for first, last in gaps(sure):
        # A part with the DLO's colours is not hidden, however its edges look; but beside another strand the
        # line may have strayed onto that strand.
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
        through = through[_misses(np.concatenate([line[before], line[after]]), through, near)]
        points = np.concatenate([line[before], through, line[after]])
        at = arc_lengths(points)
        if (np.diff(at) <= 0).any():
            continue
        share = (arc[low:high + 1] - arc[low]) / (arc[high] - arc[low])
        begin, end = at[len(before) - 1], at[len(before) + len(through)]
        bridged[low:high + 1] = CubicSpline(at, points)(begin + share * (end - begin))
    return bridged
