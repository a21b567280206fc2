# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Board: a ChArUco board, which is printed, laid beside the DLO, and found in the photograph.

Its frame: the origin is the lower left corner of the squares, x goes along the paper's short side to the
right, y along the long side upwards, z up from the paper.  Of OpenCV, only the markers and their corners
are used: the order of a board's corners, its origin and its colours differ between its versions.
The sheet is a PDF document, to be printed at its true size; its second page has tags to cut out.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
import io
import itertools
from pathlib import Path
from typing import Any, Mapping

import cv2
import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.sheet import Sheet
from dlo_calibration.vision.tags import QUIET, TAG_CELLS, tag_cells, TAG_SIDE, TAGS
from dlo_calibration.writing import write_file

COLUMNS, ROWS = 7, 9  # squares; those in the corners are black
SQUARE, MARKER = 0.025, 0.0175  # m, sides
INSET = (SQUARE - MARKER) / 2.0  # m, of a marker in its square
RULER = 0.1  # m, length of the printed line that shows whether the printer changed the size
CELLS = 6  # of a marker's side: 4 bits and a border
MARKERS = COLUMNS * ROWS // 2  # one in each white square
EDGE = 0.002  # m beside the edge of a square, where a picture may show either colour
FEWEST_CORNERS = 8  # of 48: a third of the sheet, which still determines how it lies
FEWEST_MARKERS = 3
ENOUGH_CORNERS = 36  # that make a search in a larger picture needless
REDUCED = 1600  # px, of the longer side, for the first search for markers
ENLARGED = 4000  # px, of the longer side, up to which a picture is searched at twice its size
SMALLEST = 0.01  # perimeter of a marker, of the picture's longer side; OpenCV itself takes 0.03

_ARUCO: Any = cv2.aruco  # of any version
INCH = 0.0254  # m
BOTTOM = 0.040  # m, from the lower edge of the paper to the squares: room for the ruler line
ARROW = 0.012  # m
TAGS_IN_A_ROW, TAG_PITCH = 4, 0.04  # of the second page; m from tag to tag
DARK = 'black'


@dataclass(frozen=True)
class Paper:
    """
    A size of paper.

    :param width: and `height`, upright [m].
    :param first: number of the first marker; the sizes have different ones, and so can be distinguished.
    """

    name: str
    width: float
    height: float
    first: int


PAPERS: Mapping[str, Paper] = {'a4': Paper('A4', 0.210, 0.297, 0),
                               'letter': Paper('Letter', 0.2159, 0.2794, MARKERS)}


def printed_sheet(printed: float = RULER) -> Sheet:
    """
    Return the sheet in the board's frame: all of it, the white around the squares, and the black squares.

    Of the first part, the squares with markers and what is beside the edges of squares are left.

    :param printed: length of the board's ruler line, as measured on the print [m].
    """
    # Of every size of paper.  A printer that changes the size leaves the middle of the page where it was.
    half_width = max(paper.width for paper in PAPERS.values()) / 2.0
    height = max(paper.height for paper in PAPERS.values())
    middle = COLUMNS * SQUARE / 2.0
    left, lower, right, upper = middle - half_width, -BOTTOM, middle + half_width, height - BOTTOM
    first, last, top = -EDGE, COLUMNS * SQUARE + EDGE, ROWS * SQUARE + EDGE
    white = [_rectangle(left, lower, right, first), _rectangle(left, top, right, upper),
             _rectangle(left, lower, first, upper), _rectangle(last, lower, right, upper)]
    black = [_rectangle(column * SQUARE + EDGE, row * SQUARE + EDGE, (column + 1) * SQUARE - EDGE,
                        (row + 1) * SQUARE - EDGE)
             for column, row in itertools.product(range(COLUMNS), range(ROWS)) if (column + row) % 2 == 0]
    return Sheet(tuple(np.array(part) * (printed / RULER) for part in (
        [_rectangle(left, lower, right, upper)], white, black)))


def _rectangle(left: float, bottom: float, right: float, top: float) -> Floats:
    return np.array([(left, bottom), (right, bottom), (right, top), (left, top)])


def marker_squares() -> list[tuple[int, int]]:
    """Return column and row, from the upper left, of each square with a marker, in the markers' order."""
    places = itertools.product(range(ROWS), range(COLUMNS))
    return [(column, row) for row, column in places if (column + row) % 2]


