# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Tags: printed squares, each glued on what holds the DLO, say on a clothes peg, tongs or a robot's finger.

Tag 0 is on the first hand, tag 1 on the second one.  The frame of a tag: its origin is the middle of the
square, x goes to the right as printed, y upwards, z out of the paper.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from dlo_calibration.vision.photograph import Pixels

TAGS = 8  # on the sheet: the most hands of an action
TAG_SIDE = 0.02  # m, of the black square; a white margin of QUIET surrounds it
TAG_CELLS = 7  # of a side: 5 bits and a border, so that no marker of the board (4 bits) is read as a tag
QUIET = 0.003  # m

_ARUCO: Any = cv2.aruco  # of any version


def tag_cells(number: int) -> Pixels:
    """Return the cells (7, 7) of a tag, 0 black and 255 white."""
    draw = _ARUCO.generateImageMarker if hasattr(_ARUCO, 'generateImageMarker') else _ARUCO.drawMarker
    return np.asarray(draw(_tag_dictionary(), number, TAG_CELLS))


def _tag_dictionary() -> Any:
    """Return the dictionary of tags: its codes differ in at least 8 bits, and are not the board's."""
    return _ARUCO.getPredefinedDictionary(_ARUCO.DICT_5X5_50)
