# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The board is printed at its true size, and found in photographs, by any version of OpenCV."""

import functools
import io
import re
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image
import pytest
from sheet_views import LENGTH, on_table, overhead, seen_sheet, SIZE, turned

from dlo_calibration.errors import InputError
from dlo_calibration.vision import board
from dlo_calibration.vision.board import (
    board_figure,
    BOTTOM,
    COLUMNS,
    find_board,
    PAPERS,
    ROWS,
    SQUARE,
    write_board,
)
from dlo_calibration.vision.pose import scale_from_points

SHEETS = pytest.mark.parametrize('paper', ['a4', 'letter'])
#: Where the sheet's lower left corner lies on the table [m], and how it is turned [degrees].
ORIGIN, TURN = np.array([0.12, -0.1]), 25.0


@functools.cache
def printed_sheet(paper):
    """Return (rows, columns) grey values of the printed sheet, 200 pixels an inch."""
    stream = io.BytesIO()
    board_figure(paper).savefig(stream, format='png', dpi=200)
    return np.asarray(Image.open(stream).convert('L'))


def photograph(camera, paper='a4', **options):
    sheet = PAPERS[paper]
    return seen_sheet(camera, printed_sheet(paper), sheet.width, sheet.height, ORIGIN, TURN, **options)


def on_sheet(places, paper='a4'):
    """Return where on the table places (k, 2) in the board's frame are [m]."""
    corner = (PAPERS[paper].width - COLUMNS * SQUARE) / 2.0, BOTTOM
    return turned(places + corner, TURN) + ORIGIN


@SHEETS
def test_the_document_has_the_size_of_the_paper(paper, tmp_path):
    write_board(tmp_path / 'board.pdf', paper)
    content = (tmp_path / 'board.pdf').read_bytes()
    width, height = re.search(rb'/MediaBox \[\s*0 0 ([0-9.]+) ([0-9.]+)', content).groups()
    assert float(width) / 72 * 0.0254 == pytest.approx(PAPERS[paper].width, abs=1e-6)
    assert float(height) / 72 * 0.0254 == pytest.approx(PAPERS[paper].height, abs=1e-6)
    assert PAPERS[paper].name.encode() in content
    write_board(tmp_path / 'again.pdf', paper)
    assert (tmp_path / 'again.pdf').read_bytes() == content


@SHEETS
def test_the_printed_ruler_has_the_length_that_it_names(paper):
    """In the row of its line, the sheet is dark over 100 mm, and nowhere else."""
    sheet = printed_sheet(paper)
    dark = sheet[round(len(sheet) - 0.023 / 0.0254 * 200) - 3:][:6].min(axis=0) < 128
    columns = np.flatnonzero(dark)
    assert (columns[-1] - columns[0] + 1) / 200 * 0.0254 == pytest.approx(0.1, abs=5e-4)
    assert dark[columns[0]:columns[-1] + 1].all()


@SHEETS
@pytest.mark.parametrize('tilt, turn, coefficients', [(0.0, 0.0, ()), (30.0, 100.0, (-0.1, 0.03, 0.0, 0.0)),
                                                      (45.0, 250.0, ())])
def test_the_board_is_found(paper, tilt, turn, coefficients):
    camera = overhead(tilt, turn, coefficients=coefficients)
    pixels, places = find_board(photograph(camera, paper))
    assert len(pixels) >= (COLUMNS - 1) * (ROWS - 1) - 3
    truth = camera.to_pixels(on_table(on_sheet(places, paper)))
    assert np.linalg.norm(pixels - truth, axis=1).max() < 0.4


def test_the_scale_from_a_board_reaches_across_the_table():
    camera = overhead(25.0, 60.0)
    pixels, places = find_board(photograph(camera))
    scale = scale_from_points(pixels, places, SIZE, camera.lens)
    assert scale.residual < 2e-4
    ends = np.array([[-0.25, -0.1], [-0.25, 0.15], [0.0, 0.0], [0.25, 0.15]])  # m, of the table
    at = scale.to_table(camera.to_pixels(on_table(ends, 0.005)), 0.005)[:, :2]
    assert np.linalg.norm(on_sheet(at) - ends, axis=1).max() < 7e-4


