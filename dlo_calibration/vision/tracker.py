# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tracker: follows a DLO from image to image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace, Tracer

COUNT = 61  # points along the DLO


@dataclass(frozen=True, eq=False)
class Tracked:
    """
    Where a DLO is in an image.

    :param pixels: (count, 2) [px], evenly along the DLO: the same material points in each image; not a number
        where the DLO is not seen.
    :param width: of the DLO [px].
    :param lost: why the DLO is lost, one sentence; empty: it is not.
    """

    pixels: Floats
    width: float
    reason: str = ''

    def __post_init__(self) -> None:
        object.__setattr__(self, 'pixels', frozen_array(self.pixels))

    @property
    def lost(self) -> bool:
        """Whether the DLO is lost; then no point is a number."""
        return bool(self.reason)


class Tracker:
    """
    Follows a DLO from image to image, forwards or backwards in time.

    :param count: of points along the DLO.
    """

    def __init__(self, count: int = COUNT) -> None:
        self._count = count

    def start(self, pixels: Pixels, clicks: ArrayLike, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the first image.

        :param pixels: (h, w, 3) RGB.
        :param clicks: (k, 2) [px], k >= 2, rough, in order along the DLO.
        :param scale: of this image; None: the length is that in the picture.
        :raises InputError: where there is no DLO along the clicks.
        """
        return self._of(Tracer(pixels).trace(clicks))

    def next(self, pixels: Pixels, elapsed: float, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the next image.

        :param pixels: (h, w, 3) RGB.
        :param elapsed: time since the image before, also where that was earlier [s]; not below 0.
        :param scale: of this image; None only if there was none at the start.
        """
        try:
            return self._of(Tracer(pixels).trace(self._clicks))
        except InputError as error:
            return Tracked(np.full((self._count, 2), np.nan), self._width, str(error))

    def _of(self, trace: Trace) -> Tracked:
        arc = arc_lengths(trace.pixels)
        points = along_line(trace.pixels, arc, np.linspace(0, arc[-1], self._count))
        self._clicks, self._width = points[::max(1, self._count // 12)], trace.width
        return Tracked(points, trace.width)