def marker_cells(number: int) -> Pixels:
    """Return the cells (6, 6) of a marker, 0 black and 255 white."""
    draw = _ARUCO.generateImageMarker if hasattr(_ARUCO, 'generateImageMarker') else _ARUCO.drawMarker
    return np.asarray(draw(_dictionary(), number, CELLS))


def find_board(pixels: Pixels, printed: float = RULER) -> tuple[Floats, Floats]:
    """
    Return the corners of the board's squares in a photograph: (k, 2) pixels, and (k, 2) in its frame [m].

    :param pixels: (h, w, 3) red, green, blue of the photograph.
    :param printed: length of the board's ruler line, as measured on the print [m].
    :raises InputError: where too little of it is seen.
    """
    if not 0.5 * RULER <= printed <= 2.0 * RULER:
        raise InputError('length of the ruler line', f'{printed:g} m',
                         f'{0.5 * RULER:g} m to {2.0 * RULER:g} m', 'measure it in metres')
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    best = np.zeros((0, 2)), np.zeros((0, 2))
    full = max(grey.shape)
    for longest in dict.fromkeys((min(REDUCED, full), full, 2 * full if 2 * full <= ENLARGED else full)):
        markers = _markers(grey, longest)
        for paper in PAPERS.values():
            seen, places = _corners(grey, {number - paper.first: marker for number, marker in markers.items()
                                           if 0 <= number - paper.first < MARKERS})
            best = max(best, (seen, places), key=lambda corners: len(corners[0]))
        if len(best[0]) >= ENOUGH_CORNERS:
            break
    seen, places = best
    if len(seen) >= FEWEST_CORNERS and np.linalg.matrix_rank(places - places[0], SQUARE / 2.0) == 2:
        return seen, places * (printed / RULER)
    raise InputError('board', f'{len(seen)} of its {(COLUMNS - 1) * (ROWS - 1)} corners',
                     f'at least {FEWEST_CORNERS}, seen sharply and without a reflection',
                     'lay it flat beside the DLO, wholly in the picture, and take the photograph from nearer')


def _dictionary() -> Any:
    """Return the predefined dictionary of markers, which OpenCV before and after 4.7 both know."""
    return _ARUCO.getPredefinedDictionary(_ARUCO.DICT_4X4_100)


def _detected(grey: Pixels) -> tuple[Any, Any]:
    """Return the corners and numbers of markers; OpenCV has another interface since 4.7."""
    new = hasattr(_ARUCO, 'ArucoDetector')
    options = _ARUCO.DetectorParameters() if new else _ARUCO.DetectorParameters_create()
    options.minMarkerPerimeterRate = SMALLEST
    options.errorCorrectionRate = 1.0  # a misread marker does not lie where the others say (`_consistent`)
    if new:
        corners, numbers, _ = _ARUCO.ArucoDetector(_dictionary(), options).detectMarkers(grey)
    else:
        corners, numbers, _ = _ARUCO.detectMarkers(grey, _dictionary(), parameters=options)
    return corners, numbers


def _markers(grey: Pixels, longest: int) -> dict[int, Floats]:
    """Return the corners (4, 2) [px] of each marker, found in the picture scaled to a longer side [px]."""
    scale = longest / max(grey.shape)
    height, width = (round(scale * side) for side in grey.shape)
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    scaled = grey if scale == 1.0 else cv2.resize(grey, (width, height), interpolation=way)
    corners, numbers = _detected(scaled)
    back = np.array([grey.shape[1] / width, grey.shape[0] / height])
    return {int(number): (marker.reshape(4, 2).astype(float) + 0.5) * back - 0.5
            for number, marker in zip([] if numbers is None else np.ravel(numbers), corners, strict=True)}


