# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""When the errors of left-out trials count as smaller."""

import numpy as np
import pytest

from dlo_calibration.inference.cross_validation import predicts_better

MANY = np.array([0.9, 0.5, 0.4, 0.9, 1.02, 0.9, 0.8, 0.9])


@pytest.mark.parametrize('shares, better', [
    ([0.8] * 4, True),
    ([0.99] * 4, False),  # too little
    ([0.1, 0.9, 0.9, 1.1], False),  # one trial does not decide
    (MANY, True),
    ([0.9, 0.5, 0.4, 1.1, 1.2, 0.9, 0.8, 1.1], False),
    ([0.5], False),
], ids=['all', 'too little', 'one of four', 'nearly all', 'most', 'a single one'])
def test_errors_are_smaller_only_if_those_of_nearly_all_trials_are(shares, better):
    before = np.array([5.0, 4.0, 6.0, 5.0] * 2)[:len(shares)] * 1e-3
    assert predicts_better(np.array(shares) * before, before) is better


def test_errors_far_below_any_measurement_count_as_equal():
    assert not predicts_better(MANY * 1e-9, np.full(8, 1e-9))
