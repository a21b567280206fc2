# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Obstacles that stand on the photographed table: from two clicks and a height to a scene."""

from __future__ import annotations

from typing import Mapping, Sequence, Union

import numpy as np

from dlo_calibration.capture.document import Document, ObstacleEntry, PEG
from dlo_calibration.capture.measurement import Measurement
from dlo_calibration.errors import InputError
from dlo_calibration.files.xml import add, document, new_root
from dlo_calibration.model.chain import Floats
from dlo_calibration.report.obstacles import ABOVE, outline
from dlo_calibration.simulation.scene import NO_TRIANGLES, Obstacle
from dlo_calibration.vision.scale import Scale

SMALLEST, LARGEST = 5e-4, 5.0  # m, of an edge or a diameter
ON_CIRCLE = 4  # of the corners of a circle, one of so many is drawn

PlacedObstacle = Union[Obstacle, InputError]  # the error says why it cannot be placed


def place_obstacles(document: Document, photographs: Mapping[str, Measurement]) -> tuple[PlacedObstacle, ...]:
    """
    Return the obstacles of a document in the frame of the table, in its order.

    :param photographs: the measurement of each photograph, by its id.
    """
    return tuple(_placed(entry, photographs[entry.photograph].scale, f'obstacle {number}')
                 for number, entry in enumerate(document.obstacles, start=1))


def _placed(entry: ObstacleEntry, scale: Scale | None, name: str) -> PlacedObstacle:
    if scale is None:
        return InputError(name, 'a photograph without a scale', 'one with a scale',
                          'give it a scale, or remove the obstacle')
    try:
        first, second = scale.to_table([entry.first, entry.second], entry.height)
    except InputError:
        return InputError(name, f'a top that the camera does not see {entry.height:g} m above the table',
                          'a height below the camera', 'correct its height, or its clicks')
    across = (second - first)[:2]
    if entry.kind == PEG:
        radius = float(np.linalg.norm(across))
        shape, sizes, least, most = 'cylinder', [entry.height, radius], 2 * radius, 2 * radius
        middle, turn = first, 0.0
    else:
        turn = entry.turn
        cosine, sine = np.cos(turn), np.sin(turn)
        edges = np.abs([cosine * across[0] + sine * across[1], cosine * across[1] - sine * across[0]])
        shape, sizes, least, most = 'box', [*edges, entry.height], edges.min(), edges.max()
        middle = (first + second) / 2
    if not SMALLEST <= least <= most <= LARGEST:
        return InputError(name, f'{1e3 * least:.3g} mm between its clicks', f'{1e3 * SMALLEST:g} mm to '
                          f'{LARGEST:g} m in each direction', 'move one of its clicks')
    return Obstacle(shape, np.array(sizes), np.array([middle[0], middle[1], entry.height / 2]),
                    np.array([0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)]), 1.0, NO_TRIANGLES)


def lines_around(obstacle: Obstacle) -> list[Floats]:
    """Return the closed lines around its top and its foot, each (n, 3) [m]."""
    line = outline(obstacle, ABOVE)[::ON_CIRCLE if obstacle.shape == 'cylinder' else 1]
    line = np.concatenate([line, line[:1]])
    return [np.column_stack([line, np.full(len(line), height)]) for height in (2 * obstacle.position[2], 0.0)]


def seen_lines(lines: Sequence[Floats], scale: Scale) -> list[Floats]:
    """Return lines, each (n, 3) [m], in a photograph, each (n, 2) [px]; without those behind the camera."""
    pixels = scale.to_pixels(np.concatenate([*lines, np.zeros((0, 3))]))
    pieces = np.split(pixels, np.cumsum([len(line) for line in lines]))[:len(lines)]
    return [piece for piece in pieces if np.isfinite(piece).all()]


def scene_document(obstacles: Sequence[Obstacle]) -> bytes:
    """Return a URDF file with cylinders and boxes, which `read_scene` reads."""
    root = new_root('robot', name='obstacles')
    link = add(root, 'link', name='obstacles')
    for obstacle in obstacles:
        collision = add(link, 'collision')
        turn = 2 * np.arctan2(obstacle.turn[2], obstacle.turn[3])
        add(collision, 'origin', xyz=_text(obstacle.position), rpy=_text([0.0, 0.0, turn]))
        geometry = add(collision, 'geometry')
        if obstacle.shape == 'box':
            add(geometry, 'box', size=_text(obstacle.sizes))
        else:
            add(geometry, 'cylinder', length=_text(obstacle.sizes[:1]), radius=_text(obstacle.sizes[1:]))
    return document(root)


def _text(numbers: Sequence[float] | Floats) -> str:
    return ' '.join(repr(float(number)) for number in numbers)
