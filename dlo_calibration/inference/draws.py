# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Draws from what is known of the parameters before a calibration."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from dlo_calibration.inference.uncertainty import Uncertainty
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import spread

EDGE = 0.05  # from the ends of the scale, where no draw lies


def drawn_points(point: Floats, uncertainty: Uncertainty, count: int, seed: int) -> Floats:
    """
    Return draws, (count, d), of what is known: a Latin hypercube, so that few draws cover each parameter.

    :param point: (d,) the best values in the box; a parameter of which nothing is known is drawn
        from one unit around its value.
    """
    generator = np.random.default_rng(seed)
    shares = (np.argsort(generator.random((count, len(point))), axis=0) + 0.5) / count
    normal = np.vectorize(NormalDist().inv_cdf)(shares)
    values, axes = np.linalg.eigh(uncertainty.spread)
    drawn = point + normal @ (axes * np.sqrt(np.maximum(values, 0.0))).T
    return np.clip(np.where(uncertainty.unknown, spread(point, uncertainty.ends, shares), drawn), EDGE,
                   uncertainty.ends - EDGE)
