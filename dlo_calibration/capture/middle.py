# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The middle of the DLO in the full resolution: between both of its edges.

A rough line is straightened.  Each station chooses where the middle is, such that there are edges at half
the width on both sides, that colours between them are the DLO's and those beside them are not, and that the
choice changes little from station to station (dynamic programming).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dlo_calibration.capture.path import steady
from dlo_calibration.capture.ridge import Singles
from dlo_calibration.capture.strip import (
    edges,
    evenly,
    learn_colours,
    lengths,
    odds,
    smoothed,
    straighten,
    Strip,
)
from dlo_calibration.model.chain import Floats

SPACING = 4.0  # px between stations, at least
STATIONS = 800  # along a line, at most: more take time, and tell nothing new
HALVES = 0.5 * np.geomspace(0.3, 2.6, 26)  # of the rough width: half widths that are tried
FAR = 2.6  # half widths: how far the strip reaches beside the line
STEP = 0.04  # half widths between the offsets
COLOUR = 0.2  # weight of colours; that of each edge is 1
FIRST_COLOUR = 0.1  # that at first, when only the colours in the very middle of the DLO are known
FULL = 0.9  # share of the usual strength from which on an edge counts fully
TURNS = 3  # of straightening the strip anew
LEAST = 0.4  # mean logarithm of the odds below which a colour says nothing
LOCAL = 3.0  # half widths, standard deviation of smoothing the local width along the line
UNSEEN = 0.05  # what the width elsewhere counts there, where edges of the usual strength count 1
DRIFT = 0.15  # cost of a change of the middle by one offset; that by two is four times as much


@dataclass(frozen=True, eq=False)
class Middle:
    """
    The line in the middle.

    :param line: (n, 2) [px], evenly.
    :param half: (n,) half the width of the DLO [px].
    :param quality: (n,) 1 where both edges and the colours are as usual, 0 where nothing is.
    :param edges: (n, 2) strength of both edges, 1 is usual.
    :param inside: (n,) mean logarithm of the odds that the middle has a colour of the DLO.
    :param table: of these logarithms, as `strip.odds` reads it.
    """

    line: Floats
    half: Floats
    quality: Floats
    edges: Floats
    inside: Floats
    table: Singles


def fit(pixels: NDArray[np.uint8], rough: Floats, width: float, known: bool, beyond: float) -> Middle:
    """
    Fit the middle line.

    :param pixels: (height, width, 3) RGB.
    :param rough: (k, 2) [px], at most about half a width beside the middle.
    :param width: rough width of the DLO [px].
    :param known: the width is exact to a tenth.
    :param beyond: by how much the line is prolonged at both ends, at least [px].
    """
    least = max(SPACING, float(lengths(rough)[-1]) / STATIONS)
    spacing = max(least, width / 10)
    line = smoothed(evenly(rough, spacing), 0.5 * width / spacing)
    line = prolonged(line, max(beyond, 2.2 * width), width)
    line, half = _first(pixels, evenly(line, 2.0 * spacing), width, known)
    spacing = max(least, half / 6)
    halves = np.full(len(line), half)
    for turn in range(TURNS):
        line, halves = _again(line, halves, spacing)
        strip = straighten(pixels, line, halves, np.arange(-FAR, FAR + STEP / 2, STEP))
        along = 1.0 * half / spacing
        strength = edges(strip, along * (0.6 if turn == 0 else 1.0))
        table = learn_colours(strip, 0.75, (1.5, 2.4))
        colours = gaussian_filter1d(odds(table, strip.lab), along / 2, axis=0)
        index = steady(_scores(strip, _evidence(strip, strength, colours), 1.0)[None], DRIFT)[0][0]
        if turn < TURNS - 1:
            halves = halves * _wider(strip, strength, index)
            line = smoothed(strip.at(strip.offsets[index]), along)
    return _exact(strip, strength, colours, index, along, table, _changes(strip, table, along))


def _changes(strip: Strip, table: Singles, along: float) -> Singles:
    """Return the strength (n, m) of edges between the DLO's colours and the ground's."""
    smooth = gaussian_filter1d(gaussian_filter1d(odds(table, strip.lab), along, axis=0), 1.0, axis=1)
    found: Singles = np.abs(np.gradient(smooth, axis=1)).astype(np.float32)
    return found


def prolonged(line: Floats, by: float, width: float) -> Floats:
    """Return a line (n, 2) that goes straight on at both ends."""
    arc = lengths(line)
    ends = []
    for order in (1, -1):
        part = line[::order]
        reach = int(np.searchsorted(np.abs(arc[::order] - arc[::order][0]), 1.2 * width))
        reach = min(max(reach, 1), len(line) - 1)
        towards = part[0] - part[reach]
        ends.append(part[0] + by * towards / max(float(np.linalg.norm(towards)), 1e-9))
    return np.concatenate([ends[:1], line, ends[1:]])


