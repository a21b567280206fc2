# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Whether two calibrations are of the same DLO: false alarms, changes that are found, and their names."""

import numpy as np
import pytest

from dlo_calibration.inference.comparison import compare

# EI and friction are known together; the third parameter is not known at all.
BEFORE = np.array([[4e-6, -2e-6, 0.0], [-2e-6, 9e-6, 0.0], [0.0, 0.0, 1 / 12]])
DRAWS = 400


def comparisons(change, covariance=BEFORE):
    """Return comparisons of calibrations with random errors, after a true change."""
    generator = np.random.default_rng(3)
    errors = generator.multivariate_normal(np.zeros(3), 2 * covariance, DRAWS)
    errors[:, 2] = np.clip(errors[:, 2], -1, 1)
    return [compare(change + error, covariance, covariance) for error in errors]


def test_unchanged_parameters_are_seldom_called_changed():
    alarms = sum(each.changed.any() for each in comparisons(np.zeros(3)))
    assert 0.005 * DRAWS < alarms < 0.06 * DRAWS  # 3 % are expected


@pytest.mark.parametrize('k', [0, 1])
def test_a_change_is_found_and_named(k):
    change = 6 * np.sqrt(2 * BEFORE[k, k]) * np.eye(3)[k]
    found = comparisons(change)
    assert sum(each.changed.any() for each in found) > 0.97 * DRAWS
    assert sum(each.changed.tolist() == [n == k for n in range(3)] for each in found) > 0.9 * DRAWS
    inside = [each.lower[k] <= change[k] <= each.upper[k] for each in found]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.04)


def test_what_only_two_parameters_together_tell_is_compared():
    flat = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    covariance = 1e-6 * np.eye(3) + 0.05 * np.outer(flat, flat)
    assert not compare(0.2 * flat, covariance, covariance).changed.any()
    across = compare(0.02 * np.array([1.0, -1.0, 0.0]), covariance, covariance)
    assert across.changed.any()
    assert across.agreement < 1e-6


def test_nothing_known_tells_nothing():
    comparison = compare(np.array([0.3]), np.eye(1) / 12, np.eye(1) / 12)
    assert np.isnan(comparison.agreement)
    assert not comparison.changed.any()
