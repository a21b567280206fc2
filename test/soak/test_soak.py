# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A short form of each campaign of `make soak`."""

from contextlib import suppress
import importlib
from pathlib import Path

import pytest
from soak import CAMPAIGNS


@pytest.mark.parametrize('name', CAMPAIGNS)
def test_nothing_is_lost_and_nothing_dies(name, tmp_path):
    # A child begins with the peak of its parent, in which other tests may have needed much: forget it.
    with suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5')
    campaign = importlib.import_module(name)
    tally = campaign.conduct(campaign.SHORT, 1, tmp_path)
    assert tally.tried > 0
    assert (tally.lost, tally.died) == (0, 0)
    assert tally.peak < 1e9
