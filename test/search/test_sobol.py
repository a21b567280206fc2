# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The Sobol sequence."""

import pytest

from dlo_calibration.model.parameters import PARAMETERS
from dlo_calibration.search.sobol import DIRECTIONS, Sobol


def test_every_parameter_may_be_a_coordinate():
    assert len(DIRECTIONS) + 1 >= len(PARAMETERS)


@pytest.mark.parametrize('dimension, seed', [(1, 1), (2, 7), (9, 123), (64, 2**32 - 1)])
def test_its_points_are_those_of_scipy(dimension, seed):
    from scipy.stats import qmc

    expected, sobol = qmc.Sobol(dimension, scramble=True, seed=seed), Sobol(dimension, seed)
    for count in (8, 8, 32):
        assert sobol.points(count).tobytes() == expected.random(count).tobytes()
