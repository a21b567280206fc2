# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Cameras above a table, and what they see of a flat sheet on it."""

import math

import cv2
import numpy as np

from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.scale import Scale

SIZE = 1600, 1200
LENGTH = 26.0 / math.hypot(36.0, 24.0) * math.hypot(*SIZE)  # px, of a telephone's camera


def overhead(tilt=20.0, turn=30.0, distance=0.8, length=LENGTH, size=SIZE, coefficients=(),
             target=(0.0, 0.0)):
    """Return the scale of a camera that looks at a point of the table; angles in degrees."""
    polar, azimuth = math.radians(tilt), math.radians(turn)
    aside = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    back = math.sin(polar) * aside + [0.0, 0.0, math.cos(polar)]
    right = np.array([-aside[1], aside[0], 0.0])
    rotation = np.stack([right, np.cross(-back, right), -back])
    place = np.array([*target, 0.0]) + distance * back
    matrix = [[length, 0.0, (size[0] - 1) / 2], [0.0, length, (size[1] - 1) / 2], [0.0, 0.0, 1.0]]
    return Scale(Lens(size, matrix, coefficients), rotation, -rotation @ place, np.zeros(1), True)


def on_table(points, height=0.0):
    """Return points (n, 2) of the table as points (n, 3)."""
    points = np.asarray(points, float)
    return np.column_stack([points, np.broadcast_to(height, len(points))])


def seen_sheet(camera, sheet, width, height, origin=(0.0, 0.0), turn=0.0, noise=2.0, seed=0):
    """
    Return the picture (h, w, 3) of a sheet of paper on a grey table.

    :param sheet: (rows, columns) grey values, 0 to 255, of a sheet with a width and height [m].
    :param origin: place (2,) of its lower left corner on the table [m].
    :param turn: of the sheet, anticlockwise [degrees].
    """
    columns, rows = camera.size
    step = 8  # px, between the pixels that are followed to the table
    u, v = np.meshgrid(np.arange(0, columns + step, step), np.arange(0, rows + step, step))
    places = camera.points(np.stack([u.ravel(), v.ravel()], axis=1))[:, :2]
    x, y = turned(places - origin, -turn).T
    v, u = np.mgrid[:rows, :columns].astype(np.float32) / step
    at = [cv2.remap((axis * len(sheet) / height - 0.5).reshape(rows // step + 1, -1), u, v, cv2.INTER_LINEAR)
          .astype(np.float32) for axis in (x, height - y)]
    middle = [[(columns - 1) / 2.0, (rows - 1) / 2.0]]
    pixel = float(camera.metres_per_pixel(middle)[0]) * len(sheet) / height  # in the sheet's
    soft = cv2.GaussianBlur(sheet.astype(np.float32) * 0.7 + 40.0, (0, 0), max(0.5 * pixel, 0.5))
    grey = cv2.remap(soft, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=130.0)
    grey += np.random.default_rng(seed).normal(scale=noise, size=grey.shape)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def turned(points, angle):
    """Turn points (n, 2) anticlockwise about the origin [degrees]."""
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return np.asarray(points) @ np.array([[cosine, sine], [-sine, cosine]])
