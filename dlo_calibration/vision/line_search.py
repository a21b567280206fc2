# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where in the whole picture, reduced, a DLO's colour is, and the paths along it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Bools
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.elastic import directions
from dlo_calibration.vision.middle_line import odds

REDUCED = 4.0  # px, width of the DLO in the picture in which colours are counted
LEAST_AREA = 2.0  # squares of the DLO's width: a smaller area is nothing
THICKER = 1.7  # widths, from which on an area is another thing, say a hand
WRONG_LENGTH = 0.05  # share of the length by which a line that is found again may differ
LEAST_PATH = 8  # points


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


def elsewhere(image: DloImage, line: Floats, shown: float) -> tuple[Bools, float, float]:
    """
    Return where else than at a line (n, 2) the reduced picture shows the DLO.

    :param shown: share of the DLO's area that has its colour.
    :returns: the places, and the areas elsewhere and at the line [px^2 of the picture].
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
    found, own = np.asarray(large[parts]), mask & (covered == 1)
    return found, float(np.count_nonzero(found)) * factor ** 2, float(np.count_nonzero(own)) * factor ** 2


def largest_path(mask: Bools, factor: int) -> Floats | None:
    """Return the path (n, 2) [px] along the largest area of a reduced picture; None: there is none."""
    parts, number = label(mask, np.ones((3, 3)))
    if not number:
        return None
    sizes = np.bincount(parts.ravel())[1:]
    v, u = np.nonzero(parts == int(np.argmax(sizes)) + 1)
    path = _longest(u, v, mask)
    return path * factor if len(path) >= LEAST_PATH else None


def _longest(u: NDArray[np.int64], v: NDArray[np.int64], mask: Bools) -> Floats:
    """Return the path (n, 2) between the two places of an area that are farthest apart within it."""
    depth = distance_transform_edt(mask)[v, u]
    index = np.full(mask.shape, -1)
    index[v, u] = np.arange(len(u))
    rows, columns, costs = [], [], []
    height, width = mask.shape
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


def bridge(image: DloImage, before: Floats, after: Floats, length: float) -> Floats | None:
    """Return the smooth curve (n, 2) [px] of a length from one line to another; None: none has it."""
    share = np.linspace(0.0, 1.0, 22)[1:-1]
    gap = float(np.linalg.norm(after[0] - before[-1]))
    ways = [directions(part[[0, -1]])[0] for part in (before, after)]
    low, high = 0.0, 3.0
    for _ in range(20):
        middle = (low + high) / 2
        slopes = [middle * gap * way for way in ways]
        curve = CubicHermiteSpline((0.0, 1.0), (before[-1], after[0]), slopes)(share)
        whole = np.concatenate([before[-1:], curve, after[:1]])
        excess = float(image.arc_lengths(whole)[-1]) / max(length, 1e-9) - 1
        low, high = (middle, high) if excess < 0 else (low, middle)
    return np.asarray(curve) if abs(excess) < WRONG_LENGTH else None
