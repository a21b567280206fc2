# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Appearance: what a DLO looks like, learned in the first image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.middle_line import arc_lengths, learn_colours, odds, straighten, Strip
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.ridge import Singles
from dlo_calibration.vision.scale import Scale

Bools = NDArray[np.bool_]

OTHERS = 5e-4  # share of each colour, e.g. of 2000 colours of hands: a rare colour of the DLO may be theirs
SEEN = 0.35  # mean logarithm of the odds of a colour from which on the DLO is seen
ALIKE = 0.75  # share of the DLO's usual logarithm of the odds from which on a place has its colour
MARKED = 8  # stations from an end, in which other colours than the DLO's may be
INNER, OUTER, OFFSETS = 0.5, (1.4, 2.4), np.arange(-2.4, 2.41, 0.08)  # half widths: the DLO, the ground, both


def finenesses(line: Floats, scale: Scale | None) -> Floats:
    """Return the pixels (n - 1,) to a unit of the DLO's length, of each segment of a line (n, 2)."""
    if scale is None:
        return np.ones(len(line) - 1)
    there = np.linalg.norm(np.diff(scale.points(line), axis=0), axis=1)
    here = np.linalg.norm(np.diff(line, axis=0), axis=1)
    ratios = here / np.maximum(there, 1e-12)
    ratios[~np.isfinite(ratios)] = np.nanmedian(ratios)
    return np.asarray(ratios)


@dataclass(frozen=True, eq=False)
class Appearance:
    """
    What a DLO looks like.

    A whipped or taped part has other colours than the rest.  They count as the DLO's in that part only.

    :param length: of the DLO [m, or px without a scale].
    :param half: half its width, in the same unit.
    :param colours: table of the logarithm of the odds that a colour is the DLO's, as `odds` reads it.
    :param marked: (n,) which stations along it have other colours.
    :param marks: the same table for those stations.
    :param alike: mean logarithm of the odds from which on a place has the DLO's colour.
    """

    length: float
    half: float
    colours: Singles
    marked: Bools
    marks: Singles
    alike: float

    @classmethod
    def of(cls, pixels: Pixels, line: Floats, half: float, scale: Scale | None) -> Appearance:
        """Return that of the DLO along a line (n, 2) [px], whose width is `2 half` [px]."""
        flat = line if scale is None else scale.points(line)
        halves = np.full(len(line), half)
        strip = straighten(pixels, line, halves, OFFSETS)
        colours = learn_colours(strip, INNER, OUTER, OTHERS)
        looks = odds(colours, straighten(pixels, line, halves, np.linspace(-0.4, 0.4, 5)).lab).mean(axis=1)
        marked = np.asarray(looks < SEEN)
        marked[[0, -1]] = False  # there, the ground is half of what is seen
        part = Strip(strip.line[marked], strip.normals[marked], strip.half[marked], strip.offsets,
                     strip.lab[marked])
        marks = np.maximum(colours, learn_colours(part, INNER, OUTER, OTHERS))
        fineness = float(np.median(finenesses(line, scale)))
        return cls(float(arc_lengths(flat)[-1]), half / fineness, colours, marked, marks,
                   ALIKE * float(np.median(looks)))

    def halves(self, line: Floats, scale: Scale | None) -> Floats:
        """Return half its width (n,) [px] at each point of a line (n, 2) in a picture."""
        fineness = finenesses(line, scale)
        return np.asarray(self.half * np.append(fineness, fineness[-1]))

    def colours_near(self, order: int) -> Singles:
        """Return the table near the first end (order 1) or the last one (-1)."""
        return self.marks if self.marked[::order][:MARKED].any() else self.colours

    def looks(self, lab: Singles) -> Floats:
        """Return the mean logarithm of the odds (n,) that colours (n, m, 3) at each station are the DLO's."""
        each = np.where(self.marked[:, None], odds(self.marks, lab), odds(self.colours, lab))
        return np.asarray(each.mean(axis=1, dtype=float))
