# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tracer: finds the middle line of a DLO in a photograph, from a few rough clicks along it, and draws it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter1d

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.middle_line import arc_lengths, between_ends, evenly, fit, odds
from dlo_calibration.vision.path import ridge_path
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.ridge import learn, Level, levels, Singles
from dlo_calibration.writing import whole

NEAR_END = 90.0  # px in a photograph of 4000 px: how far from the DLO's end the first and last clicks may be
CLICK = 80.0  # px in a photograph of 4000 px: how far beside the DLO a click may be
APART = 0.4  # of the distance to the next click: beyond, it could stand for another place of the DLO
SPACING = 3.0  # px between the points of a trace, in a photograph of 4000 px
SEEN = 0.3  # share of the line that must be sure, else there is no DLO
UNSURE_END = 1.5  # widths that are not sure at an end, or to its click: the line is looked for again
ABOVE = 1.35  # least ratio of the upper strand's edge strength to the lower one's
LINE, UNSURE, POINTS = (0, 220, 255), (255, 60, 0), (255, 255, 0)  # red, green, blue
OUTLINE = (0, 0, 0)


@dataclass(frozen=True)
class Crossing:
    """
    Where the DLO crosses itself.

    :param pixel: u, v [px].
    :param first: arc length along the trace at the first passage [px].
    :param second: and at the second.
    :param first_above: whether the first passage seems to be above; None: the photograph does not show it.
    """

    pixel: tuple[float, float]
    first: float
    second: float
    first_above: bool | None


@dataclass(frozen=True, eq=False)
class Trace:
    """
    The middle line of a DLO, from the first click's end to the last one's.

    :param pixels: (n, 2) [px], evenly, u to the right and v down from the middle of the upper left pixel.
    :param sure: (n,) False where the line is hidden or ambiguous.
    :param width: median width of the DLO [px].
    :param crossings: where the DLO crosses itself, in the order of their first passage.
    """

    pixels: Floats
    sure: NDArray[np.bool_]
    width: float
    crossings: tuple[Crossing, ...]


class Tracer:
    """
    Traces DLOs in one photograph.

    :param pixels: (height, width, 3) uint8 RGB.
    """

    def __init__(self, pixels: NDArray[np.uint8]) -> None:
        self._pixels = np.ascontiguousarray(pixels)
        self._levels = levels(self._pixels)

    def trace(self, clicks: ArrayLike, clamped: bool = False) -> Trace:
        """
        Trace the DLO along clicks.

        The line ends at the DLO's end if the first or last click is near one, else at the click; that of a
        DLO whose ends are clamped ends at the clicks, where it leaves the clamps.

        :param clicks: (k, 2) [px], k >= 2, in order along the DLO, each at most 2 % of the longer side of the
            photograph beside it.
        :raises InputError: if there are fewer than two clicks, one is outside the photograph, or there is no
            DLO along them.
        """
        places = self._checked(clicks)
        first = self._along(self._levels, places, clamped)
        if first is None:
            raise _no_dlo()
        trace, table = first
        if _unsure_end(trace, places):
            # Something else led the line astray, say the edge of a sheet: its colours are not the DLO's.
            looks = odds(table, self._levels[0].lab)
            again = self._along([level.showing(looks) for level in self._levels], places, clamped)
            if again is not None and _sure_length(again[0]) > _sure_length(trace) + trace.width:
                return again[0]
        return trace

    def _along(self, reduced: list[Level], places: Floats, clamped: bool) -> tuple[Trace, Singles] | None:
        """Return the trace along clicks (k, 2), and the table of the DLO's colours, as `odds` reads it."""
        scale = max(self._pixels.shape[:2]) / 4000
        ridge = learn(reduced, places)
        rough = ridge_path(ridge, places, _reaches(places, scale))
        if len(rough) < 2:
            return None
        near = max(NEAR_END * scale, 2 * ridge.width)
        middle = fit(self._pixels, rough, ridge.width, near)
        line, sure, strength = between_ends(self._pixels, middle, places, NEAR_END * scale,
                                            max(SPACING * scale, 1.0), clamped)
        if len(line) < 3 or sure.mean() < SEEN:
            return None
        size = 2 * float(np.median(middle.half))
        return Trace(frozen_array(line), frozen_array(sure, bool), size,
                     tuple(_crossings(line, strength, size))), middle.table

    def _checked(self, clicks: ArrayLike) -> Floats:
        places = np.asarray(clicks, dtype=float)
        if places.ndim != 2 or places.shape[1:] != (2,) or len(places) < 2:
            raise InputError('clicks', f'an array of shape {places.shape}', 'two or more pixels u,v',
                             'click on both ends of the DLO, and on its bends')
        height, width = self._pixels.shape[:2]
        outside = ~((places > -1) & (places < (width, height))).all(axis=1)
        if outside.any():
            k = int(np.argmax(outside))
            raise InputError(f'click {k + 1}', f'{places[k][0]:g},{places[k][1]:g}',
                             f'a pixel of the photograph, which is {width} x {height}',
                             'click on the DLO in the photograph')
        distinct = np.concatenate([[True], np.linalg.norm(np.diff(places, axis=0), axis=1) > 1])
        if distinct.sum() < 2:
            raise InputError('clicks', 'all at one place', 'at least two places',
                             'click on both ends of the DLO')
        return np.asarray(np.clip(places[distinct], 0, (width - 1, height - 1)))


