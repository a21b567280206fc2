# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The line that fits what is seen keeps its length, its bends, and what it knows of them."""

import numpy as np
import pytest

from dlo_calibration.vision.elastic import Evidence, fitted

SPACING = 4.0  # px
COUNT = 101
BEND = 0.05  # px


def known(measured, expected, ends, seen=None):
    """Return the evidence for lines (n, 2) of one width; `seen` (n,) 0 or 1."""
    seen = np.ones(COUNT) if seen is None else seen
    return Evidence(measured, seen / 0.5 ** 2, expected, np.full(COUNT, 1 / 50.0 ** 2), 0.2 / 50.0 ** 2,
                    np.full(COUNT - 1, SPACING), np.full(COUNT - 1, 1 / (0.02 * SPACING) ** 2),
                    1 / BEND ** 2, np.ones(COUNT - 2), ends, np.full(2, 1 / 0.5 ** 2))


def segments(line):
    return np.linalg.norm(np.diff(line, axis=0), axis=1)


def test_a_part_that_looked_longer_while_it_was_in_the_air_has_its_length_again_at_once():
    straight = np.column_stack([SPACING * np.arange(COUNT), np.zeros(COUNT)])
    steps = SPACING * np.where(np.arange(COUNT - 1) < 70, 0.985, 1.035)
    expected = np.column_stack([np.concatenate([[0.0], np.cumsum(steps)]), np.zeros(COUNT)])
    line = fitted(expected, known(straight, expected, straight[[0, -1]]))
    assert segments(line) == pytest.approx(SPACING, rel=0.002)


def test_what_is_hidden_moves_along_with_what_is_seen_beside_it_and_keeps_its_bends():
    angle = 2.0 * np.arange(COUNT) / COUNT
    radius = SPACING * COUNT / 2.0
    arc = radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    seen = (np.abs(np.arange(COUNT) - 50) > 20).astype(float)
    now = arc + (9.0, -12.0)
    rough = np.where(seen[:, None] > 0, now, 0.0)  # what is measured behind a hand is nonsense
    line = fitted(arc, known(rough, arc, now[[0, -1]], seen))
    assert np.linalg.norm(line - now, axis=1).max() < 1.0
