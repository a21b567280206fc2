# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What every format needs of the obstacles of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.scene import Obstacle

COLOUR = (0.5, 0.5, 0.6)  # red, green and blue of obstacles


def corners_and_faces(obstacle: Obstacle) -> tuple[Floats, NDArray[np.int64]]:
    """
    Return the corners (v, 3) [m] of a mesh, scaled, each once, and its triangles (t, 3) as their indices.

    The triangles keep their sense of rotation, also where a negative scale mirrors the mesh.
    """
    triangles = obstacle.triangles * obstacle.sizes
    if np.prod(obstacle.sizes) < 0:
        triangles = triangles[:, ::-1]
    corners, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return corners, faces.reshape(-1, 3)