def test_a_print_of_another_size_is_measured():
    _, places = find_board(photograph(overhead()))
    _, smaller = find_board(photograph(overhead()), printed=0.097)
    assert smaller == pytest.approx(0.97 * places)
    with pytest.raises(InputError, match='in metres'):
        find_board(photograph(overhead()), printed=97.0)


def test_what_covers_a_part_of_the_board_does_not_bend_it():
    """A dark rope lies over the board; corners beside it are left out or right."""
    camera = overhead(20.0)
    picture = photograph(camera)
    line = camera.to_pixels(on_table(on_sheet(np.array([[-0.02, 0.03], [0.1, 0.1], [0.19, 0.21]]))))
    cv2.polylines(picture, [np.round(line).astype(np.int32)], False, (60, 40, 30), 14, cv2.LINE_AA)
    pixels, places = find_board(picture)
    truth = camera.to_pixels(on_table(on_sheet(places)))
    assert 20 < len(pixels) < 48
    assert np.linalg.norm(pixels - truth, axis=1).max() < 1.0


@pytest.mark.parametrize('distance, least', [(1.6, 40), (2.2, 20)])
def test_a_board_that_is_far_away_is_found(distance, least):
    camera = overhead(20.0, distance=distance, target=(0.2, 0.0))
    pixels, places = find_board(photograph(camera, noise=1.0))
    assert len(pixels) > least
    assert np.linalg.norm(pixels - camera.to_pixels(on_table(on_sheet(places))), axis=1).max() < 0.4


@pytest.mark.parametrize('make', [
    lambda picture: np.zeros_like(picture),
    lambda picture: np.ascontiguousarray(picture[:, ::-1]),  # as in a mirror
    lambda picture: cv2.GaussianBlur(picture, (0, 0), 8.0),
    lambda picture: np.random.default_rng(0).integers(0, 256, picture.shape).astype(np.uint8),
], ids=['black', 'mirrored', 'blurred', 'noise'])
def test_a_picture_without_a_board_is_refused(make):
    with pytest.raises(InputError, match='lay it flat beside the DLO'):
        find_board(make(photograph(overhead())))


def test_opencv_before_4_7_finds_the_same(monkeypatch):
    """A stand-in has the old interface's names; OpenCV 4.6 itself has them."""
    now = cv2.aruco
    if not hasattr(now, 'ArucoDetector'):
        pytest.skip('this OpenCV has the old interface itself')
    picture = photograph(overhead())
    expected = find_board(picture)
    cells = board.marker_cells(7)

    def detected(grey, dictionary, parameters):
        return now.ArucoDetector(dictionary, parameters).detectMarkers(grey)

    monkeypatch.setattr(board, '_ARUCO', SimpleNamespace(
        DICT_4X4_100=now.DICT_4X4_100, getPredefinedDictionary=now.getPredefinedDictionary,
        drawMarker=now.generateImageMarker, DetectorParameters_create=now.DetectorParameters,
        detectMarkers=detected))
    assert np.array_equal(find_board(picture)[0], expected[0])
    assert np.array_equal(board.marker_cells(7), cells)


def test_opencvs_own_board_is_the_same():
    """The board is OpenCV's ChArUco board, so other programs find its corners, too."""
    if not hasattr(cv2.aruco, 'CharucoDetector'):
        pytest.skip('this OpenCV has the old interface')
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    theirs = cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, board.MARKER, dictionary)
    picture = photograph(overhead())
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(
        cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    assert len(numbers) > 40
    ours = find_board(picture)[0]
    nearest = np.linalg.norm(corners.reshape(-1, 1, 2) - ours, axis=2).min(axis=1)
    assert np.median(nearest) < 1.0  # px; OpenCV 4.10 has them half a pixel off in u and v


def test_a_focal_length_in_the_file_serves_the_board():
    camera = overhead(20.0, 60.0)
    pixels, places = find_board(photograph(camera))
    scale = scale_from_points(pixels, places, SIZE, focal_length=1.02 * LENGTH)
    assert scale.lens.matrix[0, 0] == pytest.approx(LENGTH, rel=0.03)
