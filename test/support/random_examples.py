# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""How many random examples a test draws: few in `make test`, ten times as many in `make soak`."""

from hypothesis import settings

USUAL = 100  # examples that Hypothesis draws by default; the profile of `make soak` has another number


def drawing(count: int, **others: object) -> settings:
    """Return the settings of a test that draws so many examples in `make test`; `others` as in Hypothesis."""
    return settings(max_examples=count * settings.default.max_examples // USUAL, **others)
