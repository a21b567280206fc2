# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A compiler that takes its time, for processes that import it."""

import time

SECONDS = 1000.0


def compile_slowly(module):
    time.sleep(SECONDS)


def compile_at_once(module):
    """Compile nothing."""
