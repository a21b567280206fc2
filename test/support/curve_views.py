# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Known curves as cameras see them: exact lines, as a perfect tracer finds them, and simple pictures."""

import math

import cv2
import numpy as np

from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Crossing, Trace

SIZE = (1200, 900)
FOCAL_LENGTH = 900.0
DIAMETER = 0.008


def view(tilt=0.0, turn=0.0, distance=0.8, at=(0.0, 0.0, 0.0)):
    """
    Return the scale of a camera that looks at a point.

    :param tilt: angle between its view and straight down [rad].
    :param turn: angle around the vertical [rad]; at 0 the camera stands at the side of -y.
    """
    matrix = np.array([[FOCAL_LENGTH, 0, SIZE[0] / 2], [0, FOCAL_LENGTH, SIZE[1] / 2], [0, 0, 1]])
    cosine, sine = math.cos(turn), math.sin(turn)
    right = np.array([cosine, sine, 0.0])
    back = np.array([sine * math.sin(tilt), -cosine * math.sin(tilt), math.cos(tilt)])
    rotation = np.stack([right, -np.cross(back, right), -back])
    place = np.asarray(at) + distance * back
    return Scale(Lens(SIZE, matrix, np.zeros(5)), rotation, -rotation @ place, np.zeros(4), True)


def traced(points, scale, crossings=(), diameter=DIAMETER, spacing=2.0):
    """
    Return the line of points (n, 3) [m].

    :param crossings: pairs of shares of the curve's length, of the first and of the second passage.
    """
    pixels = scale.to_pixels(points)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], round(along[-1] / spacing))
    even = np.stack([np.interp(at, along, axis) for axis in pixels.T], axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    crossed = []
    for pair in crossings:
        first, second = np.interp(np.array(pair) * lengths[-1], lengths, along)
        pixel = tuple(float(np.interp(first, along, axis)) for axis in pixels.T)
        crossed.append(Crossing(pixel, float(first), float(second), None))
    tangents = np.gradient(points, axis=0)
    aside = np.cross(tangents, scale.camera - points)
    aside *= diameter / 2 / np.linalg.norm(aside, axis=1, keepdims=True)
    edges = scale.to_pixels(points + aside) - scale.to_pixels(points - aside)
    width = float(np.median(np.linalg.norm(edges, axis=1)))
    return Trace(even, np.ones(len(even), bool), width, tuple(crossed))


def curve(bend=0.8, angle=0.2, length=0.5, count=400, height=DIAMETER / 2):
    """Return an S-shaped curve (count, 3) [m] on the table, about its middle."""
    shares = np.linspace(0.0, 1.0, count)
    return laid(angle + bend * np.sin(2 * np.pi * shares), length, height)


def loop(radius=0.045, length=0.6, count=500, height=DIAMETER / 2):
    """
    Return a curve (count, 3) [m] that crosses itself once, and the shares of its length where it does.

    Both ends are straight.
    """
    shares = np.linspace(0.0, 1.0, count)
    turned = 2 * math.pi - 1.2
    arc = turned * radius / length
    points = laid(np.clip((shares - 0.5) / arc + 0.5, 0.0, 1.0) * turned, length, height)
    gaps = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2)
    gaps[np.abs(np.subtract.outer(shares, shares)) < arc / 2] = np.inf
    first, second = np.unravel_index(gaps.argmin(), gaps.shape)
    return points, tuple(sorted((shares[first], shares[second])))


def laid(angles, length, height):
    """Return the curve (n, 3) [m] with directions (n,) [rad], about its middle."""
    steps = length / (len(angles) - 1) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    middles = (steps[1:] + steps[:-1]) / 2
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(middles, axis=0)])
    return np.column_stack([points - points.mean(axis=0), np.full(len(points), height)])


def drawn(points, scale, diameter=DIAMETER, seed=1):
    """Return a photograph (h, w, 3) of a dark DLO with an even colour on a bright table."""
    trace = traced(points, scale, diameter=diameter)
    picture = np.full((SIZE[1], SIZE[0], 3), 205, np.uint8)
    tangents = np.gradient(trace.pixels, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    aside = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    edges = [trace.pixels + side * trace.width / 2 * aside for side in (-1, 1)]
    outline = np.rint(np.concatenate([edges[0], edges[1][::-1]]) * 16).astype(np.int32)
    cv2.fillPoly(picture, [outline], (40, 50, 120), cv2.LINE_AA, 4)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 1.0) + noise, 0, 255).astype(np.uint8)
