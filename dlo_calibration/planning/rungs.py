# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rungs: candidates of a plan are compared with few nodes and long steps before the default ones decide."""

from __future__ import annotations

from dataclasses import replace

from dlo_calibration.calibration.options import Options

LEAST_NODES = 21  # of a coarse DLO; with fewer, a plan is not found faster
LONGEST_STEP = 0.01  # s, of a coarse simulation


def coarser(options: Options) -> Options:
    """Return options with half the segments and twice the time step, within limits."""
    return replace(options, nodes=min(options.nodes, max(options.nodes // 2 + 1, LEAST_NODES)),
                   time_step=max(options.time_step, min(2 * options.time_step, LONGEST_STEP)))
