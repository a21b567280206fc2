# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Axis of a DLO on a table, in metres, from its middle line in a photograph.

The axis lies the DLO's radius above the table.  Where two strands cross, the upper one goes over the lower.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace

#: A beam on a table, lifted at one point by its diameter d, leaves the table (72 EI d / w)^(1/4) on either
#: side, with bending stiffness EI and weight per length w (Euler-Bernoulli; no force, moment or slope where
#: it leaves).  For ropes and cables this is 6 to 12 diameters.
BUMP = 8.0  # diameters
ENOUGH_POINTS = 1.5  # spacings of a chain in half a bump, at least, so that its curve can show it
TOLERANCE = 2e-5  # m, of the distance between two crossing strands
ITERATIONS = 12  # of raising a chain's points, at most


@dataclass(frozen=True, eq=False)
class Axis:
    """
    The axis of a DLO as a dense line.

    :param points: (n, 3) [m], first to last.
    :param sure: (n,) False where the photograph does not show it well.
    :param over: (c, 2) arc lengths [m] of the upper and the lower strand at each crossing.
    :param diameter: of the DLO [m].
    """

    points: Floats
    sure: NDArray[np.bool_]
    over: Floats
    diameter: float

    def __post_init__(self) -> None:
        object.__setattr__(self, 'points', frozen_array(self.points))
        object.__setattr__(self, 'sure', frozen_array(self.sure, bool))
        object.__setattr__(self, 'over', frozen_array(np.reshape(self.over, (-1, 2))))

    @cached_property
    def along(self) -> Floats:
        """Arc length at each point, (n,) [m], from 0."""
        return frozen_array(arc_lengths(self.points))

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(self.along[-1])

    def at(self, fractions: ArrayLike) -> Floats:
        """Return the points (m, 3) [m] at fractions (m,) of the length."""
        return along_line(self.points, self.along, np.asarray(fractions, float) * self.length)

    def chain(self, fractions: ArrayLike) -> Chain:
        """
        Return the chain of the points at fractions (m,) of the length.

        The points beside a crossing are raised where they are too far apart to show the bump, so that the
        crossing strands would come nearer than a diameter.
        """
        shares = np.asarray(fractions, float)
        chain = Chain(self.at(shares))
        for _ in range(ITERATIONS):
            lack = self.diameter - self.clearances(chain, shares)
            if not (lack > TOLERANCE).any():
                break
            points = chain.points.copy()
            for missing, (upper, _) in zip(lack, self.over / self.length, strict=True):
                if missing > TOLERANCE:
                    after = int(np.clip(np.searchsorted(shares, upper), 1, len(shares) - 1))
                    points[after - 1:after + 1, 2] += missing
            chain = Chain(points)
        return chain

    def clearances(self, chain: Chain, fractions: ArrayLike) -> Floats:
        """
        Return the height of the upper strand above the lower one at each crossing, (c,) [m].

        :param chain: of the points at `fractions` (m,) of the length.
        """
        shares = np.asarray(fractions, float)
        along = np.interp((self.over / self.length).ravel(), shares, chain.arc_lengths())
        heights = chain.resample(along)[:, 2].reshape(-1, 2)
        return np.asarray(heights[:, 0] - heights[:, 1])


def axis_of(trace: Trace, scale: Scale, diameter: float, count: int,
            above: Mapping[int, bool] | None = None) -> Axis:
    """
    Return the axis of a DLO on the table.

    :param trace: its middle line in the photograph.
    :param diameter: of the DLO [m].
    :param count: number of points that its chain will have.
    :param above: index of a crossing -> whether the first strand along the DLO is the upper one.  Elsewhere
        the second one is: a person lays the later part on top.
    """
    radius = diameter / 2
    flat = scale.to_table(trace.pixels, radius)
    along, along_pixels = arc_lengths(flat), arc_lengths(trace.pixels)
    both = np.array([(crossing.first, crossing.second) for crossing in trace.crossings]).reshape(-1, 2)
    both = np.interp(both.ravel(), along_pixels, along).reshape(-1, 2)
    answers = above or {}
    over = np.array([pair if answers.get(k, False) else pair[::-1] for k, pair in enumerate(both)])
    if not len(over):
        return Axis(flat, trace.sure, over, diameter)
    heights = radius + bumps(along, over, diameter, ENOUGH_POINTS * along[-1] / max(count - 1, 1))
    points = scale.to_table(trace.pixels, heights)
    lifted = arc_lengths(points)
    return Axis(points, trace.sure, np.interp(over.ravel(), along, lifted), diameter)


def measured_diameter(trace: Trace, scale: Scale) -> float:
    """Return the diameter of a round DLO on the table from its width in the photograph [m]."""
    points = scale.to_table(trace.pixels)
    normals = np.cross(np.gradient(points, axis=0), scale.camera - points)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    step = 5e-4  # m to either side
    pixels = scale.to_pixels(points + step * normals) - scale.to_pixels(points - step * normals)
    return trace.width / float(np.nanmedian(np.linalg.norm(pixels, axis=1))) * 2 * step


def bumps(along: Floats, over: Floats, diameter: float, least: float) -> Floats:
    """
    Return the height by which crossings lift a DLO, (n,) [m].

    A bump has the shape of a beam that is lifted at one point (see `BUMP`).  It ends before the strand passes
    below another one, where it lies on the table.

    :param along: (n,) arc lengths [m].
    :param over: (c, 2) arc lengths [m] of the upper and the lower strand at each crossing.
    :param least: half length of a bump [m], where there is room for it.
    """
    heights = np.zeros(len(along))
    for upper, _ in over:
        half = max(min(max(BUMP * diameter, least), float(np.abs(over[:, 1] - upper).min())), diameter / 2)
        t = np.clip(1.0 - np.abs(along - upper) / half, 0.0, 1.0)
        heights = np.maximum(heights, diameter * (4.0 * t**3 - 3.0 * t**4))
    return heights