def _corners(grey: Pixels, markers: dict[int, Floats]) -> tuple[Floats, Floats]:
    """
    Return the corners (k, 2) [px] between black squares, and their places (k, 2) [m].

    Each marker gives the corners of its square, also where the lens bends the board.  The estimates of the
    markers beside a corner are averaged, and then moved to where the edges meet.
    """
    estimates: dict[tuple[int, int], list[Floats]] = defaultdict(list)
    sides: dict[tuple[int, int], list[float]] = defaultdict(list)
    for number, seen in _consistent(markers).items():
        column, row = marker_squares()[number]
        view = cv2.getPerspectiveTransform(_square(INSET, INSET, MARKER), seen.astype(np.float32))
        corners = cv2.perspectiveTransform(_square(0.0, 0.0, SQUARE)[:, None], view).reshape(4, 2)
        side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
        for corner, (right, down) in zip(corners, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
            place = column + right, row + down
            if 0 < place[0] < COLUMNS and 0 < place[1] < ROWS:
                estimates[place].append(corner)
                sides[place].append(side)
    meetings, places = [], []
    for place in sorted(estimates):
        side = min(sides[place])
        corner = _refined(grey, np.mean(estimates[place], axis=0), side)
        if corner is not None and np.ptp(estimates[place], axis=0).max() < 0.2 * side:
            meetings.append(corner)
            places.append((place[0] * SQUARE, (ROWS - place[1]) * SQUARE))
    return _without_outliers(np.array(meetings).reshape(-1, 2), np.array(places).reshape(-1, 2))


def _without_outliers(corners: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return corners (k, 2) [px] and places (k, 2) [m] without corners that something partly covers."""
    if len(corners) < FEWEST_CORNERS:
        return corners, places
    view, _ = cv2.findHomography(places, corners, cv2.LMEDS)
    if view is None:
        return corners[:0], places[:0]
    errors = np.linalg.norm(cv2.perspectiveTransform(places[:, None], view)[:, 0] - corners, axis=1)
    inliers = errors <= max(4.0 * float(np.median(errors)), 0.6)  # the distortion of a lens stays below
    return corners[inliers], places[inliers]


def _consistent(markers: dict[int, Floats]) -> dict[int, Floats]:
    """Return the markers that lie together as on the board; the others are misreadings."""
    if len(markers) < FEWEST_MARKERS:
        return {}
    places = np.concatenate([_square(column * SQUARE + INSET, row * SQUARE + INSET, MARKER)
                             for column, row in (marker_squares()[number] for number in markers)])
    seen = np.concatenate(list(markers.values()))
    side = float(np.median([np.linalg.norm(marker[0] - marker[1]) for marker in markers.values()]))
    _, near = cv2.findHomography(places, seen, cv2.RANSAC, 0.25 * side)  # a lens may bend the board
    if near is None:
        return {}
    # All four corners: those of a misreading lie elsewhere, or are turned.
    inliers = near.reshape(-1, 4).all(axis=1)
    if inliers.sum() < FEWEST_MARKERS:
        return {}
    return {number: marker for (number, marker), near in zip(markers.items(), inliers, strict=True) if near}


def _refined(grey: Pixels, corner: Floats, side: float) -> Floats | None:
    """Return where black squares of `side` px meet near a pixel (2,), to a fraction of a pixel, or None."""
    half = max(round(0.12 * side), 3)  # the markers' corners stay outside
    height, width = grey.shape
    if not (half + 2 < corner[0] < width - half - 3 and half + 2 < corner[1] < height - half - 3):
        return None
    left, top = (int(coordinate) - 2 * half - 4 for coordinate in corner)
    left, top = max(left, 0), max(top, 0)
    piece = np.ascontiguousarray(grey[top:top + 4 * half + 9, left:left + 4 * half + 9])
    start = (corner - (left, top)).astype(np.float32).reshape(1, 1, 2)
    ends = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
    places = cv2.cornerSubPix(piece, start.copy(), (half, half), (-1, -1), ends)
    refined: Floats = places.reshape(2) + (left, top)
    return refined if np.linalg.norm(refined - corner) < max(half, 3.0) else None


def _square(left: float, top: float, side: float) -> Any:
    """Return the corners (4, 2) of a square, clockwise from the upper left."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side + (left, top)
    return corners.astype(np.float32)


def write_board(path: Path, paper: str = 'a4') -> None:
    """
    Write the board for a size of paper, `a4` or `letter`, as a PDF document.

    :raises InputError: where the file cannot be written.
    """
    write_file(path, board_document(paper))


def board_document(paper: str = 'a4') -> bytes:
    """Return the PDF document of the board, and of tags to cut out, for a size of paper."""
    from matplotlib.backends.backend_pdf import PdfPages

    stream = io.BytesIO()
    metadata = {'CreationDate': None, 'Title': f'Board for {PAPERS[paper].name}'}
    with PdfPages(stream, metadata=metadata) as pages:
        for figure in (board_figure(paper), tags_figure(paper)):
            pages.savefig(figure)
    return stream.getvalue()


def board_figure(paper: str = 'a4') -> Any:
    """Return the board as a figure of Matplotlib, with the size of the paper."""
    sheet = PAPERS[paper]
    figure, axes = _blank(sheet)
    left = (sheet.width - COLUMNS * SQUARE) / 2.0
    _draw_squares(axes, sheet, left, BOTTOM)
    _draw_frame(axes, left, BOTTOM)
    _draw_ruler(axes, sheet)
    return figure


def tags_figure(paper: str = 'a4') -> Any:
    """Return the tags to cut out, as a figure of Matplotlib with the size of the paper."""
    sheet = PAPERS[paper]
    figure, axes = _blank(sheet)
    side, cell = TAG_SIDE + 2.0 * QUIET, TAG_SIDE / TAG_CELLS
    for number in range(TAGS):
        row, column = divmod(number, TAGS_IN_A_ROW)
        left = sheet.width / 2.0 + (column - TAGS_IN_A_ROW / 2.0) * TAG_PITCH + (TAG_PITCH - side) / 2.0
        bottom = sheet.height - 0.06 - row * TAG_PITCH
        axes.plot(left + side * np.array([0, 1, 1, 0, 0]), bottom + side * np.array([0, 0, 1, 1, 0]),
                  color='0.6', lw=0.4)  # where to cut
        x, y = left + QUIET, bottom + QUIET
        _fill(axes, [(x, y, TAG_SIDE)], DARK)
        _fill(axes, [(x + across * cell, y + TAG_SIDE - (down + 1) * cell, cell)
                     for down, across in np.argwhere(tag_cells(number))], 'white')
        axes.text(left + side / 2.0, bottom - 0.004, f'hand_{number + 1}', ha='center', va='center',
                  fontsize=9)
    axes.text(sheet.width / 2.0, sheet.height - 0.06 - 2.0 * TAG_PITCH + 0.02,
              'Cut out along the grey lines.  Glue each tag flat on what holds the DLO: a clothes peg, a\n'
              'pair of tongs, a finger of a robot, so that the camera sees it while the hand moves.',
              ha='center', va='top', fontsize=9)
    return figure


def _blank(sheet: Paper) -> tuple[Any, Any]:
    """Return a figure of Matplotlib with the size of a paper, and axes in metres on the paper."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sheet.width / INCH, sheet.height / INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, sheet.width), ylim=(0.0, sheet.height))
    axes.set_axis_off()
    return figure, axes


def _draw_squares(axes: Any, sheet: Paper, left: float, bottom: float) -> None:
    """Draw the black squares and the markers in the white ones."""
    black, white = [], []
    top = bottom + ROWS * SQUARE
    for column in range(COLUMNS):
        for row in range(column % 2, ROWS, 2):
            black.append((left + column * SQUARE, top - (row + 1) * SQUARE, SQUARE))
    cell = MARKER / CELLS
    for number, (column, row) in enumerate(marker_squares(), sheet.first):
        x, y = left + column * SQUARE + INSET, top - row * SQUARE - INSET
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
    """Draw the line of known length, and the instructions."""
    begin, y = (sheet.width - RULER) / 2.0, 0.023
    ends = [(begin, 0.002), (begin + RULER, 0.002), (begin + RULER / 2.0, 0.001)]
    axes.plot([begin, begin + RULER], [y, y], color=DARK, lw=0.8, solid_capstyle='butt')
    for x, half in ends:
        axes.plot([x, x], [y - half, y + half], color=DARK, lw=0.8, solid_capstyle='butt')
    axes.text(sheet.width / 2.0, y + 0.004, f'This line is {1e3 * RULER:.0f} mm long: measure it.',
              ha='center', va='bottom', fontsize=10)
    axes.text(sheet.width / 2.0, y - 0.005, f'{sheet.name}. Print it at 100 % ("actual size"), '
              'lay it flat on the table beside the DLO.', ha='center', va='top', fontsize=9)
