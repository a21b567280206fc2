# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sobol points against SciPy's."""

import numpy as np
import pytest
from scipy.stats import qmc

from dlo_calibration.model.parameters import PARAMETERS
from dlo_calibration.search.sobol import DIRECTIONS, Sobol


@pytest.mark.parametrize('seed', [0, 1, 12345])
@pytest.mark.parametrize('dimension', [1, 2, 5, 13, len(DIRECTIONS) + 1])
def test_the_points_are_those_of_scipy_bit_for_bit(dimension, seed):
    ours, theirs = Sobol(dimension, seed), qmc.Sobol(dimension, scramble=True, seed=seed)
    for count in (8, 8, 64, 16):
        assert np.array_equal(ours.random(count), theirs.random(count))


def test_there_are_directions_for_every_parameter():
    assert len(PARAMETERS) <= len(DIRECTIONS) + 1