def _again(line: Floats, halves: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Return the line evenly, and the half widths there."""
    arc = lengths(line)
    even = evenly(line, spacing)
    return even, np.interp(np.linspace(0, arc[-1], len(even)), arc, halves)


def _first(pixels: NDArray[np.uint8], line: Floats, width: float, known: bool) -> tuple[Floats, float]:
    """Return a better line, and half the width, from among many."""
    spacing = float(lengths(line)[-1]) / (len(line) - 1)
    halves = 0.5 * np.array([0.9, 0.95, 1.0, 1.05, 1.1]) if known else HALVES
    reach = 1.7 * halves[-1] + 0.6
    strip = straighten(pixels, line, np.full(len(line), width), np.arange(-reach, reach, 0.04))
    strength = edges(strip, 0.3 * width / spacing)
    table = learn_colours(strip, 0.2, (1.2, reach))
    colours = gaussian_filter1d(odds(table, strip.lab), 0.3 * width / spacing, axis=0)
    colours *= np.float32(FIRST_COLOUR / COLOUR)
    evidence = _evidence(strip, strength, colours)
    found, means = steady(np.stack([_scores(strip, evidence, half) for half in halves]), DRIFT)
    best = int(np.argmax(means))
    index = found[best]
    half = float(halves[best]) * width
    return smoothed(strip.at(strip.offsets[index]), half / spacing), half


def _evidence(strip: Strip, strength: Singles, colours: Singles) -> tuple[Singles, Singles]:
    """Return the edges (n, m), of which one counts 1 at most, and the colours (n, m + 1) added up across."""
    # An edge counts fully from a share of the usual one on.
    saturated = np.minimum(strength / max(FULL * _usual(strip, strength), 1e-6), 1)
    return saturated, np.concatenate(
        [np.zeros((len(colours), 1), np.float32), np.cumsum(colours, axis=1)], axis=1)


def _scores(strip: Strip, evidence: tuple[Singles, Singles], half: float) -> Singles:
    """Return how well each offset (n, m) is the middle of a DLO with a half width."""
    saturated, sums = evidence
    step = strip.offsets[1] - strip.offsets[0]
    count = len(strip.offsets)
    middle = np.arange(count)

    def at(by: float) -> Singles:
        found: Singles = saturated[:, np.clip(middle + round(by / step), 0, count - 1)]
        return found

    def between(low: float, high: float) -> Singles:
        first = np.clip(middle + round(low / step), 0, count - 1)
        last = np.clip(middle + round(high / step), 0, count - 1) + 1
        mean: Singles = (sums[:, last] - sums[:, first]) / (last - first)
        return mean

    inside = between(-0.85 * half, 0.85 * half)
    left, right = between(-1.7 * half, -1.15 * half), between(1.15 * half, 1.7 * half)
    found = at(-half) + at(half) + COLOUR * (inside - (left + right) / 2)
    outside = np.abs(strip.offsets) > np.abs(strip.offsets).max() - half
    found[:, outside] = -4
    return np.ascontiguousarray(found, dtype=np.float32)


def _usual(strip: Strip, strength: Singles) -> float:
    """Return the usual strength of the DLO's edges."""
    near = np.abs(strip.offsets) < 0.6 * np.abs(strip.offsets).max()
    return float(np.median(strength[:, near].max(axis=1)))


def _sides(strip: Strip, strength: Singles, index: NDArray[np.int64],
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


def _wider(strip: Strip, strength: Singles, index: NDArray[np.int64]) -> Floats:
    """Return by which factor (n,) the edges are further apart than the half widths say, changing evenly."""
    (left, right), strengths = _sides(strip, strength, index)
    ratio = np.log(np.clip((right - left) / 2, 0.6, 1.6))
    place = strip.line - strip.line.mean(axis=0)
    terms = np.column_stack([np.ones(len(place)), place / max(float(np.abs(place).max()), 1.0)])
    weight = strengths.min(axis=0) ** 2
    found = np.zeros(3)
    for scale in (0.3, 0.2, 0.1, 0.05, 0.05, 0.05):
        # Cauchy's weights, against shadows; without evidence the width stays.
        share = weight / (1 + ((ratio - terms @ found) / scale) ** 2)
        normal = (terms * share[:, None]).T @ terms + np.diag([1e-6, 0.002, 0.002]) * len(place)
        found = np.linalg.solve(normal, (terms * share[:, None]).T @ ratio)
    return np.exp(np.clip(terms @ found, -0.3, 0.3))


def _exact(strip: Strip, strength: Singles, colours: Singles, index: NDArray[np.int64], along: float,
           table: Singles, changes: Singles) -> Middle:
    """Place both edges between the offsets, and smooth the middle where they are weak."""
    half = np.ones(len(index))
    for _ in range(2):
        (left, right), (left_strength, right_strength) = _sides(strip, strength, index, half)
        # A rope is wider here and narrower there; without evidence it is as wide as elsewhere.
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
    # Through a shadow the edge of the colours is seen better than that of the light.
    (left_seen, right_seen) = _sides(strip, changes, index, half)[1]
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
