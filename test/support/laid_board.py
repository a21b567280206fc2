# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The printed board, laid on a table that is photographed (photographs.py)."""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
from photographs import Sheet

from dlo_calibration.vision.board import board_figure, BOTTOM, COLUMNS, INCH, PAPERS, SQUARE

FINENESS = 200  # pixels per inch of the picture of the sheet


@functools.cache
def sheet_picture(paper):
    """Return the printed sheet as a picture (h, w, 3) uint8."""
    figure = board_figure(paper)
    figure.set_dpi(FINENESS)
    canvas = FigureCanvasAgg(figure)
    with matplotlib.rc_context({'path.snap': False}):  # else edges lie on whole pixels
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@dataclass(frozen=True)
class LaidBoard:
    """
    A sheet of paper with the board.

    :param corner: its lower left corner (x, y) on the table [m].
    :param turn: of the sheet around that corner [rad].
    """

    corner: tuple[float, float]
    turn: float = 0.0
    paper: str = 'a4'

    @property
    def sheet(self):
        """What a photograph shows."""
        picture = sheet_picture(self.paper)
        height, width = picture.shape[:2]  # of whole pixels: a little smaller than the paper
        return Sheet(picture, (width * INCH / FINENESS, height * INCH / FINENESS), self.corner, self.turn)

    def seen_from(self, points):
        """Return points (n, 3) of the table [m] in the board's frame."""
        points = np.asarray(points, dtype=float)
        cosine, sine = math.cos(self.turn), math.sin(self.turn)
        x, y = (points[:, :2] - self.corner).T
        left = (PAPERS[self.paper].width - COLUMNS * SQUARE) / 2
        return np.column_stack([cosine * x + sine * y - left, cosine * y - sine * x - BOTTOM, points[:, 2]])
