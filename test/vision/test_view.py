# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A film shows how its camera sees the table, image by image, or says that it does not."""

from dataclasses import replace
import functools

from films import Instant, plain_look, Renderer
from laid_board import LaidBoard
import numpy as np
from photographs import Camera
import pytest

from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.view import BoardFinder, first_lens

SIZE = (800, 600)
CAMERA = Camera(SIZE, 800.0, tilt=0.5, distance=0.75, target=(0.1, 0.1))
LENS = Lens(SIZE, CAMERA.matrix, np.zeros(4))
BOARD = LaidBoard((-0.05, -0.1))
PLACES = np.array([[-0.1, 0.25, 0.0], [0.1, 0.3, 0.0], [0.3, 0.1, 0.0]])


@functools.cache
def renderer():
    """Return the renderer of the table, which takes a second to make."""
    return Renderer(plain_look(sheets=(BOARD.sheet,)), 0.004, (-0.4, -0.4), (0.6, 0.6))


def seen(camera=CAMERA, covered=0.0):
    """Return an image, in which an arm of skin colour covers a share of the board from the right."""
    pixels = renderer().image([Instant(camera, None)])
    corners = camera.project(np.array([[-0.05, -0.1, 0.0], [0.16, 0.2, 0.0]]))
    low, high = corners.min(axis=0).astype(int) - 20, corners.max(axis=0).astype(int) + 20
    left = int(high[0] - covered * (high[0] - low[0]))
    if covered:
        pixels[:, left:high[0]] = (200, 150, 130)
        pixels[::16, left:high[0]] = (120, 80, 70)  # it has edges of its own
    return pixels


def error(scale, camera=CAMERA):
    """Return by how much places on the table are wrong, at most [m]."""
    found = scale.points(camera.project(PLACES))
    return float(np.linalg.norm(found - BOARD.seen_from(PLACES), axis=1).max())


@pytest.mark.long
@pytest.mark.parametrize('order', [(0, 0.3, 0.6, 0.8, 1.0, 0.7, 0.2, 0), (0.5, 0.7, 1.0, 0.6, 0.1, 0)])
def test_an_arm_before_the_board_does_not_move_a_camera_that_stands(order):
    finder = BoardFinder(LENS)
    scales = [finder.next(seen(covered=share)) for share in order]
    assert max(error(scale) for scale in scales) < 0.003
    assert len({id(scale) for scale in scales}) == 1


@pytest.mark.long
def test_a_camera_in_the_hand_is_followed_or_its_view_is_unknown():
    finder = BoardFinder(LENS)
    known = []
    for k in range(24):
        camera = replace(CAMERA, tilt=0.5 + 0.004 * k, turn=0.006 * k, target=(0.1 + 0.001 * k, 0.1))
        covered = 1.0 if 8 <= k < 12 else 0.85 if 12 <= k < 15 else 0.0
        scale = finder.next(seen(camera, covered))
        known.append(scale is not None)
        if scale is not None:
            assert error(scale, camera) < 0.004, k
    assert all(known[:8])
    assert not any(known[8:12])
    assert all(known[16:])


def test_a_camera_in_the_hand_that_hardly_moves_is_followed():
    finder = BoardFinder(LENS)
    places = np.concatenate([0.003 * np.arange(3), 0.006 + 0.00015 * np.arange(1, 13)])  # 0.15 px an image
    for k, place in enumerate(places):
        camera = replace(CAMERA, target=(0.1 + place, 0.1))
        assert error(finder.next(seen(camera)), camera) < 0.001, k


def test_one_view_of_the_board_gives_the_focal_length():
    assert first_lens(seen()).matrix[0, 0] == pytest.approx(800.0, rel=0.02)
