# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Board sheet: the board as a PDF document, to be printed at its true size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dlo_calibration.capture.board import (
    CELLS,
    COLUMNS,
    MARKER,
    marker_cells,
    marker_squares,
    Paper,
    PAPERS,
    ROWS,
    RULER,
    SQUARE,
)
from dlo_calibration.writing import whole

INCH = 0.0254  # m
BOTTOM = 0.040  # m, from the lower edge of the paper to the squares: room for the ruler line
ARROW = 0.012  # m
DARK = 'black'


def write_board(path: Path, paper: str = 'a4') -> None:
    """
    Write the board for a size of paper, `a4` or `letter`, as a PDF document.

    :raises InputError: where the file cannot be written.
    """
    with whole(path) as new:
        board_figure(paper).savefig(new, format='pdf', metadata={
            'CreationDate': None, 'Title': f'Board for {PAPERS[paper].name}'})


def board_figure(paper: str = 'a4') -> Any:
    """Return the board as a figure of Matplotlib, with the size of the paper."""
    from matplotlib.figure import Figure

    sheet = PAPERS[paper]
    figure = Figure(figsize=(sheet.width / INCH, sheet.height / INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, sheet.width), ylim=(0.0, sheet.height))  # m on the paper
    axes.set_axis_off()
    left = (sheet.width - COLUMNS * SQUARE) / 2.0
    _draw_squares(axes, sheet, left, BOTTOM)
    _draw_frame(axes, left, BOTTOM)
    _draw_ruler(axes, sheet)
    return figure


def _draw_squares(axes: Any, sheet: Paper, left: float, bottom: float) -> None:
    """Draw the black squares and the markers in the white ones."""
    black, white = [], []
    top = bottom + ROWS * SQUARE
    for column in range(COLUMNS):
        for row in range(column % 2, ROWS, 2):
            black.append((left + column * SQUARE, top - (row + 1) * SQUARE, SQUARE))
    inset, cell = (SQUARE - MARKER) / 2.0, MARKER / CELLS
    for number, (column, row) in enumerate(marker_squares(), sheet.first):
        x, y = left + column * SQUARE + inset, top - row * SQUARE - inset
        black.append((x, y - MARKER, MARKER))
        white += [(x + across * cell, y - (down + 1) * cell, cell)
                  for down, across in np.argwhere(marker_cells(number))]
    for squares, colour in ((black, DARK), (white, 'white')):
        _fill(axes, squares, colour)


def _fill(axes: Any, squares: list[tuple[float, float, float]], colour: str) -> None:
    """Fill squares, given by their lower left corners and sides [m]."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    points = np.concatenate([np.array([x, y]) + side * corners for x, y, side in squares])
    codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(squares)
    axes.add_patch(PathPatch(Outline(points, codes), facecolor=colour, linewidth=0.0))


def _draw_frame(axes: Any, left: float, bottom: float) -> None:
    """Draw the directions of x and y beside the corner where the board's frame has its origin."""
    gap = 0.003
    for label, (begin_x, begin_y), (right, up) in (('x', (left, bottom - gap), (1, 0)),
                                                   ('y', (left - gap, bottom), (0, 1))):
        end = begin_x + ARROW * right, begin_y + ARROW * up
        axes.annotate('', end, (begin_x, begin_y), arrowprops={'arrowstyle': '-|>', 'color': DARK, 'lw': 1.0,
                                                             'shrinkA': 0, 'shrinkB': 0})
        axes.text(end[0] + 0.003 * right, end[1] + 0.003 * up, label, ha='center', va='center', fontsize=9)
    axes.text(left - gap, bottom - gap, '0', ha='center', va='center', fontsize=9)


def _draw_ruler(axes: Any, sheet: Paper) -> None:
    """Draw the line of known length, and what to do with it."""
    begin, y = (sheet.width - RULER) / 2.0, 0.023
    ends = [(begin, 0.002), (begin + RULER, 0.002), (begin + RULER / 2.0, 0.001)]
    axes.plot([begin, begin + RULER], [y, y], color=DARK, lw=0.8, solid_capstyle='butt')
    for x, half in ends:
        axes.plot([x, x], [y - half, y + half], color=DARK, lw=0.8, solid_capstyle='butt')
    axes.text(sheet.width / 2.0, y + 0.004, f'This line is {1e3 * RULER:.0f} mm long: measure it.',
              ha='center', va='bottom', fontsize=10)
    axes.text(sheet.width / 2.0, y - 0.005, f'{sheet.name}. Print it at 100 % ("actual size"), '
              'lay it flat on the table beside the DLO.', ha='center', va='top', fontsize=9)
