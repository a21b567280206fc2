# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chains that are bent to an arc, for what depends on how a DLO is bent at the start."""

from calibrated import LENGTH, LEVEL
import numpy as np

from dlo_calibration import Chain


def arc(angle=1.0, points=21, length=LENGTH, height=LEVEL):
    """Return a DLO that lies on the table from the origin along x, and turns to the left by `angle` [rad]."""
    turned = angle * np.linspace(0, 1, points)
    across = np.column_stack([np.sin(turned), 1 - np.cos(turned)]) * length / angle
    return Chain(np.column_stack([across, np.full(points, height)]))
