# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The parts of a DLO that a picture shows are found along the places that have its colour."""

import cv2
import numpy as np

from dlo_calibration.vision.line_search import paths


def test_paths_run_along_areas_the_longest_first():
    mask = np.zeros((60, 120), np.uint8)
    cv2.line(mask, (10, 10), (40, 10), 1, 4)
    cv2.line(mask, (10, 40), (110, 50), 1, 4)
    mask[:, 60] = 0  # a scratch is no gap
    found = paths(mask > 0, 2)
    assert len(found) == 2
    for path, ends in zip(found, ([(10, 40), (110, 50)], [(10, 10), (40, 10)]), strict=True):
        ends = 2.0 * np.array(ends)
        off = [np.linalg.norm(path[[0, -1]] - one, axis=1).max() for one in (ends, ends[::-1])]
        assert min(off) < 8
