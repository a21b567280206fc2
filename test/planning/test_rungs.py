# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A coarse simulation has fewer nodes and longer steps, where there is room for that."""

import pytest

from dlo_calibration import Options
from dlo_calibration.planning.rungs import coarser


@pytest.mark.parametrize(('given', 'found'), [
    ((41, 0.003), (31, 0.004)), ((81, 0.0015), (61, 0.002)), ((25, 0.009), (21, 0.01)),
    ((8, 0.02), (8, 0.02))])
def test_it_is_coarser_within_limits(given, found):
    options = coarser(Options(nodes=given[0], time_step=given[1]))
    assert (options.nodes, options.time_step) == pytest.approx(found)
