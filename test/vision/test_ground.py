# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The ground of the first image is known again, in another light, too; a hand is not taken for it."""

import cv2
import numpy as np
import pytest

from dlo_calibration.vision.appearance import Appearance
from dlo_calibration.vision.ground import Ground
from dlo_calibration.vision.middle_line import colours_at

HALF = 6.0  # px
LINE = np.column_stack([np.linspace(60.0, 340.0, 71), np.full(71, 100.0)])
OTHER = 6.0  # distance in L, a, b, from which on something else than the ground is seen


def picture(edge):
    """Return a grey DLO on a brown table, beside white paper whose edge passes so far below it [px]."""
    pixels = np.full((200, 400, 3), (84, 48, 28), np.uint8)
    pixels[round(100 + edge):] = (235, 235, 230)
    cv2.line(pixels, (60, 100), (340, 100), (128, 128, 135), round(2 * HALF), cv2.LINE_AA)
    noise = np.random.default_rng(0).normal(0.0, 2.5, pixels.shape)
    return np.clip(cv2.GaussianBlur(pixels, (0, 0), 1.0) + noise, 0, 255).astype(np.uint8)


def differences(first, now, points):
    """Return how much else an image shows than the ground of the first one, at points (k, m, 2) [px]."""
    dlo = Appearance.of(picture(30), LINE, HALF, None)
    ground = Ground(first, None, LINE, np.full(len(LINE), HALF))
    return ground.differences(colours_at(now, points), points, None, dlo.colours)


def rows_beside(edge):
    """Return rows (k, 6, 2) of points [px] across the edge of paper, as far from the DLO as its shadow."""
    u, v = np.meshgrid(np.arange(80.0, 320.0, 8.0), 100 + edge + np.linspace(-4.0, 6.0, 6))
    return np.stack([u.T, v.T], axis=2)


@pytest.mark.parametrize('edge', [9, 12, 30])
@pytest.mark.parametrize('light', [1.0, 0.6])
def test_the_ground_is_known_again_where_paper_begins_beside_the_dlo(edge, light):
    first = picture(edge)
    # Light is proportional to the value to the power of 2.2.
    now = np.rint(255 * (light * (first / 255.0) ** 2.2) ** (1 / 2.2)).astype(np.uint8)
    assert differences(first, now, rows_beside(edge)).max() < OTHER


def test_a_hand_is_not_the_ground():
    first = picture(12)
    hand = np.full_like(first, (222, 165, 135))
    assert differences(first, hand, rows_beside(12)).min() > 2 * OTHER


def test_where_the_dlo_hides_the_ground_on_both_sides_nothing_is_strange():
    first = picture(30)
    first[80:120] = first[100, 200]
    hand = np.full_like(first, (222, 165, 135))
    points = np.stack(np.meshgrid(np.arange(80.0, 320.0, 8.0), [99.0, 100.0, 101.0], indexing='ij'), axis=2)
    assert differences(first, hand, points).max() < 1e-6
