# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A rod of known stiffness that hangs in a loop between two clamps, and photographs of it."""

from functools import lru_cache

import cv2
import numpy as np
from photographs import Camera, Look, photograph
from rods_at_rest import hung
from scipy.integrate import solve_bvp

BENDING, MASS, LENGTH, GAP, RADIUS = 3.5e-4, 0.03, 1.0, 0.2, 0.002  # N m^2, kg, m between the clamps, m, m
IN_CLAMP, LEAVES = 0.01, np.radians(-30.0)  # m; direction in which the loop leaves the first clamp
SIZE = (1600, 1200)  # px


@lru_cache
def loop():
    """
    Return the shape (301, 2) of the loop, right and up [m], from clamp to clamp, and its ends in the clamps.

    It is the planar elastica between two clamps (Antman, Nonlinear Problems of Elasticity, 2nd ed., 4.2),
    which no engine of ours has computed, except the guess where its solution begins.
    """
    weight = MASS * 9.81 / LENGTH
    away = np.array([np.cos(LEAVES), np.sin(LEAVES)])
    step = LENGTH / 58
    held = {0: (-step * away[0], 0, 1 - step * away[1]), 1: (0, 0, 1), 59: (GAP, 0, 1),
            60: (GAP + step * away[0], 0, 1 - step * away[1])}
    guess = hung(BENDING, held, MASS * 60 / 58, length=60 * step)
    flat = guess[1:-1, [0, 2]] - [0, 1]
    places = np.linspace(0, LENGTH, len(flat))
    angle = np.unwrap(np.arctan2(*np.gradient(flat, axis=0).T[::-1]))

    def slope(s, y, force):
        moment = force[0] * np.sin(y[2]) - (force[1] + weight * s) * np.cos(y[2])
        return np.vstack([np.cos(y[2]), np.sin(y[2]), y[3], moment / BENDING])

    def ends(first, last, _):
        return np.array([*first[:2], first[2] - LEAVES, last[0] - GAP, last[1], last[2] + LEAVES])

    solved = solve_bvp(slope, ends, places, np.vstack([*flat.T, angle, np.gradient(angle, places)]),
                       p=(0.05, -weight * LENGTH / 2), tol=1e-6, max_nodes=20000)
    assert solved.success, solved.message
    shape = solved.sol(np.linspace(0, LENGTH, 301))[:2].T
    middle = shape.mean(axis=0)
    into = IN_CLAMP * np.array([-away, [away[0], -away[1]]])
    return shape - middle, shape[[0, -1]] + into - middle


def view(**changes):
    """Return a camera that looks squarely at the loop."""
    return Camera(**{'size': SIZE, 'focal_length': 1900.0, 'distance': 1.15, **changes})


@lru_cache
def picture(camera, seed=1):
    """Return a photograph of the loop before a wall, which is the renderer's table."""
    shape, ends = loop()
    whole = np.concatenate([ends[:1], shape, ends[1:]])
    curve = np.column_stack([whole, np.full(len(whole), RADIUS)])
    drawn = photograph(camera, curve, RADIUS, Look(), seed)
    for mouth, end in zip(shape[[0, -1]], ends, strict=True):
        into = (end - mouth) / np.linalg.norm(end - mouth)
        aside = 0.012 * np.array([-into[1], into[0]])
        corners = np.array([mouth + aside, mouth - aside, mouth - aside + 0.05 * into,
                            mouth + aside + 0.05 * into])
        cv2.fillConvexPoly(drawn, np.rint(pixels(camera, corners)).astype(np.int32), (40, 40, 45))
    return drawn


def pixels(camera, points):
    """Return where a camera shows points (n, 2) of the loop [px]."""
    return camera.project(np.column_stack([points, np.full(len(points), RADIUS)]))
