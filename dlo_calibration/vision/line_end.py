# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The end of a DLO in an image, near the end of a line that follows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import SEEN
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.middle_line import (
    along_line,
    arc_lengths,
    colours_at,
    edge_near,
    end_near,
    evenly,
    odds,
    straighten,
)
from dlo_calibration.vision.ridge import Singles

LAST = 30  # stations, within which the last part of the DLO is seen
SURE = 0.3  # how sure it is of a place of that part, at least
BEYOND = 6.0  # half widths behind the last part that looks like the DLO, from which on its end is looked for
CLEAR = 1.5  # half widths behind that part, which the picture must show
LONGEST_TIP = 14  # half widths by which the line may be too short
FAN = np.radians(np.arange(-50.0, 51.0, 10.0))  # directions in which the DLO may go on
REACHES = np.array([0.4, 0.8, 1.2, 1.6])  # half widths, where colours are read in each of them
BEHIND = np.array([0.8, 1.2, 1.6, 2.0, 2.4, 2.8])  # half widths, where it is seen what is behind an end


@dataclass(frozen=True, eq=False)
class LineEnd:
    """
    An end that is seen.

    :param place: (2,) [px].
    :param strange: distance in L, a, b of what is behind it from the ground there, in whatever light; large
        where something covers the DLO from there on.
    """

    place: Floats
    strange: float


def end_of(image: DloImage, half: float, measured: Floats, quality: Floats,
           colours: Singles) -> LineEnd | None:
    """
    Return the end near the first point of a line; None: it is not seen.

    :param half: half the DLO's width there [px].
    :param measured: (n, 2) where the image shows the line [px].
    :param quality: (n,) how sure that is, 0 to 1.
    :param colours: of the DLO near that end.
    """
    near = np.flatnonzero(quality[:LAST] > SURE)
    if len(near) < 4:
        return None
    part = measured[near[0]:]
    # What is measured where the DLO is covered tells nothing of its direction.
    part = part[:np.append(np.flatnonzero(~image.inside(part, 0.0)), len(part))[0]]
    if len(part) < 2:
        return None
    towards = part[0] - part[:8][-1]
    towards = towards / max(float(np.linalg.norm(towards)), 1e-9)
    tip, towards = _tip(image, part[0], towards, half)
    way = evenly(np.concatenate([tip[-1:] + BEYOND * half * towards, tip[::-1],
                                 part[:14]]), 0.2 * half)
    arc = arc_lengths(way)
    inside = image.inside(way, 0.0)
    if not inside[arc > (BEYOND - CLEAR) * half].all():
        return None
    halves = np.full(len(way), half)
    strip = straighten(image.pixels, way, halves, np.linspace(-0.25, 0.25, 5))
    logarithms = odds(colours, strip.lab).mean(axis=1, dtype=float)
    logarithms[~inside] = -1.0
    end = end_near(arc, logarithms, BEYOND * half, 5 * half + float(arc_lengths(tip)[-1]))
    if end is None:
        return None
    end = edge_near(arc, strip, end, 0.5 * half)
    place = np.asarray(along_line(way, arc, [end])[0])
    if not image.inside(place + CLEAR * half * _fan(towards), 0.0).all():
        return None  # it may be the corner of what is seen of the DLO beside something that is covered
    return LineEnd(place, _strange(image, place, half, towards, colours))


def _strange(image: DloImage, place: Floats, half: float, towards: Floats, colours: Singles) -> float:
    """Return how strange it is behind an end (2,) [px]: the most in any direction in which the DLO is not."""
    behind = place + half * BEHIND[:, None] * _fan(towards)[:, None]
    there = colours_at(image.pixels, behind)
    others = odds(colours, there).mean(axis=1) < SEEN
    others &= image.inside(behind.reshape(-1, 2), 0.0).reshape(there.shape[:2]).all(axis=1)
    if not others.any():
        return 0.0
    return float(image.ground.differences(there[others], behind[others], image.scale, colours).max())


def _tip(image: DloImage, begin: Floats, towards: Floats, half: float) -> tuple[Floats, Floats]:
    """Follow the DLO's colour from a point (2,) [px]; return the points (n, 2) and the last direction."""
    points = [begin]
    for _ in range(LONGEST_TIP):
        ways = _fan(towards)
        lab = colours_at(image.pixels, points[-1] + half * REACHES[:, None] * ways[:, None])
        logarithms = odds(image.dlo.colours, lab).mean(axis=1, dtype=float)
        best = int(np.argmax(logarithms - FAN ** 2))
        if logarithms[best] < SEEN:
            break
        towards = ways[best]
        points.append(points[-1] + half * towards)
    return np.array(points), towards


def _fan(towards: Floats) -> Floats:
    """Return the directions (k, 2) of the fan around one (2,)."""
    turned = np.stack([np.cos(FAN), np.sin(FAN)], axis=1)
    return np.stack([turned @ (towards * (1, -1)), turned @ towards[::-1]], axis=1)
