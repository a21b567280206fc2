# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Obstacles on a photograph become a scene with the places and sizes that they have on the table."""


import numpy as np
import pytest

from dlo_calibration.capture.document import Document
from dlo_calibration.capture.measurement import Measurement
from dlo_calibration.capture.obstacles import lines_around, place_obstacles, scene_document, seen_lines
from dlo_calibration.errors import InputError
from dlo_calibration.simulation.scene import read_scene
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.scale import Scale

A = 'aaaaaaaa'
TILT = 0.5  # rad, of the camera
CAMERA = np.array([0.3, -0.3, 0.8])  # m


def slanted():
    """Return the scale of a camera that looks at the table from the side."""
    matrix = np.array([[900.0, 0, 500], [0, 900, 400], [0, 0, 1]])
    rotation = np.array([[1.0, 0, 0], [0, -np.cos(TILT), -np.sin(TILT)], [0, np.sin(TILT), -np.cos(TILT)]])
    return Scale(Lens((1000, 800), matrix, np.zeros(0)), rotation, -rotation @ CAMERA, np.zeros(0), True)


def placed(scale, *obstacles):
    """Return obstacles that were clicked in a photograph with a scale."""
    document = Document.of({'photographs': [{'id': A}], 'obstacles': [
        {'photograph': A, **obstacle} for obstacle in obstacles]})
    return place_obstacles(document, {A: Measurement(document.photographs[0], scale=scale)})


def clicked(scale, kind, first, second, height, **more):
    """Return an obstacle whose top was clicked at two places on the table, x y [m]."""
    pixels = scale.to_pixels([[*first, height], [*second, height]]).tolist()
    return {'kind': kind, 'first': pixels[0], 'second': pixels[1], 'height': height, **more}


def test_a_peg_and_a_turned_box_stand_where_they_are_however_the_camera_looks(tmp_path):
    scale, turn = slanted(), 0.4
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    middle, half = np.array([0.35, 0.2]), 0.06 * along + 0.02 * across
    obstacles = placed(scale, clicked(scale, 'peg', (0.2, 0.1), (0.204, 0.103), 0.08),
                       clicked(scale, 'box', middle - half, middle + half, 0.05, turn=turn))
    (tmp_path / 'obstacles.urdf').write_bytes(scene_document(obstacles))
    peg, box = read_scene(str(tmp_path / 'obstacles.urdf'))
    assert (peg.shape, box.shape) == ('cylinder', 'box')
    assert peg.sizes == pytest.approx([0.08, 0.005], abs=1e-7)  # length and radius
    assert peg.position == pytest.approx([0.2, 0.1, 0.04], abs=1e-7)
    assert box.sizes == pytest.approx([0.12, 0.04, 0.05], abs=1e-7)
    assert box.position == pytest.approx([0.35, 0.2, 0.025], abs=1e-7)
    assert box.turn == pytest.approx([0, 0, np.sin(0.2), np.cos(0.2)])
    assert (peg.friction, box.friction) == (1, 1)


def test_its_lines_are_drawn_around_its_top_and_its_foot():
    scale = slanted()
    peg, = placed(scale, clicked(scale, 'peg', (0.2, 0.1), (0.22, 0.1), 0.08))
    top, foot = seen_lines(lines_around(peg), scale)
    for line, height in ((top, 0.08), (foot, 0.0)):
        around = scale.to_table(line, height)[:, :2] - (0.2, 0.1)
        assert np.linalg.norm(around, axis=1) == pytest.approx(np.full(len(around), 0.02))
        assert line[0] == pytest.approx(line[-1])


@pytest.mark.parametrize('obstacle, why', [
    ({'kind': 'peg', 'first': [500, 400], 'second': [500, 400]}, '0 mm between its clicks'),
    ({'kind': 'box', 'first': [500, 400], 'second': [600, 400], 'height': 0.9}, 'camera does not see'),
])
def test_what_cannot_be_placed_is_said(obstacle, why):
    problem, = placed(slanted(), obstacle)
    assert isinstance(problem, InputError)
    assert str(problem).startswith('obstacle 1') and why in str(problem)


def test_an_obstacle_in_a_photograph_without_a_scale_is_not_forgotten():
    problem, = placed(None, {'kind': 'peg', 'first': [500, 400], 'second': [510, 400]})
    assert 'a photograph without a scale' in str(problem)
