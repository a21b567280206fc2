# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where in the whole picture, reduced, a DLO's colour is, and the paths along it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Bools
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.middle_line import odds

REDUCED = 4.0  # px, width of the DLO in the picture in which colours are counted
LEAST_AREA = 2.0  # squares of the DLO's width: a smaller area is nothing
THICKER = 1.7  # widths, from which on an area is another thing, say a hand
LEAST_PATH = 8  # points
CLOSED = 5  # px of the reduced picture: gaps in a path that are nothing


def reduction(width: float) -> int:
    """Return by what a picture is reduced in which the DLO has a width [px]."""
    return max(1, int(width / REDUCED))


def coloured(image: DloImage, width: float) -> Bools:
    """Return where the reduced picture has the colour of the DLO, which has a width [px]."""
    factor = reduction(width)
    lab: Any = cv2.cvtColor(image.pixels[::factor, ::factor].astype(np.float32) / np.float32(255),
                            cv2.COLOR_RGB2Lab)
    # A mixture of colours, as of skin, has some pixels of the DLO's colour; the DLO has no others.
    side = max(2, round(0.6 * width / factor))
    return np.asarray(cv2.blur(odds(image.dlo.colours, lab), (side, side)) > image.dlo.alike)


def shown_places(image: DloImage, line: Floats, shown: float) -> tuple[Bools, Bools]:
    """
    Return where the reduced picture shows the DLO: at a line (n, 2) [px], and elsewhere.

    :param shown: share of the DLO's area that has its colour.
    """
    width = image.width(line)
    factor, mask = reduction(width), coloured(image, width)
    covered = np.zeros(mask.shape, np.uint8)
    points = np.rint(line / factor * 16).astype(np.int32)
    cv2.polylines(covered, [points], False, 1, round(2.5 * width / factor + 2), cv2.LINE_8, 4)
    free: Any = (mask & (covered == 0)).astype(np.uint8)
    kernel = np.ones((round(THICKER * width / factor) + 1,) * 2, np.uint8)
    free &= 1 - cv2.morphologyEx(free, cv2.MORPH_OPEN, kernel)
    _, parts, each, _ = cv2.connectedComponentsWithStats(free)
    large = each[:, cv2.CC_STAT_AREA] * float(factor ** 2) > LEAST_AREA * shown * width ** 2
    large[0] = False
    return mask & (covered == 1), np.asarray(large[parts])


def area(mask: Bools, factor: int) -> float:
    """Return the area of a reduced picture (h, w) [px^2 of the picture]."""
    return float(np.count_nonzero(mask)) * factor ** 2


def paths(mask: Bools, factor: int) -> list[Floats]:
    """Return the paths (n, 2) [px] along the areas of a reduced picture, the longest first."""
    kernel = np.ones((CLOSED, CLOSED), np.uint8)
    closed: Any = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    parts, _ = label(closed, np.ones((3, 3)))
    depths, found = distance_transform_edt(closed), []
    for number, part in enumerate(find_objects(parts), 1):
        v, u = np.nonzero(parts[part] == number)
        if len(v) >= LEAST_PATH:
            found.append(_longest(u + part[1].start, v + part[0].start, depths) * factor)
    return sorted((path for path in found if len(path) >= LEAST_PATH), key=len, reverse=True)


def _longest(u: NDArray[np.int64], v: NDArray[np.int64], depths: Floats) -> Floats:
    """Return the path between the two places of an area that are farthest apart within it."""
    depth = depths[v, u]
    index = np.full(depths.shape, -1)
    index[v, u] = np.arange(len(u))
    rows, columns, costs = [], [], []
    height, width = depths.shape
    for x, y in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        inside = (u + x >= 0) & (u + x < width) & (v + y < height)
        other = index[(v + y)[inside], (u + x)[inside]]
        pairs = np.flatnonzero(inside)[other >= 0]
        other = other[other >= 0]
        rows.append(pairs)
        columns.append(other)
        costs.append(np.hypot(x, y) * (1.0 + 2.0 / np.minimum(depth[pairs], depth[other]) ** 2))
    graph = coo_matrix((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))),
                       shape=(len(u), len(u))).tocsr()
    begin = 0
    for _ in range(2):
        far, before = dijkstra(graph, False, begin, return_predecessors=True)
        start, begin = begin, int(np.argmax(np.where(np.isfinite(far), far, -1.0)))
    path = [begin]
    while path[-1] != start and before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.column_stack([u[path], v[path]]).astype(float)
