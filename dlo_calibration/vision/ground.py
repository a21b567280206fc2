# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The ground on which a DLO lies, as the first image shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import SEEN
from dlo_calibration.vision.elastic import directions
from dlo_calibration.vision.middle_line import colours_at, odds
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.ridge import Singles
from dlo_calibration.vision.scale import Scale

SHADED = 2.2  # half widths from the middle of the DLO to the ground beside it and its shadow
BLACK = np.array([-16.0, 0.0, 0.0])  # L, a, b of a surface without light, as its cube root goes on
NOTHING = 1e3  # distance in L, a, b, larger than any between colours
LIGHT = (0.65, 1.1)  # L + 16, a, b of the ground in a shadow, or in more light, to those in the first image


@dataclass(frozen=True, eq=False)
class Ground:
    """
    The ground on which a DLO lies.

    :param pixels: (h, w, 3) RGB of the first image.
    :param scale: of it; None: lengths are those in the picture.
    :param line: (n, 2) the DLO in it [px].
    :param halves: (n,) half its width [px].
    """

    pixels: Pixels
    scale: Scale | None
    line: Floats
    halves: Floats

    def differences(self, lab: Singles, points: Floats, scale: Scale | None, dlo: Singles) -> Floats:
        """
        Return the distances (k,) in L, a, b of what an image shows from the ground, in whatever light.

        Where the DLO or its shadow lay, the ground may be that on either side of it.  What looks like the DLO
        is no ground; a point for which nothing else is known differs from nothing.  Light from a surface is
        proportional to that on it, and so are the cubes of L + 16, a and b (CIE 1976).

        :param lab: (k, m, 3) colours, of which the means over m are compared; each point has its own ground.
        :param points: (k, m, 2) where the image shows them [px].
        :param scale: of that image.
        :param dlo: table of the logarithm of the odds that a colour is the DLO's, as `odds` reads it.
        """
        flat = points.reshape(-1, 2)
        if self.scale is not None and scale is not None and self.scale is not scale:
            flat = self.scale.to_pixels(scale.points(flat))
        seen = lab.astype(float) - BLACK
        candidates, distances = [seen], [np.full(seen.shape[:2], NOTHING)]
        for places in (flat, *self._beside(flat)):
            colours = colours_at(self.pixels, places.reshape(points.shape))
            candidates.append(_lit(colours - BLACK, seen))
            distance = np.linalg.norm(seen - candidates[-1], axis=2)
            distances.append(np.where(odds(dlo, colours) < SEEN, distance, np.inf))
        nearest = np.argmin(distances, axis=0)[None, ..., None]
        ground = np.take_along_axis(np.array(candidates), nearest, axis=0)[0].mean(axis=1)
        return np.asarray(np.linalg.norm(seen.mean(axis=1) - ground, axis=1))

    def _beside(self, points: Floats) -> tuple[Floats, Floats]:
        """Return points (m, 2) [px] where the DLO is not: those on it are moved to the left, to the right."""
        distance = np.linalg.norm(points[:, None] - self.line, axis=2)
        nearest = distance.argmin(axis=1)
        reach = SHADED * self.halves[nearest]
        tangents = directions(self.line)[nearest]
        aside = reach[:, None] * np.column_stack([-tangents[:, 1], tangents[:, 0]])
        covered = (distance.min(axis=1) < reach)[:, None]
        left, right = (np.where(covered, self.line[nearest] + sign * aside, points) for sign in (-1.0, 1.0))
        return left, right


def _lit(colours: Floats, seen: Floats) -> Floats:
    """Return colours (..., 3), relative to `BLACK`, in the light in which they are nearest to other ones."""
    light = (seen * colours).sum(axis=-1) / (colours * colours).sum(axis=-1)
    return np.asarray(np.clip(light, *LIGHT)[..., None] * colours)
