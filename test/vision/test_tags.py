# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tags in pictures: their poses, their paths, and the sheet with tags to cut out."""

import io

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_calibration.errors import InputError
from dlo_calibration.vision.board import find_board, marker_cells, tags_figure
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tags import (
    QUIET,
    TAG_CELLS,
    tag_cells,
    tag_path,
    tag_poses,
    TAG_SIDE,
    TagFinder,
    TAGS,
)

SIZE = (1280, 720)
LENS = Lens(SIZE, np.array([[1100.0, 0, 639.5], [0, 1100.0, 359.5], [0, 0, 1]]), np.zeros(0))
LOOK = Rotation.from_euler('x', 150, degrees=True).as_matrix()  # from the table's frame: down, from the front
SCALE = Scale(LENS, LOOK, -LOOK @ np.array([0.0, -0.4, 0.7]), np.zeros(4), True)
PITCH = 20  # px of a cell in the picture of a tag


def picture(tags, noise=3.0, seed=0):
    """Return a picture of tags: number -> position and rotation in the table's frame."""
    image = np.full((SIZE[1] * 2, SIZE[0] * 2), 90, np.uint8)  # of light
    margin = round(QUIET / TAG_SIDE * TAG_CELLS * PITCH)
    for number, (position, rotation) in tags.items():
        cells = np.kron(tag_cells(number), np.ones((PITCH, PITCH), np.uint8))
        printed = np.pad(cells, margin, constant_values=255)
        half = TAG_SIDE / 2 + QUIET
        corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        seen = SCALE.to_pixels(corners @ rotation.T + position) * 2 + 0.5
        edges = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * len(printed) - 0.5
        view = cv2.getPerspectiveTransform(edges, seen.astype(np.float32))
        cv2.warpPerspective(printed, view, image.shape[::-1], image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    image = np.sqrt(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) / 255.0) * 255.0
    image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def angle(one, other):
    """Return the angle between rotations [deg]."""
    return np.rad2deg((Rotation.from_matrix(one).inv() * Rotation.from_matrix(other)).magnitude())


def moved(time):
    """Return where a tag is at a time [s]: it goes up and sideways, and turns."""
    place = np.array([-0.15 + 0.2 * time, 0.05 * np.sin(2 * time), 0.03 + 0.1 * time**2])
    return place, Rotation.from_euler('zx', [60 * time, 25 * np.sin(3 * time)], degrees=True).as_matrix()


def test_a_tag_gives_the_pose_of_a_hand():
    rotation = Rotation.from_euler('zyx', [40, 20, -30], degrees=True).as_matrix()
    tags = {0: (np.array([0.1, 0.02, 0.05]), rotation), 3: (np.array([-0.2, -0.05, 0.01]), np.eye(3))}
    found = TagFinder().find(picture(tags))
    assert set(found) == {0, 3}
    for number, (position, turn) in tags.items():
        poses = tag_poses(found[number], SCALE)
        best = min(range(len(poses.errors)), key=lambda k: angle(poses.rotations[k], turn))
        assert np.linalg.norm(poses.positions[best] - position) < 0.008
        assert angle(poses.rotations[best], turn) < 3.0


@pytest.mark.long
def test_the_path_of_a_tag_is_smooth_goes_on_over_short_gaps_and_leaves_out_long_ones():
    times = np.arange(0.0, 1.5, 1 / 30)
    finder, poses = TagFinder(), {}
    for k, time in enumerate(times):
        hidden = 0.3 < time < 0.45 or time > 1.3
        found = finder.find(picture({} if hidden else {1: moved(time)}, seed=k))
        poses.update({k: tag_poses(found[1], SCALE)} if 1 in found else {})
    path = tag_path(times, poses)
    assert np.isfinite(path.positions[times < 1.28]).all()
    assert np.isnan(path.positions[times > 1.32]).all()
    assert np.isnan(path.orientations[times > 1.32]).all()
    seen = times < 1.28
    truth = [moved(time) for time in times[seen]]
    away = np.linalg.norm(path.positions[seen] - [place for place, _ in truth], axis=1)
    turned = [angle(Rotation.from_quat(quaternion).as_matrix(), rotation)
              for quaternion, (_, rotation) in zip(path.orientations[seen], truth, strict=True)]
    assert np.sqrt(np.mean(away**2)) < 0.003  # OpenCV 4 and 5 differ by 0.1 mm
    assert np.mean(turned) < 2.0


def test_a_tag_that_jumps_is_found_at_once():
    finder = TagFinder()
    for place in (-0.2, -0.2, 0.2):
        assert set(finder.find(picture({2: (np.array([place, 0.0, 0.02]), np.eye(3))}))) == {2}


def test_no_marker_of_the_board_is_a_tag():
    image = np.full((900, 1200), 255, np.uint8)
    for number in range(62):
        row, column = divmod(number, 10)
        cells = np.kron(marker_cells(number), np.ones((12, 12), np.uint8))
        image[30 + 120 * row:102 + 120 * row, 30 + 115 * column:102 + 115 * column] = cells
    assert TagFinder().find(np.repeat(image[..., None], 3, axis=2)) == {}


@pytest.mark.parametrize('paper', ['a4', 'letter'])
def test_the_second_page_has_all_tags_in_their_true_size(paper):
    stream = io.BytesIO()
    tags_figure(paper).savefig(stream, format='png', dpi=100)
    pixels = cv2.imdecode(np.frombuffer(stream.getvalue(), np.uint8), cv2.IMREAD_COLOR)
    found = TagFinder().find(pixels)
    assert set(found) == set(range(TAGS))
    sides = [np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) for corners in found.values()]
    assert np.mean(sides) == pytest.approx(TAG_SIDE / 0.0254 * 100, rel=0.02)
    with pytest.raises(InputError, match='board'):
        find_board(pixels)
