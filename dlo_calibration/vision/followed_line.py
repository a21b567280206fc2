# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The line of a DLO in an image, near where it is expected.

Strips of the image beside the line, each narrower than the one before, say where the DLO is now
(`middle_line`).  At last the image is compared with the line: what does not look like the DLO is not seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Bools, SEEN
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.elastic import directions
from dlo_calibration.vision.elastic_line import elastic_line, Shown, TrackedLine
from dlo_calibration.vision.line_end import end_of
from dlo_calibration.vision.middle_line import (
    arc_lengths,
    best_columns,
    edges,
    evidence_of,
    odds,
    scores_of,
    straighten,
    Strip,
)
from dlo_calibration.vision.ridge import Singles

FAR = (9.0, 4.0, 2.4)  # half widths: how far each of the strips reaches beside the line
STEPS = (0.25, 0.2, 0.08)  # half widths between the offsets of each of them
DRIFT = 0.15  # cost of a change by 0.2 half widths from one station to the next
SIGMA = (0.5, 0.3, 0.1)  # half widths: standard deviation of the places that each of them gives
APART = 0.6  # half widths between the line and where the image shows it, from which on it is not seen


def followed(image: DloImage, before: TrackedLine, expected: Floats, far: float = FAR[0]) -> TrackedLine:
    """
    Return the line near where it is expected.

    :param before: the line in the last image.
    :param expected: (n, 2) [px].
    :param far: half widths, how far from there it may be.
    """
    found, line = before, expected
    for stage, (reach, step, sigma) in enumerate(zip((far, *FAR[1:]), STEPS, SIGMA, strict=True)):
        halves = image.halves(line)
        usual = float(np.median(halves))
        offsets = step * np.arange(-float(round(reach / step)), round(reach / step) + 1)
        strip = straighten(image.pixels, line, halves, offsets)
        index, quality = _places(image.dlo.colours, strip, stage)
        chosen = offsets[index]
        quality = quality * image.inside(line, 0.0)
        if stage == len(FAR) - 1:
            weight = np.maximum(gaussian_filter1d(quality, 1.0), 1e-3)
            chosen = gaussian_filter1d(quality * chosen, 1.0) / weight
        measured = strip.at(chosen)
        first, last = (end_of(image, float(halves[::order][0]), measured[::order], quality[::order],
                              image.dlo.colours_near(order)) for order in (1, -1))
        found = elastic_line(image, before, Shown(
            line, measured, quality / (sigma * usual) ** 2, expected, (first, last), usual))
        line = found.line
    tangents = directions(line)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    apart = np.abs(((line - measured) * normals).sum(axis=1)) / usual
    return replace(found, seen=_seen(image, line, apart))


def _seen(image: DloImage, line: Floats, apart: Floats) -> Bools:
    """
    Tell which points (n,) of a line are seen.

    :param apart: (n,) half widths between the line and where the image shows it.
    """
    strip = straighten(image.pixels, line, image.halves(line), np.linspace(-0.6, 0.6, 9))
    colours = gaussian_filter1d(image.dlo.looks(strip.lab), 1.0, mode='nearest')
    inside = image.inside(line, -0.5)
    seen = (colours > SEEN) & (apart < APART) & inside
    # One station alone is a coincidence.
    return np.asarray((gaussian_filter1d(seen.astype(float), 1.0, mode='nearest') > 0.5) & inside)


def _places(colours: Singles, strip: Strip, stage: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the offset's index (n,) where the DLO is in a strip, and how sure that is (n,), 0 to 1."""
    logarithms = odds(colours, strip.lab)
    _without_others(logarithms, strip)
    logarithms = gaussian_filter1d(logarithms, 0.8, axis=0)
    step = float(strip.offsets[1] - strip.offsets[0])
    strength = edges(strip, 1.0)
    scores = scores_of(strip, evidence_of(strip, strength, logarithms), 1.0)
    scores = scores - np.float32(0.004 if stage else 0.01) * np.square(strip.offsets).astype(np.float32)
    index = best_columns(scores[None], DRIFT * min(1.0, step / 0.2))[0][0]
    reach = round(0.6 / step)
    around = np.clip(index[:, None] + np.arange(-reach, reach + 1), 0, len(strip.offsets) - 1)
    inside = np.take_along_axis(logarithms, around, axis=1).mean(axis=1, dtype=float)
    return index, np.clip((inside - 0.2) / 1.0, 0.0, 1.0) ** 2


def _without_others(logarithms: Singles, strip: Strip) -> None:
    """Take the colours of other strands of the DLO out of a strip."""
    line, half = strip.line, strip.half
    reach = float(np.abs(strip.offsets).max() + 1.5) * half
    distance = np.linalg.norm(line[:, None] - line, axis=2)
    arc = arc_lengths(line)
    # Another strand is much farther along the line than through the air.
    apart = np.abs(arc[:, None] - arc) > 2.0 * distance + 4.0 * half[:, None]
    near = np.asarray(apart & (distance < reach[:, None]))
    for row in np.flatnonzero(near.any(axis=1)):
        others = line[near[row]]
        at = strip.line[row] + (strip.offsets * strip.half[row])[:, None] * strip.normals[row]
        explained = np.linalg.norm(at[:, None] - others, axis=2).min(axis=1) < 1.1 * half[row]
        logarithms[row, explained] = 0.0
