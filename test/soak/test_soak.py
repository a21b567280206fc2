# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A little of the campaigns of `make soak` that show more than all other tests: memory, and native code."""

import importlib

import pytest
from soak import CAMPAIGNS


@pytest.mark.parametrize('name', CAMPAIGNS)
def test_every_campaign_can_be_conducted(name):
    campaign = importlib.import_module(name)
    assert callable(campaign.conduct)
    assert campaign.FULL > 0


@pytest.mark.pybullet
@pytest.mark.parametrize(('name', 'amount'), [
    pytest.param('bombs', 1, marks=pytest.mark.long), ('scenes', 10)])
def test_nothing_is_lost_and_nothing_dies(name, amount, tmp_path):
    tally = importlib.import_module(name).conduct(amount, 1, tmp_path)
    assert tally.tried == amount
    assert (tally.lost, tally.died) == (0, 0)
    assert tally.peak < 1e9
