# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sheet: the printed one on the table, of which parts may have the colour of the DLO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.scale import Scale

COVER = (255, 0, 255)  # red, green, blue that nothing has


@dataclass(frozen=True, eq=False)
class Sheet:
    """
    A printed sheet on the table.

    :param parts: each (k, 4, 2), corners [m] of quadrilaterals.  The first part has the colours of all later
        ones, which lie over it and have one each.
    """

    parts: tuple[Floats, ...]

    def drawn(self, scale: Scale, shape: tuple[int, ...], values: Iterable[int]) -> NDArray[np.uint8]:
        """
        Return (h, w): the value of the part that a picture shows; 0 where it shows none, or none is known.

        :param shape: height and width of the picture [px].
        :param values: one of each part, 0 to 255.
        """
        found = np.zeros(shape, np.uint8)
        for part, value in zip(self.parts, values, strict=True):
            corners = part.reshape(-1, 2)
            places = scale.to_pixels(np.column_stack([corners, np.zeros(len(corners))]))
            if not np.isfinite(places).all():
                return np.zeros(shape, np.uint8)
            for polygon in np.rint(places).astype(np.int32).reshape(part.shape):
                cv2.fillConvexPoly(found, polygon, int(value))
        return found


NO_SHEET = Sheet(())
