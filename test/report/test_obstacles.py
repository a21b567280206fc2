# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Outlines of obstacles are those of their shapes, and drawings show them behind the DLO."""

from dataclasses import replace

from exported_scene import write_scene
import numpy as np
from PIL import Image, ImageColor
import pytest
from toy_messages import toy_trials

from dlo_calibration.report.drawing import session_picture
from dlo_calibration.report.figure import OBSTACLE
from dlo_calibration.report.obstacles import ABOVE, MOST_TRIANGLES, outline, triangles_of
from dlo_calibration.simulation.scene import NO_TRIANGLES, Obstacle, read_scene

ASIDE = np.eye(3)[[0, 2]]  # the projection seen along y
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def obstacles(tmp_path):
    return read_scene(write_scene(tmp_path))


def extent(outline):
    """Return lower and upper ends of an outline."""
    return [*outline.min(axis=0), *outline.max(axis=0)]


def area(outline):
    """Return the area of a polygon, positive if it is anticlockwise."""
    x, y = outline.T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def test_a_box_that_is_turned_is_a_turned_rectangle(obstacles):
    seen = outline(obstacles[0], ABOVE)
    turn = np.array([[3**0.5, 1.0], [-1.0, 3**0.5]]) / 2  # from x, y to the edges of the box
    assert len(seen) == 4
    assert np.abs((seen - [0.3, 0.0]) @ turn.T) == pytest.approx(np.tile([0.1, 0.2], (4, 1)))
    assert area(seen) == pytest.approx(0.08)


def test_round_shapes_are_circles_from_above_and_as_high_as_they_are_long(obstacles):
    _, sphere, cylinder, capsule, _ = obstacles
    assert extent(outline(sphere, ABOVE)) == pytest.approx([-0.05, 0.25, 0.05, 0.35])
    assert extent(outline(sphere, ASIDE)) == pytest.approx([-0.05, 0, 0.05, 0.1])
    assert area(outline(sphere, ABOVE)) == pytest.approx(np.pi * 0.05**2, rel=0.01)
    assert area(outline(cylinder, ABOVE)) == pytest.approx(np.pi * 0.01**2, rel=0.01)
    assert extent(outline(cylinder, ASIDE)) == pytest.approx([-0.01, 0, 0.01, 0.2])
    assert extent(outline(capsule, ABOVE)) == pytest.approx([0.48, 0.43, 0.52, 0.57])  # it lies along y
    assert area(outline(capsule, ABOVE)) == pytest.approx(0.04 * 0.1 + np.pi * 0.02**2, rel=0.01)


def test_the_outline_of_a_mesh_is_its_hull(obstacles):
    assert extent(outline(obstacles[4], ABOVE)) == pytest.approx([-0.3, 0, -0.2, 0.1])
    assert extent(outline(obstacles[4], ASIDE)) == pytest.approx([-0.3, 0, -0.2, 0.2])


def test_a_flat_mesh_is_a_line_from_the_side():
    flat = Obstacle('mesh', np.ones(3), np.zeros(3), UPRIGHT, 1.0,
                    np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float))
    assert extent(outline(flat, ASIDE)) == pytest.approx([0, 0, 1, 0])


def test_a_fine_mesh_is_shown_with_fewer_triangles_of_the_same_shape():
    count = 120
    heights = np.linspace(0, 1, count + 1)
    angles = np.linspace(0, 2 * np.pi, count + 1)
    corners = np.stack([np.outer(np.ones(count + 1), np.cos(angles)), np.outer(np.ones(count + 1),
                        np.sin(angles)), np.outer(heights, np.ones(count + 1))], axis=2)
    first = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:]], axis=2)
    second = np.stack([corners[:-1, :-1], corners[1:, 1:], corners[1:, :-1]], axis=2)
    fine = Obstacle('mesh', np.ones(3), np.zeros(3), UPRIGHT, 1.0,
                    np.concatenate([first.reshape(-1, 3, 3), second.reshape(-1, 3, 3)]))
    coarse = triangles_of(fine)
    assert len(fine.triangles) > 5 * MOST_TRIANGLES > 5 * len(coarse) / 2
    assert np.linalg.norm(coarse[..., :2], axis=-1) == pytest.approx(np.ones(coarse.shape[:2]), abs=0.02)
    areas = np.linalg.norm(np.cross(coarse[:, 1] - coarse[:, 0], coarse[:, 2] - coarse[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(2 * np.pi, rel=0.05)


def pixels_of_obstacles(path):
    image = np.asarray(Image.open(path).convert('RGB')).astype(int)
    return int((np.abs(image - ImageColor.getrgb(OBSTACLE)).sum(axis=2) < 6).sum())


@pytest.mark.long
def test_pictures_show_obstacles_and_the_same_section(tmp_path):
    trial, = toy_trials(1)
    middle = trial.initial.points.mean(axis=0)
    near = Obstacle('box', np.full(3, 0.2), middle, UPRIGHT, 1.0, NO_TRIANGLES)
    far = replace(near, position=middle + 100.0)
    seen = []
    for name, obstacles in (('none', ()), ('near', (near,)), ('far', (far,))):
        session_picture([trial], None, tmp_path / f'{name}.png', obstacles)
        seen.append(pixels_of_obstacles(tmp_path / f'{name}.png'))
    none, one, beyond = seen
    assert none == 0
    assert one > 5000
    assert beyond < 1000  # only in the legend: the picture would be a hundred metres wide else