def _unsure_end(trace: Trace, clicks: Floats) -> bool:
    """Tell whether the first or last part of a line is not sure, or its end is not at the click (k, 2)."""
    least = UNSURE_END * trace.width
    arc = arc_lengths(trace.pixels)
    sure = trace.sure[arc < least].any() and trace.sure[arc > arc[-1] - least].any()
    return not sure or bool((np.linalg.norm(trace.pixels[[0, -1]] - clicks[[0, -1]], axis=1) > least).any())


def _sure_length(trace: Trace) -> float:
    return float(trace.sure.mean() * arc_lengths(trace.pixels)[-1])


def _reaches(clicks: Floats, scale: float) -> Floats:
    """Return how far beside the DLO each of (k, 2) clicks may be [px]."""
    gaps = np.linalg.norm(np.diff(clicks, axis=0), axis=1)
    nearest = np.minimum(np.append(gaps, np.inf), np.insert(gaps, 0, np.inf))
    return np.asarray(np.maximum(np.minimum(CLICK * scale, APART * nearest), 3.0))


def _no_dlo() -> InputError:
    return InputError('clicks', 'nothing along them that looks the same from end to end', 'clicks on a DLO',
                      'click on both ends of the DLO, and on its bends, in order; if its colour is that of '
                      'the ground, photograph it on another one')


def _crossings(line: Floats, strength: Floats, width: float) -> list[Crossing]:
    """List where a line (n, 2) crosses itself."""
    arc = arc_lengths(line)
    coarse = evenly(line, max(width / 3, arc[-1] / 600))
    steps = np.diff(coarse, axis=0)
    at = arc_lengths(coarse) * (arc[-1] / max(float(arc_lengths(coarse)[-1]), 1e-9))
    gaps = coarse[None, :-1] - coarse[:-1, None]  # from the start of i to the start of j
    turns = steps[:, None, 0] * steps[None, :, 1] - steps[:, None, 1] * steps[None, :, 0]
    turns = np.where(np.abs(turns) < 1e-12, 1e-12, turns)
    of_first = (gaps[..., 0] * steps[None, :, 1] - gaps[..., 1] * steps[None, :, 0]) / turns
    of_second = (gaps[..., 0] * steps[:, None, 1] - gaps[..., 1] * steps[:, None, 0]) / turns
    meets = (of_first >= 0) & (of_first < 1) & (of_second >= 0) & (of_second < 1)
    index = np.arange(len(steps))
    smooth = gaussian_filter1d(strength, 1.0)
    crossings = []
    for i, j in np.argwhere(meets & (index[None] > index[:, None] + 2)):
        first = float(at[i] + of_first[i, j] * (at[i + 1] - at[i]))
        second = float(at[j] + of_second[i, j] * (at[j + 1] - at[j]))
        sine = abs(float(turns[i, j])) / float(np.linalg.norm(steps[i]) * np.linalg.norm(steps[j]))
        reach = 0.35 * width / max(sine, 0.4)
        ways = [float(smooth[np.abs(arc - place) <= reach].mean()) for place in (first, second)]
        above = None if max(ways) < ABOVE * min(ways) else ways[0] > ways[1]
        u, v = coarse[i] + of_first[i, j] * steps[i]
        crossings.append(Crossing((float(u), float(v)), first, second, above))
    return crossings


def write_picture(path: Path, pixels: Pixels, trace: Trace, points: Floats | None = None) -> None:
    """
    Write a photograph as PNG with its line; unsure parts have another colour.

    :param points: (n, 2) [px] of the chain, drawn as dots; None: none are drawn.
    :raises InputError: where the file cannot be written.
    """
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    thick = max(round(trace.width / 6), 2)
    for colour, width in ((OUTLINE, thick + 2), (None, thick)):
        for begin, end, sure in zip(trace.pixels[:-1], trace.pixels[1:], trace.sure[:-1], strict=True):
            draw.line([*begin.tolist(), *end.tolist()], colour or (LINE if sure else UNSURE), width)
    for u, v in np.zeros((0, 2)) if points is None else points:
        draw.ellipse([u - thick, v - thick, u + thick, v + thick], POINTS, OUTLINE)
    with whole(path) as new, new.open('wb') as stream:
        image.save(stream, 'PNG', compress_level=1)
