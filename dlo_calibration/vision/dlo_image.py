# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""An image in which a DLO is looked for: how large the DLO is in it, and where its borders are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Appearance, Bools, finenesses
from dlo_calibration.vision.ground import Ground
from dlo_calibration.vision.middle_line import arc_lengths, colours_at
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.scale import Scale

OTHER = 10.0  # distance in L, a, b from the ground, from which on a pixel shows something else


@dataclass(frozen=True, eq=False)
class DloImage:
    """
    An image in which a DLO is looked for.

    :param pixels: (h, w, 3) RGB.
    :param scale: None: lengths are those in the picture.
    :param dlo: what it looks like.
    :param ground: on which it lies.
    :param covered: (h, w) where something of its colour would hide it; None: nowhere.
    """

    pixels: Pixels
    scale: Scale | None
    dlo: Appearance
    ground: Ground
    covered: Bools | None = None

    def finenesses(self, line: Floats) -> Floats:
        """Return the pixels (n - 1,) to a unit of the length, of each segment of a line (n, 2)."""
        return finenesses(line, self.scale)

    def halves(self, line: Floats) -> Floats:
        """Return half the width (n,) of the DLO [px] at each point of a line (n, 2)."""
        return self.dlo.halves(line, self.scale)

    def width(self, line: Floats) -> float:
        """Return the width of the DLO [px] along a line (n, 2)."""
        return 2.0 * self.dlo.half * float(np.median(self.finenesses(line)))

    def arc_lengths(self, line: Floats) -> Floats:
        """Return the length (n,) from the beginning of a line (n, 2) [px], in the DLO's unit."""
        return arc_lengths(self.flat(line))

    def flat(self, line: Floats) -> Floats:
        """Return a line (n, 2) [px] on the table (n, 3) [m]; without a scale, the line itself."""
        return line if self.scale is None else self.scale.points(line)

    def inside(self, points: Floats, margin: float) -> Bools:
        """Tell which points (n, 2) [px] are farther than a margin within the picture, and not covered."""
        most = np.array(self.pixels.shape[1::-1]) - 1
        found = np.asarray(((points > margin) & (points < most - margin)).all(axis=1))
        if self.covered is not None:
            u, v = np.clip(np.rint(np.where(found[:, None], points, 0.0)), 0, most).astype(int).T
            found &= ~self.covered[v, u]
        return found

    def hidden(self, points: Floats) -> Bools:
        """Tell at which points (n, 2) [px] something hides the ground, or the picture does not show it."""
        lab = colours_at(self.pixels, points[:, None])
        strange = self.ground.differences(lab, points[:, None], self.scale, self.dlo.colours)
        return np.asarray((strange > OTHER) | ~self.inside(points, 0.0))
